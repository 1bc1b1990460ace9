"""The normals of a mesh before its decimation, as an image over the decimated one: glTF's normal texture.

Each texel is told the normal of the fine mesh's point that is closest within REACH times the decimation's error, in the
tangent frame that viewers make of the file by themselves (`mesh/tangents.py`). Both sides of a seam tell one direction,
each in its own frame. Where there is none, and between charts, the surface keeps its normal. Rays along the normals
meet the same: on a relief the map's error is .896 degrees by closest points, .894 by rays, at 1.1 times the time.

Frames are those of the mesh as it was decimated. Moved afterwards, by registration or refinement, it takes its relief
along.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import cv2
import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.atlas.build import covered_share
from advtex_engine.atlas.charting import split_faces
from advtex_engine.core.scene import Atlas, Mesh, face_areas
from advtex_engine.mesh.borders import median_edge
from advtex_engine.mesh.closest import ClosestPoints
from advtex_engine.mesh.detail import Detail
from advtex_engine.mesh.normals import vertex_normals
from advtex_engine.mesh.tangents import TangentFrames
from advtex_engine.render.texels import map_texels, surface_points

FLAT = (128, 128, 255)
PER_EDGE = 1
"""Texels along an edge of the fine mesh. With 2 a sheet of waves that was 7.6 degrees off is .25 degrees off instead of
.29, for four times the bytes and the time."""
SCALES = (0.5, 1, 2)
"""Sides of the image that is baked, of the texture's. More than 1 is averaged to 1; at less than half, charts would
touch each other."""
MAX_FINER = 4096  # texels a side of a baked image that is larger than the texture
REACH = 2  # of the decimation's error
LEAST_HEIGHT = 0.1  # of a normal over the surface: what turns away further is the surface's edge, or its back
PART_FACES = 4_000  # of the decimated mesh at once: bounds the memory, whatever the fine mesh has


def bake_normals(detail: Detail, atlas: Atlas) -> Tensor:
    """[h,w,3] uint8: (x, y, z) from -1 to 1 as 0 to 255, x along u, y to the first row, z out of the surface.

    atlas: of the mesh that was decimated, its vertices and faces in that order; h and w are its sides or half of them.
    """
    mesh = replace(atlas.mesh.to(torch.device("cpu")), v_pos=detail.v_pos)
    side = math.sqrt(float(face_areas(mesh).sum()) / (covered_share(mesh) * atlas.width * atlas.height))
    scales = [scale for scale in SCALES if scale <= 1 or scale * atlas.width <= MAX_FINER]
    scale = next((scale for scale in scales if PER_EDGE * side <= scale * median_edge(detail.fine)), scales[-1])
    width, height = round(atlas.width * scale), round(atlas.height * scale)
    image = flat_map(width, height)
    for texel, normal in _normals(detail, replace(atlas, mesh=mesh, width=width, height=height)):
        image.view(-1, 3)[texel] = encode_normals(normal)
    if scale > 1:
        averaged = cv2.resize(image.numpy(), (atlas.width, atlas.height), interpolation=cv2.INTER_AREA)
        return torch.from_numpy(averaged)
    return image


def flat_map(width: int, height: int) -> Tensor:
    """[height,width,3] uint8: the surface as it is."""
    return torch.tensor(FLAT, dtype=torch.uint8).repeat(height, width, 1)


def encode_normals(normals: Tensor) -> Tensor:
    """[N,3] uint8 of vectors of any length."""
    return ((F.normalize(normals, dim=1) + 1) * 127.5).round().to(torch.uint8)


def decode_normals(texels: Tensor) -> Tensor:
    """Unit vectors [N,3] float32 of texels [N,3] in [0,255], or between them."""
    return F.normalize(texels / 127.5 - 1, dim=1)


def _normals(detail: Detail, atlas: Atlas) -> Iterator[tuple[Tensor, Tensor]]:
    """Texels [N] and the fine mesh's normals there [N,3], unit vectors in the frames of the atlas's mesh."""
    mesh, fine, reach = atlas.mesh, detail.fine, REACH * detail.error
    texels, frames, smooth = map_texels(atlas), TangentFrames.of(mesh), vertex_normals(fine)
    points = surface_points(mesh, texels)
    low, high = _bounds(fine)
    parts = split_faces(mesh.v_pos.numpy(), mesh.t_pos_idx.numpy(), PART_FACES)
    part_of_face = torch.empty(len(mesh.t_pos_idx), dtype=torch.int64)
    for number, part in enumerate(parts):
        part_of_face[torch.from_numpy(part)] = number
    part_of_texel = part_of_face[texels.face]
    for number in range(len(parts)):
        mine = (part_of_texel == number).nonzero()[:, 0]
        if len(mine) == 0:
            continue
        frame, point = frames.at(texels.face[mine], texels.barycentric[mine]), points[mine]
        inside = ((high >= point.amin(0) - reach) & (low <= point.amax(0) + reach)).all(1).nonzero()[:, 0]
        if len(inside) == 0:
            continue
        used, local = torch.unique(fine.t_pos_idx[inside], return_inverse=True)
        near = Mesh(fine.v_pos[used], local)
        found = ClosestPoints(near).find(point, frame[:, 2], within=reach)
        normal = F.normalize(found.mix(smooth[used], local), dim=1)
        normal = (frame @ normal[..., None])[..., 0]
        there = (found.distance <= reach) & (normal[:, 2] >= LEAST_HEIGHT)
        yield texels.texel[mine[there]], normal[there]


def _bounds(mesh: Mesh) -> tuple[Tensor, Tensor]:
    """The least and the greatest coordinates [T,3] of each face."""
    corners = [mesh.v_pos[corner] for corner in mesh.t_pos_idx.T]
    low, high = torch.minimum(corners[0], corners[1]), torch.maximum(corners[0], corners[1])
    return torch.minimum(low, corners[2], out=low), torch.maximum(high, corners[2], out=high)

"""Texel -> surface: which face each texel of an atlas shows, and which point of it.

The atlas is drawn like an image: its uv triangles lie in the plane z = 1 before a camera whose pixels are the texels.
Bilinear sampling reads texels whose centres lie just outside their chart, so each chart is continued by REACH texels
in the plane of the face beside them.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from advtex_engine.core.scene import Atlas, Camera, Mesh
from advtex_engine.render.filtering import greatest
from advtex_engine.render.rasterize import rasterize

REACH = 2  # texels; the padding that charts have
STEP = 0.5  # texels between the places at which the texels under a thin face are looked for
# A texel outside its face is extrapolated, that of a sliver by no more than this (a corner has 2/3).
MAX_FROM_CENTROID = 5 / 3


@dataclass(frozen=True)
class TexelMap:
    """The N texels that show surface, in row-major order.

    texel: [N] int64, index into the flattened height x width texture. face: [N] int64.
    barycentric: [N,3] float32 weights of the face's corners; beyond [0, 1] for texels outside of their chart.
    """

    texel: Tensor
    face: Tensor
    barycentric: Tensor


def map_texels(atlas: Atlas) -> TexelMap:
    """Face and point of every texel on a chart or at most REACH texels beside one. Not differentiable."""
    mesh = atlas.mesh
    assert mesh.v_uv is not None
    assert mesh.t_uv_idx is not None
    position = torch.ones((len(mesh.v_uv), 3), device=mesh.v_uv.device)
    position[:, :2] = mesh.v_uv * mesh.v_uv.new_tensor([atlas.width, atlas.height])
    identity = torch.eye(4, dtype=torch.float64)
    camera = Camera(identity[:3, :3], identity, atlas.width, atlas.height)
    fragments = rasterize(Mesh(position, mesh.t_uv_idx), camera)
    inside = fragments.face_index.flatten() >= 0
    corners = position[:, :2][mesh.t_uv_idx]
    face = _grow(_with_thin_parts(fragments.face_index, corners), REACH).flatten()
    texel = (face >= 0).nonzero()[:, 0]
    barycentric = fragments.barycentric.view(-1, 3)[texel]
    face = face[texel].long()
    outside = ~inside[texel]
    corners = corners[face[outside]].double()
    center = torch.stack((texel[outside] % atlas.width, texel[outside] // atlas.width), 1) + 0.5
    barycentric[outside] = _barycentric(corners, center.double()).to(barycentric)
    return TexelMap(texel, face, barycentric)


def surface_points(mesh: Mesh, texels: TexelMap) -> Tensor:
    """World positions [N,3] float32 of the texels' centres, metres."""
    corner = mesh.t_pos_idx[texels.face]
    points = mesh.v_pos[corner[:, 0]] * texels.barycentric[:, :1]
    for side in (1, 2):
        points += mesh.v_pos[corner[:, side]] * texels.barycentric[:, side : side + 1]
    return points


def _with_thin_parts(face: Tensor, corners: Tensor) -> Tensor:
    """[H,W] with texels of nobody (-1) given to faces [T,3,2] that run over them, but not over their centers.

    A chart of less than a texel's width, or a needle's end, would else have no texels, and be drawn in the color of
    whatever lies beside it. Such faces are followed along their sides and from their corners to their middle.
    """
    height, width = face.shape

    def texel_at(points: Tensor) -> Tensor:
        column, row = points.long().unbind(-1)
        return row.clamp(0, height - 1) * width + column.clamp(0, width - 1)

    marks = torch.cat((corners, corners.mean(1, keepdim=True)), 1)
    places, drawn = texel_at(marks), torch.bincount(face[face >= 0].long(), minlength=len(corners)) > 0
    out, far = ((owner.flatten()[places] < 0).any(1) for owner in (face, _grow(face, REACH - 1)))
    thin = (out & (~drawn | (_heights(corners) < 1)) | far).nonzero()[:, 0]
    start, end = marks[thin][:, [[0, 1], [1, 2], [2, 0], [0, 3], [1, 3], [2, 3]]].flatten(0, 1).unbind(1)
    steps = ((end - start).norm(dim=1) / STEP).ceil().long() + 1
    line = torch.arange(len(steps), device=face.device).repeat_interleave(steps)
    step = torch.arange(len(line), device=face.device) - (steps.cumsum(0) - steps)[line]
    share = step / (steps[line] - 1).clamp(min=1)
    texel = texel_at(torch.lerp(start[line], end[line], share[:, None]))
    free = face.flatten()[texel] < 0
    owner = thin[line[free] // 6].to(face.dtype)
    return face.flatten().scatter_reduce(0, texel[free], owner, "amax").view_as(face)


def _heights(corners: Tensor) -> Tensor:
    """[T] of triangles [T,3,2] over their longest sides."""
    sides = corners.roll(-1, 1) - corners
    twice = (sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0]).abs()
    height: Tensor = twice / sides.norm(dim=2).amax(1).clamp(min=1e-9)
    return height


def _grow(face: Tensor, steps: int) -> Tensor:
    """Empty texels (-1) of [H,W] take a face of their eight neighbors, `steps` times; the highest index wins."""
    for _ in range(steps):
        face = torch.where(face >= 0, face, greatest(face, 1))
    return face


def _barycentric(corners: Tensor, points: Tensor) -> Tensor:
    """Barycentric coordinates [N,3] of points [N,2] in triangles [N,3,2], far ones drawn in towards the face."""
    a, b, c = corners.unbind(1)
    side, other, offset = b - a, c - a, points - a
    area = side[:, 0] * other[:, 1] - side[:, 1] * other[:, 0]
    area = torch.where(area.abs() < 1e-9, 1e-9, area)
    second = (offset[:, 0] * other[:, 1] - offset[:, 1] * other[:, 0]) / area
    third = (side[:, 0] * offset[:, 1] - side[:, 1] * offset[:, 0]) / area
    from_centroid = torch.stack((1 - second - third, second, third), 1) - 1 / 3
    reach = from_centroid.abs().amax(1, keepdim=True)
    return 1 / 3 + from_centroid * (MAX_FROM_CENTROID / reach).clamp(max=1)

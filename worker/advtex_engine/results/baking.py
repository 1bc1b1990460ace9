"""A textured model with fewer faces and texels: its mesh decimated, given an atlas of its own, and painted anew.

Decimating along the charts of the full model would stop at their borders, of which a room has thousands.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from advtex_engine.atlas.build import SIZE_STEP, new_atlas
from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import Atlas, Mesh, face_areas
from advtex_engine.mesh.clean import decimate
from advtex_engine.mesh.closest import ClosestPoints
from advtex_engine.mesh.tangents import TangentFrames
from advtex_engine.render.pictures import to_bytes
from advtex_engine.render.texels import map_texels, surface_points
from advtex_engine.render.texture import fill_holes, sample_image
from advtex_engine.results.normal_map import decode_normals, encode_normals, flat_map

SOFTENED = 1.4
"""Texels of the source along a texel's side: from here on the source is averaged before it is sampled, else it would
flicker. The kernel stays within the padding of the charts, so that they do not run into each other."""
KERNEL = np.array([0.25, 0.5, 0.25])
SHARPENED = 3
"""Rounds by which an averaged image is sharpened against the viewer's bilinear filter. With it and bicubic samples the
first level of detail of a kitchen is .039 LPIPS from the full model, without either .079. An image that is not averaged
becomes worse by it."""
BILINEAR = np.array([0.125, 0.75, 0.125])
"""What is left of a texel where an image is drawn at twice its size, bilinearly, and averaged again."""
ROW = 1 << 14  # samples in a row: OpenCV takes no more than 32,767


@dataclass(frozen=True)
class TexturedModel:
    """A model on the CPU. texture: [atlas.height,atlas.width,3] uint8 sRGB. normal_map: of `bake_normals`, if any."""

    atlas: Atlas
    texture: Tensor
    normal_map: Tensor | None = None

    @staticmethod
    def of(atlas: Atlas, texture: Tensor, normal_map: Tensor | None = None) -> TexturedModel:
        """texture: uint8 sRGB or float in [0,1], on any device."""
        cpu = torch.device("cpu")
        return TexturedModel(replace(atlas, mesh=atlas.mesh.to(cpu)), torch.from_numpy(to_bytes(texture)), normal_map)

    @property
    def faces(self) -> int:
        return len(self.atlas.mesh.t_pos_idx)

    @property
    def texels(self) -> int:
        """Those that faces cover."""
        return round(float(self._face_texels.sum()))

    def texels_of(self, faces: Tensor) -> int:
        """Those that these faces [N] cover."""
        return round(float(self._face_texels[faces].sum()))

    @cached_property
    def _face_texels(self) -> Tensor:
        mesh = self.atlas.mesh
        assert mesh.v_uv is not None and mesh.t_uv_idx is not None
        size = mesh.v_uv.new_tensor([self.atlas.width, self.atlas.height], dtype=torch.float64)
        a, b, c = (mesh.v_uv.double() * size)[mesh.t_uv_idx].unbind(1)
        side, other = b - a, c - a
        return (side[:, 0] * other[:, 1] - side[:, 1] * other[:, 0]).abs() / 2

    @cached_property
    def density(self) -> Tensor:
        """[T] float64: texels per square metre of each face."""
        return self._face_texels / face_areas(self.atlas.mesh).clamp(min=1e-12)

    @cached_property
    def closest(self) -> ClosestPoints:
        return ClosestPoints(self.atlas.mesh)


@dataclass(frozen=True)
class Baked:
    """A model that was painted from another one. error: metres, how far their surfaces are apart (99.9 % of texels)."""

    model: TexturedModel
    error: float


def smaller(source: TexturedModel, faces: int, share: float, side: int, monitor: Monitor) -> Baked:
    """The source with at most `faces` faces, and `share` of its texels in an image with sides of at most `side`."""
    bare = Mesh(source.atlas.mesh.v_pos, source.atlas.mesh.t_pos_idx)
    return bake(source, decimate(bare, faces, monitor), share, side, monitor)


def bake(source: TexturedModel, mesh: Mesh, share: float, side: int, monitor: Monitor) -> Baked:
    """The source's colors on another mesh over the same surface, cleaned and without uv.

    Each texel has the color of the point of the source that is closest; their density follows the source's, times
    `share`. Texels beside the charts are filled as those of any texture.
    """
    center = mesh.v_pos[mesh.t_pos_idx].mean(1)
    normal = _face_normals(mesh)
    wanted = source.density[source.closest.find(center, normal).face] * face_areas(mesh) * share
    atlas = new_atlas(mesh, wanted.numpy(), side // SIZE_STEP * SIZE_STEP, monitor)
    painted = TexturedModel(atlas, torch.empty((0, 0, 3), dtype=torch.uint8))
    ratio = math.sqrt(source.texels / max(painted.texels, 1))
    finer = max(1, math.ceil(ratio / 2))
    fine = replace(atlas, width=atlas.width * finer, height=atlas.height * finer)
    texels = map_texels(fine)
    points = source.closest.find(surface_points(mesh, texels), normal[texels.face])
    averaged = ratio / finer >= SOFTENED
    color = _sampled(source, points.mix(*_uv(source.atlas.mesh)), soft=averaged)
    texture = torch.zeros((fine.height * fine.width, 3))
    known = torch.zeros(len(texture), dtype=torch.bool)
    texture[texels.texel], known[texels.texel] = color, True
    filled = fill_holes(texture.view(fine.height, fine.width, 3), known.view(fine.height, fine.width)).numpy()
    image = cv2.resize(filled, (atlas.width, atlas.height), interpolation=cv2.INTER_AREA)
    image = to_bytes(torch.from_numpy(_sharpened(image) if averaged or finer > 1 else image) / 255)
    apart = points.distance[texels.barycentric.amin(1) >= 0].numpy()  # other texels lie beside their face
    model = TexturedModel(atlas, torch.from_numpy(image), _relief(source, atlas))
    return Baked(model, float(np.quantile(apart, 0.999)))


def _relief(source: TexturedModel, atlas: Atlas) -> Tensor | None:
    """The source's normal map over the atlas, as fine beside the texture as the source's; None if it has none."""
    if source.normal_map is None:
        return None
    height, width, _ = source.normal_map.shape
    size = (width * atlas.width // source.atlas.width, height * atlas.height // source.atlas.height)
    texels = map_texels(replace(atlas, width=size[0], height=size[1]))
    frame = TangentFrames.of(atlas.mesh).at(texels.face, texels.barycentric)
    points = source.closest.find(surface_points(atlas.mesh, texels), frame[:, 2])
    uv = points.mix(*_uv(source.atlas.mesh))
    own = decode_normals(sample_image(source.normal_map, uv * uv.new_tensor([width, height])))
    world = own[:, None] @ TangentFrames.of(source.atlas.mesh).at(points.face, points.barycentric)
    image = flat_map(*size)
    image.view(-1, 3)[texels.texel] = encode_normals((frame @ world.mT)[..., 0])
    return image


def _sampled(source: TexturedModel, uv: Tensor, *, soft: bool) -> Tensor:
    """[N,3] float32 in [0,255], by bicubic interpolation: bilinear samples of an image of bilinear samples are dull."""
    image = source.texture.numpy()
    if soft:
        image = cv2.sepFilter2D(image, -1, KERNEL, KERNEL)
    place = (uv * uv.new_tensor([source.atlas.width, source.atlas.height]) - 0.5).T.numpy()
    x, y = np.pad(place, ((0, 0), (0, -len(uv) % ROW))).reshape(2, -1, ROW)
    color = cv2.remap(image, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return torch.from_numpy(color.reshape(-1, 3)[: len(uv)].astype(np.float32))


def _sharpened(image: NDArray[Any]) -> NDArray[Any]:
    """[H,W,3] float32 whose bilinear interpolation has the image as its averages, nearly (Van Cittert 1931)."""
    sharp = image
    for _ in range(SHARPENED):
        sharp = sharp + image - cv2.sepFilter2D(sharp, -1, BILINEAR, BILINEAR)
    return sharp


def _uv(mesh: Mesh) -> tuple[Tensor, Tensor]:
    assert mesh.v_uv is not None and mesh.t_uv_idx is not None
    return mesh.v_uv, mesh.t_uv_idx


def _face_normals(mesh: Mesh) -> Tensor:
    a, b, c = mesh.v_pos[mesh.t_pos_idx].unbind(1)
    normals: Tensor = torch.linalg.cross(b - a, c - a)
    return normals

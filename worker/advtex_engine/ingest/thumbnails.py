"""A thumbnail of each frame of a long scan, and what of the surface it shows: what the choice of views goes by.

Frames pass by one at a time; of each a thumbnail of brightness and of fine detail is kept, 40 kB. The surface is cut
into cells, cubes of a grid by the side that is seen, and every frame says how well it shows each cell, how bright and
how sharp. So frames are compared where they show the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
import torch

from advtex_engine.core.cameras import camera_center, pixel_centers, scaled_camera, unproject
from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import Camera, Mesh
from advtex_engine.mesh.clean import decimate
from advtex_engine.render.rasterize import rasterize_views

THUMBNAIL_WIDTH = 80
DETAIL_WIDTH = 640  # detail is measured at this width at most, so that a 12-megapixel frame is not judged by its noise
CELLS = 2_000  # into about as many the surface is cut
VISIBILITY_FACES = 6_000
LEAST_COSINE = 0.1  # of the viewing angle; flatter ones are not counted
DARKEST = 1e-3  # linear brightness that counts as black
NO_DETAIL = 1e-7  # energy of what 8-bit rounding leaves of a flat surface

Array = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Thumbnail:
    """A frame's thumbnail: log2 of linear brightness and log2 of the detail's energy, [h,w] float32 each.

    NaN where the frame's mask leaves anything out.
    """

    brightness: Array
    detail: Array


@dataclass(frozen=True)
class Visibility:
    """What F frames show of C cells of the surface, [F,C] float32 each.

    shown: sum of cosines over the thumbnail's pixels that show the cell, a measure of pixels per area; 0 = not seen.
    brightness, detail: means of the frame's logarithms over the cell; NaN where it is not seen.
    """

    shown: Array
    brightness: Array
    detail: Array


def thumbnail_of(image: npt.NDArray[np.uint8], mask: npt.NDArray[np.bool_] | None = None) -> Thumbnail:
    """The thumbnail of a frame's color, [H,W,3] uint8 sRGB, R first. mask: where it may be used, of any size.

    Detail is the squared Laplacian of brightness as it is coded, at DETAIL_WIDTH at most.
    """
    assert image.ndim == 3 and image.shape[2] == 3
    height, width = image.shape[:2]
    if width > DETAIL_WIDTH:
        height, width = max(1, round(height * DETAIL_WIDTH / width)), DETAIL_WIDTH
        image = np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255
    energy = np.square(cv2.Laplacian(gray, cv2.CV_32F, ksize=1))
    size = thumbnail_size(width, height)
    linear = cv2.resize(gray**2.2, size, interpolation=cv2.INTER_AREA)
    energy = cv2.resize(energy, size, interpolation=cv2.INTER_AREA)
    thumbnail = Thumbnail(np.log2(np.maximum(linear, DARKEST)), np.log2(np.maximum(energy, NO_DETAIL)))
    if mask is not None:
        left_out = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) < 0.999
        thumbnail.brightness[left_out] = thumbnail.detail[left_out] = np.nan
    return thumbnail


def thumbnail_size(width: int, height: int) -> tuple[int, int]:
    """Width and height of the thumbnail of an image of this size."""
    columns = min(width, THUMBNAIL_WIDTH)
    return columns, max(1, round(height * columns / width))


def visibility_of(mesh: Mesh, cameras: Sequence[Camera], thumbnails: Sequence[Thumbnail]) -> Visibility:
    """What each frame shows of the surface. Rasterizes a coarse copy of the mesh once per frame."""
    assert len(cameras) == len(thumbnails)
    coarse = decimate(mesh, VISIBILITY_FACES, Monitor())
    corners = coarse.v_pos[coarse.t_pos_idx].double()
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = torch.linalg.norm(normals, dim=1)
    normals = normals / areas.clamp(min=1e-30)[:, None]
    side = float((1.5 * areas.sum() / 2 / CELLS).sqrt())  # a plane that crosses a grid meets 1.5 cells per side²
    origin = corners.reshape(-1, 3).amin(0)
    small = [
        scaled_camera(camera, thumbnail.detail.shape[1], thumbnail.detail.shape[0])
        for camera, thumbnail in zip(cameras, thumbnails, strict=True)
    ]
    seen = []
    for camera, thumbnail, fragments in zip(small, thumbnails, rasterize_views(coarse, small), strict=True):
        hit = (fragments.face_index >= 0) & ~torch.from_numpy(thumbnail.detail).isnan()
        points = unproject(camera, pixel_centers(camera)[hit], fragments.depth[hit])
        facing = normals[fragments.face_index[hit].long()]
        rays = torch.nn.functional.normalize(points - camera_center(camera), dim=1)
        along = (rays * facing).sum(1)
        keys = _cell_keys(((points - origin) / side).floor().long(), -along.sign()[:, None] * facing)
        seen.append(_sums(keys.numpy(), along.abs().numpy(), thumbnail, hit.numpy()))
    return _gathered(seen)


def _cell_keys(place: torch.Tensor, facing: torch.Tensor) -> torch.Tensor:
    """One number for each grid cell [N,3] and the nearest of the six directions to the seen side's normal [N,3]."""
    axis = facing.abs().argmax(1)
    direction = axis * 2 + (facing.gather(1, axis[:, None])[:, 0] > 0)
    x, y, z = (place + (1 << 18)).clamp(0, (1 << 19) - 1).unbind(1)
    return ((x << 38 | y << 19 | z) * 6) + direction


_Seen = tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]  # cell keys, and [3, cells]: shown, brightness, detail


def _sums(
    keys: npt.NDArray[np.int64], cosine: npt.NDArray[np.float64], thumbnail: Thumbnail, hit: npt.NDArray[np.bool_]
) -> _Seen:
    usable = cosine >= LEAST_COSINE
    cells, index = np.unique(keys[usable], return_inverse=True)
    weight = cosine[usable]
    total = np.bincount(index, weight, len(cells))
    bright, detail = (
        np.bincount(index, weight * plane[hit][usable], len(cells)) / total
        for plane in (thumbnail.brightness, thumbnail.detail)
    )
    return cells, np.stack((total, bright, detail))


def _gathered(seen: Sequence[_Seen]) -> Visibility:
    cells = np.unique(np.concatenate([keys for keys, _ in seen])) if seen else np.zeros(0, np.int64)
    tables = np.full((3, len(seen), len(cells)), np.nan, np.float32)
    tables[0] = 0
    for frame, (keys, values) in enumerate(seen):
        tables[:, frame, np.searchsorted(cells, keys)] = values
    return Visibility(tables[0], tables[1], tables[2])

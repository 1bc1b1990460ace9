"""Pictures for people: what the textured model looks like beside the photographs.

OpenCV is imported where a picture is drawn or encoded: rendering needs torch alone, and so do those who only render.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from advtex_engine.cameras import scaled_camera
from advtex_engine.files import write_atomically
from advtex_engine.rasterize import rasterize_views
from advtex_engine.scene import Atlas, Camera, View
from advtex_engine.texture import sample_image

BACKGROUND = 0.8
"""Gray level of pixels that show no surface."""
JPEG_QUALITY = 90
CAPTION_HEIGHT = 20
GUTTER = 4
PAPER, INK = 250, 40

T = TypeVar("T")


def render_view(
    atlas: Atlas, texture: Tensor, camera: Camera, *, supersample: int = 2, background: float = BACKGROUND
) -> Tensor:
    """The textured model as `camera` sees it: [H,W,3] float32 sRGB in [0,1]. Not differentiable.

    texture: [atlas.height,atlas.width,3] uint8 sRGB or float in [0,1]; sampled bilinearly at supersample x supersample
    points per pixel, whose sRGB values are averaged.
    """
    assert texture.shape == (atlas.height, atlas.width, 3)
    return paint(look(atlas, camera, supersample), texture, background)


def render_layers(atlas: Atlas, texture: Tensor, camera: Camera, *, supersample: int = 2) -> tuple[Tensor, Tensor]:
    """Color [H,W,3] times coverage, and coverage [H,W], both float32 in [0,1]: what `render_view` puts together."""
    assert texture.shape == (atlas.height, atlas.width, 3)
    return _layers(look(atlas, camera, supersample), texture)


@dataclass(frozen=True)
class Sight:
    """Where a camera's samples meet the model; renders of several textures share it.

    hit: [P] int64, which of the H * s x W * s samples do, in the order of rows. uv: [P,2] float32, where they do.
    width, height: of the picture. supersample: s.
    """

    hit: Tensor
    uv: Tensor
    width: int
    height: int
    supersample: int

    @property
    def coverage(self) -> float:
        """Share of the picture that shows the model."""
        return len(self.hit) / (self.width * self.height * self.supersample**2)


def look(atlas: Atlas, camera: Camera, supersample: int = 2) -> Sight:
    """What `camera` sees of the model at supersample x supersample points per pixel."""
    return next(look_around(atlas, [camera], supersample))


def look_around(atlas: Atlas, cameras: Sequence[Camera], supersample: int = 2) -> Iterator[Sight]:
    """`look` for each camera in turn; the same result, with the work on the mesh done once."""
    assert supersample >= 1
    mesh = atlas.mesh
    assert mesh.v_uv is not None
    assert mesh.t_uv_idx is not None
    fine = [scaled_camera(camera, camera.width * supersample, camera.height * supersample) for camera in cameras]
    for camera, fragments in zip(cameras, rasterize_views(mesh, fine), strict=True):
        faces = fragments.face_index.flatten()
        hit = (faces >= 0).nonzero()[:, 0]
        corners = mesh.t_uv_idx.index_select(0, faces.index_select(0, hit))
        weights = fragments.barycentric.view(-1, 3).index_select(0, hit)
        # The mean of three corners weighted by the barycentrics.
        uv = F.embedding_bag(corners, mesh.v_uv, per_sample_weights=weights, mode="sum")
        yield Sight(hit, uv, camera.width, camera.height, supersample)


def paint(sight: Sight, texture: Tensor, background: float = BACKGROUND) -> Tensor:
    """The picture [H,W,3] of `render_view`; the texture [h,w,3] may have any size."""
    color, coverage = _layers(sight, texture)
    return color + background * (1 - coverage[..., None])


def _layers(sight: Sight, texture: Tensor) -> tuple[Tensor, Tensor]:
    texels = texture.to(torch.float32)
    height, width, _ = texels.shape
    sampled = sample_image(texels, sight.uv * sight.uv.new_tensor([width, height]))
    if texture.dtype == torch.uint8:
        sampled /= 255
    fine = sampled.new_zeros((sight.height * sight.width * sight.supersample**2, 4))
    fine.index_copy_(0, sight.hit, F.pad(sampled, (0, 1), value=1.0))
    # Rows first, then columns: avg_pool2d takes three times as long on a CPU.
    rows = fine.view(sight.height, sight.supersample, sight.width, sight.supersample, 4).unbind(1)
    columns = sum(rows[1:], rows[0]).unbind(2)
    pooled = sum(columns[1:], columns[0])
    if sight.supersample > 1:
        pooled = pooled / sight.supersample**2
    return pooled[..., :3], pooled[..., 3]


def side_by_side(view: View, rendered: Tensor, mean: Tensor, path: Path) -> None:
    """Write a PNG: photograph | textured render | projected mean, each [H,W,3] float sRGB in [0,1]."""
    photo = view.color.to(torch.float32) / 255
    _write_png(path, _row((photo, rendered, mean), ("photograph", "advtex", "projected mean"), view.name))


def contact_sheet(views: Sequence[View], rows: Sequence[Sequence[Tensor]], captions: Sequence[str], path: Path) -> None:
    """Write a PNG with one row per view: its photograph, then its pictures of `rows`.

    rows: per view the pictures [H,W,3] float sRGB in [0,1], as many as `captions`.
    """
    assert len(views) == len(rows) > 0
    assert all(len(row) == len(captions) for row in rows)
    titles = ("photograph", *captions)
    lines = [
        _row((view.color.to(torch.float32) / 255, *row), titles, view.name)
        for view, row in zip(views, rows, strict=True)
    ]
    widest = max(line.shape[1] for line in lines)
    padded = [np.pad(line, ((0, GUTTER), (0, widest - line.shape[1]), (0, 0)), constant_values=PAPER) for line in lines]
    _write_png(path, np.concatenate(padded))


def evenly_spread(views: Sequence[T], count: int) -> tuple[T, ...]:
    """At most `count` of the views or frames, from all over the capture."""
    positions = np.linspace(0, len(views) - 1, min(count, len(views)))
    return tuple(views[round(position)] for position in positions)


def _row(pictures: Sequence[Tensor], captions: Sequence[str], name: str) -> NDArray[np.uint8]:
    """Pictures side by side under their captions, [H,W,3] uint8."""
    import cv2

    cells = []
    for index, (picture, caption) in enumerate(zip(pictures, captions, strict=True)):
        image = to_bytes(picture)
        cell = np.full((image.shape[0] + CAPTION_HEIGHT, image.shape[1], 3), PAPER, np.uint8)
        cell[CAPTION_HEIGHT:] = image
        words = f"{caption}: {name}" if index == 0 else caption
        cv2.putText(cell, words, (4, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (INK, INK, INK), 1, cv2.LINE_AA)
        cells.append(np.pad(cell, ((0, 0), (0, GUTTER), (0, 0)), constant_values=PAPER))
    return np.concatenate(cells, axis=1)[:, :-GUTTER]


def to_bytes(picture: Tensor) -> NDArray[np.uint8]:
    """[H,W,3] float sRGB in [0,1] (clamped) or uint8 -> uint8."""
    if picture.dtype == torch.uint8:
        return picture.cpu().numpy()
    return (picture.detach().clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()


def encode_jpeg(image: NDArray[np.uint8], quality: int = JPEG_QUALITY) -> bytes:
    """[H,W,3] uint8 sRGB as a JPEG."""
    import cv2

    done, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert done
    return data.tobytes()


def _write_png(path: Path, image: NDArray[np.uint8]) -> None:
    import cv2

    done, data = cv2.imencode(".png", image[..., ::-1])
    assert done
    write_atomically(path, data.tobytes())

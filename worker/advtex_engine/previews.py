"""Pictures for people: what the textured model looks like beside the photographs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from advtex_engine.cameras import scaled_camera
from advtex_engine.files import write_atomically
from advtex_engine.rasterize import rasterize
from advtex_engine.scene import Atlas, Camera, View
from advtex_engine.texture import sample_image

BACKGROUND = 0.8
"""Gray level of pixels that show no surface."""
CAPTION_HEIGHT = 20
GUTTER = 4
PAPER, INK = 250, 40


def render_view(
    atlas: Atlas, texture: Tensor, camera: Camera, *, supersample: int = 2, background: float = BACKGROUND
) -> Tensor:
    """The textured model as `camera` sees it: [H,W,3] float32 sRGB in [0,1]. Not differentiable.

    texture: [atlas.height,atlas.width,3] uint8 sRGB or float in [0,1]; sampled bilinearly at supersample x supersample
    points per pixel, whose sRGB values are averaged.
    """
    color, coverage = render_layers(atlas, texture, camera, supersample=supersample)
    return color + background * (1 - coverage[..., None])


def render_layers(atlas: Atlas, texture: Tensor, camera: Camera, *, supersample: int = 2) -> tuple[Tensor, Tensor]:
    """Color [H,W,3] times coverage, and coverage [H,W], both float32 in [0,1]: what `render_view` puts together."""
    assert texture.shape == (atlas.height, atlas.width, 3)
    assert supersample >= 1
    mesh = atlas.mesh
    assert mesh.v_uv is not None
    assert mesh.t_uv_idx is not None
    texels = texture.to(torch.float32) / (255 if texture.dtype == torch.uint8 else 1)
    width, height = camera.width * supersample, camera.height * supersample
    fragments = rasterize(mesh, scaled_camera(camera, width, height))
    hit = fragments.face_index >= 0
    corners = mesh.v_uv[mesh.t_uv_idx[fragments.face_index[hit].long()]]
    uv = (fragments.barycentric[hit][:, :, None] * corners).sum(1)
    color = torch.zeros((height, width, 3), dtype=torch.float32, device=texels.device)
    color[hit] = sample_image(texels, uv * uv.new_tensor([atlas.width, atlas.height]))
    layers = torch.cat((color, hit[..., None].to(color)), dim=2)
    blocks = layers.view(camera.height, supersample, camera.width, supersample, 4).mean(dim=(1, 3))
    return blocks[..., :3], blocks[..., 3]


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


def evenly_spread(views: Sequence[View], count: int) -> tuple[View, ...]:
    """At most `count` of the views, from all over the capture."""
    positions = np.linspace(0, len(views) - 1, min(count, len(views)))
    return tuple(views[round(position)] for position in positions)


def _row(pictures: Sequence[Tensor], captions: Sequence[str], name: str) -> NDArray[np.uint8]:
    """Pictures side by side under their captions, [H,W,3] uint8."""
    cells = []
    for index, (picture, caption) in enumerate(zip(pictures, captions, strict=True)):
        image = (picture.detach().cpu().clamp(0, 1) * 255).round().to(torch.uint8).numpy()
        cell = np.full((image.shape[0] + CAPTION_HEIGHT, image.shape[1], 3), PAPER, np.uint8)
        cell[CAPTION_HEIGHT:] = image
        words = f"{caption}: {name}" if index == 0 else caption
        cv2.putText(cell, words, (4, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (INK, INK, INK), 1, cv2.LINE_AA)
        cells.append(np.pad(cell, ((0, 0), (0, GUTTER), (0, 0)), constant_values=PAPER))
    return np.concatenate(cells, axis=1)[:, :-GUTTER]


def _write_png(path: Path, image: NDArray[np.uint8]) -> None:
    done, data = cv2.imencode(".png", image[..., ::-1])
    assert done
    write_atomically(path, data.tobytes())

"""Pictures for people: what the textured model looks like beside the photographs.

OpenCV is imported where a picture is drawn or encoded: rendering needs torch alone, and so do those who only render.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from advtex_engine.core.scene import View
from advtex_engine.runtime.files import write_atomically

JPEG_QUALITY = 90
CAPTION_HEIGHT = 20
GUTTER = 4
PAPER, INK = 250, 40


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


def encode_jpeg(image: NDArray[np.uint8], quality: int = JPEG_QUALITY, *, full_chroma: bool = False) -> bytes:
    """[H,W,3] uint8 sRGB as a JPEG, its chroma halved (4:2:0) or full (4:4:4)."""
    import cv2

    factor = cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444 if full_chroma else cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420
    parameters = (cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, factor)
    done, data = cv2.imencode(".jpg", image[..., ::-1], parameters)
    assert done
    return data.tobytes()


def _write_png(path: Path, image: NDArray[np.uint8]) -> None:
    import cv2

    done, data = cv2.imencode(".png", image[..., ::-1])
    assert done
    write_atomically(path, data.tobytes())

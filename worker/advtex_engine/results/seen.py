"""What photographs show of a model, beside it as files and over its pictures."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from advtex_engine.core.scene import Atlas
from advtex_engine.coverage import GUESSED, UNSEEN
from advtex_engine.results.pages import split_pages
from advtex_engine.runtime.files import write_atomically

MAX_SIDE = 4096
"""Texels; of larger images every second one is left out, or more."""
MARKS_SIDE = 2048
TINT = 0.65
COLORS = ((1.0, 0.6, 0.0), (0.85, 0.0, 0.85))
"""Of what is guessed, orange, and of what is unseen, magenta: rooms have little of either."""


def write_seen(out: Path, atlas: Atlas, state: Tensor, name: str = "model") -> tuple[Path, ...]:
    """Write `name`_seen.png for each page of the texture, as it lies there; -> their paths.

    state: [atlas.height,atlas.width] uint8. A gray image of three values: UNSEEN, GUESSED and SEEN.
    """
    paths = []
    for page in split_pages(atlas, state[..., None]):
        step = -(-max(page.image.shape) // MAX_SIDE)
        picture = np.ascontiguousarray(page.image[::step, ::step, 0].cpu().numpy())
        done, data = cv2.imencode(".png", picture)
        assert done
        paths.append(out / f"{name}_seen{page.suffix}.png")
        write_atomically(paths[-1], data.tobytes())
    return tuple(paths)


def marks(state: Tensor) -> Tensor:
    """A texture [h,w,3] float32 of small size for `tinted`: how much of each texel is guessed, and how much unseen."""
    height, width = state.shape
    step = -(-max(height, width) // MARKS_SIDE)
    some = state[::step, ::step]
    return torch.stack((some == GUESSED, some == UNSEEN, torch.zeros_like(some, dtype=torch.bool)), 2).float()


def tinted(picture: Tensor, marked: Tensor) -> Tensor:
    """A picture of the model [H,W,3] in [0,1] with what is not seen in COLORS; marked: the same picture of `marks`."""
    for color, share in zip(COLORS, marked.unbind(2), strict=False):
        picture = torch.lerp(picture, picture.new_tensor(color), TINT * share.clamp(0, 1)[..., None])
    return picture

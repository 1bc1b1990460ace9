"""How unlike a render is to a photograph, for eyes that forgive what a texture cannot mend.

Cameras are off by a pixel or two, and exposures differ. A difference of colors counts these most, and is least for a
blurred texture. Here every window is compared with the windows around it, by contrast and structure alone (two of the
three parts of SSIM, Wang et al. 2004): a shift of a pixel or two and a change of tone cost next to nothing, blur,
ghosts and noise their due.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

Unlikeness = Callable[[Tensor, Tensor], Tensor]
"""(renders, photographs), both [N,3,h,w] in [0,1] -> [N,h,w], 0 where they are alike. Deterministic on a CPU."""

WINDOWS = (8, 16)  # pixels; in the second one, means of 3 x 3 pixels are compared
STRIDE = 4  # pixels between two windows
REACH = 2  # pixels by which a window may be off without a penalty
FLAT = 0.03**2  # variances well below count as none (SSIM's second constant, for colors in [0, 1])


@torch.no_grad()
def structure_unlikeness(renders: Tensor, photographs: Tensor) -> Tensor:
    """1 less contrast and structure of SSIM, of gray levels, at the best shift of each window; the mean over WINDOWS.

    As `Unlikeness`: [N,h,w] in [0,2], constant over STRIDE pixels. Not differentiable.
    """
    assert renders.shape == photographs.shape and renders.shape[1] == 3
    height, width = renders.shape[-2:]
    render, photograph = renders.mean(1, keepdim=True), photographs.mean(1, keepdim=True)
    total = torch.zeros_like(render)
    for size in WINDOWS:
        unlike = _unlike_windows(render, photograph, size)
        grown = unlike.repeat_interleave(STRIDE, 2).repeat_interleave(STRIDE, 3)
        total += grown[..., :height, :width] / len(WINDOWS)
        render, photograph = (F.avg_pool2d(image, 3, 1, 1, count_include_pad=False) for image in (render, photograph))
    return total[:, 0]


def _unlike_windows(render: Tensor, photograph: Tensor, size: int) -> Tensor:
    """[N,1,h,w] each -> [N,1,ceil(h/STRIDE),ceil(w/STRIDE)], a value per window."""
    height, width = render.shape[-2:]
    around = F.pad(render, (REACH, REACH, REACH, REACH), mode="replicate")
    mean = _windows(photograph, size)
    variance = _windows(photograph.square(), size) - mean.square()
    best = torch.full_like(mean, -1.0)
    for down in range(2 * REACH + 1):
        for right in range(2 * REACH + 1):
            moved = around[..., down : down + height, right : right + width]
            moved_mean = _windows(moved, size)
            moved_variance = _windows(moved.square(), size) - moved_mean.square()
            together = _windows(moved * photograph, size) - moved_mean * mean
            best = torch.maximum(best, (2 * together + FLAT) / (moved_variance + variance + FLAT))
    return 1 - best


def _windows(image: Tensor, size: int) -> Tensor:
    """Means over windows around blocks of STRIDE pixels; what reaches beyond the border does not count."""
    beyond = (size - STRIDE) // 2
    # By pairs of pixels first: a quarter of the additions.
    pairs = F.avg_pool2d(image, 2, ceil_mode=True)
    return F.avg_pool2d(pairs, size // 2, STRIDE // 2, beyond // 2, ceil_mode=True, count_include_pad=False)

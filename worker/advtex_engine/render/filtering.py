"""Low-passes of images, every channel by itself, and the greatest of what is near."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor


def blurred(planes: Tensor, sigma: float) -> Tensor:
    """Planes [N,H,W] under a Gaussian of standard deviation `sigma` in pixels, borders mirrored; H, W above 4 sigma."""
    radius = math.ceil(4 * sigma)
    offset = torch.arange(-radius, radius + 1, dtype=torch.float32, device=planes.device)
    kernel = torch.exp(-offset.square() / (2 * sigma**2))
    return separable(planes, kernel / kernel.sum())


def separable(planes: Tensor, kernel: Tensor, border: str = "reflect") -> Tensor:
    """Planes [N,H,W] under the same kernel [2R+1] across and down. border: a mode of `F.pad`."""
    radius, count = len(kernel) // 2, len(planes)
    padded = F.pad(planes[None], (radius,) * 4, mode=border)
    # Planes as channels of one image: as images of one channel they take a CPU five to eleven times as long.
    rows = F.conv2d(padded, kernel.expand(count, 1, 1, -1), groups=count)
    return F.conv2d(rows, kernel[:, None].expand(count, 1, -1, 1), groups=count)[0]


def window_sums(planes: Tensor, reach: int) -> Tensor:
    """Sums of [C,h,w] over the windows that reach so many pixels to each side, [C,h,w]; outside there is nothing."""
    side = 2 * reach + 1
    return _runs(_runs(F.pad(planes, (reach,) * 4), side, 1), side, 2)


def greatest(values: Tensor, reach: int) -> Tensor:
    """The greatest of values [...,H,W] within so many rows and columns of each, outside there is nothing; not
    differentiable.

    Windows are made of two of about half their reach. `max_pool2d` takes a CPU fifty times as long for 7x7 of them.
    """
    for axis in (-2, -1):
        done, most = 0, min(reach, values.shape[axis] - 1)
        while done < most:
            step = min(done + 1, most - done)
            count = values.shape[axis] - step
            around = values.clone()
            for here, there in ((0, step), (step, 0)):
                side = around.narrow(axis, here, count)
                torch.maximum(side, values.narrow(axis, there, count), out=side)
            values, done = around, done + step
    return values


def _runs(planes: Tensor, length: int, axis: int) -> Tensor:
    """Sums of so many in a row along an axis, [C,...] with length - 1 less of them.

    Runs of 1, 2, 4, ... are made of two of half the length each, and the sum of some of them: sums of all that lies
    before would take a CPU twice as long, and lose three digits.
    """
    count = planes.shape[axis] - length + 1
    run, width = planes, 1
    total, done = planes.narrow(axis, length - 1, count), 1  # lengths are odd
    while True:
        if (length - 1) & width:
            total = total + run.narrow(axis, done - 1, count)
            done += width
        if done == length:
            return total
        rest = run.shape[axis] - width
        run, width = run.narrow(axis, 0, rest) + run.narrow(axis, width, rest), 2 * width


def halved(planes: Tensor) -> Tensor:
    """Means of two by two pixels of planes [C,h,w], [C,h//2,w//2]; a last odd row or column is left out."""
    height, width = (side - side % 2 for side in planes.shape[1:])
    # avg_pool2d takes a CPU ten times as long.
    rows = planes[:, 0:height:2] + planes[:, 1:height:2]
    return (rows[..., 0:width:2] + rows[..., 1:width:2]).mul_(0.25)

"""The Gabor term on Triton kernels, with the results of its plain twin in `gabor.py`."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from advtex_engine.adversarial import gabor
from advtex_engine.adversarial import kernels_gabor as kernels
from advtex_engine.adversarial.kernels_losses import difference_mean

BLOCK = 256  # pixels of a program
LONG_BLOCK = 512  # pixels of a program that reads all filters for each: a thread has several, and reads them once
WINDOW_BLOCK = 32  # windows of a program: there are few, and each looks at many energies
ALONE = 1024  # sums at a time of a program that adds all of them up by itself


class _GaborLoss(torch.autograd.Function):
    """Of rows: render, photograph [h*w,3], foreground [h*w,1]."""

    @staticmethod
    def forward(
        ctx: Any, render: Tensor, photograph: Tensor, foreground: Tensor, filters: Tensor, sides: list[tuple[int, int]]
    ) -> Tensor:
        device, (height, width) = render.device, sides[0]
        pixels, windows = sum(high * wide for high, wide in sides), sum(map(_windows, sides))
        octaves = {"HEIGHT": height, "WIDTH": width, "OCTAVES": len(sides)}
        lists = octaves | {"PIXELS": pixels, "WINDOWS": windows}
        grays = torch.empty((2, pixels), device=device)
        squares = torch.empty((2, gabor.ORIENTATIONS, pixels), device=device)
        pulls = torch.empty((2, gabor.ORIENTATIONS, windows), device=device)
        places = torch.empty((gabor.ORIENTATIONS, windows), dtype=torch.int32, device=device)
        parts, loss = _programs(windows, WINDOW_BLOCK), torch.empty((), device=device)
        sums = torch.empty(parts, device=device)
        kernels.octaves[_programs(pixels)](render, photograph, foreground, grays, PIXELS=pixels, BLOCK=BLOCK, **octaves)
        kernels.energies[(*_programs(pixels, LONG_BLOCK), 2)](
            grays, filters, squares, PIXELS=pixels, BLOCK=LONG_BLOCK, **octaves
        )
        kernels.distances[parts](grays, filters, squares, sums, pulls, places, BLOCK=WINDOW_BLOCK, **lists)
        difference_mean[(1,)](sums, loss, COUNT=1, PARTS=parts[0], BLOCK=ALONE)
        ctx.save_for_backward(foreground, filters, pulls, places)
        ctx.octaves, ctx.lists = octaves, lists
        return loss

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> tuple[Tensor | None, ...]:
        foreground, filters, pulls, places = ctx.saved_tensors
        pixels = ctx.lists["PIXELS"]
        slopes = torch.empty(pixels, device=pulls.device)
        into = torch.empty((len(foreground), 3), device=pulls.device)
        kernels.energies_backward[_programs(pixels)](filters, pulls, places, slopes, BLOCK=BLOCK, **ctx.lists)
        kernels.octaves_backward[_programs(len(foreground))](
            slopes, foreground, grads[0].contiguous(), into, BLOCK=BLOCK, **ctx.octaves
        )
        return into, None, None, None, None


def gabor_loss(render: Tensor, photograph: Tensor, foreground: Tensor, filters: Tensor) -> Tensor:
    """`gabor.gabor_loss` in four kernels, and two for its gradient; differentiable in `render` only."""
    assert render.shape == photograph.shape and render.shape[:2] == (1, 3)
    assert foreground.shape == render[:, :1].shape
    assert filters.shape == (2 * gabor.ORIENTATIONS, 1, gabor.SIZE, gabor.SIZE)
    height, width = render.shape[-2:]
    halved = [(height >> number, width >> number) for number in range(gabor.OCTAVES)]
    sides = [side for side in halved if min(side) >= gabor.window_reach()]
    if not sides:
        return torch.zeros((), device=render.device)
    images = (render, photograph.detach(), foreground)
    rows = [image.permute(0, 2, 3, 1).reshape(-1, image.shape[1]).contiguous() for image in images]
    loss: Tensor = _GaborLoss.apply(*rows, filters.contiguous(), sides)  # type: ignore[no-untyped-call]
    return loss


def _windows(side: tuple[int, int]) -> int:
    """Of an octave of so many pixels a side."""
    high, wide = ((pixels - gabor.window_reach()) // gabor.WINDOW + 1 for pixels in side)
    return high * wide


def _programs(count: int, block: int | None = None) -> tuple[int]:
    return (-(-count // (block or BLOCK)),)

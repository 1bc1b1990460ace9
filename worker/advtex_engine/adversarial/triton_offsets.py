"""The examples' alignment on Triton kernels, with the results of its plain twin in `alignment.py`."""

from __future__ import annotations

import torch
from torch import Tensor

from advtex_engine.adversarial import alignment
from advtex_engine.adversarial import kernels_offsets as kernels
from advtex_engine.adversarial.alignment import BLOCK as SIDE

BLOCK = 256  # pixels or values of a program

assert alignment.WHITENING == 0.5  # kernels.whiten and kernels.find_peaks take roots


@torch.no_grad()
def example_offsets(condition: Tensor, real: Tensor, fake: Tensor, visible: Tensor, bound: int) -> Tensor:
    """`alignment.example_offsets` in four kernels, two box filters and two Fourier transforms."""
    height, width = condition.shape[-2:]
    rows, columns = ((side - SIDE) // (SIDE // 2) + 1 for side in (height, width))
    device, sizes = condition.device, {"WIDTH": width, "COLUMNS": columns, "ROWS": rows, "SIDE": SIDE}
    images = [image.detach().permute(0, 2, 3, 1).contiguous() for image in (condition, real, fake)]
    mask = visible.contiguous()
    planes = torch.empty((3, 1, height, width), device=device)
    kernels.luminance[_programs(height * width)](*images, mask, planes, PIXELS=height * width, BLOCK=BLOCK)
    smooth = alignment.box_mean(alignment.box_mean(planes, 2), 3).contiguous()
    blocks = torch.empty((3, rows, columns, SIDE, SIDE), device=device)
    window = alignment.fading_window(device)
    kernels.cut_blocks[(3 * rows * columns,)](planes, smooth, mask, window, blocks, HEIGHT=height, **sizes)
    spectrum = torch.view_as_real(torch.fft.rfft2(blocks)).contiguous()
    cross, strength = torch.empty_like(spectrum[1:]), torch.empty(spectrum[1:, ..., 0].shape, device=device)
    values = strength.numel()
    kernels.whiten[_programs(values)](spectrum, cross, strength, COUNT=values // 2, VALUES=values, BLOCK=BLOCK)
    correlation = torch.fft.irfft2(torch.view_as_complex(cross), s=(SIDE, SIDE)).contiguous()
    offsets = torch.empty((2, rows, columns, 2), device=device)
    kernels.find_peaks[(2 * rows * columns,)](
        *(correlation, strength, mask, offsets),
        BOUND=bound,
        MIN_SEEN=alignment.MIN_SEEN,
        MIN_CORRELATION=alignment.MIN_CORRELATION,
        MIN_GAIN=alignment.MIN_GAIN,
        **sizes,
    )
    return offsets


def _programs(count: int) -> tuple[int]:
    return (-(-count // BLOCK),)

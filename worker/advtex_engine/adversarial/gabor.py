"""How unlike the fine structure of a render is to that of a photograph, for views that disagree a little.

Cameras and meshes are off by a pixel. Whatever compares a pixel with a pixel (L1, SSIM, the responses of a network that
has learned little) is least for a blurred texture then. What is compared here does not depend on where exactly an edge
lies: energies of quadrature pairs of Gabor filters, which are the same for every phase (Adelson and Bergen 1985), at
their maximum over a window, which forgives some pixels of displacement (Riesenhuber and Poggio 1999), each as a share
of the energies of all orientations there, so that faint structure counts as strong one does (Heeger 1992). Nothing in
it is learned.
"""

from __future__ import annotations

import math
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

WAVELENGTH = 3.0  # pixels
ORIENTATIONS = 6
SIZE = 7  # pixels a side of a filter
OCTAVES = 3  # images of half the size each
WINDOW = 7  # pixels a side, of which the greatest energy counts
STRIDE = 4  # pixels between two windows
FAINT = 0.2  # energies well below count as none; of colors in [0, 1]
TINY = 1e-6  # under the root of the energy, which has no slope at 0
LUMA = (0.299, 0.587, 0.114)


def gabor_filters(device: torch.device) -> Tensor:
    """[2 ORIENTATIONS,1,SIZE,SIZE]: the even filters of all orientations, then the odd ones; of mean 0 and norm 1."""
    across = torch.arange(SIZE, dtype=torch.float64) - SIZE // 2
    y, x = torch.meshgrid(across, across, indexing="ij")
    filters = []
    for phase in (0.0, math.pi / 2):
        for number in range(ORIENTATIONS):
            angle = math.pi * number / ORIENTATIONS
            along = x * math.cos(angle) + y * math.sin(angle)
            beside = y * math.cos(angle) - x * math.sin(angle)
            envelope = torch.exp(-(along**2 + beside**2 / 2) / (2 * (WAVELENGTH / 2) ** 2))
            wave = envelope * torch.cos(2 * math.pi * along / WAVELENGTH + phase)
            wave -= envelope * (wave.sum() / envelope.sum())
            filters.append(wave / wave.norm())
    return torch.stack(filters)[:, None].to(device, torch.float32)


def gabor_loss(render: Tensor, photograph: Tensor, foreground: Tensor, filters: Tensor) -> Tensor:
    """0-dim: squared distance of the shares of energy, mean over windows, sum over octaves; a gradient for the render.

    render, photograph: [1,3,h,w] in [-1,1]; the render counts where foreground [1,1,h,w] is not 0, and is the
    photograph elsewhere. filters: of `gabor_filters`, on their device. Octaves that are smaller than a window are left
    out.
    """
    with torch.no_grad():
        named = _shares(photograph, filters)
    shown = _shares(torch.where(foreground > 0, render, photograph), filters)
    distances = [F.mse_loss(ours, theirs) for ours, theirs in zip(shown, named, strict=True)]
    return ORIENTATIONS * torch.stack(distances).sum() if distances else torch.zeros((), device=render.device)


def _shares(image: Tensor, filters: Tensor) -> list[Tensor]:
    """[1,3,h,w] -> per octave [1,ORIENTATIONS,...], for each window a vector that is shorter than 1."""
    red, green, blue = (part / 2 for part in LUMA)  # differences as of colors in [0, 1]
    gray = red * image[:, :1] + green * image[:, 1:2] + blue * image[:, 2:]
    found: list[Tensor] = []
    while len(found) < OCTAVES and min(gray.shape[-2:]) >= SIZE + WINDOW - 1:
        responses: Tensor = _Filtered.apply(gray, filters)  # type: ignore[no-untyped-call]
        squares = responses.square().view(2, ORIENTATIONS, *responses.shape[-2:]).sum(0, keepdim=True)
        energies = (F.max_pool2d(squares, WINDOW, STRIDE) + TINY).sqrt()
        found.append(energies / (energies.square().sum(1, keepdim=True) + FAINT**2).sqrt())
        gray = F.avg_pool2d(gray, 2)
    return found


class _Filtered(torch.autograd.Function):
    """Correlation with the filters, and its transpose as one more: autograd's own takes a CPU nearly twice as long."""

    @staticmethod
    def forward(ctx: Any, gray: Tensor, filters: Tensor) -> Tensor:
        ctx.save_for_backward(filters)
        return F.conv2d(gray, filters)

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> tuple[Tensor, None]:
        (filters,) = ctx.saved_tensors
        return F.conv2d(grads[0], filters.flip(2, 3).transpose(0, 1), padding=SIZE - 1), None

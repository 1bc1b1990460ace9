"""How unlike the fine structure of a render is to that of a photograph, for views that disagree a little.

Cameras and meshes are off by a pixel. Whatever compares a pixel with a pixel (L1, SSIM, the responses of a network that
has learned little) is least for a blurred texture then. What is compared here does not depend on where exactly an edge
lies: energies of quadrature pairs of Gabor filters, which are the same for every phase (Adelson and Bergen 1985), at
their maximum over a window, which forgives some pixels of displacement (Riesenhuber and Poggio 1999), each as a share
of the energies of all orientations there, so that faint structure counts as strong one does (Heeger 1992). Nothing in
it is learned.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.render.filtering import halved

WAVELENGTH = 3.0  # pixels
ORIENTATIONS = 6
SIZE = 7  # pixels a side of a filter
OCTAVES = 3  # images of half the size each
WINDOW = 4  # pixels a side, of whose places the greatest energy counts; windows lie side by side
SPACING = 2
"""Pixels between two places of a filter, in rows and columns: energies are so smooth that those of every place lead to
no better texture, in more than three times the time."""
FAINT = 0.2  # energies well below count as none; of colors in [0, 1]
TINY = 1e-6  # under the root of the energy, which has no slope at 0
LUMA = (0.299, 0.587, 0.114)


def window_reach() -> int:
    """Pixels a side that the filters of a window lie in."""
    return SIZE + WINDOW - SPACING


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


def gabor_loss(
    render: Tensor,
    photograph: Tensor,
    foreground: Tensor,
    filters: Tensor,
    moved: Callable[[Tensor], Tensor] | None = None,
) -> Tensor:
    """0-dim: squared distance of the shares of energy, mean over windows, sum over octaves; a gradient for the render.

    render, photograph: [1,3,h,w] in [-1,1]; the render counts where foreground [1,1,h,w] is not 0, and is the
    photograph elsewhere. filters: of `gabor_filters`, on their device. moved: what the camera's motion makes of gray
    levels [1,h,w], if it moved. Octaves that are smaller than a window are left out.
    """
    matrix = _placed(filters)
    with torch.no_grad():
        gray = gray_levels(photograph)
        named = _shares(gray, matrix)
    ours = torch.where(foreground[:, 0] > 0, gray_levels(render), gray)
    if moved is not None:
        ours = torch.where(foreground[:, 0] > 0, moved(ours), gray)
    shown = _shares(ours, matrix)
    distances = [F.mse_loss(ours, theirs) for ours, theirs in zip(shown, named, strict=True)]
    return ORIENTATIONS * torch.stack(distances).sum() if distances else torch.zeros((), device=render.device)


def gray_levels(image: Tensor) -> Tensor:
    """[1,3,h,w] in [-1,1] -> [1,h,w], with differences as of colors in [0,1]."""
    # Filled on the device: a list of numbers would have to be copied there, which a captured step must not do.
    weights = torch.cat([image.new_full((1,), part / 2) for part in LUMA])
    return image.permute(0, 2, 3, 1) @ weights


def _shares(gray: Tensor, matrix: Tensor) -> list[Tensor]:
    """[1,h,w] -> per octave [1,ORIENTATIONS,...], for each window a vector that is shorter than 1."""
    found: list[Tensor] = []
    while len(found) < OCTAVES and min(gray.shape[-2:]) >= window_reach():
        squares: Tensor = _GreatestSquares.apply(gray[0], matrix)  # type: ignore[no-untyped-call]
        energies = (squares[None] + TINY).sqrt()
        found.append(energies / (energies.square().sum(1, keepdim=True) + FAINT**2).sqrt())
        gray = halved(gray)
    return found


def _placed(filters: Tensor) -> Tensor:
    """[2 ORIENTATIONS * places, side^2]: every filter at every place of a window, as rows to multiply a patch by, of so
    many pixels a side."""
    places = list(itertools.product(range(0, WINDOW, SPACING), repeat=2))
    side = SIZE + places[-1][0]
    placed = filters.new_zeros((len(filters), len(places), side, side))
    for number, (down, right) in enumerate(places):
        placed[:, number, down : down + SIZE, right : right + SIZE] = filters[:, 0]
    return placed.view(-1, side**2)


class _GreatestSquares(torch.autograd.Function):
    """Gray levels [h,w] -> [ORIENTATIONS,rows,columns], the greatest squared energy in each window.

    One product of matrices for all places of a window: a convolution of a single channel takes a CPU three times as
    long, and its transpose seven times. The first of equal energies, row by row of the window, has the gradient.
    """

    @staticmethod
    def forward(ctx: Any, gray: Tensor, matrix: Tensor) -> Tensor:
        side = math.isqrt(matrix.shape[1])
        patches = gray.unfold(0, side, WINDOW).unfold(1, side, WINDOW)
        rows, columns = patches.shape[:2]
        responses = (matrix @ patches.reshape(-1, side**2).T).view(2, ORIENTATIONS, -1, rows * columns)
        squares = responses[0].square().addcmul_(responses[1], responses[1])
        if not ctx.needs_input_grad[0]:
            return squares.amax(1).view(ORIENTATIONS, rows, columns)
        greatest, place = squares.max(1, keepdim=True)
        place = place.expand(2, -1, -1, -1)
        ctx.save_for_backward(matrix, responses.gather(2, place), place)
        ctx.size = gray.shape
        return greatest.view(ORIENTATIONS, rows, columns)

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> tuple[Tensor, None]:
        matrix, responses, place = ctx.saved_tensors
        pull = 2 * responses * grads[0].reshape(ORIENTATIONS, 1, -1)
        places = len(matrix) // (2 * ORIENTATIONS)
        pulls = pull.new_zeros((2, ORIENTATIONS, places, pull.shape[-1])).scatter_(2, place, pull)
        patches = matrix.T @ pulls.view(len(matrix), -1)
        return F.fold(patches, ctx.size, math.isqrt(matrix.shape[1]), stride=WINDOW)[0], None

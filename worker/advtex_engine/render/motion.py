"""Motion blur: how far, and along which line, a photograph's camera moved while it was exposed.

A photograph is compared with what a texture shows in its view. Where it lacks energy of gradients along one direction
and not along others, its camera moved in that direction; energies do not mind that the two are a pixel apart. Of
photographs that are sharper than the render nothing is found. The blur is then put onto the render (Irani and Peleg
1991, "Improving resolution by image registration"): what is compared with a blurred photograph may stay sharp.

A view has one motion. Parts of it move differently, as cameras turn and what is near moves further; but by less of a
picture it is told less surely (nine tiles with a motion each cost the shelf .6 %, and gain nothing elsewhere).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

PIXELS = (1.75, 2.5, 3.5, 5.0, 7.0, 10.0)
ANGLES = 12
ACROSS = 0.2
"""Pixels, the deviation of a motion's blur across it: thin, so that the directions beside it keep their energies."""
DIRECTIONS = 6
"""Along which gradients are compared, to find a motion."""
LEAST_KNOWN = 400  # pixels, by which a motion can be told
FAINT = 1e-6  # energy that counts as none
LEAST_SHARE = 0.1  # of the pixels, that have a known one so far beside them
LEAST_WEIGHT = 1e-3  # of a pixel of a line; less is left out

Taps = tuple[tuple[int, int, float], ...]
"""A blur: how far down and right of each pixel others lie, and what they weigh; nothing where nothing moved."""


def motions() -> list[tuple[float, float]]:
    """Those looked at: length in pixels and direction in radians, from right to down; first that of no motion."""
    angles = [math.pi * number / ANGLES for number in range(ANGLES)]
    return [(0.0, 0.0), *((pixels, angle) for pixels in PIXELS for angle in angles)]


def motion_kernel(pixels: float, angle: float) -> Tensor:
    """[2R+1,2R+1] float64, of sum 1: a line, with the weights of a Gaussian as wide: motions are no uniform ones."""
    deviation = max(pixels, 1e-3) / 12**0.5
    reach = math.ceil(3 * deviation) if pixels else 0
    steps = torch.arange(-reach, reach + 1, dtype=torch.float64)
    y, x = torch.meshgrid(steps, steps, indexing="ij")
    along, beside = x * math.cos(angle) + y * math.sin(angle), y * math.cos(angle) - x * math.sin(angle)
    kernel = torch.exp(-((along / deviation) ** 2 + (beside / ACROSS) ** 2) / 2)
    return kernel / kernel.sum()


def found_motion(render: Tensor, photograph: Tensor, known: Tensor) -> Taps:
    """By how much more motion the photograph is blurred than the render.

    render, photograph: [h,w] gray levels in [0,1], compared where known [h,w] bool. Not differentiable.
    """
    assert render.shape == photograph.shape == known.shape
    inside = torch.zeros_like(known)
    inside[1:-1, 1:-1] = known[1:-1, 1:-1] & known[1:-1, 2:] & known[1:-1, :-2] & known[2:, 1:-1] & known[:-2, 1:-1]
    directions = _directions(render)
    wanted = directions @ torch.stack([(a * b).sum() for a, b in _pairs(*_steps(photograph, inside))])
    energies = directions @ _energies_after(*_steps(render, inside), inside)
    unlike = ((energies + FAINT) / (wanted[:, None] + FAINT)).log().square().sum(0)
    best = torch.where(inside.sum() < LEAST_KNOWN, 0, unlike.argmin())
    return _taps(int(best))


def smeared(planes: Tensor, taps: Taps) -> Tensor:
    """Planes [C,h,w] as they are blurred by a motion; what lies beyond them is as their border. Differentiable."""
    if not taps:
        return planes
    reach = max(max(abs(down), abs(right)) for down, right, _ in taps)
    padded = F.pad(planes[None], (reach,) * 4, mode="replicate")[0]
    found: Tensor = _AlongLine.apply(padded, taps, reach)  # type: ignore[no-untyped-call]
    return found


class _AlongLine(torch.autograd.Function):
    """The sum of shifted pictures: a convolution of single channels takes a CPU many times as long, and its transpose
    more."""

    @staticmethod
    def forward(ctx: Any, padded: Tensor, taps: Taps, reach: int) -> Tensor:
        ctx.taps, ctx.reach = taps, reach
        found = torch.zeros_like(padded[:, 2 * reach :, 2 * reach :])
        for down, right, weight in taps:
            found.add_(_beside(padded, found.shape, reach + down, reach + right), alpha=weight)
        return found

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> tuple[Tensor, None, None]:
        (grad,) = grads
        slope = grad.new_zeros((len(grad), *(side + 2 * ctx.reach for side in grad.shape[1:])))
        for down, right, weight in ctx.taps:
            _beside(slope, grad.shape, ctx.reach + down, ctx.reach + right).add_(grad, alpha=weight)
        return slope, None, None


def _beside(planes: Tensor, size: Sequence[int], down: int, right: int) -> Tensor:
    return planes[:, down : down + size[1], right : right + size[2]]


def _steps(gray: Tensor, inside: Tensor) -> tuple[Tensor, Tensor]:
    """Differences of pixels two apart, to the right and down, 0 where not inside."""
    right, down = torch.zeros_like(gray), torch.zeros_like(gray)
    right[:, 1:-1], down[1:-1] = gray[:, 2:] - gray[:, :-2], gray[2:] - gray[:-2]
    return torch.where(inside, right, 0.0), torch.where(inside, down, 0.0)


def _pairs(right: Tensor, down: Tensor) -> tuple[tuple[Tensor, Tensor], ...]:
    return (right, right), (right, down), (down, down)


def _directions(like: Tensor) -> Tensor:
    """[DIRECTIONS,3]: what squares, products and squares of steps right and down have of a direction's energy."""
    rows = []
    for number in range(DIRECTIONS):
        angle = math.pi * number / DIRECTIONS
        rows.append([math.cos(angle) ** 2, 2 * math.cos(angle) * math.sin(angle), math.sin(angle) ** 2])
    return like.new_tensor(rows)


def _energies_after(right: Tensor, down: Tensor, inside: Tensor) -> Tensor:
    """[3,motions]: of steps right and down [h,w] the sums of squares, products and squares after each motion.

    A sum of products of blurred pictures is one of the pictures' correlation, with the kernel's own as weights. Pairs
    of pixels so far apart are the fewer, the fewer are inside [h,w].
    """
    weights = _kernels_correlated().to(right)
    lag = math.isqrt(weights.shape[1]) // 2
    size = [_fast(side + lag) for side in right.shape]
    spectra = [torch.fft.rfft2(plane, s=size) for plane in (right, down, inside.to(right))]
    powers = torch.stack([(a.conj() * b).real for a, b in (*_pairs(*spectra[:2]), (spectra[2], spectra[2]))])
    correlated = torch.fft.irfft2(powers, s=size).roll((lag, lag), (-2, -1))[:, : 2 * lag + 1, : 2 * lag + 1]
    *products, number = correlated.flatten(1)
    share = number / number[len(number) // 2].clamp(min=1)
    found: Tensor = (torch.stack(products) / share.clamp(min=LEAST_SHARE)) @ weights.T
    return found


@cache
def _fast(side: int) -> int:
    """The next length without large factors: with them a transform takes twice as long."""
    rest = side
    for factor in (2, 3, 5, 7, 11):
        while rest % factor == 0:
            rest //= factor
    return side if rest == 1 else _fast(side + 1)


@cache
def _kernels_correlated() -> Tensor:
    """[motions,(2L+1)^2] float32: each kernel's correlation with itself."""
    kernels = [motion_kernel(*motion) for motion in motions()]
    side = 2 * max(len(kernel) for kernel in kernels) - 1
    spectra = torch.stack([torch.fft.rfft2(kernel, s=(side, side)) for kernel in kernels])
    found: Tensor = torch.fft.irfft2(spectra.abs().square(), s=(side, side)).roll((side // 2,) * 2, (1, 2))
    return found.flatten(1).to(torch.float32)


@cache
def _taps(number: int) -> Taps:
    kernel = motion_kernel(*motions()[number])
    kernel = torch.where(kernel > LEAST_WEIGHT, kernel, 0.0)
    reach = len(kernel) // 2
    kernel = kernel / kernel.sum()
    found = kernel.nonzero().tolist() if number else []
    return tuple((down - reach, right - reach, float(kernel[down, right])) for down, right in found)

"""Is the render as sharp as the photograph, everywhere and in every band? Measures that forgive shifts of some pixels.

Images are [H,W,3] float sRGB in [0,1], masks [H,W] bool, as in `image_metrics.py`. Windows may reach over the mask's
edge: outside the mask both images should hold the same (the photograph), so that only the mask's inside makes a
difference.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.metrics.image_metrics import eroded, gradient_magnitude, luminance
from advtex_engine.metrics.photograph import Photograph
from advtex_engine.refine.exposure import BRIGHT, DARK
from advtex_engine.render.filtering import blurred, window_sums

BANDS = 3
BAND_SIGMA = 1.2
"""Standard deviation in pixels of the low-pass whose rest is a band; each band has half the size of the one before."""
TILE, LEAST_TILE = 32, 8
"""Side of the tiles whose energies are compared, at full size and at least."""
TILE_SHARE = 0.8
"""Share of a tile that must lie in the mask."""
BAND_FLOOR = 1e-5
"""Energy that counts as nothing: that of 8-bit rounding and a little noise."""

S3_BLOCK, S3_STEP = 32, 8
S3_SLOPE, S3_CENTER = -3.0, 2.0
"""The sigmoid from spectral slope to sharpness: beta_1 and beta_2 of the paper's equation 4."""
S3_LEAST_CONTRAST, S3_LEAST_MEAN = 5.0, 2.0
"""Gray levels; blocks below have no sharpness (paper section III-A)."""
S3_SHARE = 0.95
"""Share of a block that must lie in the mask."""
S3_ROWS = 8
"""Rows of blocks whose spectra are held at once: those of all take twice as long, most of it for new memory."""

FLAT_SIGMA = 1.5
"""Standard deviation in pixels of the low-pass that separates fine texture, noise and ringing from shading."""
FLAT_WINDOW = 17
"""Side of the window that must be flat: edges that a misaligned render shows some pixels away stay out."""
FLAT_GRADIENT = 0.8 / 255
"""Root mean square of the smoothed photograph's gradient per pixel, below which a window is flat: shading, sensor noise
and JPEG blocks pass, wood grain and carpets do not (looked at on photographs of two kitchens)."""
FLAT_PIXELS = 500
"""Flat pixels that a view must show for anything to be said of them."""


def band_error(image: Tensor, truth: Photograph) -> float:
    """Mean |ln| of the ratio of amplitudes in three bands of a Laplacian pyramid, tile by tile; 0 is best.

    Tiles of 32, 16 and 8 pixels of the bands at full, half and quarter size count when they lie in the mask to 80 %.
    Insensitive to small shifts; blur, noise and wrong texture show. NaN when no tile lies in the mask.
    """
    assert image.shape == truth.color.shape
    pairs = zip(_band_energies(image, truth.mask), truth.once(_band_energies), strict=True)
    errors = [float((ours / theirs).log().abs().mean()) / 2 for ours, theirs in pairs]
    return sum(errors) / len(errors) if errors else math.nan


def _band_energies(image: Tensor, mask: Tensor) -> list[Tensor]:
    """Per band the energies [N] of the tiles that count; bands without any are left out."""
    plane, weight = luminance(image), mask.to(torch.float32)
    energies = []
    for band in range(BANDS):
        tile = max(LEAST_TILE, TILE >> band)
        if min(weight.shape) < tile:
            break
        energy = (plane - _low_pass(plane, BAND_SIGMA)).square() * weight
        total, share = F.avg_pool2d(torch.stack((energy, weight))[:, None], tile)[:, 0]
        inside = share > TILE_SHARE
        if bool(inside.any()):
            energies.append(total[inside] / share[inside] + BAND_FLOOR)
        plane, weight = _halved(plane), _halved(weight)
    return energies


def s3_ratio(image: Tensor, truth: Photograph) -> float:
    """Mean S3 sharpness of the image over that of the truth, in blocks that lie in the mask to 95 %; NaN without any.

    S3 is that of `s3_map`. 1 is best, below is blurred.
    """
    assert image.shape == truth.color.shape
    return (_s3(image, truth.mask) + 1e-6) / (truth.once(_s3) + 1e-6)


def _s3(image: Tensor, mask: Tensor) -> float:
    if min(mask.shape) < S3_BLOCK:
        return math.nan
    share = F.avg_pool2d(mask.to(torch.float32)[None, None], S3_BLOCK, S3_STEP)[0, 0]
    return float(s3_map(image)[share > S3_SHARE].mean())


def s3_map(image: Tensor) -> Tensor:
    """S3 (Vu, Phan, Chandler 2012, "A Spectral and Spatial Measure of Local Perceived Sharpness in Natural Images").

    [H,W,3] -> [(H - 32) // 8 + 1, (W - 32) // 8 + 1] in [0,1], one value per 32x32 block: the geometric mean of
    S1, from the slope of the block's magnitude spectrum, and S2, the largest total variation of 2x2 pixels near the
    block's centre.
    """
    gray = luminance(image) * 255
    rows, columns = ((side - S3_BLOCK) // S3_STEP + 1 for side in gray.shape)
    blocks = gray.unfold(0, S3_BLOCK, S3_STEP).unfold(1, S3_BLOCK, S3_STEP)
    near = (gray[:-1, :-1], gray[:-1, 1:], gray[1:, :-1], gray[1:, 1:])
    variation = torch.zeros_like(near[0])
    for first in range(4):
        for second in range(first):
            variation += (near[first] - near[second]).abs()
    window = S3_BLOCK // 4
    start = S3_BLOCK // 2 - window // 2
    largest = F.max_pool2d(variation[None, None, start:, start:], window, S3_STEP)[0, 0, :rows, :columns]
    spatial = (largest / (4 * 255)).clamp(0, 1)
    spectral = torch.cat([_spectral_sharpness(part) for part in blocks.split(S3_ROWS)])  # type: ignore[no-untyped-call]
    return (spectral * spatial).sqrt()


def _spectral_sharpness(blocks: Tensor) -> Tensor:
    """S1 of blocks [R,C,32,32] in gray levels -> [R,C] in [0,1]."""
    hann = torch.hann_window(S3_BLOCK, periodic=False, device=blocks.device)
    # The spectrum of real numbers is symmetric: of its two halves one is enough, whose inner columns count twice.
    magnitude = torch.fft.rfft2(blocks * (hann[:, None] * hann)).abs().flatten(-2)
    frequency = torch.fft.fftfreq(S3_BLOCK, 1 / S3_BLOCK, device=blocks.device)
    half = torch.arange(S3_BLOCK // 2 + 1, device=blocks.device)
    ring = torch.hypot(frequency[:, None], half.to(torch.float32)).round().flatten()
    radii = torch.arange(1, S3_BLOCK // 2 + 1, device=blocks.device)
    twice = torch.where((half == 0) | (half == S3_BLOCK // 2), 1.0, 2.0).repeat(S3_BLOCK)
    members = (ring[:, None] == radii) * twice[:, None]
    spectrum = magnitude @ (members / members.sum(0))
    logs, positions = spectrum.clamp(min=1e-6).log(), radii.to(torch.float32).log()
    positions = positions - positions.mean()
    slope = -(logs * positions).sum(-1) / positions.square().sum()
    sharpness = 1 - torch.sigmoid(-S3_SLOPE * (slope - S3_CENTER))
    contrast = blocks.amax((-2, -1)) - blocks.amin((-2, -1))
    visible = (contrast > S3_LEAST_CONTRAST) & (blocks.mean((-2, -1)) > S3_LEAST_MEAN)
    return sharpness * visible


def flat_energy(image: Tensor, truth: Photograph, covered: Tensor) -> float:
    """Fine texture of the image over that of the truth where the truth is flat: above 1 ringing, speckles or seams.

    The ratio of root mean squares of luminance minus its low-pass (`FLAT_SIGMA`) over `flat_pixels`. The photograph's
    sensor noise is part of the reference: a render without any grain scores below 1. covered: pixels of the mask that
    the render covers; its holes would be counted as texture. NaN below FLAT_PIXELS.
    """
    assert image.shape == truth.color.shape == (*covered.shape, 3)
    flat = truth.once(flat_pixels) & eroded(covered, FLAT_WINDOW // 2)
    if int(flat.sum()) < FLAT_PIXELS:
        return math.nan
    details = (_detail(image, truth.mask), truth.once(_detail))
    ours, theirs = (float(detail[flat].double().square().mean().sqrt()) for detail in details)
    return (ours + 1e-6) / (theirs + 1e-6)


def _detail(image: Tensor, _: Tensor) -> Tensor:
    plane = luminance(image)
    return plane - _low_pass(plane, FLAT_SIGMA)


def flat_pixels(truth: Tensor, mask: Tensor) -> Tensor:
    """Where a photograph [H,W,3] is flat, [H,W] bool: nothing but noise and slow shading in a 17x17 window.

    The window must lie in the mask, and the root mean square of the smoothed luminance's gradient in it must be below
    FLAT_GRADIENT. Clipped pixels do not count: they have no noise to compare with.
    """
    smooth = torch.stack([_low_pass(plane, FLAT_SIGMA) for plane in truth.to(torch.float32).permute(2, 0, 1)])
    clear = ((smooth > DARK) & (smooth < BRIGHT)).all(0)
    gradient = gradient_magnitude(_low_pass(luminance(truth), FLAT_SIGMA))
    radius = FLAT_WINDOW // 2
    square = window_sums(gradient.double().square()[None], radius)[0] / FLAT_WINDOW**2
    return eroded(mask, radius) & (square < FLAT_GRADIENT**2) & clear


def _low_pass(plane: Tensor, sigma: float) -> Tensor:
    """`blurred`, [H,W]: one plane after the other, since several at once take a CPU longer."""
    return blurred(plane[None], sigma)[0]


def _halved(plane: Tensor) -> Tensor:
    """The next level of the Gaussian pyramid (Burt & Adelson 1983): [H,W] -> [(H+1)//2,(W+1)//2]."""
    kernel = plane.new_tensor([1.0, 4.0, 6.0, 4.0, 1.0]) / 16
    padded = F.pad(plane[None, None], (2,) * 4, mode="reflect")
    rows = F.conv2d(padded, kernel.expand(1, 1, 1, -1), stride=(1, 2))
    return F.conv2d(rows, kernel[:, None].expand(1, 1, -1, 1), stride=(2, 1))[0, 0]

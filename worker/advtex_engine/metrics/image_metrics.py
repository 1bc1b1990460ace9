"""How a render differs from a photograph, and a texture from the truth; `sharpness.py` has the spectral measures.

Images are [H,W,3] float sRGB in [0,1]; masks are [H,W] bool and say which pixels count. What depends on the truth alone
is found once for all images that are compared with it (`Photograph.once`). Nothing here is used in the optimization.
PSNR and SSIM assume perfect alignment and prefer a blurred image to a sharp one that is a pixel off: on real scans read
the gradient ratio and the distance between patch statistics first, and look.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from advtex_engine.metrics.photograph import Photograph
from advtex_engine.render.filtering import window_sums

LUMINANCE = (0.299, 0.587, 0.114)
PATCH = 7
"""Side of the patches that are compared (paper section 4)."""
SSIM_WINDOW, SSIM_SIGMA = 11, 1.5
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2
PROJECTIONS = 128
MAX_PATCHES = 1 << 14
"""Patches per image in the sliced Wasserstein distance; of more, as many are drawn, at the same places in both. All
that a photograph has take nine times as long, and differ by a hundredth."""
GRADIENT_MARGIN = 2
"""Pixels between the mask's edge and those whose gradient counts: the edge itself is a step that belongs to neither."""
MAX_PSNR = 100.0
"""Decibels given to equal images."""
CHUNK_BYTES = 256 << 20
"""Bound on the distance matrix's part that is held at once."""
PATCH_BLOCK = 1 << 16
"""Patches of the truth that are held at once: its columns."""


def psnr(image: Tensor, truth: Photograph) -> float:
    """Peak signal-to-noise ratio in dB over the mask."""
    assert image.shape == truth.color.shape
    error = float((image - truth.color)[truth.mask].double().square().mean())
    return min(MAX_PSNR, -10 * math.log10(max(error, 1e-30)))


def ssim(image: Tensor, truth: Photograph) -> float:
    """Structural similarity (Wang et al. 2004) of the luminance, Gaussian window, mean over the mask.

    The window's weights are those of the masked pixels alone, so nothing outside the mask has any influence.
    """
    assert image.shape == truth.color.shape
    share = truth.once(_window_share)
    (x, mean_x, square_x), (y, mean_y, square_y) = _window_means(image, truth.mask), truth.once(_window_means)
    mean_x, mean_y = mean_x / share, mean_y / share
    variance_x, variance_y = square_x / share - mean_x.square(), square_y / share - mean_y.square()
    covariance = _windowed(x * y * truth.mask) / share - mean_x * mean_y
    likeness = ((2 * mean_x * mean_y + SSIM_C1) * (2 * covariance + SSIM_C2)) / (
        (mean_x.square() + mean_y.square() + SSIM_C1) * (variance_x + variance_y + SSIM_C2)
    )
    return float(likeness[truth.mask].mean())


def _window_share(_: Tensor, mask: Tensor) -> Tensor:
    return _windowed(mask.to(torch.float32)).clamp(min=1e-8)


def _window_means(image: Tensor, mask: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The luminance, and under the window its mean and that of its square, both times the mask's share; [H,W] each."""
    plane = luminance(image)
    return plane, _windowed(plane * mask), _windowed(plane * plane * mask)


def _windowed(plane: Tensor) -> Tensor:
    """A plane [H,W] under SSIM's window; outside there is nothing."""
    offset = torch.arange(SSIM_WINDOW, dtype=torch.float32, device=plane.device) - SSIM_WINDOW // 2
    window = torch.exp(-offset.square() / (2 * SSIM_SIGMA**2))
    window = window / window.sum()
    rows = F.conv2d(plane[None, None], window.view(1, 1, -1, 1), padding=(SSIM_WINDOW // 2, 0))
    return F.conv2d(rows, window.view(1, 1, 1, -1), padding=(0, SSIM_WINDOW // 2))[0, 0]


def gradient_ratio(image: Tensor, truth: Photograph) -> float:
    """Mean luminance gradient (Sobel) of the image over that of the truth: below 1 blurred, above 1 noisy or seamy.

    Counts pixels whose whole 5x5 neighborhood lies in the mask; 1 when neither image has a gradient there.
    """
    assert image.shape == truth.color.shape
    return (_gradient(image, truth.mask) + 1e-6) / (truth.once(_gradient) + 1e-6)


def _gradient(image: Tensor, mask: Tensor) -> float:
    return float(gradient_magnitude(luminance(image))[eroded(mask, GRADIENT_MARGIN)].mean())


def sharpness_ratio(image: Tensor, truth: Photograph) -> float:
    """Mean magnitude of the luminance's Laplacian, image over truth: the finest detail alone; otherwise as
    `gradient_ratio`."""
    assert image.shape == truth.color.shape
    return (_laplacian(image, truth.mask) + 1e-6) / (truth.once(_laplacian) + 1e-6)


def _laplacian(image: Tensor, mask: Tensor) -> float:
    kernel = image.new_tensor([[0.0, 1.0, 0.0], [1.0, -4.0, 1.0], [0.0, 1.0, 0.0]])
    return float(_filtered(luminance(image), kernel).abs()[eroded(mask, GRADIENT_MARGIN)].mean())


def nearest_patch_loss(
    image: Tensor, truth: Tensor, mask: Tensor | None = None, *, queries: int | None = None, seed: int = 0
) -> float:
    """The paper's nearest patch loss (section 4.1): how far each 7x7 patch of the image is from the truth's nearest.

    L2 distance over the square root of the patch's 147 numbers, in levels of 0 to 255, mean over all patches that lie
    within the image, or over `queries` of them drawn with `seed`; always against all patches of the truth. mask:
    patches count that lie in it entirely, in both images; without one the images may differ in size. Cost grows with
    the product of the patch counts. NaN when there is no patch.
    """
    ours, theirs = _patch_corners(image, mask, queries, seed), _patch_corners(truth, mask)
    if len(ours) == 0:
        return math.nan
    # |a - b|^2 = |a|^2 + |b|^2 - 2ab suffers from cancellation unless both sides are centred.
    center = _patches(truth, theirs[:PATCH_BLOCK]).mean(0)
    rows = max(1, CHUNK_BYTES // (4 * PATCH_BLOCK))
    total = 0.0
    for part in ours.split(rows):  # type: ignore[no-untyped-call]
        seeking = _patches(image, part) - center
        least = torch.full((len(part),), math.inf, device=image.device)
        for block in theirs.split(PATCH_BLOCK):  # type: ignore[no-untyped-call]
            offered = _patches(truth, block) - center
            squares = torch.addmm(offered.square().sum(1), seeking, offered.T, alpha=-2)
            least = torch.minimum(least, squares.amin(1))
        total += float((least + seeking.square().sum(1)).clamp(min=0).double().sqrt().sum())
    return total / len(ours) / math.sqrt(PATCH * PATCH * 3)


def sliced_wasserstein(image: Tensor, truth: Photograph) -> float:
    """Sliced Wasserstein-1 distance between the images' distributions of 7x7 patches, in levels of 0 to 255.

    Patches become vectors of 147 numbers; along each of PROJECTIONS random unit vectors both sets are sorted and the
    mean absolute difference is taken. Where things lie does not matter, only what they look like: blur and noise
    show, a shift does not. Patches count that lie in the mask entirely. NaN when there is none.
    """
    assert image.shape == truth.color.shape
    ours, theirs = _sorted_patches(image, truth.mask), truth.once(_sorted_patches)
    if ours.size == 0:
        return math.nan
    ours -= theirs
    return float(np.abs(ours, out=ours).mean())


def _sorted_patches(image: Tensor, mask: Tensor) -> NDArray[np.float32]:
    """[PROJECTIONS,N]: patches along each of the vectors, in ascending order."""
    corners = _patch_corners(image, mask, MAX_PATCHES)
    directions = torch.randn(PATCH * PATCH * 3, PROJECTIONS, generator=torch.Generator().manual_seed(0))
    directions = directions.to(image.device)
    directions = directions / directions.norm(dim=0)
    values: NDArray[np.float32] = (directions.T @ _patches(image, corners).T).cpu().numpy()
    values.sort(axis=1)  # NumPy sorts float32 ten times as fast as torch on a CPU
    return values


METRICS = {
    "psnr": psnr,
    "ssim": ssim,
    "gradient_ratio": gradient_ratio,
    "sharpness_ratio": sharpness_ratio,
    "sliced_wasserstein": sliced_wasserstein,
}


def score_views(renders: Iterable[Tensor], photos: Iterable[Tensor], masks: Iterable[Tensor]) -> dict[str, float]:
    """Each metric's mean over views: renders and photos [H,W,3] (float in [0,1] or uint8), masks [H,W] bool.

    Views whose mask leaves no 7x7 patch do not count; `views` says how many did. Empty when none did.
    """
    scores: list[dict[str, float]] = []
    for render, photo, mask in zip(renders, photos, masks, strict=True):
        if not bool(eroded(mask, PATCH // 2).any()):
            continue
        image, truth = _unit(render), Photograph(_unit(photo).to(render.device), mask.to(render.device))
        scores.append({name: metric(image, truth) for name, metric in METRICS.items()})
    if not scores:
        return {}
    means = {name: sum(score[name] for score in scores) / len(scores) for name in METRICS}
    return means | {"views": float(len(scores))}


def eroded(mask: Tensor, radius: int) -> Tensor:
    """Pixels [H,W] bool whose whole (2 radius + 1)^2 neighborhood lies inside the image and the mask."""
    # Sums by runs take a CPU a fifteenth of what pooling does.
    return window_sums(mask.to(torch.int16)[None], radius)[0] == (2 * radius + 1) ** 2


def _unit(image: Tensor) -> Tensor:
    return image.to(torch.float32) / (255 if image.dtype == torch.uint8 else 1)


def luminance(image: Tensor) -> Tensor:
    """[H,W,3] -> [H,W] float32."""
    return image.to(torch.float32) @ torch.tensor(LUMINANCE, device=image.device)


def gradient_magnitude(plane: Tensor) -> Tensor:
    """Length of the Sobel gradient of a plane [H,W], per pixel."""
    kernel = plane.new_tensor([[-1.0, 0.0, 1.0], [-2.0, 0.0, 2.0], [-1.0, 0.0, 1.0]]) / 8
    return torch.hypot(_filtered(plane, kernel), _filtered(plane, kernel.T))


def _filtered(plane: Tensor, kernel: Tensor) -> Tensor:
    padded = F.pad(plane[None, None], (1, 1, 1, 1), mode="replicate")
    return F.conv2d(padded, kernel[None, None])[0, 0]


def _patch_corners(image: Tensor, mask: Tensor | None, most: int | None = None, seed: int = 0) -> Tensor:
    """Flat indices [N] of the first pixels of the patches inside image and mask, row by row; at most `most`, drawn."""
    height, width = image.shape[:2]
    whole = torch.ones((height, width), dtype=torch.bool, device=image.device) if mask is None else mask
    edge = PATCH // 2
    rows, columns = eroded(whole, edge).nonzero().unbind(1)
    corners = (rows - edge) * width + columns - edge
    if most is None or len(corners) <= most:
        return corners
    drawn = torch.randperm(len(corners), generator=torch.Generator().manual_seed(seed))[:most]
    return corners[drawn.to(corners.device)]


def _patches(image: Tensor, corners: Tensor) -> Tensor:
    """The 7x7 patches whose first pixels are `corners` [N] (flat indices), as [N,147] in levels of 0 to 255."""
    steps = torch.arange(PATCH, device=image.device)
    rows = (image.to(torch.float32) * 255).reshape(-1).unfold(0, PATCH * 3, 3)  # seven pixels each
    return rows[corners[:, None] + steps * image.shape[1]].flatten(1)

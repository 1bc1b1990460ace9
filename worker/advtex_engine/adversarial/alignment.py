"""Alignment inside the loop: both examples are moved onto the source image before they are judged.

Per block of the crop, the offset between an example and the source is found by phase correlation (Kuglin & Hines 1975),
as Zhao et al. 2022 do per pair. What poses and geometry leave is not one offset per pair but a field of them, smooth
where surfaces are: the blocks' offsets are interpolated. A block keeps its place where no offset is clearly better than
none: flat walls, changed scenes, offsets beyond the bound.

Images [N,C,H,W]; offsets in pixels, x then y. The offsets are constants to autograd; the moved image is differentiable.
"""

from __future__ import annotations

import functools

import torch
import torch.nn.functional as F
from torch import Tensor

BLOCK = 64  # pixels, every BLOCK / 2: large enough for the search, small against the offsets' field
SHARE_OF_WIDTH = 1 / 128  # the largest offset that is believed: 5 of 640 pixels
MIN_SEEN = 0.6  # of a block
# Of the correlation of equal spectra. On two kitchens a third of the blocks below .2 fit worse at the offset found than
# at none, 15 of 100 at .35 and 7 at .55.
MIN_CORRELATION = 0.25
MIN_GAIN = 1.15  # of the correlation at the best offset over that at none
WHITENING = 0.5  # 1 is phase correlation proper, which noise leads astray; 0 is plain correlation, which edges blur
DETAIL = 11  # pixels; what is smoother is exposure and shading


def search_bound(width: int) -> int:
    """The largest offset in pixels that is believed in views of this width."""
    return max(2, round(width * SHARE_OF_WIDTH))


def example_offsets(condition: Tensor, real: Tensor, fake: Tensor, visible: Tensor, bound: int) -> Tensor:
    """`block_offsets` [2,gh,gw,2] of the real and the fake example [1,3,H,W] against the source image."""
    return block_offsets(condition, torch.cat((real, fake.detach())), visible, bound)


@torch.no_grad()
def block_offsets(reference: Tensor, examples: Tensor, mask: Tensor, bound: int) -> Tensor:
    """Offsets [N,gh,gw,2] with examples(x + offset) ~ reference(x), for blocks every BLOCK / 2 pixels.

    reference: [1,3,H,W]. examples: [N,3,H,W]. mask: [1,1,H,W] float 0/1, what counts. H, W of at least BLOCK.
    """
    height, width = reference.shape[-2:]
    assert examples.shape[1:] == (3, height, width) and mask.shape == (1, 1, height, width)
    detail = _detail(torch.cat((reference, examples)), mask)
    blocks = detail.unfold(1, BLOCK, BLOCK // 2).unfold(2, BLOCK, BLOCK // 2)
    spectrum = torch.fft.rfft2(blocks * fading_window(reference.device))
    cross = spectrum[1:] * spectrum[:1].conj()
    strength = cross.abs()
    correlation = torch.fft.irfft2(cross / (strength.pow(WHITENING) + 1e-6), s=(BLOCK, BLOCK))
    highest = _mean_of_half_spectrum(strength.pow_(1 - WHITENING))
    best, place = correlation.flatten(-2).max(-1)
    y, x = place // BLOCK, place % BLOCK
    x, y = x - BLOCK * (x >= BLOCK // 2), y - BLOCK * (y >= BLOCK // 2)
    near = (x.abs() <= bound) & (y.abs() <= bound)
    seen = F.avg_pool2d(mask, BLOCK, BLOCK // 2)[:, 0] > MIN_SEEN
    clear = (best > MIN_CORRELATION * highest) & (best > MIN_GAIN * correlation[..., 0, 0])
    believed = near & seen & clear
    offsets: Tensor = torch.stack((x, y), -1) * believed[..., None].to(torch.float32)
    return offsets


def shift(images: Tensor, offsets: Tensor) -> Tensor:
    """images(x + offset(x)) [N,C,H,W], the offsets [N,gh,gw,2] of `block_offsets` interpolated between block centers.

    Bilinear, differentiable in the images; the border is repeated outward.
    """
    return move(images, moved_positions(offsets, images.shape[-2:]))


def moved_positions(offsets: Tensor, size: tuple[int, int] | torch.Size) -> Tensor:
    """x + offset(x) [N,H,W,2] for images of `size` (H, W), in units of -1 to 1 from border to border."""
    height, width = size
    count, rows, columns, two = offsets.shape
    assert two == 2
    x = torch.arange(width, device=offsets.device) + 0.5
    y = torch.arange(height, device=offsets.device) + 0.5
    xy = torch.stack((x.expand(height, -1), y[:, None].expand(-1, width)), -1)
    # In units of blocks from the first center; beyond the outer centers the offset is theirs.
    step = BLOCK // 2
    at_x = (x - BLOCK / 2) * (2 / (step * max(columns - 1, 1))) - 1
    at_y = (y - BLOCK / 2) * (2 / (step * max(rows - 1, 1))) - 1
    at = torch.stack((at_x.expand(height, -1), at_y[:, None].expand(-1, width)), -1)
    field = F.grid_sample(
        offsets.permute(0, 3, 1, 2), at.expand(count, -1, -1, -1), align_corners=True, padding_mode="border"
    )
    moved = xy + field.permute(0, 2, 3, 1)
    return torch.stack((moved[..., 0] * (2 / width) - 1, moved[..., 1] * (2 / height) - 1), -1)


def move(images: Tensor, positions: Tensor) -> Tensor:
    """images [N,C,H,W] at `moved_positions` [N,H,W,2]."""
    assert positions.shape == (images.shape[0], *images.shape[2:], 2)
    return F.grid_sample(images, positions, align_corners=False, padding_mode="border")


@functools.cache
def fading_window(device: torch.device) -> Tensor:
    """[BLOCK,BLOCK], which fades out towards the block's border."""
    window = torch.hann_window(BLOCK, periodic=False, device=device)
    square: Tensor = window[:, None] * window
    return square


def _mean_of_half_spectrum(half: Tensor) -> Tensor:
    """Mean of a real, even spectrum [...,BLOCK,BLOCK] of which the columns [...,BLOCK,BLOCK // 2 + 1] are given."""
    twice = half[..., 1:-1].sum((-2, -1))
    mean: Tensor = (half[..., 0].sum(-1) + half[..., -1].sum(-1) + 2 * twice) / BLOCK**2
    return mean


def _detail(images: Tensor, mask: Tensor) -> Tensor:
    """Luminance without its local mean, 0 outside the mask [N,H,W]."""
    red, green, blue = images[:, :1], images[:, 1:2], images[:, 2:]
    luminance = (0.299 * red + 0.587 * green + 0.114 * blue) * mask
    smooth = box_mean(box_mean(luminance, 2), 3)
    return ((luminance - smooth) * mask)[:, 0]


def box_mean(images: Tensor, dim: int) -> Tensor:
    """Means of [N,1,H,W] over DETAIL pixels along one side, zero beyond the border."""
    half = DETAIL // 2
    if images.is_cuda:
        along, padding = ((DETAIL, 1), (half, 0)) if dim == 2 else ((1, DETAIL), (0, half))
        return F.avg_pool2d(images, along, 1, padding)
    # The same sums in the same order, ten times as fast: a CPU's pooling adds up value by value.
    count = images.shape[dim]
    padded = F.pad(images, (0, 0, half, half) if dim == 2 else (half, half))
    total = padded.narrow(dim, 0, count) + padded.narrow(dim, 1, count)
    for place in range(2, DETAIL):
        total += padded.narrow(dim, place, count)
    return total.div_(DETAIL)

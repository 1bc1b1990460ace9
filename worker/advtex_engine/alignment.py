"""Alignment inside the loop: both examples are moved onto the source image before they are judged.

Per block of the crop, the offset between an example and the source is found by phase correlation (Kuglin & Hines 1975),
as Zhao et al. 2022 do per pair. What poses and geometry leave is not one offset per pair but a field of them, smooth
where surfaces are: the blocks' offsets are interpolated. A block keeps its place where no offset is clearly better than
none: flat walls, changed scenes, offsets beyond the bound.

Images [N,C,H,W]; offsets in pixels, x then y. The offsets are constants to autograd; the moved image is differentiable.
"""

from __future__ import annotations

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


@torch.no_grad()
def block_offsets(reference: Tensor, examples: Tensor, mask: Tensor, bound: int) -> Tensor:
    """Offsets [N,gh,gw,2] with examples(x + offset) ~ reference(x), for blocks every BLOCK / 2 pixels.

    reference: [1,3,H,W]. examples: [N,3,H,W]. mask: [1,1,H,W] float 0/1, what counts. H, W of at least BLOCK.
    """
    height, width = reference.shape[-2:]
    assert examples.shape[1:] == (3, height, width) and mask.shape == (1, 1, height, width)
    detail = _detail(torch.cat((reference, examples)), mask)
    blocks = detail.unfold(1, BLOCK, BLOCK // 2).unfold(2, BLOCK, BLOCK // 2)
    window = torch.hann_window(BLOCK, periodic=False, device=reference.device)
    spectrum = torch.fft.rfft2(blocks * (window[:, None] * window))
    cross = spectrum[1:] * spectrum[:1].conj()
    energy = cross.abs().pow(1 - WHITENING)
    correlation = torch.fft.irfft2(cross / (cross.abs().pow(WHITENING) + 1e-6), s=(BLOCK, BLOCK))
    highest = torch.fft.irfft2(energy.to(cross.dtype), s=(BLOCK, BLOCK))[..., 0, 0]
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
    count, _, height, width = images.shape
    assert offsets.shape[0] == count and offsets.shape[3] == 2
    xy = torch.stack(
        torch.meshgrid(
            torch.arange(width, device=images.device) + 0.5,
            torch.arange(height, device=images.device) + 0.5,
            indexing="xy",
        ),
        -1,
    )
    # In units of blocks from the first center; beyond the outer centers the offset is theirs.
    grid_size = torch.tensor(offsets.shape[2:0:-1], device=images.device)
    at = (xy - BLOCK / 2) / (BLOCK // 2) / (grid_size - 1).clamp(min=1) * 2 - 1
    field = F.grid_sample(
        offsets.permute(0, 3, 1, 2), at.expand(count, -1, -1, -1), align_corners=True, padding_mode="border"
    )
    target = (xy + field.permute(0, 2, 3, 1)) / xy.new_tensor((width, height)) * 2 - 1
    return F.grid_sample(images, target, align_corners=False, padding_mode="border")


def _detail(images: Tensor, mask: Tensor) -> Tensor:
    """Luminance without its local mean, 0 outside the mask [N,H,W]."""
    weights = images.new_tensor((0.299, 0.587, 0.114)).view(1, 3, 1, 1)
    luminance = (images * weights).sum(1, keepdim=True) * mask
    rows = F.avg_pool2d(luminance, (DETAIL, 1), 1, (DETAIL // 2, 0))
    smooth = F.avg_pool2d(rows, (1, DETAIL), 1, (0, DETAIL // 2))
    return ((luminance - smooth) * mask)[:, 0]

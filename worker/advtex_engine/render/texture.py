"""Sampling a texture stored as the compact list of its texels, and filling the texels that no view touched.

Convention: uv has its origin at the texture's first row and column; texel (row i, column j) has its centre at
((j + 0.5) / width, (i + 0.5) / height). Between centres the texture is bilinear; outside the outermost centres it
is clamped.

The optimizer owns only the texels that some view samples, as a matrix [N,C] (`slot` = row). A 2048² atlas is about half
empty, so this halves the bytes of the gradient and of Adam's state; a slot map [H,W] int32 (-1 = not owned) leads from
the dense texture to the rows.
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

UV_LEVELS = 65535
LEAST_WEIGHT = 1e-6  # of a pixel's owned texels; some are owned where a view shows the surface
FAR_APART = 4.0  # texels between what neighboring pixels show, beyond which they show different charts


def encode_uv(uv: Tensor) -> Tensor:
    """uv [...,2] float in [0,1] -> int16, 1/65535 of the texture per level (1/32 texel at 2048)."""
    return ((uv.clamp(0, 1) * UV_LEVELS).round() - 32768).to(torch.int16)


def decode_uv(code: Tensor) -> Tensor:
    """Inverse of `encode_uv`: int16 [...,2] -> float32 uv."""
    return (code.to(torch.float32) + 32768) / UV_LEVELS


def bilinear_footprint(xy: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
    """The four grid cells around continuous pixel positions, and their weights.

    xy: [P,2] positions in pixels, first centre at (0.5, 0.5); clamped to the outermost centres.
    Returns indices [P,4] int64 into the flattened height x width grid and weights [P,4]; order: (y0,x0), (y0,x1),
    (y1,x0), (y1,x1). Not differentiable with respect to xy.
    """
    assert xy.ndim == 2 and xy.shape[1] == 2
    x = (xy[:, 0] - 0.5).clamp(0, width - 1)
    y = (xy[:, 1] - 0.5).clamp(0, height - 1)
    x0 = x.floor().clamp(max=max(width - 2, 0))
    y0 = y.floor().clamp(max=max(height - 2, 0))
    corner = y0.long() * width + x0.long()
    right, down = (1 if width > 1 else 0), (width if height > 1 else 0)
    pair = torch.arange(2, device=xy.device)
    indices = corner[:, None] + (pair[:, None] * down + pair * right).flatten()
    fx, fy = x - x0, y - y0
    weights = torch.stack(((1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy)).T.contiguous()
    return indices, weights


def area_footprint(xy: Tensor, seen: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
    """The 3 x 3 grid cells around what each pixel shows, and their weights: its area's mean, not its middle's value.

    A photograph's pixel is the mean of what lies before it, and so is a renderer's with several samples; a texture that
    is compared with photographs at the pixels' middles alone learns to be as soft as these means. Four bilinear samples
    half a pixel apart stand for the area; of areas that are wider than two cells, the inner two.

    xy: [h,w,2] positions of the pixels' middles in cells, as in `bilinear_footprint`; seen: [h,w] bool, where they mean
    something. A grid of 3 x 3 cells or more. Returns indices [h*w,9] int64 and weights [h*w,9], row by row. Not
    differentiable with respect to xy.
    """
    assert xy.ndim == 3 and min(width, height) >= 3
    right, down = (_steps(xy, seen, axis).view(-1, 2).T / 4 for axis in (1, 0))
    inner = 0.5 / (right.abs() + down.abs()).clamp(min=0.5)
    right, down = right * inner, down * inner
    middle = xy.view(-1, 2).T - 0.5
    # Made on the device: steps that are captured as a graph copy nothing to it.
    most = torch.cat([torch.full((1, 1), side - 1.0, device=xy.device) for side in (width, height)])
    first = (middle - right.abs() - down.abs()).floor().clamp(min=0).minimum(most - 2)
    samples = torch.stack((middle - right - down, middle + right - down, middle - right + down, middle + right + down))
    place = samples.clamp(min=0).minimum(most) - first  # of samples in the 3 x 3 cells, [4,2,h*w] in [0,2]
    before, after = (1 - place).clamp(min=0), (place - 1).clamp(min=0)
    shares = torch.stack((before, 1 - before - after, after))  # of the cells along each axis
    weights = [(down * right).mean(0) for down in shares[:, :, 1] for right in shares[:, :, 0]]
    corner = first[1].long() * width + first[0].long()
    cells = torch.arange(3, device=xy.device)
    return corner[:, None] + (cells[:, None] * width + cells).flatten(), torch.stack(weights, 1)


def footprints(uv: Tensor, seen: Tensor, slot_map: Tensor, *, areas: bool) -> tuple[Tensor, Tensor]:
    """The owned texels that each pixel of a picture shows, and their weights, which make 1 where it is seen, else 0.

    uv: [h,w,2] int16 of `encode_uv`; seen: [h,w] bool; slot_map: [H,W]. Returns slots and weights [h*w,K]: 9 of
    `area_footprint` with areas, else the 4 of `bilinear_footprint` around the pixels' middles.
    """
    height, width = slot_map.shape
    place = decode_uv(uv)
    position = torch.stack((place[..., 0] * width, place[..., 1] * height), -1)
    if areas:
        texels, weights = area_footprint(position, seen, width, height)
    else:
        texels, weights = bilinear_footprint(position.view(-1, 2), width, height)
    slots = slot_map.flatten().index_select(0, texels.flatten()).view(texels.shape)
    # A pixel that is not seen has uv 0, so any row may stand for a texel that nobody owns.
    weights = weights * seen.reshape(-1, 1)
    if areas:  # reach beyond a chart's border, where nobody owns any
        weights = weights * (slots >= 0)
        weights = weights / weights.sum(1, keepdim=True).clamp(min=LEAST_WEIGHT)
    return slots.clamp(min=0), weights


def _steps(xy: Tensor, seen: Tensor, axis: int) -> Tensor:
    """[h,w,2] how far apart is what a pixel and the next along the axis show: the nearer of both neighbors counts, and
    it is 0 where neither shows the same surface."""
    step = xy.diff(dim=axis)
    count = step.shape[axis]
    same = seen.narrow(axis, 0, count) & seen.narrow(axis, 1, count)
    length = step.abs().amax(-1)
    length = torch.where(same & (length <= FAR_APART), length, torch.inf)
    nothing = torch.zeros_like(xy.narrow(axis, 0, 1))
    far = torch.full_like(nothing[..., 0], torch.inf)
    before, after = torch.cat((far, length), axis), torch.cat((length, far), axis)
    found = torch.where((before < after)[..., None], torch.cat((nothing, step), axis), torch.cat((step, nothing), axis))
    return torch.where(before.minimum(after).isfinite()[..., None], found, 0.0)


class _SampleTexels(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, slots: Tensor, weights: Tensor, into: Tensor | None) -> Tensor:
        ctx.save_for_backward(slots, weights)
        ctx.rows, ctx.into = values.shape[0], into
        return F.embedding_bag(slots, values, per_sample_weights=weights, mode="sum")

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> tuple[Tensor, None, None, None]:
        slots, weights = ctx.saved_tensors
        (grad,) = grads
        # embedding_bag's own backward sorts the indices (ten times slower on a CPU) and has a gradient for weights.
        # Channel by channel, and in place: index_add_ of short rows takes three times as long, with int32 indices seven
        # times, and a plane of every channel that is copied afterwards twice as long.
        index = slots.flatten().long()
        dense = grad.new_zeros((ctx.rows, grad.shape[1])) if ctx.into is None else ctx.into.zero_()
        shares = torch.empty_like(weights)
        for channel in range(grad.shape[1]):
            torch.mul(grad[:, channel, None], weights, out=shares)
            dense[:, channel].index_add_(0, index, shares.flatten())
        return dense, None, None, None


def sample_texels(values: Tensor, slots: Tensor, weights: Tensor, into: Tensor | None = None) -> Tensor:
    """Weighted sum of some texels per pixel: values [N,C], slots [P,K] integer, weights [P,K] -> [P,C].

    Differentiable with respect to `values` only. With the four of `bilinear_footprint` the same as grid_sample
    (bilinear, border, align_corners=False) on the dense texture, without touching the texels that no pixel needs.
    into: [N,C], takes the gradient, and that of the next step again; to map a fresh one of tens of MB page by page
    takes a CPU as long as to fill it.
    """
    assert values.ndim == 2 and slots.ndim == 2 and slots.shape == weights.shape
    out: Tensor = _SampleTexels.apply(values, slots, weights, into)  # type: ignore[no-untyped-call]
    return out


def sample_image(image: Tensor, xy: Tensor) -> Tensor:
    """Bilinear samples of a dense image [H,W,C] at pixel positions xy [P,2] -> [P,C] float32. No gradient."""
    height, width, _ = image.shape
    grid = (xy * (2 / xy.new_tensor([width, height])) - 1)[None, None]
    planes = image.to(torch.float32).permute(2, 0, 1)[None]
    with torch.no_grad():
        sampled = F.grid_sample(planes, grid, mode="bilinear", padding_mode="border", align_corners=False)
    return sampled[0, :, 0].T


def touched_slots(uv_codes: Tensor, foreground: Tensor, width: int, height: int) -> tuple[Tensor, int]:
    """Which texels the views sample.

    uv_codes: [V,H,W,2] int16; foreground: [V,H,W] bool. Returns the slot map [height,width] int32 (-1 = untouched) and
    the number of slots; slots are numbered in row-major texel order.
    """
    touched = torch.zeros(height * width, dtype=torch.bool, device=uv_codes.device)
    size = torch.tensor([width, height], dtype=torch.float32, device=uv_codes.device)
    for codes, mask in zip(uv_codes, foreground, strict=True):
        indices, weights = bilinear_footprint(decode_uv(codes[mask]) * size, width, height)
        touched[indices[weights > 0]] = True
    return number_slots(touched.view(height, width))


def number_slots(touched: Tensor) -> tuple[Tensor, int]:
    """The slot map of touched texels [H,W] bool, and the number of slots, as from `touched_slots`."""
    order = touched.flatten().to(torch.int32).cumsum(0, dtype=torch.int32)
    return torch.where(touched, order.view(touched.shape) - 1, -1), int(order[-1])


def fill_holes(texture: Tensor, known: Tensor) -> Tensor:
    """Colors every unknown texel from the nearest known ones, so that filtering across chart borders never bleeds.

    texture: [H,W,C] float; known: [H,W] bool. Push-pull (Gortler et al. 1996, section 6): average known texels into
    ever coarser levels, then fill from the coarse levels back to the fine ones. Known texels keep their value; a
    texture without a known texel stays as it is.
    """
    assert texture.ndim == 3 and known.shape == texture.shape[:2]
    if not bool(known.any()):
        return texture
    image = texture.permute(2, 0, 1)[None].to(torch.float32)
    weight = known[None, None].to(torch.float32)
    filled = _push_pull(image * weight, weight)
    return torch.where(known[:, :, None], texture, filled[0].permute(1, 2, 0).to(texture.dtype))


def _push_pull(weighted: Tensor, weight: Tensor) -> Tensor:
    """weighted [1,C,H,W] (color times weight), weight [1,1,H,W] in [0,1] -> dense color [1,C,H,W]."""
    height, width = weight.shape[-2:]
    color = weighted / weight.clamp(min=1e-12)
    if height == 1 and width == 1:
        return color
    pooled = F.avg_pool2d(torch.cat((weighted, weight), 1), 2, ceil_mode=True, count_include_pad=False)
    # A coarse texel with any known child counts as fully known: its average is the best guess for the others.
    coarse_weight = pooled[:, -1:]
    coarse_known = (coarse_weight > 0).to(weight.dtype)
    coarse_color = pooled[:, :-1] / coarse_weight.clamp(min=1e-12) * coarse_known
    coarse = _push_pull(coarse_color, coarse_known)
    up = F.interpolate(coarse, scale_factor=2.0, mode="bilinear", align_corners=False)[..., :height, :width]
    return torch.where(weight > 0, color, up)

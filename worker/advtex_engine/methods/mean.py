"""The projected mean: every texel is the mean of the pixels that show it. Blurred wherever views disagree."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor

from advtex_engine.methods.inputs import LossPoint, MethodInput
from advtex_engine.render.texture import bilinear_footprint, decode_uv, fill_holes
from advtex_engine.render.view_maps import ViewMaps
from advtex_engine.runtime.threads import side_by_side

PARTS = 2
"""Of the views, whose sums are found side by side on a CPU: `index_add_` takes one thread. As many on every machine,
so that the sums are the same."""


def mean(given: MethodInput) -> tuple[Tensor, list[LossPoint]]:
    """The mean texture at full size, [H,W,3] float32 in [0,1]; no iterations, so no losses."""
    return given.means[1], []


def mean_texture(maps: ViewMaps) -> Tensor:
    """Splats all foreground pixels with their bilinear weights, normalizes, fills the rest -> [H,W,3] in [0,1]."""
    parts = [range(first, maps.count, PARTS) for first in range(PARTS)]
    with side_by_side(PARTS if maps.device.type == "cpu" else 1) as mapped:
        total = torch.stack(mapped(partial(_splatted, maps), parts)).sum(0)
    return dense_texture(maps, (total[:3] / total[3].clamp(min=1e-6)).T.contiguous())


def _splatted(maps: ViewMaps, views: Sequence[int]) -> Tensor:
    """Sums [4,slots] of red, green, blue and weight over the pixels of some views."""
    height, width = maps.slot_map.shape
    device = maps.device
    size = torch.tensor([width, height], dtype=torch.float32, device=device)
    # Channel by channel: index_add_ of short rows takes three times as long on a CPU.
    total = torch.zeros((4, maps.slots), device=device)
    flat_slots = maps.slot_map.flatten()
    for index in views:
        view = maps.only(index)
        seen = view.depth[0] > 0
        texels, weights = bilinear_footprint(decode_uv(view.uv[0][seen]) * size, width, height)
        slots = flat_slots[texels].clamp(min=0).flatten().long()
        color = view.color[0][seen].to(torch.float32) / 255
        for channel in range(3):
            total[channel].index_add_(0, slots, (color[:, channel, None] * weights).flatten())
        total[3].index_add_(0, slots, weights.flatten())
    return total


def dense_texture(maps: ViewMaps, values: Tensor) -> Tensor:
    """Compact values [slots,3] as a dense texture [H,W,3]; texels that no view touches are filled from others."""
    known = maps.slot_map >= 0
    texture = torch.zeros((*maps.slot_map.shape, 3), dtype=values.dtype, device=values.device)
    texture[known] = values
    return fill_holes(texture, known)

"""A plane of known texture before cameras that look at it straight on, a pixel per texel."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.render.texture import bilinear_footprint, encode_uv, number_slots
from advtex_engine.render.view_maps import ViewMaps

SIDE = 60  # texels
WIDTH, HEIGHT = 56, 50


def maps_of(shifts: list[tuple[float, float]], truth: Tensor) -> ViewMaps:
    """Views that look at the texture straight on, one pixel per texel, from these places; they show means of the truth
    over their pixels."""
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    uv = torch.stack([(torch.stack((x + u, y + v), 2) / SIDE).view(-1, 2) for u, v in shifts])
    quarters = [torch.tensor([u, v]) / 4 / SIDE for u in (-1, 1) for v in (-1, 1)]
    color = torch.stack([torch.stack([sampled(truth, place + by) for by in quarters]).mean(0) for place in uv])
    count = len(shifts)
    slot_map, slots = number_slots(torch.ones((SIDE, SIDE), dtype=torch.bool))
    return ViewMaps(
        color=(color * 255).round().to(torch.uint8),
        uv=encode_uv(uv),
        depth=torch.ones((count, WIDTH * HEIGHT), dtype=torch.float16),
        intrinsics=torch.ones((count, 4)),
        world_to_camera=torch.eye(4, dtype=torch.float64).expand(count, 4, 4),
        slot_map=slot_map,
        slots=slots,
        width=WIDTH,
        height=HEIGHT,
    )


def sampled(texture: Tensor, uv: Tensor) -> Tensor:
    texels, weights = bilinear_footprint(uv * SIDE, SIDE, SIDE)
    return (texture.reshape(-1, 3)[texels] * weights[..., None]).sum(1)


def noise() -> Tensor:
    coarse = torch.rand((1, 3, 30, 30), generator=torch.Generator().manual_seed(1)) * 0.6 + 0.2
    return F.interpolate(coarse, (SIDE, SIDE), mode="bicubic").clamp(0.1, 0.9)[0].permute(1, 2, 0)


def blurred(texture: Tensor) -> Tensor:
    return F.avg_pool2d(texture.permute(2, 0, 1)[None], 3, 1, 1, count_include_pad=False)[0].permute(1, 2, 0)

"""The paper's 2D case as view maps (section 4.1 "2D texture optimization"): a flat texture, views that are shifted.

All cameras claim to be the same, but each view's image is a shifted cut of one picture, so warping a view into another
changes nothing and every pair is misaligned by up to twice the shift.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.render.pairs import Pairs
from advtex_engine.render.texture import encode_uv, touched_slots
from advtex_engine.render.view_maps import ViewMaps


def shifted_views(picture: Tensor, size: int, shift: int, count: int, seed: int) -> Tensor:
    """`count` cuts [count,size,size,3] uint8 of picture [size+2*shift, size+2*shift, 3], shifted by up to +-shift."""
    assert picture.shape == (size + 2 * shift, size + 2 * shift, 3) and picture.dtype == torch.uint8
    offsets = torch.randint(0, 2 * shift + 1, (count, 2), generator=torch.Generator().manual_seed(seed)).tolist()
    return torch.stack([picture[top : top + size, left : left + size] for top, left in offsets])


def planar_maps(color: Tensor, texture_width: int, texture_height: int) -> ViewMaps:
    """View maps of views [V,H,W,3] uint8 that all look straight at the whole texture from 1 m."""
    count, height, width = color.shape[:3]
    device = color.device
    v = (torch.arange(height, device=device) + 0.5) / height
    u = (torch.arange(width, device=device) + 0.5) / width
    codes = encode_uv(torch.stack((u.expand(height, -1), v[:, None].expand(-1, width)), 2))[None]
    everywhere = torch.ones((1, height, width), dtype=torch.bool, device=device)
    slot_map, slots = touched_slots(codes, everywhere, texture_width, texture_height)
    return ViewMaps(
        color=color.reshape(count, height * width, 3),
        uv=codes.reshape(1, -1, 2).repeat(count, 1, 1),
        depth=torch.ones((count, height * width), dtype=torch.float16, device=device),
        intrinsics=torch.tensor([width, width, width / 2, height / 2], device=device).repeat(count, 1).float(),
        world_to_camera=torch.eye(4, dtype=torch.float64, device=device).repeat(count, 1, 1),
        slot_map=slot_map,
        slots=slots,
        width=width,
        height=height,
    )


def planar_pairs(count: int, device: torch.device, *, auxiliary: bool = True) -> Pairs:
    """Every view with every view; with auxiliary=False each view with itself only (the paper's ablation)."""
    views = torch.arange(count, device=device)
    table = views.repeat(count, 1) if auxiliary else views[:, None]
    relative = torch.eye(4, device=device)[:3].expand(*table.shape, 3, 4).contiguous()
    return Pairs(table, torch.full((count,), table.shape[1], device=device), views, relative)


def planar_views(
    count: int, width: int, height: int, texels_per_pixel: float, device: torch.device
) -> tuple[ViewMaps, Pairs]:
    """Views of smooth noise at any size, for timing."""
    noise = torch.rand((count, 3, height // 8 + 1, width // 8 + 1), generator=torch.Generator().manual_seed(0))
    smooth = F.interpolate(noise, (height, width), mode="bilinear", align_corners=False)
    color = (smooth * 255).to(torch.uint8).permute(0, 2, 3, 1).contiguous().to(device)
    maps = planar_maps(color, round(width * texels_per_pixel), round(height * texels_per_pixel))
    return maps, planar_pairs(count, device)

"""A plane of known texture before two cameras: detail comes back, and nothing else changes."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.render.texture import bilinear_footprint, encode_uv, number_slots
from advtex_engine.render.view_maps import ViewMaps
from advtex_engine.selection.back_projection import _window_sums, back_project

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


def test_detail_that_was_lost_comes_back() -> None:
    truth = noise()
    maps = maps_of([(2.3, 1.6)], truth)
    start = blurred(truth)
    found = back_project(start, torch.zeros((SIDE, SIDE), dtype=torch.int64), maps)
    inner = slice(10, 44)
    before, after = ((part - truth)[inner, inner].square().mean().sqrt() for part in (start, found))
    assert after < 0.4 * before


def test_what_leveling_did_stays() -> None:
    truth = noise()
    maps = maps_of([(2.0, 2.0)], truth)  # on the texels: nothing is lost
    rising = truth + torch.linspace(-0.05, 0.05, SIDE)[None, :, None]
    found = back_project(rising, torch.zeros((SIDE, SIDE), dtype=torch.int64), maps)
    inner = slice(10, 44)
    torch.testing.assert_close(found[inner, inner], rising[inner, inner], atol=6e-3, rtol=0)


def test_each_texel_hears_its_own_view_alone() -> None:
    truth = noise()
    maps = maps_of([(2.3, 1.6), (2.4, 1.7)], truth)
    other = maps_of([(2.4, 1.7)], noise().flip(0))  # as fine
    mixed = torch.stack((maps.color[0], other.color[0]))
    label = torch.zeros((SIDE, SIDE), dtype=torch.int64)
    label[:, SIDE // 2 :] = 1
    label[:5] = -1
    start = blurred(truth)
    clean = back_project(start, label, maps)
    spoiled = back_project(start, label, ViewMaps(**{**vars(maps), "color": mixed}))
    assert torch.equal(clean[:5], start[:5])
    assert torch.equal(clean[:, : SIDE // 2], spoiled[:, : SIDE // 2])
    assert not torch.equal(clean[:, SIDE // 2 :], spoiled[:, SIDE // 2 :])
    assert not torch.equal(clean[5:, : SIDE // 2], start[5:, : SIDE // 2])


def test_windows_are_summed_as_a_pool_of_ones_does() -> None:
    planes = torch.rand((3, 37, 52), generator=torch.Generator().manual_seed(4)) - 0.5
    expected = 81 * F.avg_pool2d(planes, 9, 1, 4)
    torch.testing.assert_close(_window_sums(planes, 4), expected, atol=1e-4, rtol=0)


def test_a_view_that_shows_nothing_of_its_own_is_passed_over() -> None:
    truth = noise()
    maps, alone = maps_of([(2.3, 1.6), (2.4, 1.7)], truth), maps_of([(2.3, 1.6)], truth)
    label = torch.zeros((SIDE, SIDE), dtype=torch.int64)
    assert torch.equal(back_project(blurred(truth), label, maps), back_project(blurred(truth), label, alone))

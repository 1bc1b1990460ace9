"""A plane of known texture before two cameras: detail comes back, and nothing else changes."""

from __future__ import annotations

import torch
from plane import SIDE, blurred, maps_of, noise

from advtex_engine.render.view_maps import ViewMaps
from advtex_engine.selection.back_projection import back_project


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


def test_a_view_that_shows_nothing_of_its_own_is_passed_over() -> None:
    truth = noise()
    maps, alone = maps_of([(2.3, 1.6), (2.4, 1.7)], truth), maps_of([(2.3, 1.6)], truth)
    label = torch.zeros((SIDE, SIDE), dtype=torch.int64)
    assert torch.equal(back_project(blurred(truth), label, maps), back_project(blurred(truth), label, alone))

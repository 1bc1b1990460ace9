"""A plane of known texture before several cameras: grain fades, detail stays, and only what agrees counts."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from plane import HEIGHT, SIDE, WIDTH, blurred, maps_of, noise, sampled
from torch import Tensor

from advtex_engine.render.filtering import blurred as gaussian
from advtex_engine.render.motion import smeared
from advtex_engine.render.texture import decode_uv, number_slots, sample_texels
from advtex_engine.render.view_maps import ViewMaps
from advtex_engine.selection import shared_detail
from advtex_engine.selection.shared_detail import displacement, share_detail


@pytest.fixture(autouse=True)
def _photographs_are_means(monkeypatch: pytest.MonkeyPatch) -> None:
    """As those of `plane.py` are, however blurred."""
    monkeypatch.setattr(shared_detail, "shows_areas", lambda _: True)


INNER = slice(12, 42)
PLACES = [(2.3, 1.6), (1.7, 2.2), (2.6, 2.4), (1.4, 1.9), (2.1, 2.8)]
GRAIN = 0.04


def grainy(maps: ViewMaps, seed: int = 5) -> ViewMaps:
    grain = torch.randn(maps.color.shape, generator=torch.Generator().manual_seed(seed)) * GRAIN * 255
    return replace(maps, color=(maps.color + grain).round().clamp(0, 255).to(torch.uint8))


def from_first(truth: Tensor) -> Tensor:
    """The truth with the grain of one photograph, as resampling leaves it."""
    grain = torch.randn(truth.shape, generator=torch.Generator().manual_seed(6))
    return (truth + 2 * GRAIN * blurred(grain)).clamp(0, 1)


def error(found: Tensor, truth: Tensor) -> float:
    return float((found - truth)[INNER, INNER].square().mean().sqrt())


def test_grain_fades_and_detail_stays() -> None:
    truth = noise()
    start = from_first(truth)
    found = share_detail(start, grainy(maps_of(PLACES, truth)))
    assert error(found, truth) < 0.8 * error(start, truth)
    strength = [float(image[INNER, INNER].diff(dim=0).abs().mean()) for image in (found, truth)]
    assert strength[0] > 0.95 * strength[1]


def bent(seed: int, height: int, width: int) -> Tensor:
    """Displacements [h,w,2] of parts of a pixel in the right half, too narrow to be found; none in the left one."""
    field = gaussian(torch.randn((2, height, width), generator=torch.Generator().manual_seed(seed)), 2.0)
    field = 0.4 * field / field.std()
    field[:, :, : width // 2] = 0
    return field.permute(1, 2, 0)


@pytest.mark.parametrize("share", [1.0, 0.5])
def test_detail_is_as_strong_where_photographs_agree_in_part(share: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """The mean of photographs that are bent, each in its way, is softer than each."""
    truth = noise()
    maps = maps_of(PLACES, truth)
    places = [decode_uv(uv) + bent(seed, HEIGHT, WIDTH).view(-1, 2) / SIDE for seed, uv in enumerate(maps.uv)]
    color = torch.stack([sampled(truth, place) for place in places])
    maps = replace(maps, color=(color * 255).round().to(torch.uint8))
    middles = (torch.stack(torch.meshgrid(torch.arange(SIDE), torch.arange(SIDE), indexing="xy"), -1) + 0.5) / SIDE
    start = sampled(truth, (middles + bent(9, SIDE, SIDE) / SIDE).view(-1, 2)).view(SIDE, SIDE, 3)
    strengths = []
    for power in (shared_detail.RAISED, 0.0):
        monkeypatch.setattr(shared_detail, "RAISED", power)
        found = share_detail(start, maps, share)
        assert error(found[:, :22], start[:, :22]) < 0.01
        strengths.append(float(found[INNER, 33:45].diff(dim=0).abs().mean()))
    true = float(truth[INNER, 33:45].diff(dim=0).abs().mean())
    assert strengths[1] < 0.95 * true < strengths[0]


def test_what_a_moved_photograph_lacks_is_not_taken_away() -> None:
    truth = noise()
    motion = ((0, -1, 0.25), (0, 0, 0.5), (0, 1, 0.25))
    sharp = maps_of(PLACES, truth)
    size = (len(PLACES), HEIGHT, WIDTH, 3)
    moved = [smeared(color.permute(2, 0, 1).float(), motion) for color in sharp.color.view(size)]
    color = torch.stack(moved).permute(0, 2, 3, 1).round().to(torch.uint8)
    maps = replace(sharp, color=color.view(sharp.color.shape))
    errors = [
        error(share_detail(truth, maps, 0.5, motions), truth) for motions in (None, dict.fromkeys(range(5), motion))
    ]
    assert errors[1] < 0.7 * errors[0]


def test_photographs_that_are_a_pixel_off_are_moved_onto_the_render() -> None:
    """Cameras that claim another place than they have blur nothing."""
    truth = noise()
    start = from_first(truth)
    where = maps_of(PLACES, truth)
    elsewhere = maps_of([(u + 0.9, v - 0.7) for u, v in PLACES], truth)
    found = share_detail(start, grainy(replace(where, color=elsewhere.color)))
    assert error(found, truth) < 0.8 * error(start, truth)


def test_what_shows_something_else_does_not_count() -> None:
    truth = noise()
    other = maps_of(PLACES, noise().flip(0).flip(1))
    found = share_detail(truth, other)
    assert error(found, truth) < 0.006
    assert error(share_detail(from_first(truth), maps_of(PLACES, truth)), truth) < 0.72 * error(
        from_first(truth), truth
    )


def test_what_is_wide_stays() -> None:
    truth = noise()
    rising = truth + torch.linspace(-0.05, 0.05, SIDE)[None, :, None]
    found = share_detail(rising, maps_of([(2.0, 2.0)], truth))
    torch.testing.assert_close(found[INNER, INNER], rising[INNER, INNER], atol=0.012, rtol=0)


def test_of_blurred_photographs_the_middles_of_pixels_are_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is no mean over a pixel is not compared with one."""
    fine = torch.rand((SIDE, SIDE, 3), generator=torch.Generator().manual_seed(0))
    monkeypatch.undo()
    for shown, texels in ((fine, 9), (noise(), 4)):
        seen = set[int]()

        def sample(values: Tensor, slots: Tensor, weights: Tensor, seen: set[int] = seen) -> Tensor:
            seen.add(slots.shape[1])
            return sample_texels(values, slots, weights)

        monkeypatch.setattr(shared_detail, "sample_texels", sample)
        share_detail(shown, maps_of(PLACES, shown))
        assert seen == {texels}


def test_texels_that_no_view_samples_stay() -> None:
    truth = noise()
    owned = torch.ones((SIDE, SIDE), dtype=torch.bool)
    owned[20:30, 20:30] = False
    slot_map, slots = number_slots(owned)
    start = from_first(truth)
    found = share_detail(start, replace(maps_of(PLACES, truth), slot_map=slot_map, slots=slots))
    assert torch.equal(found[20:30, 20:30], start[20:30, 20:30])
    assert not torch.equal(found[30:40, 20:30], start[30:40, 20:30])


def test_half_of_the_correction_is_half_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shared_detail, "RAISED", 0.0)  # which makes up for the other half
    truth = noise()
    start, maps = from_first(truth), grainy(maps_of(PLACES, truth))
    whole, half = share_detail(start, maps), share_detail(start, maps, 0.5)
    torch.testing.assert_close(half[INNER, INNER], (start + whole)[INNER, INNER] / 2)


def test_nothing_before_the_cameras_changes_nothing() -> None:
    truth = noise()
    maps = maps_of(PLACES, truth)
    assert torch.equal(share_detail(truth, replace(maps, depth=torch.zeros_like(maps.depth))), truth)


@settings(deadline=None, max_examples=20)
@given(right=st.floats(-3, 3), down=st.floats(-3, 3), gain=st.floats(0.7, 1.0))
def test_displacements_are_found_to_a_tenth_of_a_pixel(right: float, down: float, gain: float) -> None:
    """A picture that is moved, and shown darker."""
    coarse = gaussian(torch.rand((1, 160, 180), generator=torch.Generator().manual_seed(2)), 1.5)[0]
    coarse = 0.5 + 4 * (coarse - coarse.mean())
    rows, columns = torch.meshgrid(torch.arange(120) + 20 - down, torch.arange(140) + 20 - right, indexing="ij")
    grid = torch.stack((columns * (2 / 179) - 1, rows * (2 / 159) - 1), -1)
    photograph = torch.nn.functional.grid_sample(coarse[None, None], grid[None], "bicubic", align_corners=True)[0, 0]
    found = displacement(coarse[20:140, 20:160], gain * photograph, torch.ones((120, 140)))[:, 20:100, 20:120]
    torch.testing.assert_close(found.mean((1, 2)), torch.tensor([right, down]), atol=0.1, rtol=0)
    assert found.flatten(1).std(1).max() < 0.2


@pytest.mark.parametrize("shape", [(HEIGHT, WIDTH), (17, 90), (5, 4), (33, 32)])
def test_pictures_of_any_size_have_displacements(shape: tuple[int, int]) -> None:
    picture = torch.rand(shape, generator=torch.Generator().manual_seed(3))
    found = displacement(picture, picture, torch.ones(shape))
    assert found.shape == (2, *shape)
    assert found.abs().max() < 0.01

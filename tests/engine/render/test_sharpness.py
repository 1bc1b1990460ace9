"""How sharp pictures of a plane are, against what is known of them."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.render.sharpness import FINE, fineness, sharpness, shows_areas
from advtex_engine.render.view_maps import ViewMaps
from advtex_engine.synthetic.planar import planar_maps

SIDE = 96


def noise(cell: int) -> Tensor:
    """[SIDE,SIDE,3], random every `cell` pixels."""
    coarse = torch.rand((1, 3, SIDE // cell, SIDE // cell), generator=torch.Generator().manual_seed(4))
    return F.interpolate(coarse, (SIDE, SIDE), mode="bilinear", align_corners=False)[0].permute(1, 2, 0)


def photographed(picture: Tensor) -> Tensor:
    """Means over pixels of a texel's size, of bilinear samples a quarter of a texel to each side."""
    for axis in (0, 1):
        picture = 0.75 * picture + 0.125 * (picture.roll(1, axis) + picture.roll(-1, axis))
    return picture


def maps_of(picture: Tensor) -> ViewMaps:
    """One texel per pixel, straight on."""
    return planar_maps((picture * 255).round().to(torch.uint8).expand(3, -1, -1, -1).contiguous(), SIDE, SIDE)


def slope(picture: Tensor) -> float:
    return float(sum(picture.diff(dim=axis).abs().sum() for axis in (0, 1)))


def test_noise_of_every_pixel_is_fine_and_what_is_interpolated_is_not() -> None:
    white = torch.rand((SIDE, SIDE, 3), generator=torch.Generator().manual_seed(1))
    # Of uniform numbers a, b, c the mean of |a - 2 b + c| is 7/12, and that of |a - c| is 1/3.
    assert fineness(maps_of(white)) == pytest.approx(1.75, rel=0.02)
    assert shows_areas(maps_of(white))
    assert fineness(maps_of(noise(3))) < FINE
    assert not shows_areas(maps_of(noise(3)))


def test_only_what_shows_the_mesh_is_measured() -> None:
    white = torch.rand((SIDE, SIDE, 3), generator=torch.Generator().manual_seed(1))
    half = torch.where((torch.arange(SIDE) < SIDE // 2)[:, None, None], noise(3), white)
    maps = maps_of(half)
    maps.depth.view(-1, SIDE, SIDE)[:, SIDE // 2 :] = 0
    assert fineness(maps) == pytest.approx(fineness(maps_of(noise(3))), rel=0.05)
    soft = photographed(half)
    inner = (slice(0, SIDE // 2), slice(0, SIDE))
    assert sharpness(half, maps) == pytest.approx(slope(soft[inner]) / slope(half[inner]), abs=0.03)


def test_a_texture_is_as_sharp_as_its_photographs() -> None:
    picture = noise(3)
    assert sharpness(picture, maps_of(photographed(picture))) == pytest.approx(1, abs=0.02)
    twice = photographed(photographed(picture))
    expected = slope(photographed(picture)) / slope(twice)
    assert expected > 1.1
    assert sharpness(picture, maps_of(twice)) == pytest.approx(expected, abs=0.02)

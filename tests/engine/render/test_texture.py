"""Compact texture sampling against grid_sample on the dense texture; hole filling."""

from __future__ import annotations

import math

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from advtex_engine.render.texture import (
    area_footprint,
    bilinear_footprint,
    decode_uv,
    encode_uv,
    fill_holes,
    sample_image,
    sample_texels,
    touched_slots,
)


def grid_sample(texture: torch.Tensor, uv: torch.Tensor) -> torch.Tensor:
    """The plain twin: [H,W,C] and uv [P,2] -> [P,C]."""
    image = texture.permute(2, 0, 1)[None]
    sampled = F.grid_sample(
        image, (uv * 2 - 1)[None, None], mode="bilinear", padding_mode="border", align_corners=False
    )
    return sampled[0, :, 0].T


@pytest.mark.parametrize(("width", "height"), [(17, 9), (64, 64), (2, 3)])
def test_values_and_gradients_equal_grid_sample(width: int, height: int) -> None:
    generator = torch.Generator().manual_seed(1)
    uv = decode_uv(encode_uv(torch.rand(500, 2, generator=generator)))
    dense = torch.rand(height, width, 3, generator=generator, dtype=torch.float32)
    upstream = torch.randn(500, 3, generator=generator)
    slot_map, slots = touched_slots(
        encode_uv(uv)[None, :, None], torch.ones(1, 500, 1, dtype=torch.bool), width, height
    )
    texels, weights = bilinear_footprint(uv * torch.tensor([width, height]), width, height)
    rows = slot_map.flatten()[texels]
    assert rows[weights > 0].min() >= 0
    values = dense[slot_map >= 0].clone().requires_grad_(True)
    twin = dense.clone().requires_grad_(True)
    compact = sample_texels(values, rows.clamp(min=0), weights)
    plain = grid_sample(twin, uv)
    torch.testing.assert_close(compact, plain, atol=2e-6, rtol=1e-5)
    (gradient,) = torch.autograd.grad(compact, [values], upstream)
    (gradient_twin,) = torch.autograd.grad(plain, [twin], upstream)
    assert values.shape == (slots, 3)
    torch.testing.assert_close(gradient, gradient_twin[slot_map >= 0], atol=1e-4, rtol=1e-4)
    assert gradient_twin[slot_map < 0].abs().sum() == 0


def pixels(width: int, height: int) -> Tensor:
    """[height,width,2], the pixels' middles."""
    x, y = torch.meshgrid(torch.arange(width) + 0.5, torch.arange(height) + 0.5, indexing="xy")
    return torch.stack((x, y), -1)


@settings(deadline=None, max_examples=50)
@given(st.floats(0.2, 1.8), st.floats(0, 6.3), st.integers(0, 2**31 - 1))
def test_what_a_pixel_shows_is_the_mean_of_samples_all_over_it(scale: float, turn: float, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    image = torch.rand(40, 50, 3, generator=generator)
    place = torch.tensor([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    place *= scale / (abs(math.cos(turn)) + abs(math.sin(turn)))
    offset = torch.rand(2, generator=generator) * 30 + 10
    texels, weights = area_footprint(pixels(8, 6) @ place.T + offset, torch.ones(6, 8, dtype=torch.bool), 50, 40)
    samples = [pixels(8, 6) + torch.tensor([x, y]) for x in (-0.25, 0.25) for y in (-0.25, 0.25)]
    expected = torch.stack([sample_image(image, (at @ place.T + offset).view(-1, 2)) for at in samples]).mean(0)
    torch.testing.assert_close((image.view(-1, 3)[texels] * weights[..., None]).sum(1), expected, atol=1e-4, rtol=1e-4)


def test_a_pixel_at_the_border_of_a_chart_is_as_wide_as_the_one_beside_it() -> None:
    """Left of the border charts run one way, right of it another lies elsewhere; further right nothing is seen."""
    xy = pixels(9, 4) + 3
    whole = area_footprint(xy, torch.ones(4, 9, dtype=torch.bool), 40, 30)
    seen = torch.ones(4, 9, dtype=torch.bool)
    seen[:, 7:] = False
    cut = xy.clone()
    cut[:, 4:] += 20
    cut[:, 7:] = 0
    texels, weights = (part.view(4, 9, 9) for part in area_footprint(cut, seen, 40, 30))
    for part, expected in zip((texels, weights), whole, strict=True):
        assert torch.equal(part[:, :4], expected.view(4, 9, 9)[:, :4])
    assert torch.equal(texels[:, 4:7] - 20 * 41, whole[0].view(4, 9, 9)[:, 4:7])
    torch.testing.assert_close(weights[:, 4:7], whole[1].view(4, 9, 9)[:, 4:7])


def test_areas_wider_than_their_cells_and_beyond_the_texture_have_whole_weights() -> None:
    texels, weights = area_footprint(pixels(20, 15) * 3.5 - 10, torch.ones(15, 20, dtype=torch.bool), 30, 20)
    assert texels.min() >= 0 and texels.max() < 600
    assert weights.min() >= 0
    torch.testing.assert_close(weights.sum(1), torch.ones(300))


def test_a_gradient_is_put_where_it_is_wanted_and_nothing_of_the_last_one_stays() -> None:
    generator = torch.Generator().manual_seed(0)
    values, into = torch.rand((30, 3), generator=generator), torch.full((30, 3), 7.0)
    for seed in range(2):
        slots = torch.randint(0, 20, (50, 4), generator=generator.manual_seed(seed))
        weights, at = torch.rand((50, 4), generator=generator), values.clone().requires_grad_(True)
        fresh, put = (
            torch.autograd.grad(sample_texels(at, slots, weights, *buffer).square().sum(), [at])[0]
            for buffer in ((), (into,))
        )
        assert put.data_ptr() == into.data_ptr()
        torch.testing.assert_close(put, fresh)


def test_sample_image_equals_grid_sample_outside_the_centers_too() -> None:
    image = torch.rand(6, 5, 4, generator=torch.Generator().manual_seed(0))
    xy = torch.tensor([[0.0, 0.0], [5.0, 6.0], [0.5, 0.5], [2.25, 3.75], [4.9, 0.1]])
    torch.testing.assert_close(sample_image(image, xy), grid_sample(image, xy / torch.tensor([5.0, 6.0])))


@given(st.floats(0, 1), st.floats(0, 1))
def test_uv_codes_are_within_half_a_level(u: float, v: float) -> None:
    uv = torch.tensor([u, v])
    assert (decode_uv(encode_uv(uv)) - uv).abs().max() <= 0.5 / 65535 + 1e-7


@settings(deadline=None, max_examples=25)
@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 2**31 - 1))
def test_filling_keeps_known_texels_and_stays_in_their_range(width: int, height: int, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    texture = torch.rand(height, width, 3, generator=generator)
    known = torch.rand(height, width, generator=generator) < 0.2
    texture[~known] = 1e6
    filled = fill_holes(texture, known)
    assert torch.equal(filled[known], texture[known])
    if known.any():
        assert filled.max() <= texture[known].max() + 1e-5
        assert filled.min() >= texture[known].min() - 1e-5


def test_filling_takes_the_color_of_the_near_side() -> None:
    texture = torch.zeros(32, 32, 3)
    texture[:, 28:] = 1
    known = torch.zeros(32, 32, dtype=torch.bool)
    known[:, :4] = known[:, 28:] = True
    filled = fill_holes(texture, known)
    assert filled[:, 4:6].max() < 0.25
    assert filled[:, 26:28].min() > 0.75


def test_without_a_known_texel_nothing_changes() -> None:
    texture = torch.rand(4, 4, 3)
    assert torch.equal(fill_holes(texture, torch.zeros(4, 4, dtype=torch.bool)), texture)

"""Compact texture sampling against grid_sample on the dense texture; hole filling."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st

from advtex_engine.render.texture import (
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

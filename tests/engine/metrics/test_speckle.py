"""The share of speckled texels, against a plain twin and on textures whose speckles are counted."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from advtex_engine.metrics.speckle import LEVELS, speckle_share


def twin(texture: np.ndarray, known: np.ndarray) -> float | None:
    """Texel by texel, in levels of 8 bits."""
    odd = []
    for row in range(1, texture.shape[0] - 1):
        for column in range(1, texture.shape[1] - 1):
            window = (slice(row - 1, row + 2), slice(column - 1, column + 2))
            if known[window].all():
                median = np.median(texture[window].reshape(9, 3), axis=0)
                odd.append(bool((np.abs(texture[row, column] - median) > LEVELS).any()))
    return float(np.mean(odd)) if odd else None


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**16), st.integers(1, 9), st.integers(1, 12), st.floats(0, 1))
def test_it_is_the_share_that_a_plain_loop_counts(seed: int, height: int, width: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    levels = rng.integers(0, 256, (height, width, 3))
    known = rng.random((height, width)) < 0.5 + share / 2
    found = speckle_share(torch.from_numpy(levels / 255).float(), torch.from_numpy(known))
    expected = twin(levels, known)
    assert (found is None) == (expected is None)
    assert found is None or abs(found - expected) < 1e-9


def test_lone_texels_are_speckles_and_edges_and_shading_are_not() -> None:
    shading = torch.linspace(0, 1, 40).expand(40, 40)[..., None].expand(-1, -1, 3).clone()
    known = torch.ones(40, 40, dtype=torch.bool)
    assert speckle_share(shading, known) == 0
    edge = shading.clone()
    edge[:, 20:] = 0.0
    assert speckle_share(edge, known) == 0
    speckled = edge.clone()
    speckled[5:35:3, 5:15:3, 1] += 0.2
    assert speckle_share(speckled, known) == 40 / 38**2


def test_what_no_view_samples_has_no_say() -> None:
    texture = torch.zeros(9, 9, 3)
    texture[4, 4] = 1.0
    known = torch.ones(9, 9, dtype=torch.bool)
    assert speckle_share(texture, known) == 1 / 49
    known[4, 5] = False
    assert speckle_share(texture, known) == 0
    assert speckle_share(texture, torch.zeros(9, 9, dtype=torch.bool)) is None

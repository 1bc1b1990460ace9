"""Sums and maxima over windows against PyTorch's pools."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F

from advtex_engine.render.filtering import greatest, window_sums

REACHES = [0, 1, 2, 3, 4, 7]


@pytest.mark.parametrize("reach", REACHES)
def test_windows_are_summed_as_a_pool_of_ones_does(reach: int) -> None:
    planes = torch.rand((3, 37, 52), generator=torch.Generator().manual_seed(4))
    side = 2 * reach + 1
    expected = side**2 * F.avg_pool2d(planes.double(), side, 1, reach)
    torch.testing.assert_close(window_sums(planes, reach).double(), expected, atol=0, rtol=1e-6)


@pytest.mark.parametrize("reach", [*REACHES, 40])
@pytest.mark.parametrize("size", [(37, 52), (1, 9), (2, 3)])
def test_the_greatest_of_a_window_is_what_a_pool_finds(size: tuple[int, int], reach: int) -> None:
    values = torch.randn((3, *size), generator=torch.Generator().manual_seed(4))
    given = values.clone()
    padded = F.pad(values, (reach,) * 4, value=-torch.inf)
    assert torch.equal(greatest(values, reach), F.max_pool2d(padded, 2 * reach + 1, 1))
    mask = values > 1.5
    assert torch.equal(greatest(mask, reach), greatest(mask.float(), reach) > 0)
    assert torch.equal(values, given)

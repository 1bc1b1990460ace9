"""What all views together take for better: a gain that is certain to be worth a change, over few cells and many."""

from __future__ import annotations

import torch
from torch import Tensor

from advtex_engine.refine.check import better, disagreement
from advtex_engine.refine.points import Observations

VIEWS = 4
EACH = 40  # points of a cell
SCALE = 0.2


def scan(shares: Tensor) -> tuple[Tensor, Tensor, Tensor, Observations, Tensor]:
    """Arguments of `better` but the scale: the views disagree in each cell by that share [cells] of what they did."""
    count = len(shares) * EACH
    generator = torch.Generator().manual_seed(0)
    truth = torch.rand(count, 3, generator=generator)
    error = 0.02 * torch.randn(VIEWS, count, 3, generator=generator)
    cell = torch.arange(len(shares)).repeat_interleave(EACH)
    points = Observations(
        torch.zeros(count, 3, dtype=torch.float64),
        torch.arange(count).expand(VIEWS, -1),
        torch.ones(VIEWS, count, dtype=torch.bool),
    )
    return truth + error, truth + error * shares[cell, None], points.seen, points, cell


def test_a_large_gain_of_a_small_scan_is_taken() -> None:
    """A third of the disagreement is gone, but not everywhere: 2.8 standard errors of 16 cells."""
    shares = torch.tensor([0.1, 0.2, 1.2, 0.3, 1.1, 0.2, 1.3, 0.1, 0.2, 1.3, 0.9, 0.3, 1.2, 0.1, 1.3, 0.8])
    old, new, valid, points, cell = scan(shares)
    assert better(old, new, valid, points, cell, SCALE)
    assert not better(new, old, valid, points, cell, SCALE)


def test_a_small_gain_is_not_taken_however_certain() -> None:
    assert not better(*scan(torch.full((2000,), 0.995)), SCALE)
    assert better(*scan(torch.full((2000,), 0.95)), SCALE)


def test_a_gain_that_may_be_none_is_not_taken() -> None:
    """2 % over 24 cells that gain and lose by 4 %: above 1 %, and 2 standard errors above 0, but not both at once."""
    shares = 0.98 + 0.045 * torch.tensor([1.0, -1.0]).repeat(12)
    assert not better(*scan(shares), SCALE)


def test_too_few_cells_tell_nothing() -> None:
    assert not better(*scan(torch.full((5,), 0.1)), SCALE)
    assert better(*scan(torch.full((8,), 0.1)), SCALE)


def test_views_that_are_asked_are_compared_with_the_rest_alone() -> None:
    """Two of four views agree with each other and not with the rest: as one of all they would disagree less."""
    old, _, valid, points, cell = scan(torch.full((8,), 1.0))
    asked = torch.tensor([True, False, True, False])
    off = old + 0.1 * asked[:, None, None]
    among_all = disagreement(off, valid, points, SCALE)
    found = disagreement(off, valid, points, SCALE, asked)
    assert found.isnan().equal(~asked)
    assert bool((found[asked] > among_all[asked]).all())
    rest = off[~asked].mean(0)
    assert torch.allclose(found[asked], (off[asked] - rest).abs().mean((1, 2)), atol=1e-3)
    assert better(off, old, valid, points, cell, SCALE, asked)
    # What the views that are not asked have become among themselves does not count.
    worse = old + 0.3 * torch.tensor([0.0, 0.05, 0.0, -0.05])[:, None, None]
    assert better(off, worse, valid, points, cell, SCALE, asked)

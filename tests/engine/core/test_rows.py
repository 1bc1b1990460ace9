"""Distinct rows are those of torch."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from advtex_engine.core.rows import distinct_rows

FAR = 2**62 - 1


@given(data=st.data(), columns=st.integers(1, 3), far=st.sampled_from([3, 1000, FAR]))
def test_they_are_those_of_torch(data: st.DataObject, columns: int, far: int) -> None:
    row = st.lists(st.integers(-far, far), min_size=columns, max_size=columns)
    rows = torch.tensor(data.draw(st.lists(row, min_size=1, max_size=40)))
    distinct, index = distinct_rows(rows)
    expected, of_each = torch.unique(rows, dim=0, return_inverse=True)
    assert torch.equal(distinct, expected)
    assert torch.equal(index, of_each)


@pytest.mark.parametrize("columns", [1, 2, 3])
def test_none_have_none(columns: int) -> None:
    distinct, index = distinct_rows(torch.zeros((0, columns), dtype=torch.int64))
    assert distinct.shape == (0, columns)
    assert index.shape == (0,)

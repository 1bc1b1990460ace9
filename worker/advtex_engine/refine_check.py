"""How well views agree at surface points that no fit has seen, per view: the judge of camera refinement."""

from __future__ import annotations

import torch
from torch import Tensor

from advtex_engine.refine_points import Observations
from advtex_engine.refine_solve import residuals, weighted_mean

MIN_CHECKED = 50  # points that a view must share with others to be judged
MARGIN = 0.99  # what has improved by less than that may have by chance


def disagreement(value: Tensor, valid: Tensor, points: Observations, scale: float) -> Tensor:
    """Mean distance [V] of what each view sees from what the others see at the same points; nan if too few.

    value: [V,K,C]; valid: [V,K]. A point's distance counts at most 2 * scale: beyond, something hides it.
    """
    rest, others = _others(value, valid, points, scale)
    return _mean((value - rest).abs(), others, scale)


def improved(old: Tensor, new: Tensor, valid: Tensor, points: Observations, scale: float) -> Tensor:
    """[V] bool: whether each view agrees better with the others' new values by its own new ones than by its old.

    old, new: [V,K,C]; valid: [V,K], where both mean something. False where nothing can be said.
    """
    rest, others = _others(new, valid, points, scale)
    return _mean((new - rest).abs(), others, scale) < MARGIN * _mean((old - rest).abs(), others, scale)


def better(new: Tensor, old: Tensor) -> bool:
    """Whether the views of `disagreement` [V] agree better on the whole."""
    return bool(new.nanmean() < MARGIN * old.nanmean())


def _others(value: Tensor, valid: Tensor, points: Observations, scale: float) -> tuple[Tensor, Tensor]:
    """Robust mean [V,K,C] of the other views at each point, and where there is one, [V,K] bool."""
    means, known = [], valid
    for channel in value.unbind(-1):
        _, weight = residuals(channel, valid, points, scale)
        mean, total = weighted_mean(channel, weight, points)
        left = total[points.point] - weight
        means.append((mean[points.point] * total[points.point] - weight * channel) / left.clamp(min=1e-6))
        known = known & (left > 0.5)
    return torch.stack(means, -1), known


def _mean(distance: Tensor, counts: Tensor, scale: float) -> Tensor:
    """Mean [V] over points and channels of capped distances [V,K,C], nan for views with too few points."""
    per_point = distance.clamp(max=2 * scale).mean(-1)
    number = counts.sum(1)
    mean = (per_point * counts).sum(1) / number.clamp(min=1)
    return torch.where(number >= MIN_CHECKED, mean, torch.nan)

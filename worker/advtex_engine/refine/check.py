"""How well views agree at surface points that no fit has seen, per view: the judge of camera refinement.

Neighboring points share pixels, so that many of them are hardly more evidence than one. What is tested is therefore
the change per cell of the surface (`refine_points.surface_cells`), all of its points together.
"""

from __future__ import annotations

import torch
from torch import Tensor

from advtex_engine.refine.points import Observations
from advtex_engine.refine.solve import residuals, weighted_mean

MIN_CHECKED = 50  # points that a view must share with others to be judged
MIN_CELLS = 6
MARGIN = 0.99  # what has improved by less than that is not worth a change
SURE = 1.0  # standard error for one view: its cells are few, and what holds for all views together is likely for it
VERY_SURE = 2.0  # and for all views together, by so many of which the gain has to be above what is worth a change


def disagreement(
    value: Tensor, valid: Tensor, points: Observations, scale: float, asked: Tensor | None = None
) -> Tensor:
    """Mean distance [V] of what each view sees from what the others see at the same points; nan if too few.

    value: [V,K,C]; valid: [V,K]. A point's distance counts at most 2 * scale: beyond, something hides it. asked: [V]
    bool, views that are compared with the rest of them alone, the only ones that have a distance; None for all.
    """
    rest, others = _others(value, valid, points, scale, asked)
    mean, count = _mean(_distance(value, rest, scale), others)
    return torch.where(count >= MIN_CHECKED, mean, torch.nan)


def improved(
    old: Tensor, new: Tensor, valid: Tensor, points: Observations, cell: Tensor, scale: float, errors: float = SURE
) -> Tensor:
    """[V] bool: whether each view agrees better with the others' new values by its own new ones than by its old.

    old, new: [V,K,C]; valid: [V,K], where both mean something. cell: [P] int64, the cell of each of the points. False
    where nothing can be said, and where the mean gain is not above 0 by `errors` standard errors of the cells' gains.
    """
    rest, others = _others(new, valid, points, scale)
    before, after = _distance(old, rest, scale), _distance(new, rest, scale)
    mean_before, count = _mean(before, others)
    mean_after, _ = _mean(after, others)
    sure = _significant((before - after) * others, others, cell[points.point], errors)
    return sure & (count >= MIN_CHECKED) & (mean_after < MARGIN * mean_before)


def better(
    old: Tensor,
    new: Tensor,
    valid: Tensor,
    points: Observations,
    cell: Tensor,
    scale: float,
    asked: Tensor | None = None,
) -> bool:
    """Whether all views together agree better among themselves by their new values than by their old ones.

    It has to be certain that the gain is worth a change, not only that there is one: a scan of a dozen views has few
    cells, but what halves their disagreement is no accident, and over many cells next to none is significant.
    Arguments as for `improved`; asked: as for `disagreement`.
    """
    distances, counts = [], valid
    for value in (old, new):
        rest, others = _others(value, valid, points, scale, asked)
        distances.append(_distance(value, rest, scale))
        counts = counts & others
    before, after = ((distance * counts).flatten()[None] for distance in distances)
    worth = MARGIN * before - after
    return bool(_significant(worth, counts.flatten()[None], cell[points.point].flatten()[None], VERY_SURE)[0])


def rounded(value: Tensor) -> float | None:
    """For a report: four decimals; None for nan."""
    return None if bool(value.isnan()) else round(float(value), 4)


def _significant(gain: Tensor, counts: Tensor, cell: Tensor, errors: float) -> Tensor:
    """[N] bool: whether the mean gain [N,K] is above 0 by that many standard errors, clustered by cell [N,K].

    gain is 0 where counts [N,K] is False.
    """
    cells = int(cell.max()) + 1
    rows = torch.arange(len(gain), device=gain.device)[:, None]
    place = (rows * cells + cell).flatten()
    sums = gain.new_zeros(len(gain) * cells).index_add_(0, place, gain.flatten()).view(-1, cells)
    numbers = torch.zeros_like(sums).flatten().index_add_(0, place, counts.flatten().to(gain.dtype)).view(-1, cells)
    total = numbers.sum(1, keepdim=True).clamp(min=1)
    mean = sums.sum(1, keepdim=True) / total
    occupied = (numbers > 0).sum(1)
    spread = (sums - mean * numbers).square().sum(1) * occupied / (occupied - 1).clamp(min=1)
    return (occupied >= MIN_CELLS) & (sums.sum(1) > errors * spread.sqrt())


def _others(
    value: Tensor, valid: Tensor, points: Observations, scale: float, asked: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Robust mean [V,K,C] of the other views at each point, and where there is one, [V,K] bool."""
    means, known = [], valid
    if asked is not None:
        known, valid = valid & asked[:, None], valid & ~asked[:, None]
    for channel in value.unbind(-1):
        _, weight = residuals(channel, valid, points, scale)
        mean, total = weighted_mean(channel, weight, points)
        left = total[points.point] - weight
        means.append((mean[points.point] * total[points.point] - weight * channel) / left.clamp(min=1e-6))
        known = known & (left > 0.5)
    return torch.stack(means, -1), known


def _distance(value: Tensor, rest: Tensor, scale: float) -> Tensor:
    """[V,K]: mean over channels of the distance of values [V,K,C], at most 2 * scale."""
    return (value - rest).abs().clamp(max=2 * scale).mean(-1)


def _mean(distance: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
    """Mean [V] of distances [V,K] where counts [V,K], and the number [V] of those."""
    number = counts.sum(1)
    return (distance * counts).sum(1) / number.clamp(min=1), number

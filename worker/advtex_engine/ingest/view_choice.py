"""Which frames of a long scan become views: sharp, evenly exposed, and together good views of all of the surface.

A frame is left out as blurred or badly exposed by what the other frames show of the same surface. Of the rest, the one
that adds most is taken again and again (greedy cover of a submodular measure: at least 63 % of what the best choice of
as many reaches; Nemhauser, Wolsey, Fisher 1978). A good view of a cell leaves half of it to be shown, so that a second
and a third one still count: the method compares views, and needs more than one of everything. Views that no other view
overlaps get a partner. A frame that was left out returns where nothing else shows a part of the surface.

Pure and deterministic: thumbnails and cameras in, indices and a report out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from advtex_engine.core.cameras import camera_forward
from advtex_engine.core.config import Preset
from advtex_engine.core.scene import Camera, Mesh
from advtex_engine.ingest.thumbnails import Array, Thumbnail, Visibility, visibility_of

BLURRED = -1.5
"""Median log2 of the detail's energy over that of the sharper frames of the same surface; blurred frames are below."""
SHARPER = 0.75
"""Quantile of the frames that show a cell whose detail is what it can have."""
EXPOSURE = 1.0
"""Stops by which a frame may be brighter or darker than most frames of the same surface."""
DETAIL_PER_STOP = 2 / 2.2
"""log2 of the energy that detail, as it is coded, gains with each stop of brightness."""
LEAST_FRAMES = 3
"""Frames that must show a cell for it to be compared in."""
GOOD_VIEW = 0.5
"""Share of a cell that the best of views shows."""
BEST_SIGHTS = 0.9
"""Quantile of the views of a cell that counts as the best; the very nearest would make all others poor."""
APP_NEIGHBORS = 5
"""Frames before and after, with which an app's own measure of sharpness is compared."""
APP_BLURRED = 0.5
"""Share of their median below which it says that a frame is blurred."""
PARTNERS = 0.1
"""Share of the budget that is kept for partners of views that no other one overlaps."""
ONLY_SIGHT = 1e-3
"""Share of the surface that a frame that was left out must be alone in showing, to return."""


@dataclass(frozen=True)
class Candidate:
    """A frame that may become a view. sharpness: the app's own measure, higher is sharper; None without one."""

    name: str
    camera: Camera
    thumbnail: Thumbnail
    sharpness: float | None = None


@dataclass(frozen=True)
class ViewChoice:
    """kept: indices of the chosen candidates, rising. report: JSON-ready, what was kept and left out, and why."""

    kept: tuple[int, ...]
    report: dict[str, Any]


def choose_views(mesh: Mesh, candidates: Sequence[Candidate], budget: int) -> ViewChoice:
    """At most `budget` of the candidates, which are in the order of capture. Not differentiable."""
    assert budget >= 1
    visibility = visibility_of(mesh, [one.camera for one in candidates], [one.thumbnail for one in candidates])
    exposure = _medians(visibility.brightness - _quantile(visibility.brightness, 0.5))
    sharpness = _medians(visibility.detail - _quantile(visibility.detail, SHARPER)) - DETAIL_PER_STOP * exposure
    blurred = (sharpness < BLURRED) | _app_blurred([one.sharpness for one in candidates])
    reasons = np.full(len(candidates), "redundant", object)
    reasons[blurred] = "blurred"
    reasons[np.abs(exposure) > EXPOSURE] = "exposure"
    reasons[visibility.shown.sum(1) == 0] = "blind"
    good = reasons == "redundant"
    shares = _shares(visibility, sharpness)
    axes = np.array([camera_forward(one.camera).tolist() for one in candidates]).reshape(-1, 3)
    chosen = _Chosen(shares, good, reasons)
    reserve = 0 if good.sum() <= budget else round(budget * PARTNERS)
    chosen.cover(budget - reserve, "coverage")
    chosen.add_partners(budget, visibility, axes)
    chosen.cover(budget, "coverage")
    chosen.bring_back(budget)
    kept = tuple(sorted(chosen.gains))
    return ViewChoice(kept, _report(candidates, chosen, visibility, budget, exposure, sharpness))


class _Chosen:
    """The choice as it grows. rest: what of each cell is still to be shown; gains: what each view added."""

    def __init__(self, shares: Array, good: npt.NDArray[np.bool_], reasons: npt.NDArray[np.object_]) -> None:
        self.shares = shares
        self.good = good
        self.reasons = reasons
        self.rest = np.ones(shares.shape[1], np.float32)
        self.gains: dict[int, float] = {}

    def take(self, frame: int, reason: str) -> None:
        before = float(self.rest.sum())
        self.rest *= 1 - self.shares[frame]
        self.gains[frame] = before - float(self.rest.sum())
        self.reasons[frame] = reason
        self.good[frame] = False

    def cover(self, budget: int, reason: str) -> None:
        """Takes the frame that adds most, until nothing is added or the budget is used up."""
        while len(self.gains) < budget and self.good.any():
            added = np.where(self.good, self.shares @ self.rest, -1)
            best = int(added.argmax())
            if added[best] <= 0:
                break
            self.take(best, reason)

    def add_partners(self, budget: int, visibility: Visibility, axes: npt.NDArray[np.float64]) -> None:
        """Gives each view that pairs with no other one the pairing frame that adds most."""
        seen = (visibility.shown > 0).astype(np.float32)
        for view in sorted(self.gains):
            partners = _partners(view, seen @ visibility.shown[view] / visibility.shown[view].sum(), axes)
            if len(self.gains) >= budget or partners[list(self.gains)].any() or not (partners & self.good).any():
                continue
            added = np.where(partners & self.good, self.shares @ self.rest, -1)
            self.take(int(added.argmax()), "partner")

    def bring_back(self, budget: int) -> None:
        """Frames that were left out as blurred or badly exposed, for cells that no view shows."""
        unseen = (self.rest == 1) & (self.shares > 0).any(0)
        spoiled = (self.reasons == "blurred") | (self.reasons == "exposure")
        while len(self.gains) < budget and spoiled.any():
            added = np.where(spoiled, (self.shares[:, unseen] > 0).sum(1), -1)
            best = int(added.argmax())
            if added[best] < max(1.0, ONLY_SIGHT * self.shares.shape[1]):
                break
            self.take(best, "only_sight")
            spoiled[best] = False
            unseen &= self.shares[best] == 0


def _quantile(values: Array, share: float) -> Array:
    """[F,C] -> [C]: quantile over the frames that show a cell; NaN where fewer than LEAST_FRAMES do."""
    found = _row_quantiles(values.T, share)
    found[(~np.isnan(values)).sum(0) < LEAST_FRAMES] = np.nan
    return found


def _medians(values: Array) -> Array:
    """[F,C] -> [F]: median over a frame's cells; 0 for a frame that shares none with others."""
    return np.nan_to_num(_row_quantiles(values, 0.5))


def _row_quantiles(values: Array, share: float) -> Array:
    """[N,M] -> [N]: quantile of what is not NaN, between two values the mean of them; NaN for rows of only NaN.

    np.nanquantile goes row by row in Python, a minute for thousands of frames.
    """
    if not values.shape[1]:
        return np.full(len(values), np.nan, np.float32)
    rising = np.sort(np.ascontiguousarray(values), axis=1)  # NaN last
    place = share * np.maximum((~np.isnan(values)).sum(1) - 1, 0)
    rows = np.arange(len(values))
    low, high = rising[rows, np.floor(place).astype(int)], rising[rows, np.ceil(place).astype(int)]
    return np.asarray((low + high) / 2, np.float32)


def _app_blurred(given: Sequence[float | None]) -> npt.NDArray[np.bool_]:
    """Frames whose app says that they are much less sharp than those before and after."""
    values = np.array([np.nan if value is None else value for value in given], float)
    blurred = np.zeros(len(values), bool)
    for frame in np.flatnonzero(~np.isnan(values)):
        around = values[max(0, frame - APP_NEIGHBORS) : frame + APP_NEIGHBORS + 1]
        blurred[frame] = values[frame] < APP_BLURRED * np.nanmedian(around)
    return blurred


def _shares(visibility: Visibility, sharpness: Array) -> Array:
    """Share [F,C] of each cell that a frame shows: near, from the front and sharp is GOOD_VIEW, not seen is 0."""
    shown = np.where(visibility.shown > 0, visibility.shown, np.float32(np.nan))
    best = _row_quantiles(shown.T, BEST_SIGHTS)
    quality = np.exp2(np.clip(sharpness, 2 * BLURRED, 0) / 2)
    return np.asarray(GOOD_VIEW * np.clip(visibility.shown / best, 0, 1) * quality[:, None], np.float32)


def _partners(view: int, overlap: Array, axes: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
    """Frames [F] that the method would pair with a view. overlap: share [F] of the view's pixels that they see too."""
    near = axes @ axes[view] >= np.cos(np.radians(Preset.max_pair_angle))
    found = np.asarray(near & (overlap >= Preset.min_pair_overlap))
    found[view] = False
    return found


def _report(
    candidates: Sequence[Candidate],
    chosen: _Chosen,
    visibility: Visibility,
    budget: int,
    exposure: Array,
    sharpness: Array,
) -> dict[str, Any]:
    kept = sorted(chosen.gains)
    cells = max(1, visibility.shown.shape[1])
    times = (visibility.shown[kept] > 0).sum(0)
    left_out: dict[str, list[str]] = {}
    for frame, one in enumerate(candidates):
        if frame not in chosen.gains:
            left_out.setdefault(str(chosen.reasons[frame]), []).append(one.name)
    return {
        "frames": len(candidates),
        "budget": budget,
        "kept": [
            {
                "name": candidates[frame].name,
                "reason": str(chosen.reasons[frame]),
                "gain": round(chosen.gains[frame] / cells, 6),
                "sharpness": round(2 ** (float(sharpness[frame]) / 2), 3),
                "exposure": round(float(exposure[frame]), 3),
            }
            for frame in kept
        ],
        "left_out": left_out,
        "surface_seen": {str(count): round(float((times >= count).mean()), 4) for count in (1, 2, 3)} if kept else {},
    }

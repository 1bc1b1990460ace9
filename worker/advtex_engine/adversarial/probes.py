"""Whether the game's steps pay: views are left out of it by turns, and say whether the texture comes nearer to them.

turn: a stretch of steps of which some views know nothing, neither as sources nor as auxiliary views; others each time.
At its beginning and at its end the texture is looked at in some cells of these views, where the start was painted from
another view: it would be hard to beat where it is a copy of the very photograph. The ratio of what is unlike at the end
and at the beginning is the turn's; the product of all ratios so far is the share of the start's unlikeness that is
left. The state of the least share is kept. After `patience` turns without a lesser one the game ends; the start's share
is 1, so that where nothing helps, the start is kept.

A step that is captured as a CUDA graph reads the same tables throughout; views are left out by changing these in place,
between two launches. Only a look waits for the device.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import torch
from torch import Tensor

from advtex_engine.adversarial.unlikeness import Unlikeness
from advtex_engine.core.scene import evenly_spread
from advtex_engine.render.motion import Taps, smeared
from advtex_engine.render.texture import footprints, sample_texels
from advtex_engine.render.view_maps import ViewMaps
from advtex_engine.runtime.threads import in_threads, one_thread_each

PARTS = 5
"""Every view is left out in one of so many turns: more parts would be smaller samples, fewer would be missed more."""
LEAST_VIEWS = 3  # that can be drawn; of two, one would be left to play with itself
CELL, CELLS, AREAS = 128, 24, 4
"""Side of a cell in pixels, how many a look takes at most, and of how many views' area: it costs one or two steps."""
AT_ONCE = 2  # views on a CPU: more would take more than the estimate has for them
LEAST_UNLIKE = 1e-6  # what is nearer to a photograph than this is the photograph

Probed = dict[str, Any]
"""What one level tells of its turns."""
LeaveOut = Callable[[Tensor], None]
"""Views [V] bool, on the CPU: the pairs of the steps to come have none of them."""
T = TypeVar("T")
R = TypeVar("R")


@dataclass
class Turns:
    """What the turns of a level have brought.

    patience: turns in a row without a better state after which there will be no other. left: share of the start's
    unlikeness in the newest state, and `least` in that after step `kept`; None is the start. fruitless: turns since
    then. done: {"step", "gain", "total"} of each, its last step, what it gained, and all so far, as shares.
    """

    patience: int
    left: float = 1.0
    least: float = 1.0
    kept: int | None = None
    fruitless: int = 0
    done: list[dict[str, Any]] = field(default_factory=list)

    def add(self, step: int, before: float, after: float) -> bool:
        """A turn has ended with `step`; -> whether its last state is the best so far."""
        ratio = (after + LEAST_UNLIKE) / (before + LEAST_UNLIKE)
        self.left *= ratio
        self.done.append({"step": step, "gain": 1 - ratio, "total": self.gain})
        if self.left < self.least:
            self.least, self.kept, self.fruitless = self.left, step, 0
        else:
            self.fruitless += 1
        return self.fruitless == 0

    @property
    def gain(self) -> float:
        """By what share of the start's the newest state is less unlike."""
        return 1 - self.left

    @property
    def over(self) -> bool:
        return self.fruitless >= self.patience


@dataclass(frozen=True)
class _Cells:
    """N cells of a left-out view: photograph [N,3,h,w] in [0,1], judged [N,h,w] bool, `footprints` [N*h*w,K], and the
    motion of its camera."""

    photograph: Tensor
    judged: Tensor
    slots: Tensor
    weights: Tensor
    motion: Taps


class LeftOutCells:
    """Cells of views, and how unlike a texture is to them.

    maps: of all views, wherever their pixels are. painted: [H,W] int16 of the start's own size, the view that each
    texel was painted from, -1 = none. areas: as of the `PairSampler`. motions: of views whose cameras moved, put onto
    what is compared with their photographs, to which a softer texture would seem nearer.
    """

    def __init__(
        self,
        maps: ViewMaps,
        painted: Tensor,
        unlikeness: Unlikeness,
        *,
        areas: bool = False,
        motions: Mapping[int, Taps] | None = None,
    ) -> None:
        self.maps, self.unlikeness, self.areas, self.motions = maps, unlikeness, areas, motions or {}
        self._painted = _resized(painted.to(maps.device), maps.slot_map.shape)[maps.slot_map >= 0]
        self.width, self.height = min(CELL, maps.width), min(CELL, maps.height)
        rows, columns = (torch.arange(side, device=maps.device) for side in (self.height, self.width))
        self._window = (rows[:, None] * maps.width + columns).flatten()
        corners = [
            (round(top), round(left))
            for top in _spread(maps.height - self.height, round(maps.height / self.height))
            for left in _spread(maps.width - self.width, round(maps.width / self.width))
        ]
        self._corners = torch.tensor([top * maps.width + left for top, left in corners], device=maps.device)

    def of(self, views: list[int]) -> list[_Cells]:
        """Cells of these views, in each those with the most pixels that can be judged; none without any."""
        area = self.maps.width * self.maps.height / (self.width * self.height)
        most = min(CELLS, int(AREAS * area))
        some = views if len(views) <= most else evenly_spread(views, most)
        found = self._each(lambda view: self._cells(view, most // len(some)), some)
        return [cells for cells in found if len(cells.photograph)]

    def unlike(self, cells: list[_Cells], values: Tensor) -> float:
        """The mean over all judged pixels; values: compact texture [slots,3]. Waits for the device."""

        def total(some: _Cells) -> Tensor:
            shown = sample_texels(values, some.slots, some.weights).clamp(0, 1)
            shown = shown.view(*some.judged.shape, 3).permute(0, 3, 1, 2)
            shown = torch.where(some.judged[:, None], shown, some.photograph)
            if some.motion:  # of what is judged alone: the photograph is smeared already
                moved = smeared(shown.flatten(0, 1), some.motion).view_as(shown)
                shown = torch.where(some.judged[:, None], moved, some.photograph)
            judged = (self.unlikeness(shown, some.photograph) * some.judged).sum(dtype=torch.float64)
            return torch.stack((judged, some.judged.sum(dtype=torch.float64)))

        unlike, count = torch.stack([values.new_zeros(2, dtype=torch.float64), *self._each(total, cells)]).sum(0)
        return float(unlike / count)

    def chance(self, cells: list[_Cells], values: Tensor) -> float:
        """`unlike` to the cells' photographs upside down: what it is where pictures have nothing in common."""
        return self.unlike([replace(some, photograph=some.photograph.flip((2, 3))) for some in cells], values)

    def _each(self, function: Callable[[T], R], items: Sequence[T]) -> list[R]:
        """On a CPU some at a time, on a thread each."""
        at_once = min(AT_ONCE, torch.get_num_threads()) if self.maps.device.type == "cpu" else 1
        with one_thread_each():
            return list(in_threads(function, items, at_once))

    def _cells(self, view: int, most: int) -> _Cells:
        maps = self.maps.only(view)
        seen = maps.depth[0] > 0
        picture = (maps.height, maps.width)
        slots, weights = footprints(maps.uv[0].view(*picture, 2), seen.view(picture), maps.slot_map, areas=self.areas)
        source = self._painted[slots]
        judged = seen & ((weights == 0) | (source >= 0) & (source != view)).all(1)
        pixels = self._corners[:, None] + self._window
        counts = judged[pixels].sum(1)
        chosen = counts.argsort(descending=True, stable=True)[:most]
        pixels = pixels[chosen[counts[chosen] > 0]]
        shape = (len(pixels), self.height, self.width)
        flat = pixels.flatten()
        color = maps.color[0][flat].to(torch.float32) / 255
        return _Cells(
            color.view(*shape, 3).permute(0, 3, 1, 2).contiguous(),
            judged[flat].view(shape),
            slots[flat],
            weights[flat],
            self.motions.get(view, ()),
        )


class Probes:
    """The turns of one level.

    cells: of the level's views. sources: those that can be drawn. judged_by: the measure's name, for the report. start:
    the texture before the first step, [slots,3]. first: the step after which the first turn begins. end: the level's
    last step. turn: steps.
    next: the step at which the next look is due. ended: the step at which the turns were over. best: the texture that
    is kept [slots,3], None for the start.
    """

    def __init__(
        self,
        cells: LeftOutCells,
        sources: list[int],
        leave_out: LeaveOut,
        *,
        judged_by: str,
        start: Tensor,
        first: int,
        end: int,
        turn: int,
        patience: int,
    ) -> None:
        self.cells, self.leave_out, self.judged_by = cells, leave_out, judged_by
        self.turn, self.end = turn, end
        self.turns = Turns(patience)
        self.best: Tensor | None = None
        self._start = start
        self._parts = [sources[part::PARTS] for part in range(min(PARTS, len(sources)))]
        self._number, self._before = 0, 0.0
        self.next = first
        self.ended: int | None = None

    @property
    def possible(self) -> bool:
        """Whether there are views to be left out, and pixels of them that can be judged."""
        enough = sum(map(len, self._parts)) >= LEAST_VIEWS and self.next < self.end
        return enough and any(self.cells.of(part) for part in self._parts)

    @property
    def over(self) -> bool:
        """Whether the game ends before its last step."""
        return self.ended is not None and self.ended < self.end

    def reached(self, step: int, values: Tensor) -> None:
        """To be called at `next`, the end of a turn and the beginning of another; values: the texture [slots,3]."""
        if step != self.next or self.ended is not None:
            return
        if self._number:
            if self.turns.add(step, self._before, self.cells.unlike(self._looked_at, values)):
                self.best = values.clone()
            if self.turns.over or step >= self.end:
                self.ended = step
                return
        self._begin(self._number + 1)
        self._before = self.cells.unlike(self._looked_at, values)
        self.next = min(step + self.turn, self.end)

    def _begin(self, number: int) -> None:
        self._number = number
        for part in range(len(self._parts)):
            views = self._parts[(number - 1 + part) % len(self._parts)]
            self._looked_at = self.cells.of(views)
            if self._looked_at:
                break
        left_out = torch.zeros(self.cells.maps.count, dtype=torch.bool)
        left_out[views] = True
        self.leave_out(left_out)

    @property
    def kept(self) -> Tensor:
        """The best texture so far, [slots,3]."""
        return self._start if self.best is None else self.best

    @property
    def told(self) -> Probed:
        """What `probed` makes the report of."""
        return {
            "judged_by": self.judged_by,
            "ended": self.ended,
            "over": self.over,
            "patience": self.turns.patience,
            "kept": self.turns.kept,
            "turns": self.turns.done,
        }

    def state_dict(self) -> dict[str, Any]:
        """All that decides the turns to come and what is kept."""
        return {
            "number": self._number,
            "before": self._before,
            "next": self.next,
            "ended": self.ended,
            "judged_by": self.judged_by,
            "best": self.best,
            **{name: value for name, value in vars(self.turns).items() if name != "patience"},
        }

    def load_state_dict(self, state: dict[str, Any], values: Tensor) -> None:
        """Goes on in the middle of a turn; with another measure it is as if the turn had begun here.

        To be called before the views go on from their state. values: the texture [slots,3] as it is now.
        """
        for name in ("left", "least", "kept", "fruitless", "done"):
            setattr(self.turns, name, state[name])
        self.next, self.ended = state["next"], state["ended"]
        self.best = None if state["best"] is None else state["best"].to(values)
        if not state["number"] or self.ended is not None:
            return
        self._begin(state["number"])
        same = state["judged_by"] == self.judged_by
        self._before = state["before"] if same else self.cells.unlike(self._looked_at, values)


def probed(levels: Sequence[Probed], steps: int) -> dict[str, Any] | None:
    """The report's part `probes` of a run of `steps` steps; None where nothing was probed.

    judged_by: the measure. turns: {"level", "step", "gain", "total"} of each, `total` since the level's start. ended:
    the step after which the game ended. kept: the step whose texture is kept, None for the start. why, told: in words.
    """
    if not levels:
        return None
    last = levels[-1]
    kept: int | None = next((level["kept"] for level in reversed(levels) if level["kept"] is not None), None)
    if kept is None:
        why, result = "never better than its start", "the texture is exactly what it began with"
    elif last["over"]:
        why, result = f"no gain in {last['patience']} turns", f"the texture is that of step {kept}"
    else:
        why, result = "all steps taken", f"the texture is that of step {kept}"
    return {
        "judged_by": last["judged_by"],
        "turns": [{"level": number + 1, **turn} for number, level in enumerate(levels) for turn in level["turns"]],
        "ended": last["ended"],
        "kept": kept,
        "why": why,
        "told": f"The game ended after step {last['ended']} of {steps}, judged by views that were left out of it by"
        f" turns ({last['judged_by']}): {why}; {result}.",
    }


def _resized(labels: Tensor, shape: Sequence[int]) -> Tensor:
    """Labels [H,W] at the size `shape` [h,w], those nearest to the centers."""
    rows, columns = (
        ((torch.arange(new, device=labels.device) + 0.5) * (old / new)).long()
        for new, old in zip(shape, labels.shape, strict=True)
    )
    return labels[rows[:, None], columns]


def _spread(last: int, count: int) -> list[float]:
    """`count` places from 0 to `last`, evenly."""
    return [last * index / max(1, count - 1) for index in range(count)]

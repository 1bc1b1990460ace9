"""Views that do not fit on the device take turns there, and every pair is as likely as if all of them stayed.

group: a source view with up to AUXILIARIES of its candidates. block: the groups that steps draw from at one time. The
device holds two blocks: steps draw from one while the next is copied into the other, one view per step, so a block
lasts as many steps as it has views, and on to the end of a launch of several steps. All tensors keep their addresses,
so that a captured CUDA graph stays valid.

Why nothing is biased: sources come in random order, all of them before any comes again, and each brings candidates
drawn evenly from all of its own. At every single step, each source is therefore equally likely to be the one that is
drawn from the block (1/S), and each of its n candidates to be the one drawn with it (1/n), which is what the sampler
does where all views stay. How long a block lasts depends on nothing that it holds.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import os
import tempfile
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor

from advtex_engine.render.pairs import Pairs, without
from advtex_engine.render.view_maps import Allocate, ViewMaps

AUXILIARIES = 3
"""Candidates that a source brings: more would make blocks of fewer sources, fewer would repeat pairs."""
LEAST_VIEWS = 2 * (1 + AUXILIARIES)  # two blocks of one group


def host_allocator(device: torch.device, folder: Path) -> Allocate:
    """Keeps views on the host, for a device that has no room for all of them.

    For a GPU in memory that it can read by itself. A CPU's memory is what is short, so there they lie in files below
    `folder`, which are gone with the last reference: what is not used makes room. OSError when the disk is full.
    """

    def pinned(shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
        return torch.empty(shape, dtype=dtype, pin_memory=True)

    def mapped(shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
        count = math.prod(shape)
        with tempfile.NamedTemporaryFile(dir=folder) as file:
            # Reserved at once: a mapped file that does not fit on the disk would end the process with a signal.
            os.posix_fallocate(file.fileno(), 0, max(1, count * dtype.itemsize))
            return torch.from_file(file.name, shared=True, size=count, dtype=dtype).view(shape)

    return pinned if device.type == "cuda" else mapped


def keep_off(maps: ViewMaps, device: torch.device, folder: Path) -> ViewMaps:
    """The maps with color, uv and depth on the host (see `host_allocator`), and all else on the device."""
    allocate = host_allocator(device, folder)
    color, uv, depth = (allocate(tuple(part.shape), part.dtype).copy_(part) for part in _pixels(maps))
    return replace(
        maps,
        color=color,
        uv=uv,
        depth=depth,
        intrinsics=maps.intrinsics.to(device),
        world_to_camera=maps.world_to_camera.to(device),
        slot_map=maps.slot_map.to(device),
    )


class PairViews(Protocol):
    """What a pair sampler reads, and what keeps it filled.

    maps, pairs: the same tensors for as long as the run lasts. advance: called once `steps` more steps have been taken.
    leave_out: from now on, no pair of these views [V] bool (on the CPU) is drawn, and all others are; -> how many of
    `pairs.sources` count then. Waits for nothing but tables of views.
    state_dict: all that decides which views come next; load_state_dict goes on from there, after the same `leave_out`.
    """

    @property
    def maps(self) -> ViewMaps: ...

    @property
    def pairs(self) -> Pairs: ...

    def advance(self, steps: int) -> None: ...

    def leave_out(self, left_out: Tensor) -> int: ...

    def state_dict(self) -> dict[str, int]: ...

    def load_state_dict(self, state: dict[str, int]) -> None: ...


def pair_views(maps: ViewMaps, pairs: Pairs, on_device: int | None, seed: int) -> PairViews:
    """All views where they are, or at most `on_device` of them at a time on the maps' device."""
    return ResidentViews(maps, pairs) if on_device is None else StreamedViews(maps, pairs, on_device, seed)


@dataclass(frozen=True)
class ResidentViews:
    """All views are on the device, and nothing moves. pairs: its own, if views are to be left out."""

    maps: ViewMaps
    pairs: Pairs

    def advance(self, steps: int) -> None:
        """Nothing to do."""

    def leave_out(self, left_out: Tensor) -> int:
        """Changes the pairs in place."""
        remain = without(self._whole, left_out.to(self._whole.sources.device))
        number = len(remain.sources)
        self.pairs.sources[:number] = remain.sources
        for name in ("auxiliary", "count", "relative"):
            getattr(self.pairs, name).copy_(getattr(remain, name))
        return number

    @cached_property
    def _whole(self) -> Pairs:
        """All pairs, as they are before any view is left out; runs that leave none out keep no copy."""
        return Pairs(*(part.clone() for part in vars(self.pairs).values()))

    def state_dict(self) -> dict[str, int]:
        return {}

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Nothing was kept."""


@dataclass(frozen=True)
class Groups:
    """G groups: source [G] int64, candidate [G,m] int64 columns of `Pairs.auxiliary`, number [G] of them that count."""

    source: Tensor
    candidate: Tensor
    number: Tensor


class GroupOrder:
    """The endless sequence of groups: a function of the seed and the place in it, so that a run can go on anywhere.

    pairs: on the CPU. Place p is place p % S of pass p // S over the S sources. seed: a number, or any words.
    """

    def __init__(self, pairs: Pairs, seed: int | str) -> None:
        self.sources, self.seed = pairs.sources, seed
        self.count = pairs.count[pairs.sources]
        self.columns = pairs.auxiliary.shape[1]
        self.kept = min(AUXILIARIES, self.columns)
        self._pass: tuple[int, Groups] | None = None

    def groups(self, first: int, number: int) -> Groups:
        """`number` groups from place `first` on."""
        total, parts = len(self.sources), list[Groups]()
        while number > 0:
            turn, start = divmod(first, total)
            end = min(start + number, total)
            whole = self._of_pass(turn)
            parts.append(Groups(whole.source[start:end], whole.candidate[start:end], whole.number[start:end]))
            first, number = first + end - start, number - (end - start)
        joined = (torch.cat(part) for part in zip(*((p.source, p.candidate, p.number) for p in parts), strict=True))
        return Groups(*joined)

    def _of_pass(self, turn: int) -> Groups:
        if self._pass is None or self._pass[0] != turn:
            # A seed of its own: with the run's, the order would follow the sampler's draws.
            digest = hashlib.sha256(f"groups {self.seed} {turn}".encode()).digest()
            generator = torch.Generator().manual_seed(int.from_bytes(digest[:8], "big"))
            order = torch.randperm(len(self.sources), generator=generator)
            keys = torch.rand((len(self.sources), self.columns), dtype=torch.float64, generator=generator)
            self._pass = turn, arrange(self.sources, self.count, self.kept, order, keys)
        return self._pass[1]


def arrange(sources: Tensor, count: Tensor, kept: int, order: Tensor, keys: Tensor) -> Groups:
    """The groups of one pass, given what is random about it.

    sources, count: [S], and how many candidates each has. order: [S] a random permutation. keys: [S,K] uniform in
    [0, 1); the candidates of the `kept` least keys come along, which are any of them with equal chances.
    """
    lacking = torch.arange(keys.shape[1]) >= count[:, None]
    candidate = keys.masked_fill(lacking, 2.0).argsort(1)[:, :kept]
    return Groups(sources[order], candidate[order], count[order].clamp(max=kept))


class StreamedViews:
    """Two blocks of views on the device, filled in turn from the host.

    maps: color, uv and depth may be anywhere; the device is that of all else. on_device: views, at least LEAST_VIEWS.
    In `maps` and `pairs` views have the numbers of their places on the device; `held` [places] int64 (on the host)
    names the view in each, -1 = none yet.
    """

    def __init__(self, maps: ViewMaps, pairs: Pairs, on_device: int, seed: int) -> None:
        assert on_device >= LEAST_VIEWS and len(pairs.sources) > 0
        device = maps.device
        self._all, self._all_pairs, self._seed = maps, _on_host(pairs), seed
        self._drawn = self._all_pairs
        self._pose = (maps.intrinsics.cpu(), maps.world_to_camera.cpu())
        self._begin_order(0)
        self._kept = self._order.kept
        self._width = 1 + min(self._kept, self._order.columns - 1)  # a source is its own candidate, too
        self._groups = max(1, min(on_device // (2 * self._width), len(pairs.sources)))
        self.block_views = self._groups * self._width
        places = 2 * self.block_views
        pixels = maps.width * maps.height
        self.maps = replace(
            maps,
            color=torch.zeros((places, pixels, 3), dtype=torch.uint8, device=device),
            uv=torch.zeros((places, pixels, 2), dtype=torch.int16, device=device),
            depth=torch.zeros((places, pixels), dtype=torch.float16, device=device),
            intrinsics=torch.zeros((places, 4), device=device),
            world_to_camera=torch.zeros((places, 4, 4), dtype=torch.float64, device=device),
        )
        self.pairs = Pairs(
            auxiliary=torch.zeros((places, self._kept), dtype=torch.int64, device=device),
            count=torch.zeros(places, dtype=torch.int64, device=device),
            sources=torch.zeros(self._groups, dtype=torch.int64, device=device),
            relative=torch.zeros((places, self._kept, 3, 4), device=device),
        )
        self.held = torch.full((places,), -1)
        self._copies = torch.cuda.Stream(device) if device.type == "cuda" else None  # type: ignore[no-untyped-call]
        if self._copies is not None:  # copies may still be under way when these are let go
            for tensor in (*vars(self.maps).values(), *vars(self.pairs).values()):
                if isinstance(tensor, Tensor) and tensor.is_cuda:
                    tensor.record_stream(self._copies)
        self._start(0)

    def advance(self, steps: int) -> None:
        """Copies a view of the next block per step, and changes to it when this one has lasted its steps.

        Steps that were taken at once drew from one block: the next one is not passed over, however many they were.
        """
        for index in range(self._used, min(self._used + steps, self.block_views)):
            self._copy(index)
        self._used += steps
        if self._used >= self.block_views:
            self._change()

    def leave_out(self, left_out: Tensor) -> int:
        """Another order begins, with a block that is filled at once; the number of sources in a block stays."""
        self._drawn = without(self._all_pairs, left_out)
        self._begin_order(self._orders + 1)
        self._start(0)
        return self._groups

    def _begin_order(self, number: int) -> None:
        # Each its own: an order that is left before its end would always have shown the same sources.
        self._orders = number
        self._order = GroupOrder(self._drawn, self._seed if number == 0 else f"{self._seed}, order {number}")

    def state_dict(self) -> dict[str, int]:
        """place: of the block's first group. used: steps taken from it. groups: in a block. orders: begun so far."""
        return {"place": self._place, "used": self._used, "groups": self._groups, "orders": self._orders}

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Where blocks have another size, what is left of the saved one is the beginning of a new one; without a state,
        which comes from a run that had all views there, at the beginning."""
        if not state:
            return
        self._begin_order(state["orders"])
        if state["groups"] == self._groups:
            self._start(state["place"])
            self.advance(state["used"])
        else:
            self._start(state["place"] + state["used"] // self._width)

    def _start(self, place: int) -> None:
        """Fills a block at once, and makes the next one ready to be filled."""
        self._place, self._half = place - self._groups, 1
        if self._copies is not None:
            self._copies.wait_stream(torch.cuda.current_stream(self.maps.device))
        self._prepare()
        for index in range(self.block_views):
            self._copy(index)
        self._change()

    def _change(self) -> None:
        """To the block that has been filled."""
        if self._copies is not None:
            torch.cuda.current_stream(self.maps.device).wait_stream(self._copies)
        self._half, self._place, self._used = 1 - self._half, self._place + self._groups, 0
        first = self._half * self.block_views
        sources = torch.arange(first, first + self.block_views, self._width)
        self.pairs.sources.copy_(self._ready(sources), non_blocking=True)
        if self._copies is not None:  # the steps that read the other block are over before it is written
            self._copies.wait_stream(torch.cuda.current_stream(self.maps.device))
        self._prepare()

    def _prepare(self) -> None:
        """Which views the next block has, and everything about it but their pixels."""
        pairs, groups = self._drawn, self._order.groups(self._place + self._groups, self._groups)
        rows = groups.source[:, None]
        views = pairs.auxiliary[rows, groups.candidate]
        own = groups.candidate == 0  # the first candidate is the source itself
        # A candidate that is the source shares its place, and those after it move up.
        column = (~own).cumsum(1)
        first = (1 - self._half) * self.block_views
        start = first + torch.arange(self._groups) * self._width
        places = torch.where(own, 0, column.clamp(max=self._width - 1)) + start[:, None]
        held = torch.full((self.block_views,), -1)
        held[:: self._width] = groups.source
        brought = ~own & (torch.arange(self._kept) < groups.number[:, None])
        held[places[brought] - first] = views[brought]
        half = slice(first, first + self.block_views)
        self.held[half] = held
        intrinsics, world_to_camera = self._pose
        with self._copying():
            self.maps.intrinsics[half].copy_(self._ready(intrinsics[held]), non_blocking=True)
            self.maps.world_to_camera[half].copy_(self._ready(world_to_camera[held]), non_blocking=True)
            rows_on_device = slice(first, first + self.block_views, self._width)
            self.pairs.auxiliary[rows_on_device].copy_(self._ready(places), non_blocking=True)
            self.pairs.count[rows_on_device].copy_(self._ready(groups.number), non_blocking=True)
            relative = pairs.relative[rows, groups.candidate]
            self.pairs.relative[rows_on_device].copy_(self._ready(relative), non_blocking=True)

    def _copy(self, index: int) -> None:
        """One view's pixels into the next block; of a place that no candidate needs, nothing."""
        place = (1 - self._half) * self.block_views + index
        view = int(self.held[place])
        if view < 0:
            return
        with self._copying():
            for there, here in zip(_pixels(self.maps), _pixels(self._all), strict=True):
                there[place].copy_(here[view], non_blocking=True)

    def _copying(self) -> contextlib.AbstractContextManager[Any]:
        return contextlib.nullcontext() if self._copies is None else torch.cuda.stream(self._copies)

    def _ready(self, table: Tensor) -> Tensor:
        """Where the device can fetch it without anybody's waiting."""
        return table if self._copies is None else table.pin_memory()


def _pixels(maps: ViewMaps) -> tuple[Tensor, Tensor, Tensor]:
    return maps.color, maps.uv, maps.depth


def _on_host(pairs: Pairs) -> Pairs:
    return Pairs(pairs.auxiliary.cpu(), pairs.count.cpu(), pairs.sources.cpu(), pairs.relative.cpu())

"""Views by blocks: every pair as likely as with all views there, at every step; what is copied; going on again."""

from __future__ import annotations

import itertools
from collections import Counter
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import pytest
import torch
from torch import Tensor

from advtex_engine.adversarial.pair_sampler import PairSampler
from advtex_engine.render.pairs import Pairs
from advtex_engine.render.streaming import (
    AUXILIARIES,
    LEAST_VIEWS,
    GroupOrder,
    ResidentViews,
    StreamedViews,
    arrange,
    host_allocator,
    pair_views,
)
from advtex_engine.render.view_maps import ViewMaps
from advtex_engine.synthetic.planar import planar_maps

CPU = torch.device("cpu")
WIDTH, HEIGHT = 32, 24
# The candidates of six views, the view itself first; the third sees nothing and the fifth only itself.
CANDIDATES = ([0, 1, 3, 4, 5], [1, 0, 3], [2], [3, 0, 1, 4, 5], [4], [5, 3])
SOURCES = [0, 1, 3, 4, 5]


def views() -> ViewMaps:
    """Each view's color is its number."""
    color = torch.arange(len(CANDIDATES), dtype=torch.uint8)[:, None, None, None].expand(-1, HEIGHT, WIDTH, 3)
    maps = planar_maps(color.contiguous(), 32, 32)
    maps.uv.copy_((maps.uv.long() + torch.arange(len(CANDIDATES))[:, None, None]).to(torch.int16))
    maps.depth.copy_(1 + torch.arange(len(CANDIDATES))[:, None] / 8)
    maps.intrinsics[:, 0] += torch.arange(len(CANDIDATES))
    maps.world_to_camera[:, 0, 3] = torch.arange(len(CANDIDATES))
    return maps


def pairs() -> Pairs:
    """The relative pose of a pair holds the numbers of its views."""
    width = max(map(len, CANDIDATES))
    auxiliary = torch.tensor([row + row[:1] * (width - len(row)) for row in CANDIDATES])
    count = torch.tensor([len(row) for row in CANDIDATES])
    count[2] = 0
    relative = torch.zeros((len(CANDIDATES), width, 3, 4))
    relative[..., 0, 0] = torch.arange(len(CANDIDATES))[:, None]
    relative[..., 0, 1] = auxiliary
    return Pairs(auxiliary, count, torch.tensor(SOURCES), relative)


def drawable() -> dict[tuple[int, int], Fraction]:
    """The probability of each pair where all views are there: any source, then any of its candidates."""
    return {
        (source, view): Fraction(1, len(SOURCES) * len(CANDIDATES[source]))
        for source in SOURCES
        for view in CANDIDATES[source]
    }


def drawn_from(there: Pairs, held: Tensor) -> dict[tuple[int, int], Fraction]:
    """The probabilities with which the sampler draws pairs of views from what is there."""
    chances: Counter[tuple[int, int]] = Counter()
    for place in there.sources.tolist():
        number = int(there.count[place])
        for candidate in range(number):
            view = int(held[there.auxiliary[place, candidate]])
            chances[int(held[place]), view] += Fraction(1, len(there.sources) * number)  # type: ignore[assignment]
    return dict(chances)  # type: ignore[arg-type]


def test_at_every_place_all_pairs_are_as_likely_as_with_all_views() -> None:
    """All that can happen, counted out: three sources of 1, 3 and 2 candidates of which at most two come along."""
    count, columns, kept = torch.tensor([1, 3, 2]), 3, 2
    chances: Counter[tuple[int, int, int]] = Counter()
    ranks = [torch.tensor(rank) / columns for rank in itertools.permutations(range(columns))]
    orders = [torch.tensor(order) for order in itertools.permutations(range(3))]
    weight = Fraction(1, len(orders) * len(ranks) ** 3)
    for order, *rows in itertools.product(orders, ranks, ranks, ranks):
        groups = arrange(torch.arange(3), count, kept, order, torch.stack(rows).double())
        for place in range(3):
            source, number = int(groups.source[place]), int(groups.number[place])
            for candidate in groups.candidate[place, :number].tolist():
                chances[place, source, candidate] += weight / number  # type: ignore[assignment]
    expected = {
        (place, source, candidate): Fraction(1, 3) / int(count[source])
        for place in range(3)
        for source in range(3)
        for candidate in range(int(count[source]))
    }
    assert dict(chances) == expected


def test_draws_of_many_runs_follow_the_even_distribution() -> None:
    """Chi-square over independent runs, one draw each; after 20 steps a block holds the end of one pass over the
    sources and the beginning of the next."""
    maps, all_pairs, runs = views(), pairs(), 1000
    generator = torch.Generator().manual_seed(0)
    seen: Counter[tuple[int, int]] = Counter()
    for seed in range(runs):
        streamed = StreamedViews(maps, all_pairs, 2 * 2 * (1 + AUXILIARIES), seed)
        for _ in range((0, 5, 20)[seed % 3]):
            streamed.advance(1)
        chances = drawn_from(streamed.pairs, streamed.held)
        random = torch.tensor([float(chance) for chance in chances.values()]).multinomial(1, generator=generator)
        seen[list(chances)[int(random)]] += 1
    expected = {pair: float(chance) * runs for pair, chance in drawable().items()}
    assert set(seen) <= set(expected)
    square = sum((seen[pair] - mean) ** 2 / mean for pair, mean in expected.items())
    freedom = len(expected) - 1
    assert square < freedom + 4 * (2 * freedom) ** 0.5  # one in several thousand


def test_every_pass_has_every_source_once_and_different_candidates() -> None:
    order = GroupOrder(pairs(), 7)
    groups = order.groups(3, 40)
    turns = [groups.source[start : start + 5].tolist() for start in range(2, 37, 5)]
    assert all(sorted(turn) == SOURCES for turn in turns)
    assert len({tuple(turn) for turn in turns}) > 1
    for source, candidate, number in zip(groups.source, groups.candidate, groups.number, strict=True):
        assert int(number) == min(AUXILIARIES, len(CANDIDATES[int(source)]))
        brought = candidate[: int(number)].tolist()
        assert len(set(brought)) == len(brought)
        assert max(brought) < len(CANDIDATES[int(source)])


@pytest.mark.parametrize("on_device", [8, 16, 17, 1000])
def test_what_is_there_is_what_was_there(on_device: int) -> None:
    maps, all_pairs = views(), pairs()
    streamed = StreamedViews(maps, all_pairs, on_device, 3)
    assert streamed.maps.count <= min(on_device, 2 * len(SOURCES) * (1 + AUXILIARIES))
    kept = [part.data_ptr() for part in (streamed.maps.color, streamed.maps.uv, streamed.pairs.sources)]
    for _ in range(60):
        there, at = streamed.pairs, streamed.maps
        for place in there.sources.tolist():
            source, number = int(streamed.held[place]), int(there.count[place])
            assert source in SOURCES
            for candidate in range(number):
                auxiliary = int(there.auxiliary[place, candidate])
                view = int(streamed.held[auxiliary])
                assert (auxiliary == place) == (view == source)
                assert there.relative[place, candidate, 0, :2].tolist() == [source, view]
                for name in ("color", "uv", "depth", "intrinsics", "world_to_camera"):
                    assert torch.equal(getattr(at, name)[auxiliary], getattr(maps, name)[view]), name
        streamed.advance(1)
    assert kept == [part.data_ptr() for part in (streamed.maps.color, streamed.maps.uv, streamed.pairs.sources)]


def test_a_source_without_others_is_its_own_pair() -> None:
    maps = views()
    own = Pairs(torch.arange(6)[:, None], torch.ones(6, dtype=torch.int64), torch.arange(6), torch.zeros(6, 1, 3, 4))
    streamed = StreamedViews(maps, own, LEAST_VIEWS, 0)
    assert streamed.block_views == 4, "no place is kept for auxiliary views"
    for _ in range(12):
        assert all(source == view for source, view in drawn_from(streamed.pairs, streamed.held))
        streamed.advance(1)


def draws(streamed: StreamedViews, generator: torch.Generator, steps: int, launch: int) -> list[Tensor]:
    sampler = PairSampler(streamed.maps, streamed.pairs, "object", (24, 24), generator)
    drawn = []
    for _ in range(steps // launch):
        for _ in range(launch):
            batch = sampler.draw()
            drawn.append(torch.cat((batch.condition.flatten(), batch.real.flatten(), batch.weights.flatten())))
        streamed.advance(launch)
    return drawn


@pytest.mark.parametrize("launch", [1, 5])
@pytest.mark.parametrize("stop", [0, 5, 15, 25, 40])
def test_a_run_that_goes_on_draws_the_same(stop: int, launch: int) -> None:
    """Bit by bit, wherever it stopped, also between blocks."""
    maps, all_pairs = views(), pairs()
    generator = torch.Generator().manual_seed(0)
    streamed = StreamedViews(maps, all_pairs, 16, 1)
    draws(streamed, generator, stop, launch)
    state, random = streamed.state_dict(), generator.get_state()
    whole = draws(streamed, generator, 30, launch)
    again = StreamedViews(maps, all_pairs, 16, 1)
    again.load_state_dict(state)
    generator.set_state(random)
    resumed = draws(again, generator, 30, launch)
    assert all(torch.equal(one, other) for one, other in zip(whole, resumed, strict=True))


@pytest.mark.parametrize("on_device", [LEAST_VIEWS, 16, 32])
def test_launches_of_many_steps_draw_from_all_sources_alike(on_device: int) -> None:
    streamed = StreamedViews(views(), pairs(), on_device, 3)
    launches, drawn = 60, Counter[int]()
    for _ in range(launches):
        drawn.update(streamed_sources(streamed))
        streamed.advance(20)
    assert set(drawn) == set(SOURCES)
    assert max(drawn.values()) - min(drawn.values()) <= 20 // streamed.block_views + 2


def test_a_smaller_block_goes_on_with_the_sources_that_are_left() -> None:
    maps, all_pairs = views(), pairs()
    first = StreamedViews(maps, all_pairs, 32, 1)
    first.advance(first.block_views)
    first.advance(5)
    smaller = StreamedViews(maps, all_pairs, 16, 1)
    smaller.load_state_dict(first.state_dict())
    places = 4 + 5 // 4  # groups used up
    expected = GroupOrder(all_pairs, 1).groups(places, 2).source
    assert streamed_sources(smaller) == expected.tolist()


def without_by_hand(left_out: list[int]) -> dict[tuple[int, int], Fraction]:
    """The probability of each pair where some views take no part."""
    sources = [source for source in SOURCES if source not in left_out]
    remain = {source: [view for view in CANDIDATES[source] if view not in left_out] for source in sources}
    return {
        (source, view): Fraction(1, len(sources) * len(remain[source])) for source in sources for view in remain[source]
    }


def mask(left_out: list[int]) -> Tensor:
    return torch.zeros(len(CANDIDATES), dtype=torch.bool).index_fill(0, torch.tensor(left_out, dtype=torch.int64), True)


@pytest.mark.parametrize("left_out", [[0], [1, 4], [0, 3], [5], [2], []])
def test_views_that_are_left_out_are_in_no_pair_and_all_others_are_drawn_alike(left_out: list[int]) -> None:
    """In place, and not for good: the tables that a captured step reads are the same ones, and come back whole."""
    everything = ResidentViews(views(), pairs())
    tables = [part.data_ptr() for part in vars(everything.pairs).values()]
    before = [part.clone() for part in vars(everything.pairs).values()]
    held = torch.arange(len(CANDIDATES))
    for now in ([4, 5], left_out):
        number = everything.leave_out(mask(now))
        there = replace(everything.pairs, sources=everything.pairs.sources[:number])
        assert drawn_from(there, held) == without_by_hand(now)
        for source in there.sources.tolist():
            poses = there.relative[source, : int(there.count[source]), 0, :2].tolist()
            assert poses == [[source, view] for view in there.auxiliary[source, : int(there.count[source])].tolist()]
    assert everything.leave_out(mask([])) == len(SOURCES)
    assert tables == [part.data_ptr() for part in vars(everything.pairs).values()]
    rows = torch.arange(before[0].shape[1]) < before[1][:, None]
    assert torch.equal(everything.pairs.auxiliary[rows], before[0][rows])
    assert torch.equal(everything.pairs.count, before[1])
    assert torch.equal(everything.pairs.sources, before[2])


@pytest.mark.parametrize("left_out", [[0], [1, 4], [0, 3]])
def test_streamed_views_leave_out_the_same(left_out: list[int]) -> None:
    """Also when it is said in the middle of a block; with no view that is left out on the device."""
    streamed, seen = StreamedViews(views(), pairs(), 16, 3), dict[tuple[int, int], Fraction]()
    tables = [part.data_ptr() for part in vars(streamed.pairs).values()]
    streamed.advance(3)
    assert streamed.leave_out(mask(left_out)) == len(streamed.pairs.sources)
    for _ in range(80):
        seen |= drawn_from(streamed.pairs, streamed.held)
        streamed.advance(1)
        assert not set(streamed.held.tolist()) & set(left_out)
    assert set(seen) == set(without_by_hand(left_out))
    assert tables == [part.data_ptr() for part in vars(streamed.pairs).values()]
    streamed.leave_out(mask([]))
    seen.clear()
    for _ in range(120):
        seen |= drawn_from(streamed.pairs, streamed.held)
        streamed.advance(1)
    assert set(seen) == set(drawable())


def test_turns_that_are_shorter_than_a_pass_show_all_sources_alike() -> None:
    streamed, drawn = StreamedViews(views(), pairs(), LEAST_VIEWS, 3), Counter[int]()
    for _ in range(300):
        streamed.leave_out(mask([2]))
        drawn.update(streamed_sources(streamed))
    assert sum(drawn.values()) == 300
    assert min(drawn[source] for source in SOURCES) > 300 / len(SOURCES) - 4 * (300 * 0.2 * 0.8) ** 0.5


@pytest.mark.parametrize("stop", [0, 5, 25])
def test_a_turn_that_goes_on_draws_the_same(stop: int) -> None:
    maps, all_pairs = views(), pairs()
    generator = torch.Generator().manual_seed(0)
    streamed = StreamedViews(maps, all_pairs, 16, 1)
    for now in ([0], [1, 3]):
        streamed.leave_out(mask(now))
    draws(streamed, generator, stop, 1)
    state, random = streamed.state_dict(), generator.get_state()
    whole = draws(streamed, generator, 30, 1)
    again = StreamedViews(maps, all_pairs, 16, 1)
    again.leave_out(mask([1, 3]))
    again.load_state_dict(state)
    generator.set_state(random)
    assert all(torch.equal(*both) for both in zip(whole, draws(again, generator, 30, 1), strict=True))


def streamed_sources(streamed: StreamedViews) -> list[int]:
    return [int(streamed.held[place]) for place in streamed.pairs.sources.tolist()]


def test_without_a_bound_nothing_moves() -> None:
    maps, all_pairs = views(), pairs()
    everything = pair_views(maps, all_pairs, None, 0)
    assert isinstance(everything, ResidentViews)
    assert everything.maps is maps
    assert everything.pairs is all_pairs
    everything.advance(5)
    everything.load_state_dict(everything.state_dict())
    assert isinstance(pair_views(maps, all_pairs, 16, 0), StreamedViews)


def test_a_cpus_views_lie_in_files_that_vanish(tmp_path: Path) -> None:
    allocate = host_allocator(CPU, tmp_path)
    kept = allocate((5, 7, 3), torch.int16)
    kept.copy_(torch.arange(105, dtype=torch.int16).view(5, 7, 3))
    assert torch.equal(kept.flatten(), torch.arange(105, dtype=torch.int16))
    assert list(tmp_path.iterdir()) == []
    assert str(tmp_path) in Path("/proc/self/maps").read_text()

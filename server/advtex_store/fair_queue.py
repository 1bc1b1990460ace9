"""Whose job is next: fair queueing by owner.

Waiting rows of one owner that need the same memory are a line, and the index `ix_jobs_line` holds every line in order.
A look at who is next costs a probe per line and what is taken from them, however many rows wait behind those.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from heapq import merge
from itertools import islice
from typing import Any, NamedTuple

from sqlalchemy import CTE, JSON, ColumnElement, Select, TextClause, func, select, text
from sqlalchemy.orm import InstrumentedAttribute, Session

from advtex_contract.jobs import JobState
from advtex_store.models import KEPT, WAITS_IN_LINE, JobRow

FIRST_DEPTH = 8  # rows that are read of every line at first


@dataclass(frozen=True, slots=True)
class WaitingJob:
    """What the dispatcher has to know of a waiting row."""

    id: str
    attempt: int
    state: JobState


class _Place(NamedTuple):
    """A row in its line; compares as the line is ordered: preempted ones first, then by priority, then the older."""

    state: str
    urgency: int  # the less, the earlier: minus the priority
    id: str
    attempt: int


class _Cut(Exception):
    """The part of a line that was read has been used up."""


def next_jobs(session: Session, limit: int, gib: int | None = None) -> list[WaitingJob]:
    """The waiting jobs that come next, of those that a worker of the class `gib` can take; None for any.

    Preempted ones first. Then owners take turns, those first who have the fewest jobs running; among the jobs of one
    owner the larger priority comes first, then the older job.
    """
    running = _running(session)
    use_order_of_index(session)
    depth = FIRST_DEPTH
    while True:
        lines = _read_lines(session, depth, gib)
        with suppress(_Cut):
            return list(islice(_take_turns(lines, running, depth), max(limit, 0)))
        depth *= 4


def distinct_pairs(waits: TextClause, first: InstrumentedAttribute[Any], second: InstrumentedAttribute[Any]) -> CTE:
    """The pairs of values that waiting rows have in two columns, by a probe each of the index that begins with them.

    waits: the index's condition. The columns are called `first` and `second`; the last `second` of each `first` is
    null. Neither database skips through an index by itself.
    """

    def least(column: InstrumentedAttribute[Any], *where: ColumnElement[bool]) -> Select[Any]:
        return select(column).where(waits, *where).order_by(column).limit(1)

    firsts = select(least(first).scalar_subquery().label("first")).cte("firsts", recursive=True)
    following = least(first, first > firsts.c.first).scalar_subquery()
    firsts = firsts.union_all(select(following).where(firsts.c.first.is_not(None)))
    smallest = least(second, first == firsts.c.first).scalar_subquery().label("second")
    pairs = select(firsts.c.first, smallest).where(firsts.c.first.is_not(None)).cte("pairs", recursive=True)
    larger = least(second, first == pairs.c.first, second > pairs.c.second).scalar_subquery()
    return pairs.union_all(select(pairs.c.first, larger).where(pairs.c.second.is_not(None)))


def use_order_of_index(session: Session) -> None:
    """Until the transaction ends. PostgreSQL takes a condition with an expression to hold for hardly any row, and would
    rather sort all that waits than read the first few of an index."""
    if session.get_bind().dialect.name == "postgresql":
        session.execute(text("set local enable_sort = off"))


def _running(session: Session) -> Mapping[str, int]:
    query = select(JobRow.owner, func.count()).where(JobRow.state == JobState.running, KEPT).group_by(JobRow.owner)
    return {owner: int(count) for owner, count in session.execute(query)}


def _read_lines(session: Session, depth: int, gib: int | None) -> Mapping[str, list[Sequence[_Place]]]:
    """Owner -> the first `depth` rows of each of the lines."""
    pairs = distinct_pairs(WAITS_IN_LINE, JobRow.owner, JobRow.memory_gib)
    sqlite = session.get_bind().dialect.name == "sqlite"
    array, gather = (func.json_array, func.json_group_array) if sqlite else (func.json_build_array, func.json_agg)
    front = (
        select(array(JobRow.state, -JobRow.priority, JobRow.id, JobRow.attempt).label("place"))
        .where(WAITS_IN_LINE, JobRow.owner == pairs.c.first, JobRow.memory_gib == pairs.c.second)
        .order_by(JobRow.state, JobRow.priority.desc(), JobRow.id)
        .limit(depth)
        .correlate(pairs)
        .subquery()
    )
    place = func.json(front.c.place) if sqlite else front.c.place  # SQLite forgets in between that it is JSON
    query = select(pairs.c.first, select(gather(place, type_=JSON)).scalar_subquery())
    query = query.where(pairs.c.second.is_not(None) if gib is None else pairs.c.second <= gib)
    lines: dict[str, list[Sequence[_Place]]] = defaultdict(list)
    for owner, places in session.execute(query):
        lines[owner].append([_Place(*place) for place in places or ()])
    return lines


def _take_turns(
    lines: Mapping[str, Sequence[Sequence[_Place]]], running: Mapping[str, int], depth: int
) -> Iterator[WaitingJob]:
    owners = [_turns_of_one(mine, running.get(owner, 0), depth) for owner, mine in lines.items()]
    for state, _turn, job_id, attempt in merge(*owners):
        yield WaitingJob(job_id, attempt, JobState(state))


def _turns_of_one(lines: Sequence[Sequence[_Place]], running: int, depth: int) -> Iterator[tuple[str, int, str, int]]:
    """An owner's jobs, each with the number of jobs that would be running with it."""
    for turn, place in enumerate(merge(*(_read_part(line, depth) for line in lines)), running + 1):
        yield place.state, turn, place.id, place.attempt


def _read_part(line: Sequence[_Place], depth: int) -> Iterator[_Place]:
    yield from line
    if len(line) == depth:
        raise _Cut

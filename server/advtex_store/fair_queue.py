"""Whose job is next: owners take turns, and the batches of each owner do.

Waiting rows of one owner, batch and priority that need the same memory are a line, and the index `ix_jobs_turn` holds
every line in order. A look at who is next costs a probe per line and what is taken from them, however many rows wait
behind those.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from heapq import heapify, heappop, heappush, merge
from itertools import islice
from math import inf
from typing import Any, NamedTuple

from sqlalchemy import CTE, JSON, ColumnElement, Select, TextClause, func, select, text
from sqlalchemy.orm import InstrumentedAttribute, Session

from advtex_contract.jobs import JobState
from advtex_store.lines import Allowance, Line, read_holds, read_running
from advtex_store.models import WAITS_FOR_ITS_TURN, JobRow

FIRST_DEPTH = 8  # rows that are read of every line at first
AGING_SECONDS = 3600.0  # of waiting for which a batch that has nothing running counts as one step of priority more


@dataclass(frozen=True, slots=True)
class WaitingJob:
    """What the dispatcher has to know of a waiting row."""

    id: str
    attempt: int
    state: JobState


class _Place(NamedTuple):
    """A row in its line; compares as the line is ordered: preempted ones first, then what is due, then the older.

    due, deadline, made: seconds since 1970.
    """

    state: str
    due: float
    id: str
    attempt: int
    deadline: float | None
    made: float


class _Cut(Exception):
    """The part of a line that was read has been used up."""


def next_jobs(
    session: Session, limit: int, now: float, gib: int | None = None, offered: Collection[str] = ()
) -> list[WaitingJob]:
    """The waiting jobs that come next, of those that a worker of the class `gib` can take; None for any.

    Preempted ones first. Then owners take turns, those first who have the fewest jobs running. Among the jobs of one
    owner the larger priority comes first, and what waits long gains (`_Flow.urgency`); at equal priority the sooner
    deadline, then the batch that has the fewest jobs running, then the older job. Batches that are paused, and batches
    and owners of which as many jobs run as may, have none.

    offered: ids of waiting jobs that are on their way to a worker; they are in their places, and count as running where
    that is limited.
    """
    holds = read_holds(session, offered)
    running = read_running(session)
    use_order_of_index(session)
    depth = FIRST_DEPTH
    while True:
        lines = _read_lines(session, depth, gib)
        with suppress(_Cut):
            return list(islice(_take_turns(lines, running, Allowance(holds, running), now, depth), max(limit, 0)))
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


def _read_lines(session: Session, depth: int, gib: int | None) -> Mapping[Line, list[Sequence[_Place]]]:
    """Line -> its first `depth` rows of each class of memory."""
    pairs = distinct_pairs(WAITS_FOR_ITS_TURN, JobRow.line, JobRow.memory_gib)
    sqlite = session.get_bind().dialect.name == "sqlite"
    array, gather = (func.json_array, func.json_group_array) if sqlite else (func.json_build_array, func.json_agg)
    place = (JobRow.state, JobRow.due, JobRow.id, JobRow.attempt, JobRow.deadline, JobRow.created_at)
    front = (
        select(array(*place).label("place"))
        .where(WAITS_FOR_ITS_TURN, JobRow.line == pairs.c.first, JobRow.memory_gib == pairs.c.second)
        .order_by(JobRow.state, JobRow.due, JobRow.id)
        .limit(depth)
        .correlate(pairs)
        .subquery()
    )
    found = func.json(front.c.place) if sqlite else front.c.place  # SQLite forgets in between that it is JSON
    query = select(pairs.c.first, select(gather(found, type_=JSON)).scalar_subquery())
    query = query.where(pairs.c.second.is_not(None) if gib is None else pairs.c.second <= gib)
    lines: dict[Line, list[Sequence[_Place]]] = defaultdict(list)
    for line, places in session.execute(query):
        lines[Line.of(line)].append([_Place(*one) for one in places or ()])
    return lines


class _Flow:
    """The jobs of one owner, batch and priority, and how many of them run or have been taken."""

    def __init__(self, line: Line, parts: Iterable[Sequence[_Place]], running: int, depth: int) -> None:
        self.line, self.running = line, running
        self._places = merge(*(_read_part(part, depth) for part in parts))
        self.head: _Place | None = None
        self.advance()

    def advance(self) -> None:
        self.head = next(self._places, None)

    def urgency(self, now: float) -> tuple[str, int, float, int, str]:
        """Of its next job, among the owner's flows; the less, the earlier.

        A flow of which nothing runs gains a step of priority for each hour that its next job has waited: one job at a
        time gets through, however many of a larger priority come so much later.
        """
        assert self.head is not None
        waited = 0 if self.running else int(max(0.0, now - self.head.made) // AGING_SECONDS)
        deadline = inf if self.head.deadline is None else self.head.deadline
        return self.head.state, -(self.line.priority + waited), deadline, self.running, self.head.id


def _take_turns(
    lines: Mapping[Line, Sequence[Sequence[_Place]]],
    running: Mapping[Line, int],
    allowance: Allowance,
    now: float,
    depth: int,
) -> Iterator[WaitingJob]:
    flows: dict[str, list[_Flow]] = defaultdict(list)
    for line, parts in lines.items():
        flows[line.owner].append(_Flow(line, parts, running.get(line, 0), depth))
    begun = Counter[str]()
    for line, count in running.items():
        begun[line.owner] += count
    for state, _turn, job_id, attempt in merge(
        *(_turns_of_one(mine, begun[owner], allowance, now) for owner, mine in flows.items())
    ):
        yield WaitingJob(job_id, attempt, JobState(state))


def _turns_of_one(
    flows: Iterable[_Flow], running: int, allowance: Allowance, now: float
) -> Iterator[tuple[str, int, str, int]]:
    """An owner's jobs, each with the number of jobs that would be running with it."""
    order = [(flow.urgency(now), number, flow) for number, flow in enumerate(flows)]
    heapify(order)
    while order:
        _, number, flow = heappop(order)
        place = flow.head
        assert place is not None
        if not allowance.take(flow.line, place.id):
            continue  # and so none behind it may
        running += 1
        flow.running += 1
        yield place.state, running, place.id, place.attempt
        flow.advance()
        if flow.head is not None:
            heappush(order, (flow.urgency(now), number, flow))


def _read_part(line: Sequence[_Place], depth: int) -> Iterator[_Place]:
    yield from line
    if len(line) == depth:
        raise _Cut

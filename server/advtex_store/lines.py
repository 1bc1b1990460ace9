"""Whose waiting jobs may begin at all: what is paused, and how many of a batch and of an owner run at a time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from enum import Enum, auto
from typing import NamedTuple

from sqlalchemy import func, or_, select
from sqlalchemy.orm import Session

from advtex_contract.jobs import WAITING, JobState
from advtex_store.models import KEPT, ApiKeyRow, BatchRow, JobRow

Group = tuple[str, str]
"""An owner and one of the batches; with the empty name, which no batch has, all that the owner has."""


class Line(NamedTuple):
    """Whose jobs they are, as `JobRow.line` tells; the batch is empty for jobs of none."""

    priority: int
    batch: str
    owner: str

    @classmethod
    def of(cls, text: str) -> Line:
        priority, batch, owner = text.split("/", 2)
        return cls(int(priority), batch, owner)


@dataclass(frozen=True, slots=True)
class Holds:
    """What keeps waiting jobs from their turn.

    most: how many jobs run at a time, where that is limited. offered: ids of waiting jobs that are on their way to a
    worker; expected: how many of those count where that is limited.
    """

    paused: frozenset[Group] = frozenset()
    most: Mapping[Group, int] = field(default_factory=dict)
    offered: Collection[str] = ()
    expected: Mapping[Group, int] = field(default_factory=dict)


def read_holds(session: Session, offered: Collection[str] = (), *, owner: str | None = None) -> Holds:
    """As they are now, of all owners or of one. What is offered is looked up only for owners of whom something is
    limited."""
    said = or_(BatchRow.paused_at.is_not(None), BatchRow.max_running.is_not(None))
    batches = select(BatchRow.owner, BatchRow.id, BatchRow.paused_at, BatchRow.max_running).where(said)
    limited = select(ApiKeyRow.owner, func.min(ApiKeyRow.max_running_jobs)).group_by(ApiKeyRow.owner)
    limited = limited.where(ApiKeyRow.max_running_jobs.is_not(None), ApiKeyRow.revoked_at.is_(None))
    if owner is not None:
        batches, limited = batches.where(BatchRow.owner == owner), limited.where(ApiKeyRow.owner == owner)
    paused, most = set[Group](), dict[Group, int]()
    for whose, batch, paused_at, max_running in session.execute(batches):
        if paused_at is not None:
            paused.add((whose, batch))
        if max_running is not None:
            most[whose, batch] = max_running
    most |= {(whose, ""): least for whose, least in session.execute(limited) if least is not None}
    expected = Counter[Group]()
    if most and offered:
        waits = select(JobRow.owner, func.coalesce(JobRow.batch, "")).where(JobRow.id.in_(list(offered)))
        waits = waits.where(JobRow.owner.in_({owner for owner, _ in most}), JobRow.state.in_(WAITING))
        for whose, batch in session.execute(waits):
            expected.update(_groups(whose, batch))
    return Holds(frozenset(paused), most, frozenset(offered), expected)


def read_running(session: Session, owner: str | None = None) -> Mapping[Line, int]:
    """How many jobs of each line run, of all owners or of one."""
    query = select(JobRow.line, func.count()).where(JobRow.state == JobState.running, KEPT).group_by(JobRow.line)
    if owner is not None:
        query = query.where(JobRow.owner == owner)
    return {Line.of(line): int(count) for line, count in session.execute(query)}


class Full(Enum):
    """What keeps all further jobs of a batch from beginning: it is paused, or has as many running as may, or its owner
    has."""

    paused = auto()
    batch = auto()
    owner = auto()


class Allowance:
    """How many more jobs may begin; counted down as they are taken."""

    def __init__(self, holds: Holds, running: Mapping[Line, int]) -> None:
        self._holds = holds
        begun = Counter(holds.expected)
        for line, count in running.items():
            begun.update(dict.fromkeys(_groups(line.owner, line.batch), count))
        self._left = {group: most - begun[group] for group, most in holds.most.items()}

    def take(self, line: Line, job_id: str) -> bool:
        """Whether this job may begin, or does so already."""
        if (line.owner, line.batch) in self._holds.paused:
            return False
        if job_id in self._holds.offered:
            return True
        mine = _groups(line.owner, line.batch) & self._left.keys()
        if any(self._left[group] <= 0 for group in mine):
            return False
        for group in mine:
            self._left[group] -= 1
        return True

    def full(self, owner: str, batch: str) -> Full | None:
        """What keeps a further job of the batch (empty for none) from beginning, if anything does."""
        if (owner, batch) in self._holds.paused:
            return Full.paused
        if batch and self._left.get((owner, batch), 1) <= 0:
            return Full.batch
        return Full.owner if self._left.get((owner, ""), 1) <= 0 else None

    def most(self, owner: str, batch: str, full: Full) -> int:
        """How many may run where that is the limit that is met."""
        return self._holds.most[owner, batch if full is Full.batch else ""]


def _groups(owner: str, batch: str) -> set[Group]:
    return {(owner, ""), (owner, batch)}

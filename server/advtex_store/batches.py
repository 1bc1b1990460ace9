"""Batches: jobs that a client gave the same name, and what was said of them as a whole."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from sqlalchemy import Select, delete, exists, func, select
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session

from advtex_contract.jobs import PENDING, TERMINAL, JobState, Progress
from advtex_store.database import Database
from advtex_store.errors import RecordNotFound
from advtex_store.lines import Allowance, read_holds, read_running
from advtex_store.models import BatchRow, JobRow

UNUSED_SECONDS = 3600.0  # what was said of a batch before its first job is kept this long
MEASURED = 200  # of the ended jobs, the newest ones tell how long one takes


@dataclass(frozen=True, slots=True)
class BatchSummary:
    """Counts by state, and the seconds that are left, None if nothing was measured yet.

    max_running: how many of its jobs run at a time; None for any number.
    """

    id: str
    states: Mapping[str, int]
    created_at: float
    updated_at: float
    eta_seconds: float | None = None
    paused: bool = False
    max_running: int | None = None

    @property
    def finished(self) -> bool:
        return all(state in TERMINAL for state in self.states)


@dataclass(slots=True)
class Measured:
    """What jobs of one kind took: the same options but for the seed."""

    seconds: list[float] = field(default_factory=list)

    @property
    def mean(self) -> float | None:
        return sum(self.seconds) / len(self.seconds) if self.seconds else None


class Batches:
    """An owner's batches."""

    def __init__(self, database: Database) -> None:
        self.database = database

    def batch(self, owner: str, batch_id: str) -> BatchSummary:
        """RecordNotFound if no job has this name."""
        with self.database.read() as session:
            states, first, last = self._counts(session.execute(_counted(owner).where(JobRow.batch == batch_id)).all())
            if not states:
                raise RecordNotFound(f"there is no batch {batch_id}")
            said = _said(session, owner, [batch_id])
            mine = select(JobRow.options, JobRow.progress).where(
                JobRow.owner == owner, JobRow.batch == batch_id, JobRow.deleted_at.is_(None)
            )
            ended = session.execute(
                mine.where(JobRow.state == JobState.succeeded).order_by(JobRow.id.desc()).limit(MEASURED)
            ).all()
            running = session.execute(mine.where(JobRow.state == JobState.running)).all()
            waiting = session.scalars(mine.with_only_columns(JobRow.options).where(JobRow.state.in_(PENDING))).all()
        eta = remaining_seconds(
            [(o, Progress.model_validate(p)) for o, p in ended],
            [(o, Progress.model_validate(p)) for o, p in running],
            waiting,
        )
        return BatchSummary(batch_id, states, first, last, eta, **said[batch_id])

    def batches(self, owner: str, cursor: str | None, limit: int) -> tuple[list[BatchSummary], str | None]:
        """A page, newest first, and the cursor of the next one. Without the time that is left."""
        newest = (
            select(JobRow.batch, func.min(JobRow.id).label("first"))
            .where(JobRow.owner == owner, JobRow.batch.is_not(None), JobRow.deleted_at.is_(None))
            .group_by(JobRow.batch)
        )
        if cursor is not None:
            newest = newest.having(func.min(JobRow.id) < cursor)
        with self.database.read() as session:
            page = session.execute(newest.order_by(func.min(JobRow.id).desc()).limit(limit + 1)).all()
            names = [name for name, _ in page[:limit] if name is not None]
            counted = session.execute(_counted(owner).where(JobRow.batch.in_(names))).all()
            said = _said(session, owner, names)
        rows = {name: [row for row in counted if row[0] == name] for name in names}
        found = [BatchSummary(name, *self._counts(rows[name]), **said[name]) for name in names]
        return found, page[limit - 1][1] if len(page) > limit else None

    def pause(self, owner: str, batch_id: str, paused: bool) -> None:
        """From now on none of its jobs begins, or all may again; what runs goes on. RecordNotFound."""
        with self.database.write() as session:
            if session.scalar(_kept(owner, batch_id).limit(1)) is None:
                raise RecordNotFound(f"there is no batch {batch_id}")
            now = self.database.now(session)
            self._say(session, owner, batch_id, {"paused_at": now if paused else None})

    def limit(self, owner: str, batch_id: str, max_running: int | None) -> None:
        """How many of its jobs run at a time, also of one that is yet to come; None for any number."""
        with self.database.write() as session:
            self._say(session, owner, batch_id, {"max_running": max_running})

    def allowance(self, owner: str) -> Allowance:
        """Which of the owner's waiting jobs may begin, as it is now."""
        with self.database.read() as session:
            holds = read_holds(session, owner=owner)
            return Allowance(holds, read_running(session, owner) if holds.most else {})

    def forget(self) -> None:
        """Drop what was said of batches that have no jobs any more."""
        jobs = exists().where(JobRow.owner == BatchRow.owner, JobRow.batch == BatchRow.id, JobRow.deleted_at.is_(None))
        with self.database.read() as session:
            aged = BatchRow.updated_at < self.database.now(session) - UNUSED_SECONDS
            found = session.execute(select(BatchRow.owner, BatchRow.id).where(aged, ~jobs)).all()
        for owner, batch_id in found:
            with self.database.write() as session:
                where = (BatchRow.owner == owner, BatchRow.id == batch_id)
                session.execute(delete(BatchRow).where(*where, aged, ~jobs))

    def _say(self, session: Session, owner: str, batch_id: str, values: Mapping[str, Any]) -> None:
        insert = sqlite.insert if session.get_bind().dialect.name == "sqlite" else postgresql.insert
        told = {**values, "updated_at": self.database.now(session)}
        inserted = insert(BatchRow).values(owner=owner, id=batch_id, **told)
        session.execute(inserted.on_conflict_do_update(index_elements=["owner", "id"], set_=told))

    def jobs(self, owner: str, batch_id: str, states: Iterable[JobState]) -> list[str]:
        """Ids of the batch's jobs in these states, oldest first."""
        with self.database.read() as session:
            query = _kept(owner, batch_id).where(JobRow.state.in_(list(states)))
            return list(session.scalars(query.order_by(JobRow.id)))

    @staticmethod
    def _counts(rows: Sequence[Any]) -> tuple[dict[str, int], float, float]:
        states = {state: int(count) for _, state, count, _, _ in rows}
        first = min((created for *_, created, _ in rows), default=0.0)
        last = max((updated for *_, updated in rows), default=0.0)
        return states, first, last


def remaining_seconds(
    ended: Iterable[tuple[Mapping[str, Any], Progress]],
    running: Sequence[tuple[Mapping[str, Any], Progress]],
    waiting: Sequence[Mapping[str, Any]],
) -> float | None:
    """From measured step rates: what is left of the running jobs, and the waiting ones at the mean of their kind,
    shared among as many workers as have a job now. 0 with nothing left, None with nothing measured."""
    if not running and not waiting:
        return 0.0
    kinds: dict[str, Measured] = defaultdict(Measured)
    overall = Measured()
    for options, seconds in (
        *((options, sum(progress.stage_seconds.values())) for options, progress in ended),
        *((options, _whole_seconds(progress)) for options, progress in running),
    ):
        if seconds:
            kinds[_kind(options)].seconds.append(seconds)
            overall.seconds.append(seconds)
    if overall.mean is None:
        return None
    usual = overall.mean

    def expected(options: Mapping[str, Any]) -> float:
        return kinds[_kind(options)].mean or usual

    left = [
        progress.eta_seconds
        if progress.eta_seconds is not None
        else max(0.0, expected(options) - sum(progress.stage_seconds.values()))
        for options, progress in running
    ]
    total = sum(left) + sum(expected(options) for options in waiting)
    return max(total / max(1, len(running)), *left, 0.0)


def _whole_seconds(progress: Progress) -> float | None:
    """What a running job will have taken for the stages up to this one, at its present rate of steps."""
    if not progress.steps_per_second or progress.eta_seconds is None:
        return None
    return sum(progress.stage_seconds.values()) + progress.eta_seconds


def _kept(owner: str, batch_id: str) -> Select[str]:
    """Ids of the batch's jobs."""
    return select(JobRow.id).where(JobRow.owner == owner, JobRow.batch == batch_id, JobRow.deleted_at.is_(None))


def _said(session: Session, owner: str, names: Sequence[str]) -> Mapping[str, dict[str, Any]]:
    """Name -> the fields of its summary that its row tells."""
    rows = session.scalars(select(BatchRow).where(BatchRow.owner == owner, BatchRow.id.in_(names)))
    said = {row.id: {"paused": row.paused_at is not None, "max_running": row.max_running} for row in rows}
    return {name: said.get(name, {}) for name in names}


def _kind(options: Mapping[str, Any]) -> str:
    return json.dumps({name: value for name, value in options.items() if name != "seed"}, sort_keys=True)


def _counted(owner: str) -> Select[str | None, str, int, float, float]:
    return (
        select(JobRow.batch, JobRow.state, func.count(), func.min(JobRow.created_at), func.max(JobRow.updated_at))
        .where(JobRow.owner == owner, JobRow.deleted_at.is_(None))
        .group_by(JobRow.batch, JobRow.state)
    )

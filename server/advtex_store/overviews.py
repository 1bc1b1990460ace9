"""Jobs as overviews show them: without the parts of a row that can be long."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy import BigInteger, Select, cast, func, select
from sqlalchemy.orm import load_only

from advtex_contract.jobs import JobState
from advtex_store.database import Database
from advtex_store.models import ENDED, KEPT, JobRow
from advtex_store.submissions import JobFilter

MOST_CHANGED = 1000  # rows; whoever was away longer than that many changes looks at the newest
HOUR = 3600.0
SHORT = (
    JobRow.id,
    JobRow.state,
    JobRow.label,
    JobRow.batch,
    JobRow.options,
    JobRow.progress,
    JobRow.waiting_reason,
    JobRow.error,
    JobRow.created_at,
    JobRow.updated_at,
    JobRow.finished_at,
    JobRow.deleted_at,
)


@dataclass(frozen=True, slots=True)
class Failure:
    """A job that failed or was rejected: when, for which cause, and what its owner was told."""

    id: str
    owner: str
    label: str
    finished_at: float
    cause: str
    message: str


class Overviews:
    """Rows that have no `results`, `warnings` and `log_tail`: to touch these raises."""

    def __init__(self, database: Database) -> None:
        self.database = database

    def jobs(
        self, owner: str, wanted: JobFilter, cursor: str | None, limit: int
    ) -> tuple[Sequence[JobRow], str | None]:
        """A page of jobs, newest first, and the cursor of the next one. The label need only be contained."""
        query = _short().where(JobRow.owner == owner, JobRow.deleted_at.is_(None))
        if wanted.state is not None:
            query = query.where(JobRow.state == wanted.state)
        if wanted.label is not None:
            query = query.where(JobRow.label.icontains(wanted.label, autoescape=True))
        if wanted.batch is not None:
            query = query.where(JobRow.batch == wanted.batch)
        if cursor is not None:
            query = query.where(JobRow.id < cursor)
        with self.database.read() as session:
            rows = session.scalars(query.order_by(JobRow.id.desc()).limit(limit + 1)).all()
        return rows[:limit], rows[limit - 1].id if len(rows) > limit else None

    def changed(self, owner: str, since: float) -> list[JobRow]:
        """Changed after a time on the database's clock, deleted ones too, in the order of their changes."""
        query = _short().where(JobRow.owner == owner, JobRow.updated_at > since)
        with self.database.read() as session:
            rows = session.scalars(query.order_by(JobRow.updated_at.desc()).limit(MOST_CHANGED)).all()
        return list(reversed(rows))

    # -- all owners' ----------------------------------------------------------------------------------------------

    def running(self, limit: int) -> Sequence[JobRow]:
        """Jobs that have a worker, oldest first, with `owner`, `attempt` and `memory_gib`."""
        query = select(JobRow).options(
            load_only(*SHORT, JobRow.owner, JobRow.attempt, JobRow.memory_gib, raiseload=True)
        )
        query = query.where(JobRow.state == JobState.running, KEPT).order_by(JobRow.id).limit(limit)
        with self.database.read() as session:
            return session.scalars(query).all()

    def ended_by_hour(self, since: float) -> list[tuple[int, str, int]]:
        """(hours since 1970, state, how many jobs ended so in that hour), oldest first, of jobs that are kept."""
        hour = cast(func.floor(JobRow.finished_at / HOUR), BigInteger)
        query = select(hour, JobRow.state, func.count()).where(ENDED, JobRow.finished_at > since)
        with self.database.read() as session:
            found = session.execute(query.group_by(hour, JobRow.state).order_by(hour)).all()
        return [(int(at), state, jobs) for at, state, jobs in found]

    def failures(self, since: float, limit: int) -> list[Failure]:
        """What failed or was rejected, newest first."""
        code, message = (JobRow.error[name].as_string() for name in ("code", "message"))
        query = select(JobRow.id, JobRow.owner, JobRow.label, JobRow.finished_at, code, message)
        query = query.where(ENDED, JobRow.finished_at > since, JobRow.state.in_((JobState.failed, JobState.rejected)))
        with self.database.read() as session:
            found = session.execute(query.order_by(JobRow.finished_at.desc()).limit(limit)).all()
        return [Failure(*row) for row in found]

    def now(self) -> float:
        """The database's clock."""
        with self.database.read() as session:
            return self.database.now(session)


def _short() -> Select[JobRow]:
    return select(JobRow).options(load_only(*SHORT, raiseload=True))

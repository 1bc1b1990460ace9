"""Changes of a job's state: along `STATES` of `advtex_contract.jobs` only, each one compare-and-set."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sqlalchemy import ColumnElement, and_, select, update
from sqlalchemy.orm import Session

from advtex_contract.jobs import STATES, JobState
from advtex_store.counters import count_accuracy, count_end
from advtex_store.database import Database
from advtex_store.errors import IllegalTransition, RecordNotFound, StaleAttempt
from advtex_store.models import EventRow, JobRow
from advtex_store.webhooks import tell_webhooks


class Transitions:
    """What all changes of rows of jobs have in common, within the session of whoever makes one."""

    def __init__(self, database: Database) -> None:
        self.database = database

    def move(
        self,
        session: Session,
        job_id: str,
        to: JobState,
        *,
        fence: int | None = None,
        sources: frozenset[JobState] | None = None,
        **values: Any,
    ) -> JobRow:
        """Compare-and-set along `STATES`. `fence`: only if this is the job's attempt; `sources`: only from these."""
        allowed = {state for state, facts in STATES.items() if to in facts.becomes}
        where = [JobRow.id == job_id, JobRow.deleted_at.is_(None), JobRow.state.in_(allowed & (sources or allowed))]
        if fence is not None:
            where.append(JobRow.attempt == fence)
        session.flush()
        now = self.database.now(session)
        statement = update(JobRow).where(*where).values(state=to, version=JobRow.version + 1, updated_at=now, **values)
        row: JobRow | None = session.scalar(
            statement.returning(JobRow), execution_options={"populate_existing": True, "synchronize_session": False}
        )
        if row is None and fence is not None:
            raise StaleAttempt(self._why_stale(session, job_id, fence))
        if row is None:
            raise IllegalTransition(f"job {job_id} is {self._get(session, job_id, None).state}, it cannot become {to}")
        record_event(session, row, "state", {"state": to.value, "attempt": row.attempt, "at": now})
        tell_webhooks(session, row, now)
        return row

    def finish(self, session: Session, row: JobRow, **values: Any) -> JobRow:
        """What is due when a job has moved to a state that ends it."""
        row.finished_at = self.database.now(session)
        row.expires_at = row.finished_at + row.retention_seconds
        row.lease_expires_at = None
        row.cancel_requested = False
        for name, value in values.items():
            setattr(row, name, value)
        count_end(session, row.state, row.error, row.progress.get("stage_seconds", {}))
        accuracy = row.progress.get("losses", {}).get("accuracy")
        if row.state == JobState.succeeded and accuracy is not None:
            count_accuracy(session, row.options.get("preset", "auto"), accuracy)
        return row

    def _get(self, session: Session, job_id: str, owner: str | None, *, lock: bool = False) -> JobRow:
        query = select(JobRow).where(JobRow.id == job_id, JobRow.deleted_at.is_(None))
        if owner is not None:
            query = query.where(JobRow.owner == owner)
        row = session.scalar(query.with_for_update() if lock else query)
        if row is None:
            raise RecordNotFound(f"there is no job {job_id}")
        return row

    def _running(self, session: Session, job_id: str, attempt: int, *, expired_only: bool = False) -> JobRow:
        """The row of the attempt that has the job; with `expired_only` if its lease has run out. StaleAttempt."""
        row = session.scalar(select(JobRow).where(held(job_id, attempt)).with_for_update())
        if row is None:
            raise StaleAttempt(self._why_stale(session, job_id, attempt))
        if expired_only and (row.lease_expires_at or 0.0) > self.database.now(session):
            raise StaleAttempt(f"job {job_id}: the lease of attempt {attempt} still holds")
        return row

    def _why_stale(self, session: Session, job_id: str, attempt: int) -> str:
        row = session.get(JobRow, job_id)
        if row is None:
            return f"there is no job {job_id}"
        return f"attempt {attempt} of job {job_id} is stale: the job is {row.state} at attempt {row.attempt}"


def held(job_id: str, attempt: int) -> ColumnElement[bool]:
    """That the attempt has the job."""
    return and_(
        JobRow.id == job_id, JobRow.state == JobState.running, JobRow.attempt == attempt, JobRow.deleted_at.is_(None)
    )


def record_event(session: Session, row: JobRow, kind: str, data: Mapping[str, Any]) -> None:
    """What those who follow the job are told of its version."""
    session.add(EventRow(job_id=row.id, version=row.version, data={"kind": kind, **data}))

"""Counts of what has happened, kept in the rows: they are the whole fleet's, and no restart begins them anew."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sqlalchemy import func, select
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session

from advtex_contract.jobs import WAITING, JobState
from advtex_store.database import Database
from advtex_store.models import DeliveryRow, JobRow, TallyRow

# In the order in which one transaction may count: all in the same, or two of them could wait for each other.
ATTEMPTS = "attempts"  # ended early, by how: lost, preempted
FAILURES = "failures"  # jobs that failed or were rejected, by the error's code
JOBS = "jobs"  # ended, by state
STAGES = "stages"  # seconds, of jobs that ended


@dataclass(frozen=True, slots=True)
class Load:
    """What there is to do now: jobs that wait, the age of the oldest of them in seconds, steps per second of all that
    run, and webhook deliveries that wait."""

    waiting: int
    oldest_seconds: float
    steps_per_second: float
    deliveries: int


def tally(session: Session, name: str, label: str, total: float = 0.0) -> None:
    """Count one more, inside the transaction in which it happens."""
    insert = sqlite.insert if session.get_bind().dialect.name == "sqlite" else postgresql.insert
    statement = insert(TallyRow).values(name=name, label=label[:255], count=1, total=total)
    session.execute(
        statement.on_conflict_do_update(
            index_elements=["name", "label"],
            set_={"count": TallyRow.count + 1, "total": TallyRow.total + total},
        )
    )


def tally_end(
    session: Session, state: str, error: Mapping[str, Any] | None, stage_seconds: Mapping[str, float]
) -> None:
    """Count a job that has ended."""
    if error is not None:
        tally(session, FAILURES, str(error["code"]))
    tally(session, JOBS, state)
    for stage, seconds in sorted(stage_seconds.items()):
        tally(session, STAGES, stage, seconds)


class Tallies:
    """The counts, for those who watch the service."""

    def __init__(self, database: Database) -> None:
        self.database = database

    def counts(self) -> list[TallyRow]:
        """All of them."""
        with self.database.read() as session:
            return list(session.scalars(select(TallyRow).order_by(TallyRow.name, TallyRow.label)))

    def pauses(self) -> list[str]:
        """Why running jobs pause, each reason once."""
        query = select(JobRow.waiting_reason).where(JobRow.state == JobState.running, JobRow.waiting_reason != "")
        with self.database.read() as session:
            return sorted(set(session.scalars(query)))

    def load(self) -> Load:
        """How much there is to do."""
        waiting = select(func.count(), func.min(JobRow.created_at)).where(
            JobRow.state.in_(WAITING), JobRow.deleted_at.is_(None)
        )
        with self.database.read() as session:
            count, oldest = session.execute(waiting).one()
            running = session.scalars(select(JobRow.progress).where(JobRow.state == JobState.running))
            rate = sum(progress.get("steps_per_second") or 0.0 for progress in running)
            deliveries = session.scalar(select(func.count()).select_from(DeliveryRow)) or 0
            age = self.database.now(session) - oldest if count else 0.0
            return Load(int(count), age, rate, deliveries)

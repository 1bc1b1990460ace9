"""Counts of what has happened, kept in the rows: they are the whole fleet's, and no restart begins them anew."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sqlalchemy import func, select
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session

from advtex_contract.jobs import JobState
from advtex_store.database import Database
from advtex_store.ids import created_at
from advtex_store.models import KEPT, WAITS_IN_LINE, CounterRow, DeliveryRow, JobRow, WebhookRow

# In the order in which one transaction may count: all in the same, or two of them could wait for each other.
ATTEMPTS = "attempts"  # ended early, by how: lost, preempted
BYTES = "bytes"  # that workers moved, by direction and what: `down scan`; counts are of transfers
FAILURES = "failures"  # jobs that failed or were rejected, by the error's code
JOBS = "jobs"  # ended, by state
STAGE_BUCKETS = "stage_buckets"  # the same times, counted by stage and the bound that they stay below: `atlas 30`
STAGES = "stages"  # seconds, of jobs that ended
ACCURACY_BUCKETS = "accuracy_buckets"  # the same shares as below, by preset and bound: `standard 0.55`
ACCURACY = "accuracy"  # of patches that a discriminator told apart at the end of a job that succeeded, by preset

SCAN_DOWN, CHECKPOINT_DOWN, CHECKPOINT_UP, RESULT_UP = "down scan", "down checkpoint", "up checkpoint", "up result"
MOVES = (SCAN_DOWN, CHECKPOINT_DOWN, CHECKPOINT_UP, RESULT_UP)
STAGE_BOUNDS = (1, 3, 10, 30, 60, 180, 600, 1800, 3600, 10_800, 36_000)  # seconds
ACCURACY_BOUNDS = (0.45, 0.55, 0.6, 0.7, 0.8, 0.9, 0.95, 1.0)  # it guesses up to .55, and is certain above .95


@dataclass(frozen=True, slots=True)
class RunningJob:
    """An attempt at work, and its steps per second."""

    id: str
    attempt: int
    memory_gib: int
    steps_per_second: float


@dataclass(frozen=True, slots=True)
class Load:
    """What there is to do now: the age of the oldest job that waits in seconds, jobs that run, webhook deliveries that
    wait, and for how many seconds the most urgent of them has been due at a webhook that is not disabled."""

    oldest_seconds: float
    running: list[RunningJob]
    deliveries: int
    overdue_seconds: float

    @property
    def steps_per_second(self) -> float:
        """Of all together."""
        return sum(job.steps_per_second for job in self.running)


@dataclass(frozen=True, slots=True)
class Line:
    """Jobs of one owner that wait for a worker of one class (`memory_gib`), and the age of the oldest in seconds."""

    owner: str
    memory_gib: int
    jobs: int
    oldest_seconds: float


def count_one(session: Session, name: str, label: str, total: float = 0.0) -> None:
    """Count one more, inside the transaction in which it happens."""
    insert = sqlite.insert if session.get_bind().dialect.name == "sqlite" else postgresql.insert
    statement = insert(CounterRow).values(name=name, label=label[:255], count=1, total=total)
    session.execute(
        statement.on_conflict_do_update(
            index_elements=["name", "label"],
            set_={"count": CounterRow.count + 1, "total": CounterRow.total + total},
        )
    )


def count_end(
    session: Session, state: str, error: Mapping[str, Any] | None, stage_seconds: Mapping[str, float]
) -> None:
    """Count a job that has ended."""
    if error is not None:
        count_one(session, FAILURES, str(error["code"]))
    count_one(session, JOBS, state)
    for stage, seconds in sorted(stage_seconds.items()):
        if bound := next((bound for bound in STAGE_BOUNDS if seconds <= bound), None):
            count_one(session, STAGE_BUCKETS, f"{stage} {bound}")
    for stage, seconds in sorted(stage_seconds.items()):
        count_one(session, STAGES, stage, seconds)


def count_accuracy(session: Session, preset: str, accuracy: float) -> None:
    """Count what share of patches a discriminator told apart at the end of a job; preset: as it was asked for."""
    within = next((bound for bound in ACCURACY_BOUNDS if accuracy <= bound), None)
    if within is not None:
        count_one(session, ACCURACY_BUCKETS, f"{preset} {within}")
    count_one(session, ACCURACY, preset, accuracy)


class Counters:
    """The counts, for those who watch the service."""

    def __init__(self, database: Database) -> None:
        self.database = database

    def counts(self) -> list[CounterRow]:
        """All of them."""
        with self.database.read() as session:
            return list(session.scalars(select(CounterRow).order_by(CounterRow.name, CounterRow.label)))

    def pauses(self) -> list[str]:
        """Why running jobs pause, each reason once."""
        query = select(JobRow.waiting_reason).where(JobRow.state == JobState.running, KEPT, JobRow.waiting_reason != "")
        with self.database.read() as session:
            return sorted(set(session.scalars(query)))

    def lines(self) -> list[Line]:
        """Where jobs wait: from the index of those that do, whatever else there is."""
        query = select(JobRow.owner, JobRow.memory_gib, func.count(), func.min(JobRow.id)).where(WAITS_IN_LINE)
        with self.database.read() as session:
            now = self.database.now(session)
            found = session.execute(query.group_by(JobRow.owner, JobRow.memory_gib)).all()
        return [Line(owner, gib, jobs, now - created_at(oldest)) for owner, gib, jobs, oldest in found]

    def load(self) -> Load:
        """How much there is to do."""
        with self.database.read() as session:
            now = self.database.now(session)
            oldest = [
                session.scalar(
                    select(JobRow.created_at).where(JobRow.state == state, KEPT).order_by(JobRow.id).limit(1)
                )
                for state in (JobState.queued, JobState.preempted)
            ]
            columns = select(JobRow.id, JobRow.attempt, JobRow.memory_gib, JobRow.progress)
            running = [
                RunningJob(job_id, attempt, gib, progress.get("steps_per_second") or 0.0)
                for job_id, attempt, gib, progress in session.execute(
                    columns.where(JobRow.state == JobState.running, KEPT)
                )
            ]
            deliveries = session.scalar(select(func.count()).select_from(DeliveryRow)) or 0
            due = select(DeliveryRow.next_try_at).join(WebhookRow).where(WebhookRow.disabled_at.is_(None))
            first = session.scalar(due.order_by(DeliveryRow.next_try_at).limit(1))
        age = max((now - made for made in oldest if made is not None), default=0.0)
        return Load(age, running, deliveries, 0.0 if first is None else max(0.0, now - first))

"""The fleet at a glance, for those who run it: workers and what they do, who waits, what the last day brought."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence

from pydantic import BaseModel
from redis import RedisError

from advtex_contract.jobs import JobState
from advtex_store.fleet import GpuReading, LivingWorker
from advtex_store.models import JobRow
from advtex_store.overviews import HOUR, Failure
from advtex_store.store import Store

HOURS = 24
MOST_RUNNING = 1000
MOST_FAILURES = 500
NAMED_FAILURES = 5  # of each cause


class Work(BaseModel):
    """An attempt that runs."""

    job: str
    attempt: int
    owner: str
    label: str
    memory_gib: int
    stage: str
    step: int
    steps: int
    steps_per_second: float | None
    eta_seconds: float | None
    pauses: str


class WorkerView(BaseModel):
    """A living worker; `work` is None while it has none, or tells of none (it is of an older release)."""

    name: str
    host: str
    release: str
    memory_gib: int
    busy: bool
    gpu: GpuReading | None
    work: Work | None


class QueueView(BaseModel):
    """Jobs of one owner that wait, by the memory in GiB that they need."""

    owner: str
    jobs: int
    by_memory_gib: dict[int, int]
    oldest_seconds: float


class HourView(BaseModel):
    """Jobs that ended in an hour, by state; `begins` is in seconds since 1970."""

    begins: float
    states: dict[JobState, int]


class FailedJob(BaseModel):
    id: str
    owner: str
    label: str
    finished_at: float
    message: str


class CauseView(BaseModel):
    """Failures of the last day that have the same cause, the newest of them by name."""

    cause: str
    jobs: int
    newest: list[FailedJob]


class FleetView(BaseModel):
    """All of it. workers: None while Redis does not answer. elsewhere: what runs on workers that tell of no job.
    without_worker: jobs that wait and fit no living worker."""

    at: float
    states: dict[str, int]
    workers: list[WorkerView] | None
    elsewhere: list[Work]
    queue: list[QueueView]
    without_worker: int
    hours: list[HourView]
    failures: list[CauseView]


def look_at_fleet(store: Store) -> FleetView:
    """As it is now."""
    now = store.overviews.now()
    begin = now // HOUR * HOUR - (HOURS - 1) * HOUR
    rows = store.overviews.running(MOST_RUNNING)
    store.live_progress.show(rows)
    running = {(row.id, row.attempt): _work(row) for row in rows}
    lines = store.counters.lines()
    try:
        living: Sequence[LivingWorker] | None = store.fleet.workers()
    except RedisError:
        living = None
    workers = None if living is None else [_worker(found, running) for found in living]
    shown = {work.job for found in workers or () if (work := found.work) is not None}
    largest = max((found.memory_gib for found in living or ()), default=-1)
    queue = defaultdict[str, QueueView](lambda: QueueView(owner="", jobs=0, by_memory_gib={}, oldest_seconds=0.0))
    for line in lines:
        view = queue[line.owner]
        view.owner, view.jobs = line.owner, view.jobs + line.jobs
        view.by_memory_gib[line.memory_gib] = line.jobs
        view.oldest_seconds = max(view.oldest_seconds, line.oldest_seconds)
    return FleetView(
        at=now,
        states=store.records.count_by_state(),
        workers=workers,
        elsewhere=[work for work in running.values() if work.job not in shown],
        queue=sorted(queue.values(), key=lambda view: -view.jobs),
        without_worker=sum(line.jobs for line in lines if line.memory_gib > largest),
        hours=_hours(begin, store.overviews.ended_by_hour(begin)),
        failures=_causes(store.overviews.failures(begin, MOST_FAILURES)),
    )


def _worker(found: LivingWorker, running: dict[tuple[str, int], Work]) -> WorkerView:
    told = found.report
    return WorkerView(
        name=found.name,
        host=told.host or found.name.rpartition("-")[0],
        release=told.release,
        memory_gib=found.memory_gib,
        busy=found.busy,
        gpu=told.gpu,
        work=running.get((told.job, told.attempt)),
    )


def _work(row: JobRow) -> Work:
    progress = row.progress
    return Work(
        job=row.id,
        attempt=row.attempt,
        owner=row.owner,
        label=row.label,
        memory_gib=row.memory_gib,
        stage=progress.get("stage", ""),
        step=progress.get("step", 0),
        steps=progress.get("steps", 0),
        steps_per_second=progress.get("steps_per_second"),
        eta_seconds=progress.get("eta_seconds"),
        pauses=row.waiting_reason,
    )


def _hours(begin: float, ended: Iterable[tuple[int, str, int]]) -> list[HourView]:
    hours = [HourView(begins=begin + number * HOUR, states={}) for number in range(HOURS)]
    for hour, state, jobs in sorted(ended):  # states in the same order in every bar and at every look
        place = hour - int(begin // HOUR)
        if 0 <= place < HOURS:
            hours[place].states[JobState(state)] = jobs
    return hours


def _causes(failures: Iterable[Failure]) -> list[CauseView]:
    causes = dict[str, CauseView]()
    for failure in failures:
        cause = causes.setdefault(failure.cause, CauseView(cause=failure.cause, jobs=0, newest=[]))
        cause.jobs += 1
        if len(cause.newest) < NAMED_FAILURES:
            told = FailedJob(
                id=failure.id,
                owner=failure.owner,
                label=failure.label,
                finished_at=failure.finished_at,
                message=failure.message,
            )
            cause.newest.append(told)
    return sorted(causes.values(), key=lambda cause: -cause.jobs)

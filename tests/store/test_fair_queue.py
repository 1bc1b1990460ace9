"""Who is next: the same as the plain definition says that looks at all that waits."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Container, Sequence
from datetime import UTC, datetime
from typing import Any, NamedTuple

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sqlalchemy import delete, func, insert, select

from advtex_contract.jobs import JobState, Progress
from advtex_contract.options import JobOptions
from advtex_store import fair_queue
from advtex_store.fair_queue import AGING_SECONDS, Gaze, next_jobs
from advtex_store.ids import new_id
from advtex_store.memory_estimate import GIB
from advtex_store.models import BatchRow, JobRow
from advtex_store.records import EXPLAINED, WAITING

WEEK = 7 * 86400.0
STATES = (JobState.queued, JobState.queued, JobState.preempted, JobState.running, JobState.succeeded)


class Job(NamedTuple):
    """age, deadline: seconds before and after now."""

    owner: str
    state: JobState = JobState.queued
    priority: int = 0
    memory: int = GIB
    deleted: bool = False
    batch: str | None = None
    age: float = 0.0
    deadline: float | None = None


JOB = st.builds(
    Job,
    st.sampled_from("abc"),
    st.sampled_from(STATES),
    st.integers(-2, 2),
    st.sampled_from([0, 1, GIB - 1, GIB, GIB + 1, 3 * GIB, 20 * GIB]),
    st.booleans(),
    st.sampled_from([None, "x", "y", "z"]),
    st.sampled_from([0.0, 10.0, AGING_SECONDS, 2.5 * AGING_SECONDS, 2 * WEEK]),
    st.sampled_from([None, None, -60.0, 60.0, 3600.0]),
)
SAID = st.dictionaries(
    st.tuples(st.sampled_from("abc"), st.sampled_from("xy")),
    st.tuples(st.booleans(), st.sampled_from([None, 1, 2, 4])),
    max_size=4,
)


def plain_order(
    bench: Any, limit: int, memory_bytes: int | None, seen: Container[tuple[str, str | None, int]] | None = None
) -> list[str]:
    """The twin: for every place the next job of each owner is chosen among all of them; `seen`: of these lines."""
    with bench.database.read() as session:
        rows = session.scalars(select(JobRow).where(JobRow.deleted_at.is_(None))).all()
        said = {(row.owner, row.id): row for row in session.scalars(select(BatchRow))}
    now = bench.clock.now
    waits = [row for row in rows if row.state in WAITING]
    waits = [row for row in waits if memory_bytes is None or row.memory_bytes <= memory_bytes]
    waits = [row for row in waits if seen is None or (row.owner, row.batch, row.priority) in seen]
    running = [row for row in rows if row.state == JobState.running]
    owners = Counter(row.owner for row in running)
    batches = Counter((row.owner, row.batch) for row in running)
    flows = Counter((row.owner, row.batch, row.priority) for row in running)
    order: list[str] = []

    def may(row: JobRow) -> bool:
        about = said.get((row.owner, row.batch or ""))
        if about is None:
            return True
        return about.paused_at is None and (
            about.max_running is None or batches[row.owner, row.batch] < about.max_running
        )

    def due(row: JobRow) -> tuple[str, float, str]:
        return row.state, row.created_at + WEEK if row.deadline is None else row.deadline, row.id

    while len(order) < limit:
        heads: dict[Any, JobRow] = {}
        for row in filter(may, waits):
            flow = (row.owner, row.batch, row.priority)
            heads[flow] = min(heads.get(flow, row), row, key=due)
        nexts: dict[str, Any] = {}
        for flow, row in heads.items():
            aged = 0 if flows[flow] else int((now - row.created_at) // AGING_SECONDS)
            deadline = float("inf") if row.deadline is None else row.deadline
            urgency = (row.state, -(row.priority + aged), deadline, flows[flow], row.id)
            nexts[row.owner] = min(nexts.get(row.owner, (urgency, row)), (urgency, row), key=lambda pair: pair[0])
        if not nexts:
            break
        _, row = min(nexts.values(), key=lambda pair: (pair[1].state, owners[pair[1].owner], pair[1].id))
        order.append(row.id)
        waits.remove(row)
        owners[row.owner] += 1
        batches[row.owner, row.batch] += 1
        flows[row.owner, row.batch, row.priority] += 1
    return order


def fill(bench: Any, upload: str, jobs: Sequence[Job]) -> None:
    """These rows and no others."""
    with bench.database.write() as session:
        session.execute(delete(JobRow))
        session.execute(delete(BatchRow))
        rows = [
            {
                "id": new_id(bench.clock.now + number),
                "owner": job.owner,
                "batch": job.batch,
                "upload_id": upload,
                "state": job.state,
                "priority": job.priority,
                "memory_bytes": job.memory,
                "options": JobOptions().model_dump(mode="json"),
                "progress": Progress().model_dump(mode="json"),
                "warnings": [],
                "results": [],
                "created_at": bench.clock.now - job.age,
                "deadline": None if job.deadline is None else bench.clock.now + job.deadline,
                "updated_at": 0.0,
                "retention_seconds": 60,
                "deleted_at": 1.0 if job.deleted and job.state == JobState.succeeded else None,
            }
            for number, job in enumerate(jobs)
        ]
        for start in range(0, len(rows), 1000):
            session.execute(insert(JobRow), rows[start : start + 1000])


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    jobs=st.lists(JOB, max_size=60), said=SAID, limit=st.integers(0, 70), gib=st.sampled_from([None, 0, 1, 2, 3, 24])
)
def test_the_order_is_that_of_the_plain_definition(
    bench: Any, jobs: list[Job], said: dict[tuple[str, str], tuple[bool, int | None]], limit: int, gib: int | None
) -> None:
    upload = getattr(bench, "upload", None) or bench.finished_upload()
    bench.upload = upload
    fill(bench, upload, jobs)
    for (owner, batch), (paused, most) in said.items():
        bench.batches.limit(owner, batch, most)
        if paused and any((job.owner, job.batch) == (owner, batch) for job in jobs if not job.deleted):
            bench.batches.pause(owner, batch, True)
    memory = None if gib is None else gib * GIB
    expected = plain_order(bench, limit, memory)
    assert [job.id for job in bench.records.waiting(limit, memory)] == expected


def test_one_long_line_is_read_as_far_as_it_is_needed(bench: Any) -> None:
    """Nobody else waits: what is read of the line at first is not enough."""
    fill(bench, bench.finished_upload(), [Job("a")] * 500 + [Job("b", JobState.running)] * 300)
    expected = plain_order(bench, 400, None)
    assert [job.id for job in bench.records.waiting(400)] == expected


def test_what_may_begin_is_counted_by_the_memory_that_it_needs(bench: Any) -> None:
    """Of a batch of which one job runs at a time, one."""
    jobs = [Job("a")] * 3 + [Job("a", memory=3 * GIB)] * 2 + [Job("b", memory=3 * GIB, batch="x")] * 4
    fill(bench, bench.finished_upload(), jobs)
    bench.batches.limit("b", "x", 1)
    assert bench.records.ready(100) == {1: 3, 3: 3}
    assert sum(bench.records.ready(2).values()) == 2


def batches_in_order(bench: Any, limit: int) -> list[str | None]:
    return [bench.records.job(job.id).batch for job in bench.records.waiting(limit)]


def test_a_large_batch_does_not_hold_up_a_small_one(sqlite_bench: Any) -> None:
    """Of the same owner and priority, though it was there before; nor do jobs without a batch."""
    jobs = [Job("a", batch="large")] * 500 + [Job("a", batch="small")] * 3 + [Job("a")] * 2
    fill(sqlite_bench, sqlite_bench.finished_upload(), jobs)
    order = batches_in_order(sqlite_bench, 10)
    assert order == ["large", "small", None, "large", "small", None, "large", "small", "large", "large"]


def test_the_sooner_deadline_goes_first_at_equal_priority(sqlite_bench: Any) -> None:
    jobs = [
        Job("a", batch="any time"),
        Job("a", batch="tomorrow", deadline=86400.0),
        Job("a", batch="tonight", deadline=3600.0),
        Job("a", batch="late", deadline=-3600.0),
        Job("a", batch="urgent", priority=1),
    ]
    fill(sqlite_bench, sqlite_bench.finished_upload(), jobs)
    order = batches_in_order(sqlite_bench, 10)
    assert order == ["urgent", "late", "tonight", "tomorrow", "any time"]


@pytest.mark.parametrize("rival", [{"priority": 2}, {"priority": 2, "batch": "x"}, {"deadline": 60.0}])
def test_nothing_starves(sqlite_bench: Any, rival: dict[str, Any]) -> None:
    """Simulated: one worker, a job takes twenty minutes, and for each that ends two come that go before the one that
    waits: of a larger priority, or due sooner. None overtakes it that came so many hours later as it is steps below."""
    bench = sqlite_bench
    upload, begun = bench.finished_upload(), bench.clock.now
    patient = bench.job(upload_id=upload, batch="patient")
    steps, spec = rival.get("priority", 1), {name: value for name, value in rival.items() if name != "deadline"}
    for _ in range(20):
        for _ in range(2):
            if "deadline" in rival:
                spec["deadline"] = datetime.fromtimestamp(bench.clock.now + rival["deadline"], UTC)
            bench.job(upload_id=upload, **spec)
        (job,) = bench.records.waiting(1)
        if job.id == patient:
            break
        assert bench.records.job(job.id).created_at < begun + steps * AGING_SECONDS
        bench.records.claim(job.id, job.attempt, "w")
        bench.clock.now += 1200.0
        bench.records.succeed(job.id, job.attempt, [])
    assert job.id == patient, "it never began"


def test_while_others_run_a_job_gains_a_step_for_each_hour(sqlite_bench: Any) -> None:
    """It has one at a time of its kind then, and no more, however long the others behind it have waited."""
    low, high = Job("a", batch="low", age=2 * AGING_SECONDS), Job("a", batch="high", priority=2)
    before = low._replace(age=2 * AGING_SECONDS - 1.0)
    for job, order in ((before, ["high"] * 3 + ["low"] * 3), (low, ["low"] + ["high"] * 3 + ["low"] * 2)):
        running = high._replace(state=JobState.running)
        fill(sqlite_bench, sqlite_bench.finished_upload(), [running, *[high] * 3, *[job] * 3])
        assert batches_in_order(sqlite_bench, 10) == order


def test_no_deadlines_overtake_a_job_of_the_same_batch_for_ever(sqlite_bench: Any) -> None:
    """Something of the batch runs all the time, so that it gains no priority; but it is due after a week."""
    jobs = [Job("a", age=WEEK + 60.0), Job("a", deadline=0.0), Job("a", JobState.running)]
    fill(sqlite_bench, sqlite_bench.finished_upload(), jobs)
    (first, *_) = sqlite_bench.records.waiting(3)
    assert sqlite_bench.records.job(first.id).deadline is None


@pytest.mark.benchmark
def test_a_look_costs_what_it_finds_and_not_what_waits(bench: Any) -> None:
    def seconds(waiting: int) -> float:
        rows = [Job("abcde"[n % 5], priority=n % 3, memory=n % 7 * GIB, batch="xyz"[n % 2]) for n in range(waiting)]
        fill(bench, bench.finished_upload(), rows)
        took = []
        for _ in range(25):  # the least of many: other processes may be at work
            began = time.perf_counter()
            assert len(bench.records.waiting(20, 5 * GIB)) == 20
            bench.records.explain("")
            took.append(time.perf_counter() - began)
        return min(took)

    few, many = seconds(200), seconds(10_000)
    assert many < 4 * few, f"{1e3 * few:.1f} ms with 200 waiting jobs, {1e3 * many:.1f} ms with 10,000"


@pytest.mark.benchmark
def test_a_look_costs_no_more_with_thousands_of_batches(sqlite_bench: Any) -> None:
    """Of one job each: what is bounded, beside what would be without."""
    bench = sqlite_bench
    jobs = [Job("abcde"[n % 5], memory=n % 3 * GIB, batch=f"b{n}") for n in range(2000)]
    fill(bench, bench.finished_upload(), jobs)

    def seconds(gaze: Gaze | None) -> float:
        began = time.thread_time()  # the processor's: SQLite works in this thread
        with bench.database.read() as session:
            assert len(next_jobs(session, 20, bench.clock.now, 5, (), gaze)) == 20
        return time.thread_time() - began

    bounded, whole = map(min, zip(*((seconds(Gaze()), seconds(None)) for _ in range(15)), strict=True))
    assert bounded < 0.7 * whole, f"{1e3 * bounded:.1f} ms, {1e3 * whole:.1f} ms for all lines"


@pytest.fixture
def few_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fair_queue, "LINES", 3)
    monkeypatch.setattr(fair_queue, "OWNERS", 2)
    monkeypatch.setattr(fair_queue, "HEADS", 1)


def test_more_lines_than_a_look_sees_are_all_seen_in_time(bench: Any, few_lines: None) -> None:
    """Whoever is next in each look begins: the most urgent at once, and in the end all."""
    jobs = [Job("a", batch=f"b{n:02}") for n in range(30)] + [Job("b", batch="x")]
    fill(bench, bench.finished_upload(), [*jobs, Job("a", batch="zz", priority=9), Job("a", JobState.preempted)])
    began = list[str | None]()
    for _ in range(33):
        (job,) = bench.records.waiting(1)
        began.append(bench.records.job(job.id).batch)
        bench.records.claim(job.id, job.attempt, "w")
        bench.records.succeed(job.id, job.attempt, [])
    assert bench.records.waiting(1) == []
    assert set(began) == {job.batch for job in jobs} | {None, "zz"}
    assert began[:3] == [None, "x", "zz"], "what was preempted, the owner who has nothing else, the largest priority"


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(jobs=st.lists(JOB, max_size=40), gib=st.sampled_from([None, 1, 24]))
def test_among_those_that_a_look_sees_the_order_is_the_same(
    sqlite_bench: Any, few_lines: None, jobs: list[Job], gib: int | None
) -> None:
    upload = getattr(sqlite_bench, "upload", None) or sqlite_bench.finished_upload()
    sqlite_bench.upload = upload
    fill(sqlite_bench, upload, jobs)
    memory = None if gib is None else gib * GIB
    for _ in range(3):
        found = [job.id for job in sqlite_bench.records.waiting(100, memory)]
        rows = [sqlite_bench.records.job(job) for job in found]
        seen = {(row.owner, row.batch, row.priority) for row in rows}
        assert found == plain_order(sqlite_bench, 100, memory, seen)


def test_servers_that_tell_why_jobs_wait_at_once_tell_each_job_once(bench: Any) -> None:
    """And a great many of them in several goes, so that no transaction is long."""
    sizes = (0, 20 * GIB, 0, 30 * GIB)
    jobs = [Job("a", memory=sizes[n % 4]) for n in range(2 * EXPLAINED + 500)]
    fill(bench, bench.finished_upload(), jobs)

    def told() -> dict[str, int]:
        with bench.database.read() as session:
            query = select(JobRow.waiting_reason, JobRow.version, func.count()).group_by("waiting_reason", "version")
            return {f"{reason} {version}": count for reason, version, count in session.execute(query)}

    def tell(reason: str) -> None:
        bench.records.explain(reason, above=8 * GIB)

    def tell_at_once(reason: str) -> None:
        threads = [threading.Thread(target=tell, args=(reason,)) for _ in range(3)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()

    small, large = EXPLAINED + 250, EXPLAINED + 250
    tell("too large")
    assert told() == {" 1": small + 250, "too large 2": EXPLAINED}
    tell_at_once("too large")
    tell("too large")
    assert told() == {" 1": small, "too large 2": large}
    tell_at_once("")
    tell("")
    assert told() == {" 1": small, " 3": large}

"""Who is next: the same as the plain query says that looks at all that waits."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sqlalchemy import delete, func, insert, select
from sqlalchemy.orm import Session

from advtex_contract.jobs import JobState, Progress
from advtex_contract.options import JobOptions
from advtex_store.ids import new_id
from advtex_store.memory_estimate import GIB
from advtex_store.models import JobRow
from advtex_store.records import EXPLAINED, WAITING

STATES = (JobState.queued, JobState.queued, JobState.preempted, JobState.running, JobState.succeeded)
Job = tuple[str, JobState, int, int, bool]
JOB: st.SearchStrategy[Job] = st.tuples(
    st.sampled_from("abcd"),
    st.sampled_from(STATES),
    st.integers(-2, 2),
    st.sampled_from([0, 1, GIB - 1, GIB, GIB + 1, 3 * GIB, 20 * GIB]),
    st.booleans(),
)


def plain_order(session: Session, limit: int, memory_bytes: int | None) -> list[str]:
    """The twin: every waiting row gets its place by a window function."""
    waits = [JobRow.state.in_(WAITING), JobRow.deleted_at.is_(None)]
    if memory_bytes is not None:
        waits.append(JobRow.memory_bytes <= memory_bytes)
    running = select(JobRow.owner, func.count().label("jobs")).where(JobRow.state == JobState.running)
    held = running.group_by(JobRow.owner).subquery()
    place = func.row_number().over(
        partition_by=JobRow.owner, order_by=(JobRow.state != JobState.preempted, JobRow.priority.desc(), JobRow.id)
    )
    turn = (place + func.coalesce(held.c.jobs, 0)).label("turn")
    order = select(JobRow.id, turn).outerjoin(held, held.c.owner == JobRow.owner).where(*waits).subquery()
    query = select(JobRow.id).join(order, order.c.id == JobRow.id)
    return list(
        session.scalars(query.order_by(JobRow.state != JobState.preempted, order.c.turn, JobRow.id).limit(limit))
    )


def fill(bench: Any, upload: str, jobs: Sequence[Job]) -> None:
    """These rows and no others."""
    with bench.database.write() as session:
        session.execute(delete(JobRow))
        rows = [
            {
                "id": new_id(bench.clock.now + number),
                "owner": owner,
                "upload_id": upload,
                "state": state,
                "priority": priority,
                "memory_bytes": memory,
                "options": JobOptions().model_dump(mode="json"),
                "progress": Progress().model_dump(mode="json"),
                "warnings": [],
                "results": [],
                "created_at": 0.0,
                "updated_at": 0.0,
                "retention_seconds": 60,
                "deleted_at": 1.0 if deleted and state == JobState.succeeded else None,
            }
            for number, (owner, state, priority, memory, deleted) in enumerate(jobs)
        ]
        for start in range(0, len(rows), 1000):
            session.execute(insert(JobRow), rows[start : start + 1000])


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(jobs=st.lists(JOB, max_size=60), limit=st.integers(0, 70), gib=st.sampled_from([None, 0, 1, 2, 3, 24]))
def test_the_order_is_that_of_the_plain_query(bench: Any, jobs: list[Job], limit: int, gib: int | None) -> None:
    upload = getattr(bench, "upload", None) or bench.finished_upload()
    bench.upload = upload
    fill(bench, upload, jobs)
    memory = None if gib is None else gib * GIB
    with bench.database.read() as session:
        expected = plain_order(session, limit, memory)
    assert [job.id for job in bench.records.waiting(limit, memory)] == expected


def test_one_long_line_is_read_as_far_as_it_is_needed(bench: Any) -> None:
    """Nobody else waits: what is read of the line at first is not enough."""
    queued: Job = ("a", JobState.queued, 0, GIB, False)
    fill(bench, bench.finished_upload(), [queued] * 500 + [("b", JobState.running, 0, 0, False)] * 300)
    with bench.database.read() as session:
        expected = plain_order(session, 400, None)
    assert [job.id for job in bench.records.waiting(400)] == expected


@pytest.mark.benchmark
def test_a_look_costs_what_it_finds_and_not_what_waits(bench: Any) -> None:
    def seconds(waiting: int) -> float:
        rows: list[Job] = [("abcde"[n % 5], JobState.queued, n % 3, n % 7 * GIB, False) for n in range(waiting)]
        fill(bench, bench.finished_upload(), rows)
        took = []
        for _ in range(7):
            began = time.perf_counter()
            assert len(bench.records.waiting(20, 5 * GIB)) == 20
            bench.records.explain("")
            took.append(time.perf_counter() - began)
        return min(took)

    few, many = seconds(200), seconds(10_000)
    assert many < 4 * few, f"{1e3 * few:.1f} ms with 200 waiting jobs, {1e3 * many:.1f} ms with 10,000"


def test_servers_that_tell_why_jobs_wait_at_once_tell_each_job_once(bench: Any) -> None:
    """And a great many of them in several goes, so that no transaction is long."""
    sizes = (0, 20 * GIB, 0, 30 * GIB)
    jobs: list[Job] = [("a", JobState.queued, 0, sizes[n % 4], False) for n in range(2 * EXPLAINED + 500)]
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

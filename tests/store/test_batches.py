"""Batches: counts, pages, and the time that is left."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from advtex_contract.jobs import JobState, Progress
from advtex_store.batches import UNUSED_SECONDS, remaining_seconds
from advtex_store.errors import RecordNotFound

S = JobState


def test_counts_by_state(bench: Any) -> None:
    upload = bench.finished_upload()
    jobs = [bench.job(upload_id=upload, batch="night") for _ in range(4)]
    bench.job(upload_id=upload, batch="other")
    bench.job("somebody else", batch="night")
    bench.records.claim(jobs[0], 1, "w")
    bench.clock.now += 10
    bench.records.cancel(jobs[1])
    batch = bench.batches.batch(bench.owner, "night")
    assert batch.states == {S.running: 1, S.canceled: 1, S.queued: 2}
    assert (batch.updated_at - batch.created_at, batch.finished, batch.eta_seconds) == (10, False, None)
    for job in jobs:
        bench.records.cancel(job)
    bench.records.canceled(jobs[0], 1)
    batch = bench.batches.batch(bench.owner, "night")
    assert (batch.states, batch.finished, batch.eta_seconds) == ({S.canceled: 4}, True, 0.0)
    for job in jobs:
        bench.records.delete(job)
    with pytest.raises(RecordNotFound):
        bench.batches.batch(bench.owner, "night")


def test_pages_of_batches_newest_first(bench: Any) -> None:
    upload = bench.finished_upload()
    for number in range(14):
        bench.clock.now += 1
        bench.job(upload_id=upload, batch=f"b{number % 7}")
    bench.job(upload_id=upload)
    bench.job("somebody else", batch="theirs")
    seen, cursor = [], None
    while True:
        page, cursor = bench.batches.batches(bench.owner, cursor, 3)
        seen += [(batch.id, dict(batch.states)) for batch in page]
        if cursor is None:
            break
    assert seen == [(f"b{number}", {S.queued: 2}) for number in range(6, -1, -1)]


def test_the_jobs_of_a_batch_by_state(bench: Any) -> None:
    upload = bench.finished_upload()
    jobs = [bench.job(upload_id=upload, batch="night") for _ in range(3)]
    bench.job(upload_id=upload, batch="other")
    bench.records.cancel(jobs[1])
    assert bench.batches.jobs(bench.owner, "night", {S.queued}) == sorted([jobs[0], jobs[2]])
    assert bench.batches.jobs("somebody else", "night", {S.queued}) == []


def test_the_time_left_comes_from_the_rows(bench: Any) -> None:
    upload = bench.finished_upload()
    jobs = [bench.job(upload_id=upload, batch="night") for _ in range(5)]
    bench.records.claim(jobs[0], 1, "w")
    half = Progress(
        stage="optimization",
        step=50,
        steps=100,
        steps_per_second=10.0,
        eta_seconds=5.0,
        stage_seconds={"ingest": 1.0, "optimization": 5.0},
    )
    bench.records.heartbeat(jobs[0], 1, half)
    assert bench.batches.batch(bench.owner, "night").eta_seconds == 5.0 + 4 * (1.0 + 5.0 + 5.0)
    done = Progress(stage="export", stage_seconds={"ingest": 2.0, "optimization": 18.0})
    bench.records.heartbeat(jobs[0], 1, done)
    bench.records.succeed(jobs[0], 1, [])
    assert bench.batches.batch(bench.owner, "night").eta_seconds == 4 * 20.0


def test_what_was_said_of_a_batch_goes_with_its_last_job(bench: Any) -> None:
    job = bench.job(batch="night")
    bench.batches.pause(bench.owner, "night", True)
    bench.batches.limit(bench.owner, "later", 3)
    with pytest.raises(RecordNotFound):
        bench.batches.pause(bench.owner, "none", True)
    bench.clock.now += 2 * UNUSED_SECONDS
    bench.batches.limit(bench.owner, "night", 2)
    bench.batches.forget()
    batch = bench.batches.batch(bench.owner, "night")
    assert (batch.paused, batch.max_running) == (True, 2)
    bench.records.cancel(job)
    bench.records.delete(job)
    bench.clock.now += 2 * UNUSED_SECONDS
    bench.batches.forget()
    bench.job(batch="night")
    batch = bench.batches.batch(bench.owner, "night")
    assert (batch.paused, batch.max_running) == (False, None)
    bench.job(batch="later")
    assert bench.batches.batch(bench.owner, "later").max_running is None


QUICK, LONG = {"preset": "preview", "seed": 0}, {"preset": "full", "seed": 0}


def took(seconds: float) -> Progress:
    return Progress(stage_seconds={"optimization": seconds})


def test_each_kind_of_job_at_its_own_rate_shared_among_the_workers() -> None:
    ended = [(QUICK, took(10.0)), (QUICK | {"seed": 5}, took(20.0)), (LONG, took(1000.0))]
    assert remaining_seconds(ended, [], [QUICK, LONG]) == 15.0 + 1000.0
    running = [(LONG, Progress(eta_seconds=100.0)), (QUICK, Progress(eta_seconds=5.0))]
    assert remaining_seconds(ended, running, [QUICK, LONG]) == (100.0 + 5.0 + 15.0 + 1000.0) / 2
    assert remaining_seconds(ended, running, []) == 100.0, "not before the slowest one has ended"
    assert remaining_seconds(ended, [], [{"preset": "paper"}]) == (10.0 + 20.0 + 1000.0) / 3
    assert remaining_seconds([], running, [QUICK]) is None, "no rate of steps was measured"
    assert remaining_seconds(ended, [], []) == 0.0


seconds = st.floats(0.1, 1e5)
options = st.sampled_from([QUICK, LONG])


@given(
    st.lists(st.tuples(options, seconds.map(took)), min_size=1, max_size=5),
    st.lists(st.tuples(options, seconds.map(lambda s: Progress(eta_seconds=s))), max_size=5),
    st.lists(options, max_size=5),
)
def test_more_to_do_never_takes_less(ended: Any, running: Any, waiting: Any) -> None:
    left = remaining_seconds(ended, running, waiting)
    more = remaining_seconds(ended, running, [*waiting, QUICK])
    assert left is not None
    assert more is not None
    assert 0.0 <= left <= more

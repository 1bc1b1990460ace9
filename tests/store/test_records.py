"""Job rows on both databases: who may do what when."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sqlalchemy import update

from advtex_contract.errors import ErrorDetail
from advtex_contract.jobs import STATES, TERMINAL, JobError, JobState, Progress
from advtex_store.errors import IllegalTransition, NotUnderstood, RecordNotFound, StaleAttempt
from advtex_store.models import JobRow
from advtex_store.records import DECLINED, POISON_DEATHS

ERROR = JobError(code="engine", message="it broke")


def test_a_job_from_claim_to_success(bench: Any) -> None:
    job = bench.job(label="chair")
    claim = bench.records.claim(job, 1, "worker")
    assert (claim.attempt, claim.owner, claim.options.seed) == (1, bench.owner, 0)
    assert claim.lease.expires_at == bench.clock.now + 60
    bench.clock.now += 10
    lease = bench.records.heartbeat(job, 1, Progress(stage="ingest", step=1, steps=4), reached=1)
    assert lease.expires_at == bench.clock.now + 60
    assert not lease.cancel_requested
    warning = ErrorDetail(severity="warning", message="few frames")
    bench.records.succeed(job, 1, [{"name": "a", "size": 1}], [warning])
    row = bench.records.job(job)
    assert (row.state, row.attempt, row.results) == ("succeeded", 1, [{"name": "a", "size": 1}])
    assert row.warnings[0]["message"] == "few frames"
    assert (row.finished_at, row.expires_at) == (bench.clock.now, bench.clock.now + 1000)
    assert row.lease_expires_at is None


def test_only_one_of_many_gets_the_job(bench: Any) -> None:
    job = bench.job()
    barrier = threading.Barrier(6)
    won: list[int] = []

    def take(number: int) -> None:
        barrier.wait()
        try:
            bench.records.claim(job, 1, f"worker-{number}")
        except StaleAttempt:
            return
        won.append(number)

    threads = [threading.Thread(target=take, args=(n,)) for n in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(won) == 1
    assert bench.records.job(job).worker == f"worker-{won[0]}"


@pytest.mark.parametrize(
    "act",
    [
        lambda r, j: r.claim(j, 1, "w"),
        lambda r, j: r.lease(j, 1),
        lambda r, j: r.heartbeat(j, 1),
        lambda r, j: r.succeed(j, 1, []),
        lambda r, j: r.fail(j, 1, ERROR),
        lambda r, j: r.reject(j, 1, ERROR),
        lambda r, j: r.canceled(j, 1),
        lambda r, j: r.preempt(j, 1),
        lambda r, j: r.lost(j, 1),
    ],
    ids=["claim", "lease", "heartbeat", "succeed", "fail", "reject", "canceled", "preempt", "lost"],
)
def test_a_stale_attempt_can_do_nothing(bench: Any, act: Callable[[Any, str], object]) -> None:
    job = bench.job()
    bench.records.claim(job, 1, "w")
    bench.clock.now += 61
    assert bench.records.expired() == [(job, 1)]
    assert bench.records.lost(job, 1, expired_only=True) == JobState.queued
    with pytest.raises(StaleAttempt, match="queued at attempt 2"):
        act(bench.records, job)
    bench.records.claim(job, 2, "other")
    with pytest.raises(StaleAttempt, match="running at attempt 2"):
        act(bench.records, job)
    assert bench.state(job) == ("running", 2)


def test_a_waiting_attempt_cannot_be_ended_by_its_number(bench: Any) -> None:
    job = bench.job()
    with pytest.raises(StaleAttempt):
        bench.records.succeed(job, 1, [])
    with pytest.raises(StaleAttempt):
        bench.records.fail(job, 1, ERROR)


def test_a_heartbeat_in_time_keeps_the_job(bench: Any) -> None:
    job = bench.job()
    bench.records.claim(job, 1, "w")
    for _ in range(5):
        bench.clock.now += 59
        bench.records.heartbeat(job, 1)
    assert bench.records.expired() == []
    with pytest.raises(StaleAttempt, match="still holds"):
        bench.records.lost(job, 1, expired_only=True)
    assert bench.state(job) == ("running", 1)


def test_a_look_at_the_lease_does_not_renew_it(bench: Any) -> None:
    job = bench.job()
    claimed = bench.records.claim(job, 1, "w").lease
    bench.clock.now += 10
    assert bench.records.lease(job, 1) == claimed
    bench.records.cancel(job)
    assert bench.records.lease(job, 1).cancel_requested
    assert bench.records.job(job).lease_expires_at == claimed.expires_at


def test_preempted_goes_to_the_front_and_is_no_failure(bench: Any) -> None:
    first, second = bench.job(), bench.job()
    for attempt in range(1, 6):
        bench.records.claim(second, attempt, "w")
        assert bench.records.preempt(second, attempt) == JobState.preempted
    assert [(row.id, row.attempt) for row in bench.records.waiting(10)] == [(second, 6), (first, 1)]
    assert bench.records.job(second).deaths == 0


def test_three_deaths_without_progress_are_poison(bench: Any) -> None:
    job = bench.job()
    for attempt in range(1, POISON_DEATHS + 1):
        bench.records.claim(job, attempt, "w")
        bench.records.heartbeat(job, attempt, Progress(stage="atlas"), log_tail=f"line {attempt}")
        bench.records.lost(job, attempt)
    row = bench.records.job(job)
    assert (row.state, row.attempt, row.error["code"]) == ("failed", 3, "poison")
    assert row.error["log_tail"] == "line 3"
    assert "atlas" in row.error["message"]


def test_deaths_with_progress_are_no_poison(bench: Any) -> None:
    job = bench.job()
    for attempt in range(1, 8):
        bench.records.claim(job, attempt, "w")
        bench.records.heartbeat(job, attempt, reached=attempt)
        assert bench.records.lost(job, attempt) == JobState.queued


def test_dying_again_and_again_at_one_place_is_poison(bench: Any) -> None:
    job = bench.job()
    states = []
    for attempt in range(1, 5):
        bench.records.claim(job, attempt, "w")
        bench.records.heartbeat(job, attempt, reached=1210)
        states.append(bench.records.lost(job, attempt))
        if states[-1] == JobState.failed:
            break
    assert states == [JobState.queued, JobState.queued, JobState.failed]


def test_cancel_of_a_waiting_job_is_at_once(bench: Any) -> None:
    job = bench.job()
    assert bench.records.cancel(job).state == JobState.canceled
    assert bench.records.cancel(job).state == JobState.canceled
    assert bench.state(job) == ("canceled", 0)
    with pytest.raises(StaleAttempt):
        bench.records.claim(job, 1, "w")
    bench.records.retry(job)
    assert bench.state(job) == ("queued", 1)
    bench.records.claim(job, 1, "w")


@pytest.mark.parametrize("end", ["canceled", "preempt", "lost"])
def test_cancel_of_a_running_job_is_asked_for(bench: Any, end: str) -> None:
    job = bench.job()
    bench.records.claim(job, 1, "w")
    row = bench.records.cancel(job)
    assert (row.state, row.cancel_requested) == ("running", True)
    assert bench.records.heartbeat(job, 1).cancel_requested
    getattr(bench.records, end)(job, 1)
    assert bench.state(job) == ("canceled", 1)
    bench.records.retry(job)
    assert bench.state(job) == ("queued", 2)
    assert not bench.records.claim(job, 2, "w").lease.cancel_requested


def test_a_success_overtakes_a_cancel(bench: Any) -> None:
    job = bench.job()
    bench.records.claim(job, 1, "w")
    bench.records.cancel(job)
    bench.records.succeed(job, 1, [])
    assert bench.state(job) == ("succeeded", 1)
    with pytest.raises(IllegalTransition, match="succeeded"):
        bench.records.cancel(job)


def test_retry(bench: Any) -> None:
    job = bench.job()
    with pytest.raises(IllegalTransition, match="queued"):
        bench.records.retry(job)
    bench.records.claim(job, 1, "w")
    bench.records.fail(job, 1, ERROR)
    assert bench.records.job(job).error["message"] == "it broke"
    row = bench.records.retry(job)
    assert (row.state, row.attempt, row.error, row.finished_at, row.expires_at) == ("queued", 2, None, None, None)
    bench.records.claim(job, 2, "w")
    bench.records.reject(job, 2, ERROR)
    with pytest.raises(IllegalTransition, match="rejected"):
        bench.records.retry(job)


def test_delete(bench: Any) -> None:
    job = bench.job()
    with pytest.raises(IllegalTransition, match="cancel it"):
        bench.records.delete(job)
    bench.records.cancel(job)
    with pytest.raises(RecordNotFound):
        bench.records.delete(job, "somebody else")
    bench.records.delete(job)
    for act in (bench.records.job, bench.records.delete, bench.records.cancel, bench.records.retry):
        with pytest.raises(RecordNotFound):
            act(job)


def test_owners_do_not_see_each_other(bench: Any) -> None:
    job = bench.job()
    assert bench.records.job(job, bench.owner).id == job
    for act in (bench.records.job, bench.records.cancel, bench.records.retry):
        with pytest.raises(RecordNotFound):
            act(job, "somebody else")


def test_a_log_may_hold_any_character(bench: Any) -> None:
    job = bench.job()
    bench.records.claim(job, 1, "w")
    bench.records.heartbeat(job, 1, log_tail="x" * 9000 + "a\0b")
    assert bench.records.job(job).log_tail[-4:] == "xa\ufffdb"
    assert len(bench.records.job(job).log_tail) == 8000
    bench.records.lost(job, 1, log_tail="\0")
    assert bench.records.job(job).log_tail == "\ufffd"


def test_events_are_changes_of_state_and_stage(bench: Any) -> None:
    job = bench.job()
    bench.records.claim(job, 1, "w")
    for step in range(5):
        bench.records.heartbeat(job, 1, Progress(stage="optimization", step=step, steps=5))
    bench.records.heartbeat(job, 1, Progress(stage="export"))
    bench.records.succeed(job, 1, [])
    events = bench.records.events(job, 0)
    told = [event.data.get("state") or event.data["stage"] for event in events]
    assert told == ["checking", "queued", "running", "optimization", "export", "succeeded"]
    versions = [event.version for event in events]
    assert versions == sorted(set(versions))
    assert versions[-1] == bench.records.job(job).version
    assert [e.version for e in bench.records.events(job, versions[2])] == versions[3:]


def test_stages_between_two_heartbeats_are_recorded(bench: Any) -> None:
    job = bench.job()
    bench.records.claim(job, 1, "w")
    stages = [Progress(stage=name) for name in ("ingest", "atlas", "optimization")]
    bench.records.heartbeat(job, 1, Progress(stage="optimization", step=7), stages=stages)
    bench.records.heartbeat(job, 1, Progress(stage="optimization", step=8))
    told = [event.data["stage"] for event in bench.records.events(job, 0) if event.data["kind"] == "progress"]
    assert told == ["ingest", "atlas", "optimization"]
    assert bench.records.job(job).progress["step"] == 8


def test_a_heartbeat_that_says_nothing_new_is_no_change(bench: Any) -> None:
    job = bench.job()
    bench.records.claim(job, 1, "w")
    bench.records.heartbeat(job, 1, Progress(stage="atlas", step=1))
    version = bench.records.job(job).version
    bench.records.heartbeat(job, 1, Progress(stage="atlas", step=1))
    bench.records.heartbeat(job, 1)
    assert bench.records.job(job).version == version


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_history_is_legal(sqlite_bench: Any, data: st.DataObject) -> None:
    """Whatever is called in whatever order: states follow the table, attempts never fall back, ends are recorded."""
    bench = sqlite_bench
    records, job = bench.records, bench.job()
    attempt = st.integers(0, 4)
    calls: dict[str, Callable[[int], object]] = {
        "claim": lambda n: records.claim(job, n, "w"),
        "heartbeat": lambda n: records.heartbeat(job, n, Progress(step=n), reached=n),
        "succeed": lambda n: records.succeed(job, n, []),
        "adopt": lambda _: records.succeed(job, None, []),
        "fail": lambda n: records.fail(job, n, ERROR),
        "reject": lambda n: records.reject(job, n, ERROR),
        "canceled": lambda n: records.canceled(job, n),
        "preempt": lambda n: records.preempt(job, n),
        "lost": lambda n: records.lost(job, n),
        "cancel": lambda _: records.cancel(job),
        "retry": lambda _: records.retry(job),
    }
    before = records.job(job)
    for _ in range(data.draw(st.integers(1, 12))):
        name = data.draw(st.sampled_from(sorted(calls)))
        try:
            calls[name](data.draw(attempt))
        except (StaleAttempt, IllegalTransition):
            after = records.job(job)
            assert (after.state, after.version) == (before.state, before.version)
            continue
        after = records.job(job)
        if after.state != before.state:
            assert JobState(after.state) in STATES[JobState(before.state)].becomes
        assert after.version >= before.version
        assert after.attempt >= before.attempt - (before.state in ("queued", "preempted"))
        ended = JobState(after.state) in TERMINAL
        assert ended == (after.finished_at is not None) == (after.expires_at is not None)
        assert (after.state == "running") == (after.lease_expires_at is not None)
        before = after


@pytest.mark.parametrize(
    "unknown",
    [{"sharpen": 2}, {"preset": "ultra"}, {"method": "carving"}, {"layout": "hologram"}, {"seed": "one"}],
)
def test_a_job_of_another_release_is_left_to_it(bench: Any, unknown: dict[str, object]) -> None:
    job = bench.job()
    known = bench.records.job(job).options
    edit(bench, job, options=known | unknown)
    with pytest.raises(NotUnderstood) as told:
        bench.records.claim(job, 1, "old")
    (name,) = unknown
    assert name in str(told.value)
    assert bench.state(job) == ("queued", 1)
    bench.records.decline(job, 1, str(told.value))
    bench.records.explain("no worker")
    row = bench.records.job(job)
    assert (row.state, row.attempt, row.deaths) == ("queued", 1, 0)
    assert row.waiting_reason == (DECLINED + str(told.value))[:255]
    edit(bench, job, options=known)  # as a newer worker sees it
    assert bench.records.claim(job, 1, "new").attempt == 1
    assert bench.records.job(job).waiting_reason == ""


def test_what_runs_meanwhile_is_not_declined(bench: Any) -> None:
    job = bench.job()
    bench.records.claim(job, 1, "new")
    version = bench.records.job(job).version
    bench.records.decline(job, 1, "there is no option sharpen")
    row = bench.records.job(job)
    assert (row.state, row.waiting_reason, row.version) == ("running", "", version)


def test_a_retry_begins_without_the_reason_of_before(bench: Any) -> None:
    job = bench.job()
    bench.records.decline(job, 1, "there is no option sharpen")
    bench.records.cancel(job)
    assert bench.records.retry(job).waiting_reason == ""


def test_a_state_that_only_another_release_knows_is_left_to_it(bench: Any) -> None:
    job = bench.job()
    edit(bench, job, state="polishing")
    for change in (bench.records.cancel, bench.records.retry, bench.records.delete):
        with pytest.raises(IllegalTransition, match="polishing"):
            change(job)


def edit(bench: Any, job_id: str, **values: object) -> None:
    with bench.database.write() as session:
        session.execute(update(JobRow).where(JobRow.id == job_id).values(**values))

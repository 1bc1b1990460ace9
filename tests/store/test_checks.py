"""Jobs whose scan is being checked: one outcome each, whoever dies, is late or changes their mind."""

from __future__ import annotations

import threading
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from advtex_contract.errors import ErrorDetail
from advtex_contract.jobs import STATES, TERMINAL, JobError, JobSpec, JobState
from advtex_store.accounts import QuotaExceeded
from advtex_store.checks import DEATHS, DECLINED, DECLINED_SECONDS, CheckClaim
from advtex_store.errors import IllegalTransition, StaleAttempt
from advtex_store.models import JobRow

REJECTION = JobError(code="invalid_scan", message="no mesh")
LEASE = 60


def submitted(bench: Any, owner: str = "someone") -> str:
    return str(bench.submissions.create_job(owner, JobSpec(upload_id=bench.finished_upload(owner))).id)


def test_a_good_scan_waits_for_a_worker(bench: Any) -> None:
    job = submitted(bench)
    assert bench.state(job) == ("checking", 0)
    assert bench.records.waiting(10) == []
    claim = bench.checks.claim()
    assert (claim.job_id, claim.owner, claim.options.seed) == (job, bench.owner, 0)
    assert bench.checks.claim() is None
    bench.checks.passed(claim, [ErrorDetail(severity="warning", message="dark")], 5)
    row = bench.records.job(job)
    assert (row.state, row.attempt, row.memory_bytes, row.worker, row.lease_expires_at) == ("queued", 1, 5, None, None)
    assert [warning["message"] for warning in row.warnings] == ["dark"]
    assert [event.data["state"] for event in bench.records.events(job, 0)] == ["checking", "queued"]
    assert bench.records.claim(job, 1, "worker").attempt == 1


def test_a_bad_scan_ends_the_job(bench: Any) -> None:
    job = submitted(bench)
    bench.checks.rejected(bench.checks.claim(), REJECTION)
    row = bench.records.job(job)
    assert (row.state, row.attempt, row.error["message"]) == ("rejected", 0, "no mesh")
    assert (row.finished_at, row.expires_at) == (bench.clock.now, bench.clock.now + 1000)
    with pytest.raises(IllegalTransition):
        bench.records.retry(job)


def test_a_checker_that_says_nothing_more_loses_the_job(bench: Any) -> None:
    job = submitted(bench)
    first = bench.checks.claim()
    bench.clock.now += LEASE - 1
    bench.checks.renew(first)
    bench.clock.now += LEASE - 1
    assert bench.checks.claim() is None
    bench.clock.now += 2
    second = bench.checks.claim()
    assert second.job_id == job
    for call in (bench.checks.renew, bench.checks.release, lambda claim: bench.checks.passed(claim, [], 0)):
        with pytest.raises(StaleAttempt):
            call(first)
    bench.checks.rejected(second, REJECTION)
    with pytest.raises(StaleAttempt):
        bench.checks.rejected(second, REJECTION)


@pytest.mark.parametrize("with_server", [False, True])
def test_a_check_that_dies_again_and_again_ends_the_job(bench: Any, with_server: bool) -> None:
    job = submitted(bench)
    for _ in range(DEATHS):
        assert bench.state(job) == ("checking", 0)
        claim = bench.checks.claim()
        if with_server:
            bench.clock.now += LEASE + 1
        else:
            bench.checks.died(claim, "its process was killed")
    assert bench.checks.claim() is None
    row = bench.records.job(job)
    assert (row.state, row.error["code"], row.attempt) == ("failed", "check_died", 0)
    assert "killed" in row.error["message"]
    assert row.finished_at is not None


def test_a_retry_of_what_was_not_checked_checks_it(bench: Any) -> None:
    job = submitted(bench)
    for _ in range(DEATHS):
        bench.checks.died(bench.checks.claim(), "it was killed")
    assert bench.records.retry(job).state == "checking"
    bench.checks.died(bench.checks.claim(), "it was killed")
    assert bench.state(job) == ("checking", 0), "the deaths are counted anew"
    bench.checks.passed(bench.checks.claim(), [], 0)
    assert bench.state(job) == ("queued", 1)
    bench.records.cancel(job)
    assert (bench.state(job), bench.records.retry(job).state) == (("canceled", 0), "queued")


def test_a_job_of_an_older_server_keeps_its_attempts_apart(bench: Any) -> None:
    """It has no time of its check, but checkpoints of an attempt."""
    job = bench.job()
    with bench.database.write() as session:
        bench.records._get(session, job, None, lock=True).checked_at = None
    bench.records.claim(job, 1, "worker")
    bench.records.fail(job, 1, REJECTION)
    assert bench.records.retry(job).state == "checking"
    bench.checks.passed(bench.checks.claim(), [], 0)
    assert bench.state(job) == ("queued", 2)


def test_a_cancel_ends_a_check_at_once(bench: Any) -> None:
    job = submitted(bench)
    claim = bench.checks.claim()
    assert bench.records.cancel(job).state == "canceled"
    for call in (bench.checks.renew, lambda claim: bench.checks.passed(claim, [], 0)):
        with pytest.raises(StaleAttempt):
            call(claim)
    assert bench.state(job) == ("canceled", 0)
    assert bench.records.retry(job).state == "checking"


def test_a_scan_that_cannot_be_read_is_looked_at_again(bench: Any) -> None:
    job = submitted(bench)
    for _ in range(DEATHS + 1):
        bench.checks.postpone(bench.checks.claim(), "the bucket does not answer", 10)
        assert bench.records.job(job).waiting_reason == "the bucket does not answer"
        assert bench.checks.claim() is None
        bench.clock.now += 11
    bench.checks.passed(bench.checks.claim(), [], 0)
    assert (bench.state(job), bench.records.job(job).waiting_reason) == (("queued", 1), "")


def test_a_refusal_that_lasts_ends_the_job(bench: Any) -> None:
    job = submitted(bench)
    for _ in range(DEATHS):
        bench.checks.postpone(bench.checks.claim(), "no right", 10, JobError(code="storage_refused", message="no"))
        bench.clock.now += 11
    assert (bench.state(job), bench.records.job(job).error["code"]) == (("failed", 0), "storage_refused")


def test_a_checker_that_goes_leaves_the_job_to_others_at_once(bench: Any) -> None:
    job = submitted(bench)
    for _ in range(DEATHS + 1):
        bench.checks.release(bench.checks.claim())
    assert bench.checks.claim().job_id == job, "no death was counted"


def test_a_large_batch_keeps_nobody_waiting(bench: Any) -> None:
    for _ in range(20):
        submitted(bench)
    other = submitted(bench, "other")
    taken = [bench.checks.claim() for _ in range(21)]
    assert other in [claim.job_id for claim in taken[:12]], "by chance, one of two each time"
    mine = [claim.job_id for claim in taken if claim.owner == bench.owner]
    assert mine == sorted(mine), "the oldest first"


def test_jobs_that_are_checked_count_for_the_quota(bench: Any) -> None:
    spec = JobSpec(upload_id=bench.finished_upload())
    bench.submissions.create_job(bench.owner, spec, max_active_jobs=1)
    with pytest.raises(QuotaExceeded):
        bench.submissions.create_job(bench.owner, spec, max_active_jobs=1)


def test_of_many_checkers_each_job_has_one(bench: Any) -> None:
    jobs = {submitted(bench, f"owner {n % 3}") for n in range(12)}
    taken: list[str] = []
    barrier = threading.Barrier(6)

    def take() -> None:
        barrier.wait()
        while len(taken) < len(jobs):
            if (claim := bench.checks.claim()) is not None:
                taken.append(claim.job_id)

    threads = [threading.Thread(target=take) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(taken) == sorted(jobs)


CALLS = ("claim", "renew", "passed", "rejected", "died", "postpone", "release", "cancel", "retry", "time")


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.tuples(st.sampled_from(CALLS), st.integers(0, 3)), max_size=25))
def test_every_order_of_events_has_one_outcome(sqlite_bench: Any, order: list[tuple[str, int]]) -> None:
    """Also with checkers that are late: they keep their claims and tell them whenever they like."""
    bench = sqlite_bench
    job = submitted(bench)
    claims: list[CheckClaim] = []

    def told(number: int) -> CheckClaim:
        return claims[number % len(claims)]

    for name, number in order:
        before = bench.records.job(job)
        try:
            match name:
                case "claim":
                    if (claim := bench.checks.claim()) is not None:
                        claims.append(claim)
                case "time":
                    bench.clock.now += LEASE * number
                case "cancel" | "retry":
                    getattr(bench.records, name)(job)
                case _ if not claims:
                    continue
                case "passed":
                    bench.checks.passed(told(number), [], 0)
                case "rejected":
                    bench.checks.rejected(told(number), REJECTION)
                case "died":
                    bench.checks.died(told(number), "it was killed")
                case "postpone":
                    bench.checks.postpone(told(number), "away", 10)
                case _:
                    getattr(bench.checks, name)(told(number))
        except (StaleAttempt, IllegalTransition):
            assert bench.records.job(job).version == before.version
        after = bench.records.job(job)
        if after.state != before.state:
            assert JobState(after.state) in STATES[JobState(before.state)].becomes
        assert (after.state in TERMINAL) == (after.finished_at is not None)
        assert after.attempt == (after.state == "queued") or after.state == "canceled"
    for claim in iter(bench.checks.claim, None):  # no other job of this database is left to be checked
        bench.checks.rejected(claim, REJECTION)
    if bench.records.job(job).state == "checking":
        bench.clock.now += 10 * LEASE
        while (claim := bench.checks.claim()) is not None:
            bench.checks.rejected(claim, REJECTION)
    assert bench.records.job(job).state != "checking"


@pytest.mark.parametrize("unknown", [{"sharpen": 2}, {"preset": "ultra"}, {"layout": "hologram"}])
def test_a_job_of_another_release_is_left_to_a_server_of_it(bench: Any, unknown: dict[str, object]) -> None:
    job, other = submitted(bench), submitted(bench, "other")
    known = bench.records.job(job).options
    edit(bench, job, known | unknown)
    claims = [bench.checks.claim() for _ in range(3)]
    assert [claim.job_id for claim in claims if claim is not None] == [other]
    row = bench.records.job(job)
    assert (row.state, row.worker, row.deaths) == ("checking", None, 0)
    assert row.waiting_reason.startswith(DECLINED)
    assert next(iter(unknown)) in row.waiting_reason
    edit(bench, job, known)  # as a newer server sees it
    bench.clock.now += DECLINED_SECONDS + 1
    assert bench.checks.claim().job_id == job


def edit(bench: Any, job: str, options: dict[str, Any]) -> None:
    with bench.database.write() as session:
        session.get(JobRow, job).options = options

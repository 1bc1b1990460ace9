"""New jobs, lists, idempotency keys."""

from __future__ import annotations

import threading
from typing import Any

import pytest

from advtex_contract.jobs import JobSpec, JobState
from advtex_contract.options import JobOptions
from advtex_contract.stored_options import read_options
from advtex_store.errors import IdempotencyInFlight, IdempotencyMismatch, RecordNotFound
from advtex_store.models import IdempotencyRow, JobRow
from advtex_store.submissions import HOLD_SECONDS, JobFilter, Reservation

SPEC, OTHER = JobSpec(upload_id="scan"), JobSpec(upload_id="scan", options=JobOptions(seed=7))


def test_a_job_needs_a_finished_upload_of_its_owner(bench: Any) -> None:
    unfinished = bench.uploads.create(bench.owner, 3).id
    foreign = bench.finished_upload("somebody else")
    for upload_id in (unfinished, foreign, "none"):
        with pytest.raises(RecordNotFound):
            bench.submissions.create_job(bench.owner, JobSpec(upload_id=upload_id))


def test_a_job_renews_its_upload(bench: Any) -> None:
    upload = bench.finished_upload()
    bench.clock.now += 900
    bench.submissions.create_job(bench.owner, JobSpec(upload_id=upload))
    assert bench.uploads.upload(upload).expires_at == bench.clock.now + 1000


def test_a_row_holds_the_options_that_were_given(bench: Any) -> None:
    """Of the others an older worker may not know the names."""
    given = JobOptions(steps=30, seed=0)
    row = bench.submissions.create_job(bench.owner, JobSpec(upload_id=bench.finished_upload(), options=given))
    assert {name: row.options[name] for name in ("steps", "seed")} == {"steps": 30, "seed": 0}
    assert None not in row.options.values()
    assert read_options(row.options) == given


def test_pages_show_every_job_once_newest_first(bench: Any) -> None:
    upload = bench.finished_upload()
    made = []
    for number in range(7):
        bench.clock.now += 1
        made.append(
            bench.job(upload_id=upload, label="odd" if number % 2 else "even", batch="b" if number < 2 else None)
        )
    bench.job("somebody else")
    bench.records.cancel(made[3])
    seen: list[str] = []
    cursor = None
    while True:
        rows, cursor = bench.submissions.list_jobs(bench.owner, cursor=cursor, limit=3)
        seen += [row.id for row in rows]
        if cursor is None:
            break
    assert seen == made[::-1]

    def listed(**filters: object) -> list[str]:
        return [row.id for row in bench.submissions.list_jobs(bench.owner, JobFilter(**filters))[0]]

    assert listed(state=JobState.canceled) == [made[3]]
    assert listed(label="odd") == made[5::-2]
    assert listed(label="odd", state=JobState.queued) == [made[5], made[1]]
    assert listed(batch="b") == [made[1], made[0]]
    assert listed(batch="b", label="odd") == [made[1]]
    assert listed(batch="c") == []
    bench.records.delete(made[3])
    assert made[3] not in listed()


def test_an_idempotency_key_makes_one_job(bench: Any) -> None:
    spec = JobSpec(upload_id=bench.finished_upload())
    held = bench.submissions.reserve(bench.owner, "key", SPEC)
    with pytest.raises(IdempotencyInFlight):
        bench.submissions.reserve(bench.owner, "key", SPEC)
    with pytest.raises(IdempotencyMismatch):
        bench.submissions.reserve(bench.owner, "key", OTHER)
    assert isinstance(bench.submissions.reserve("somebody else", "key", OTHER), Reservation)
    job = bench.submissions.create_job(bench.owner, spec, reservation=held)
    assert bench.submissions.reserve(bench.owner, "key", SPEC).id == job.id
    with pytest.raises(IdempotencyMismatch):
        bench.submissions.reserve(bench.owner, "key", OTHER)
    bench.submissions.release(held)  # too late: the key stays bound
    assert bench.submissions.reserve(bench.owner, "key", SPEC).id == job.id


@pytest.mark.parametrize(
    "other", [{"label": "b"}, {"upload_id": "b"}, {"options": JobOptions(seed=7)}, {"priority": 1}]
)
def test_a_key_of_the_release_before_is_known_by_its_job(bench: Any, other: dict[str, Any]) -> None:
    """It wrote the same body in other words, and the options that were not given as null."""
    spec = JobSpec(upload_id=bench.finished_upload(), label="a", options=JobOptions(steps=30))
    held = bench.submissions.reserve(bench.owner, "key", spec)
    job = bench.submissions.create_job(bench.owner, spec, reservation=held)
    with bench.database.write() as session:
        session.get_one(IdempotencyRow, (bench.owner, "key")).body_sha256 = "of other words"
        session.get_one(JobRow, job.id).options = {**job.options, "width": None, "holdout": None}
    assert bench.submissions.reserve(bench.owner, "key", spec).id == job.id
    with pytest.raises(IdempotencyMismatch):
        bench.submissions.reserve(bench.owner, "key", spec.model_copy(update=other))


def test_a_released_key_is_free(bench: Any) -> None:
    bench.submissions.release(bench.submissions.reserve(bench.owner, "key", SPEC))
    assert isinstance(bench.submissions.reserve(bench.owner, "key", OTHER), Reservation)


def test_a_dead_request_gives_its_key_away_and_makes_no_second_job(bench: Any) -> None:
    spec = JobSpec(upload_id=bench.finished_upload())
    slow = bench.submissions.reserve(bench.owner, "key", SPEC)
    bench.clock.now += HOLD_SECONDS + 1
    fast = bench.submissions.reserve(bench.owner, "key", SPEC)
    assert isinstance(fast, Reservation)
    with pytest.raises(IdempotencyInFlight):
        bench.submissions.create_job(bench.owner, spec, reservation=slow)
    job = bench.submissions.create_job(bench.owner, spec, reservation=fast)
    assert [row.id for row in bench.submissions.list_jobs(bench.owner)[0]] == [job.id]


def test_many_requests_at_once_make_one_job(bench: Any) -> None:
    spec = JobSpec(upload_id=bench.finished_upload())
    barrier = threading.Barrier(8)
    answers: list[str] = []

    def submit() -> None:
        barrier.wait()
        try:
            held = bench.submissions.reserve(bench.owner, "key", SPEC)
        except IdempotencyInFlight:
            answers.append("in flight")
            return
        if isinstance(held, Reservation):
            held = bench.submissions.create_job(bench.owner, spec, reservation=held)
        answers.append(held.id)

    threads = [threading.Thread(target=submit) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    (job,) = bench.submissions.list_jobs(bench.owner)[0]
    assert len(answers) == 8
    assert set(answers) <= {job.id, "in flight"}
    assert job.id in answers

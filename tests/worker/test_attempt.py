"""One attempt, carried in this process with a real runner process and named engines."""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from collections.abc import Callable
from typing import Any

import fake_engines
import pytest
from attempts import in_background, result, step_of
from live_service import wait_until
from redis import Redis
from structlog.testing import capture_logs

from advtex_contract.jobs import JobState
from advtex_store import keys
from advtex_store.counters import BYTES, CHECKPOINT_DOWN, RESULT_UP, SCAN_DOWN
from advtex_store.errors import BlobsRefused, BlobsUnavailable, NoSpace, ReferenceUnreadable
from advtex_store.models import JobRow
from advtex_store.queue import JobQueue
from advtex_store.results import Results
from advtex_store.store import Store
from advtex_worker.attempt import Attempt
from advtex_worker.settings import WorkerSettings
from advtex_worker.tasks import Host, run_attempt

Hosts = Callable[[str], Host]
NewJob = Callable[..., str]


def test_a_job_succeeds_with_results_warnings_and_progress(
    store: Store, host: Hosts, new_job: NewJob, settings: WorkerSettings
) -> None:
    job_id = new_job(seed=7, width=320, height=240)
    run_attempt(host("quick"), job_id, 1)
    row = store.records.job(job_id)
    assert row.state == JobState.succeeded
    assert sorted(file["name"] for file in row.results) == sorted(fake_engines.RESULTS)
    assert result(store, job_id) == "model.obj\nseed 7 size (320, 240)\n"
    assert [warning["where"] for warning in row.warnings] == ["color/9.png"]
    assert row.progress["step"] == row.progress["steps"] == 3
    assert row.progress["losses"] == {"l1": pytest.approx(1 / 3)}
    assert row.progress["stage_seconds"] == {"ingest": 0.01, "optimization": 0.02}
    assert list(settings.workspaces.iterdir()) == []


def test_a_job_that_is_done_loses_no_lease(
    store: Store, host: Hosts, new_job: NewJob, monkeypatch: pytest.MonkeyPatch
) -> None:
    delete, succeed = type(store.blobs).delete_prefix, type(store.records).succeed

    def delete_slowly(*arguments: Any) -> Any:
        time.sleep(0.2)  # some heartbeats
        return delete(*arguments)

    def succeed_slowly(*arguments: Any) -> Any:
        done = succeed(*arguments)
        time.sleep(0.2)
        return done

    monkeypatch.setattr(type(store.blobs), "delete_prefix", delete_slowly)
    monkeypatch.setattr(type(store.records), "succeed", succeed_slowly)
    job_id = new_job(steps=3)
    with capture_logs() as lines:
        run_attempt(host("stepping"), job_id, 1)
    assert store.records.job(job_id).state == JobState.succeeded
    assert [line for line in lines if line["log_level"] != "info"] == []


def test_an_attempt_that_is_not_waited_for_does_nothing(store: Store, host: Hosts, new_job: NewJob) -> None:
    job_id = new_job()
    run_attempt(host("raises"), job_id, 2)
    run_attempt(host("raises"), "0" * 28, 1)
    assert store.records.job(job_id).state == JobState.queued


def test_a_finished_attempt_is_adopted_instead_of_repeated(store: Store, host: Hosts, new_job: NewJob) -> None:
    job_id = new_job()
    run_attempt(host("quick"), job_id, 1)
    manifest = store.blobs.get(keys.result_manifest_key(job_id))
    _edit(store, job_id, state="queued", attempt=2, results=[])
    run_attempt(host("raises"), job_id, 2)
    assert store.records.job(job_id).state == JobState.succeeded
    assert store.blobs.get(keys.result_manifest_key(job_id)) == manifest


@pytest.mark.one_machine("how engines end, wherever rows and blobs are")
@pytest.mark.parametrize(
    ("engine", "code", "words"),
    [
        ("raises", "engine_error", "ValueError: the widget is not a gadget"),
        ("refuses", "invalid_options", "holdout 500 leaves no frame"),
        ("out_of_memory", "out_of_memory", "max-texture-size"),
        ("no_such_engine", "engine_error", "no_such_engine"),
    ],
)
def test_an_error_that_would_come_again_fails_the_job(
    store: Store, host: Hosts, new_job: NewJob, engine: str, code: str, words: str
) -> None:
    job_id = new_job()
    run_attempt(host(engine), job_id, 1)
    row = store.records.job(job_id)
    assert row.state == JobState.failed
    assert row.error is not None
    assert row.error["code"] == code
    assert words in row.error["message"]
    assert ("Traceback" in row.error["log_tail"]) == (code != "invalid_options")


@pytest.mark.one_machine("how engines end, wherever rows and blobs are")
def test_a_full_disk_pauses_the_attempt_and_costs_nothing(store: Store, host: Hosts, new_job: NewJob) -> None:
    job_id = new_job()
    thread = in_background(host("finds_the_disk_full"), job_id)
    wait_until(lambda: "disk" in store.records.job(job_id).waiting_reason)
    thread.join()
    row = store.records.job(job_id)
    assert (row.state, row.attempt, row.waiting_reason) == (JobState.succeeded, 1, "")


def test_a_bad_scan_is_rejected_with_every_problem(store: Store, host: Hosts, new_job: NewJob) -> None:
    job_id = new_job()
    run_attempt(host("rejects"), job_id, 1)
    row = store.records.job(job_id)
    assert row.state == JobState.rejected
    assert row.error is not None
    assert [detail["where"] for detail in row.error["details"]] == ["color/", "color/1.png"]
    assert all(detail["remedy"] for detail in row.error["details"])


def test_a_scan_that_is_gone_fails_the_job(store: Store, host: Hosts, new_job: NewJob) -> None:
    job_id = new_job()
    store.blobs.delete(keys.scan_key(store.records.job(job_id).upload_id))
    run_attempt(host("quick"), job_id, 1)
    error = store.records.job(job_id).error
    assert error is not None
    assert error["code"] == "scan_missing"


def test_a_scan_that_the_storage_has_changed_fails_the_job_and_is_sent_anew(
    store: Store, host: Hosts, new_job: NewJob
) -> None:
    job_id = new_job()
    upload_id = store.records.job(job_id).upload_id
    sha256 = store.uploads.digest(upload_id)
    assert sha256 is not None
    assert [row.id for row in store.uploads.find("owner", sha256)] == [upload_id]
    store.blobs.put(keys.scan_key(upload_id), b"a scam")
    run_attempt(host("quick"), job_id, 1)
    row = store.records.job(job_id)
    assert row.state == JobState.failed
    assert row.error is not None
    assert row.error["code"] == "scan_damaged"
    assert store.uploads.find("owner", sha256) == [], "who sends the scan again is not told that it is there"
    assert store.blobs.get(keys.scan_key(upload_id)) == b"a scam"


def test_a_scan_that_was_damaged_on_its_way_is_fetched_again(
    store: Store, host: Hosts, new_job: NewJob, monkeypatch: pytest.MonkeyPatch
) -> None:
    stream, told = type(store.blobs).stream, list[str]()

    def damaged_once(self: Any, key: str, *arguments: Any) -> Any:
        if key.startswith("scans/"):
            told.append(key)
            if len(told) == 1:
                return iter([b"a longer ", b"scan"])
        return stream(self, key, *arguments)

    monkeypatch.setattr(type(store.blobs), "stream", damaged_once)
    job_id = new_job()
    run_attempt(host("quick"), job_id, 1)
    assert store.records.job(job_id).state == JobState.succeeded
    assert len(told) == 2


@pytest.mark.one_machine("how engines end, wherever rows and blobs are")
@pytest.mark.parametrize(
    ("engine", "sentence"),
    [
        ("crashes", "crashed in native code: SIGSEGV"),
        ("is_killed", "was killed (out of memory?): SIGKILL"),
        ("exits", "ended without a result (exit code 7)"),
    ],
)
def test_three_deaths_without_progress_are_poison(
    store: Store, host: Hosts, new_job: NewJob, engine: str, sentence: str
) -> None:
    job_id = new_job()
    for attempt in (1, 2, 3):
        row = store.records.job(job_id)
        assert (row.state, row.attempt) == (JobState.queued, attempt)
        run_attempt(host(engine), job_id, attempt)
    row = store.records.job(job_id)
    assert row.state == JobState.failed
    assert row.error is not None
    assert row.error["code"] == "poison"
    assert sentence in row.error["log_tail"]
    assert ("about to read address 0" in row.error["log_tail"]) == (engine == "crashes")


def test_the_attempt_after_a_death_goes_on_from_the_checkpoint(store: Store, host: Hosts, new_job: NewJob) -> None:
    job_id = new_job()
    run_attempt(host("crashes_once"), job_id, 1)
    assert store.records.job(job_id).state == JobState.queued
    run_attempt(host("crashes_once"), job_id, 2)
    assert store.records.job(job_id).state == JobState.succeeded
    assert result(store, job_id) == "model.obj\nfirst attempt\n"
    assert [warning["code"] for warning in store.records.job(job_id).warnings] == ["few_views"]


def test_sigterm_preempts_without_counting_as_a_death(store: Store, host: Hosts, new_job: NewJob) -> None:
    job_id = new_job(steps=100)
    for attempt in (1, 2, 3, 4):
        given = host("stepping")
        thread = in_background(given, job_id, attempt)
        wait_until(lambda: store.records.job(job_id).state == JobState.running)
        given.stop_signal._on_signal(signal.SIGTERM, None)
        thread.join()
        row = store.records.job(job_id)
        assert (row.state, row.attempt, row.deaths) == (JobState.preempted, attempt + 1, 0)
    run_attempt(host("stepping"), job_id, 5)
    state = json.loads(result(store, job_id).split("\n", 1)[1])
    assert state["chain"] == fake_engines.chain(100)
    assert state["began"] == sorted(state["began"])


@pytest.mark.one_machine("forks this process, in which the client of S3 has threads")
def test_a_sigterm_to_the_runner_alone_is_a_preemption_too(store: Store, host: Hosts, new_job: NewJob) -> None:
    job_id = new_job(steps=1000)
    parent = os.fork()
    if parent == 0:
        run_attempt(host("stepping"), job_id, 1)
        os._exit(0)
    wait_until(lambda: step_of(store, job_id) >= 5)
    (runner,) = _children(parent)
    os.kill(runner, signal.SIGTERM)
    os.waitpid(parent, 0)
    row = store.records.job(job_id)
    assert (row.state, row.attempt, row.deaths) == (JobState.preempted, 2, 0)


def test_a_storage_that_fails_for_a_while_delays_the_results(
    store: Store, host: Hosts, new_job: NewJob, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("advtex_worker.patience.RETRY_SECONDS", 0.0)
    commit, troubles = Results.commit, iter([NoSpace("the disk is full"), BlobsUnavailable("no answer")])

    def flaky(*arguments: Any, **named: Any) -> Any:
        for trouble in troubles:
            raise trouble
        return commit(*arguments, **named)

    monkeypatch.setattr(Results, "commit", flaky)
    job_id = new_job()
    run_attempt(host("quick"), job_id, 1)
    row = store.records.job(job_id)
    assert (row.state, row.attempt) == (JobState.succeeded, 1)


REFUSALS = [
    PermissionError(13, "Permission denied", "/mnt/scans"),
    FileNotFoundError(2, "No such file or directory", "/mnt/scans"),
    BlobsRefused("there is no bucket 'scans', or the keys do not open it"),
    ReferenceUnreadable("file:///mnt/scans cannot be read by the service (Permission denied): let its user read it"),
]


@pytest.mark.parametrize("refusal", REFUSALS, ids=lambda error: type(error).__name__)
def test_a_refusal_that_stays_ends_the_job_with_its_reason_after_a_while(
    store: Store, settings: WorkerSettings, new_job: NewJob, monkeypatch: pytest.MonkeyPatch, refusal: Exception
) -> None:
    monkeypatch.setattr("advtex_worker.patience.RETRY_SECONDS", 0.5)

    tried, seen = list[float](), threading.Event()

    def refused(*_: Any) -> None:
        if tried:
            seen.wait(60)
        tried.append(time.monotonic())
        raise refusal

    monkeypatch.setattr("advtex_worker.attempt.Attempt._fetch_scan", refused)
    job_id = new_job()
    given = Host(settings.model_copy(update={"refused_seconds": 0.1}), engine="fake_engines:quick")
    thread = in_background(given, job_id)
    wait_until(lambda: "cannot use the storage" in store.records.job(job_id).waiting_reason)
    row = store.records.job(job_id)
    assert row.state == JobState.running
    assert str(refusal)[:40] in row.waiting_reason
    seen.set()
    thread.join()
    assert len(tried) == 2
    row = store.records.job(job_id)
    assert (row.state, row.attempt) == (JobState.failed, 1)
    assert row.error is not None
    assert row.error["code"] == "storage_refused"
    assert str(refusal) in row.error["message"]
    assert list(settings.workspaces.iterdir()) == []


@pytest.mark.parametrize(
    "trouble", [BlobsUnavailable("no answer " * 50), NoSpace("the disk is full"), PermissionError(13, "denied")]
)
def test_an_outage_and_a_refusal_that_is_mended_cost_nothing(
    store: Store, settings: WorkerSettings, new_job: NewJob, monkeypatch: pytest.MonkeyPatch, trouble: Exception
) -> None:
    """Outages may last longer than refusals."""
    monkeypatch.setattr("advtex_worker.patience.RETRY_SECONDS", 0.5)
    fetch, tried, told = Attempt._fetch_scan, list[float](), threading.Event()

    def troubled(self: Attempt) -> None:
        tried.append(time.monotonic())
        if not told.is_set() or tried[-1] - tried[0] < 1:
            raise trouble
        fetch(self)

    monkeypatch.setattr(Attempt, "_fetch_scan", troubled)
    job_id, patience = new_job(), 60.0 if isinstance(trouble, PermissionError) else 0.5
    given = Host(settings.model_copy(update={"refused_seconds": patience}), engine="fake_engines:quick")
    thread = in_background(given, job_id)
    wait_until(lambda: store.records.job(job_id).waiting_reason != "")
    told.set()
    thread.join()
    row = store.records.job(job_id)
    assert (row.state, row.attempt, row.waiting_reason) == (JobState.succeeded, 1, "")


def bytes_moved(store: Store) -> dict[str, int]:
    return {row.label: int(row.total) for row in store.counters.counts() if row.name == BYTES}


@pytest.mark.one_machine("rows count it, wherever blobs are")
def test_bytes_that_an_attempt_moves_are_counted(store: Store, host: Hosts, new_job: NewJob) -> None:
    job_id = new_job()
    run_attempt(host("quick"), job_id, 1)
    row = store.records.job(job_id)
    moved = bytes_moved(store)
    assert moved[SCAN_DOWN] == store.blobs.head(keys.scan_key(row.upload_id)).size
    assert moved[RESULT_UP] == sum(result["size"] for result in row.results) > 0
    assert CHECKPOINT_DOWN not in moved, "the first attempt has none"


@pytest.mark.one_machine("the manifest is a blob like any other")
def test_a_list_of_results_that_is_damaged_ends_the_job_with_that_reason(
    store: Store, host: Hosts, new_job: NewJob
) -> None:
    """An attempt cannot adopt them, and could not commit its own."""
    job_id = new_job()
    store.blobs.put(keys.result_manifest_key(job_id), b'{"attempt": 1}')
    run_attempt(host("quick"), job_id, 1)
    row = store.records.job(job_id)
    assert row.error is not None
    assert (row.state, row.deaths, row.error["code"]) == (JobState.failed, 0, "results_lost")
    store.records.retry(job_id)
    run_attempt(host("quick"), job_id, 2)
    assert store.records.job(job_id).state == JobState.succeeded


def test_a_flaw_of_the_worker_itself_is_a_death_with_its_traceback(
    store: Store, host: Hosts, new_job: NewJob, monkeypatch: pytest.MonkeyPatch
) -> None:
    def flawed(*_arguments: Any, **_named: Any) -> None:
        raise ZeroDivisionError("a flaw")

    monkeypatch.setattr(Results, "commit", flawed)
    job_id = new_job()
    run_attempt(host("quick"), job_id, 1)
    row = store.records.job(job_id)
    assert (row.state, row.attempt, row.deaths) == (JobState.queued, 2, 1)
    assert "ZeroDivisionError: a flaw" in row.log_tail


@pytest.mark.one_machine("how engines end, wherever rows and blobs are")
@pytest.mark.parametrize("engine", ["hangs", "ignores_stop"])
def test_a_runner_that_does_not_stop_is_killed_after_the_grace(
    store: Store, host: Hosts, new_job: NewJob, engine: str
) -> None:
    job_id = new_job()
    given = host(engine)
    thread = in_background(given, job_id)
    wait_until(lambda: store.records.job(job_id).progress["stage"] != "")
    asked = time.monotonic()
    given.stop_signal._on_signal(signal.SIGTERM, None)
    thread.join()
    assert 1.0 <= time.monotonic() - asked < 4.0
    assert store.records.job(job_id).state == JobState.preempted


def test_a_lost_lease_ends_the_runner_and_commits_nothing(store: Store, host: Hosts, new_job: NewJob) -> None:
    job_id = new_job(steps=500)
    thread = in_background(host("stepping"), job_id)
    wait_until(lambda: step_of(store, job_id) >= 12)
    wait_until(lambda: store.blobs.exists(keys.checkpoint_prefix(job_id, 1) + "index.json"))
    store.records.lost(job_id, 1)  # as the server's reconciler does when it takes this worker for dead
    thread.join(timeout=5.0)
    assert not thread.is_alive()
    row = store.records.job(job_id)
    assert (row.state, row.attempt) == (JobState.queued, 2)
    assert not store.blobs.exists(keys.result_manifest_key(job_id))
    before = {blob.key: blob.etag for blob in store.blobs.list(keys.checkpoints_prefix(job_id))}
    time.sleep(0.3)
    assert {blob.key: blob.etag for blob in store.blobs.list(keys.checkpoints_prefix(job_id))} == before


@pytest.mark.one_machine("about folders of the worker")
def test_leftovers_of_killed_attempts_are_swept_and_live_ones_kept(
    store: Store, host: Hosts, new_job: NewJob, settings: WorkerSettings
) -> None:
    leftover, foreign = settings.workspaces / "attempt-dead-1", settings.workspaces / "somebody's thesis"
    (leftover / "work").mkdir(parents=True)
    foreign.mkdir()
    running = new_job(steps=100)
    thread = in_background(host("stepping"), running)
    wait_until(lambda: step_of(store, running) >= 1)
    assert not leftover.exists()
    assert foreign.exists()
    run_attempt(host("quick"), new_job(), 1)
    thread.join()
    assert store.records.job(running).state == JobState.succeeded


@pytest.mark.one_machine("forks this process, in which the client of S3 has threads")
def test_the_runner_dies_with_its_parent(store: Store, settings: WorkerSettings, new_job: NewJob) -> None:
    job_id = new_job()
    parent = os.fork()
    if parent == 0:
        run_attempt(Host(settings, engine="fake_engines:hangs"), job_id, 1)
        os._exit(0)
    wait_until(lambda: store.records.job(job_id).progress["stage"] == "atlas")
    (runner,) = _children(parent)
    os.kill(parent, signal.SIGKILL)
    os.waitpid(parent, 0)
    wait_until(lambda: not os.path.exists(f"/proc/{runner}"), seconds=3.0)  # noqa: PTH110


def _children(pid: int) -> list[int]:
    with open(f"/proc/{pid}/task/{pid}/children") as file:  # noqa: PTH123
        return [int(child) for child in file.read().split()]


def _edit(store: Store, job_id: str, **values: object) -> None:
    with store.database.write() as session:
        row = session.get_one(JobRow, job_id)
        for name, value in values.items():
            setattr(row, name, value)


def test_a_job_of_another_release_is_declined(
    store: Store, settings: WorkerSettings, redis_url: str, new_job: NewJob
) -> None:
    job_id = new_job()
    _edit(store, job_id, options={**store.records.job(job_id).options, "sharpen": 2})
    run_attempt(Host(settings.model_copy(update={"redis_url": redis_url}), engine="fake_engines:raises"), job_id, 1)
    row = store.records.job(job_id)
    assert (row.state, row.attempt, row.deaths, row.worker) == ("queued", 1, 0, None)
    assert "sharpen" in row.waiting_reason
    with Redis.from_url(redis_url) as connection:
        assert JobQueue(connection).declined() == [f"{job_id}-1"]

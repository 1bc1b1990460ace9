"""A user cancels a running job: it ends within two seconds, whatever it is busy with."""

from __future__ import annotations

import json
import signal
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import fake_engines
import pytest
import structlog
from attempts import in_background, result, spent, step_of
from live_service import wait_until

from advtex_contract.jobs import JobState
from advtex_store import keys
from advtex_store.errors import BlobsUnavailable
from advtex_store.live_progress import LiveProgress
from advtex_store.queue import connect_redis_briefly
from advtex_store.results import Results
from advtex_store.store import Store
from advtex_worker.settings import WorkerSettings
from advtex_worker.tasks import Host, run_attempt

Hosts = Callable[[str], Host]
NewJob = Callable[..., str]


def test_cancel_stops_within_two_seconds_and_retry_goes_on(store: Store, host: Hosts, new_job: NewJob) -> None:
    job_id = new_job(steps=150)
    thread = in_background(host("stepping"), job_id)
    wait_until(lambda: step_of(store, job_id) >= 15)
    asked = time.monotonic()
    store.records.cancel(job_id)
    thread.join()
    assert time.monotonic() - asked < 2.0
    assert store.records.job(job_id).state == JobState.canceled
    reached, before = step_of(store, job_id), spent(store, job_id)
    assert before > 0
    store.records.retry(job_id)
    run_attempt(host("stepping"), job_id, 2)
    state = json.loads(result(store, job_id).split("\n", 1)[1])
    assert state["chain"] == fake_engines.chain(150)
    assert state["began"][0] == 0
    assert reached <= state["began"][1] < 150, "the checkpoint of the stop itself was not used"
    assert spent(store, job_id) >= before + 0.01 * (150 - state["began"][1]), "the first attempt's seconds were lost"
    assert list(store.blobs.list(keys.checkpoints_prefix(job_id))) == [], "checkpoints outlived the results"


def test_a_cancel_does_not_wait_for_a_long_fetch(
    store: Store, settings: WorkerSettings, new_job: NewJob, monkeypatch: pytest.MonkeyPatch
) -> None:
    job_id = new_job()
    asked = threading.Event()

    def endless(*_arguments: object) -> Iterator[bytes]:
        store.records.cancel(job_id)
        asked.set()
        while True:
            time.sleep(0.01)
            yield b"0"

    monkeypatch.setattr(type(store.blobs), "stream", endless)
    monkeypatch.setattr(Results, "adopt", lambda _self, _job_id: False)
    began = time.monotonic()
    run_attempt(Host(settings, engine="fake_engines:quick"), job_id, 1)
    assert asked.is_set()
    assert time.monotonic() - began < 2.0
    assert store.records.job(job_id).state == JobState.canceled


@pytest.mark.parametrize("slow", ["restore", "commit", "checkpoint"])
def test_a_cancel_does_not_wait_for_the_storage(
    store: Store, host: Hosts, new_job: NewJob, monkeypatch: pytest.MonkeyPatch, slow: str
) -> None:
    """Neither for a checkpoint on its way here, nor for results or a checkpoint on their way there."""
    job_id = new_job(steps=20 if slow == "commit" else 1000)
    hung, go_on = threading.Event(), threading.Event()

    def hang(*_arguments: Any, **_named: Any) -> Any:
        hung.set()
        go_on.wait(20)
        raise BlobsUnavailable("no answer")

    if slow == "restore":
        monkeypatch.setattr("advtex_worker.attempt.restore", hang)
    elif slow == "commit":
        monkeypatch.setattr(Results, "commit", hang)
    else:
        monkeypatch.setattr(type(store.blobs), "upload", hang)
    thread = in_background(host("stepping"), job_id)
    assert hung.wait(10)
    asked = time.monotonic()
    store.records.cancel(job_id)
    wait_until(lambda: store.records.job(job_id).state == JobState.canceled)
    assert time.monotonic() - asked < 2.0
    go_on.set()
    thread.join()


@pytest.mark.one_machine("how engines end, wherever rows and blobs are")
@pytest.mark.parametrize("asked_before", [False, True])
@pytest.mark.parametrize(("engine", "ends"), [("hangs", "stopped"), ("ignores_stop", "stopped"), ("hangs_alone", None)])
def test_a_cancel_in_a_long_stage_is_recorded_within_two_seconds(
    store: Store,
    settings: WorkerSettings,
    redis_url: str,
    new_job: NewJob,
    engine: str,
    ends: str | None,
    asked_before: bool,
) -> None:
    """The runner ends by itself; only one that cannot run Python at all is killed. A drain before changes nothing."""
    names = ("lease_seconds", "heartbeat_seconds", "grace_seconds")
    usual = {name: WorkerSettings.model_fields[name].default for name in names}
    given = Host(settings.model_copy(update={**usual, "redis_url": redis_url}), engine=f"fake_engines:{engine}")
    live = LiveProgress(connect_redis_briefly(given.settings))  # the row itself waits for a heartbeat
    job_id = new_job()

    def stage() -> str:
        row = store.records.job(job_id)
        live.show([row])
        return str(row.progress["stage"])

    with structlog.testing.capture_logs() as lines:
        thread = in_background(given, job_id)
        wait_until(lambda: stage() != "")
        if asked_before:
            given.stop_signal._on_signal(signal.SIGTERM, None)
        asked = time.monotonic()
        store.records.cancel(job_id)
        wait_until(lambda: store.records.job(job_id).state == JobState.canceled)
        took = time.monotonic() - asked
        thread.join()
    live.redis.close()
    assert took < 2.0
    (ending,) = [line["ending"] for line in lines if line["event"] == "runner ended"]
    assert ending == (ends or "the engine's process was killed (out of memory?): SIGKILL")

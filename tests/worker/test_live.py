"""Looks at a running job: they arrive, they are the attempt's own, and the job never waits for them."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable

import psutil
import pytest
from attempts import in_background
from live_service import wait_until

from advtex_contract.jobs import JobState
from advtex_contract.live import Curves, LivePicture, LiveRecord
from advtex_store import keys
from advtex_store.blobs import Blobs
from advtex_store.store import Store
from advtex_worker.live import LivePoster
from advtex_worker.tasks import Host, run_attempt

Hosts = Callable[[str], Host]
NewJob = Callable[..., str]


def look(step: int) -> LiveRecord:
    picture = LivePicture(name="0.jpg", view="a", jpeg=b"picture %d" % step)
    return LiveRecord(step=step, curves=Curves(), pictures=[picture])


def step_shown(store: Store, job_id: str, attempt: int) -> int:
    record = store.live.read(job_id, attempt)
    return record.step if record else 0


def test_looks_notes_and_peaks_arrive_and_a_kill_leaves_the_newest_look(
    store: Store, host: Hosts, new_job: NewJob
) -> None:
    job_id = new_job()
    thread = in_background(host("glimpsing"), job_id)
    wait_until(lambda: step_shown(store, job_id, 1) > 0)
    first = step_shown(store, job_id, 1)
    wait_until(lambda: step_shown(store, job_id, 1) > first)
    record = store.live.read(job_id, 1)
    assert record is not None
    (picture,) = record.pictures
    assert (picture.view, picture.jpeg) == ("color/<1>.png", b"picture %d" % record.step)
    assert record.curves.steps == [record.step]
    wait_until(lambda: store.records.job(job_id).progress["notes"] == ["12 of 30 frames become views"])
    wait_until(lambda: store.blobs.exists(keys.checkpoint_prefix(job_id, 1) + "index.json"))
    (runner,) = [child for child in psutil.Process().children() if "advtex_worker.runner" in child.cmdline()]
    os.kill(runner.pid, signal.SIGKILL)
    thread.join()
    assert store.records.job(job_id).state == JobState.queued
    kept = step_shown(store, job_id, 1)
    assert step_shown(store, job_id, 2) == kept > 0, "the next attempt has nothing to show yet"
    assert step_shown(store, job_id, 3) == 0
    store.live.write(job_id, 2, look(1))
    assert step_shown(store, job_id, 2) == 1, "a look of the attempt before is not seen any more"
    run_attempt(host("quick"), job_id, 2)
    row = store.records.job(job_id)
    assert row.state == JobState.succeeded
    assert row.progress["notes"] == ["12 of 30 frames become views"]
    assert row.progress["stage_peak_bytes"] == {"ingest": 1 << 20, "optimization": 2 << 20}
    assert row.progress["stage_device_peak_bytes"] == {"optimization": 3 << 20}
    assert not list(store.blobs.list(keys.live_prefix(job_id))), "results replace them"


def test_a_stale_attempt_shows_nothing(store: Store, new_job: NewJob) -> None:
    job_id, asked = new_job(), threading.Event()

    def still_held() -> bool:
        asked.set()
        return False

    poster = LivePoster(store.live, job_id, 1, still_held)
    poster.post(look(1))
    assert asked.wait(5.0)
    poster.stop()
    assert store.live.read(job_id, 1) is None


def test_a_new_attempt_removes_the_looks_of_those_before(store: Store, new_job: NewJob) -> None:
    job_id = new_job()
    for attempt in (1, 2):
        store.live.write(job_id, attempt, look(attempt))
    poster = LivePoster(store.live, job_id, 3, lambda: True)
    poster.post(look(9))
    wait_until(lambda: [info.key for info in store.blobs.list(keys.live_prefix(job_id))] == [keys.live_key(job_id, 3)])
    poster.stop()
    assert step_shown(store, job_id, 3) == 9


@pytest.mark.one_machine("the trouble is made")
def test_a_storage_that_hangs_or_fails_costs_looks_alone(
    store: Store, new_job: NewJob, monkeypatch: pytest.MonkeyPatch
) -> None:
    job_id, entered, go_on = new_job(), threading.Event(), threading.Event()
    put = Blobs.put
    troubles: list[Callable[[], object]] = [lambda: 1 / 0, lambda: entered.set() or go_on.wait(10.0)]

    def troubled(blobs: Blobs, key: str, data: bytes) -> object:
        if troubles:
            troubles.pop(0)()
        return put(blobs, key, data)

    monkeypatch.setattr(Blobs, "put", troubled)
    poster = LivePoster(store.live, job_id, 1, lambda: True)
    poster.post(look(1))
    wait_until(lambda: len(troubles) == 1)
    poster.post(look(2))
    assert entered.wait(5.0)
    for step in range(3, 100):
        poster.post(look(step))  # at once: nobody waits for the second look
    poster.stop()
    go_on.set()
    wait_until(lambda: step_shown(store, job_id, 1) == 2)
    poster._thread.join()
    assert step_shown(store, job_id, 1) == 2, "after the end no other look is begun"

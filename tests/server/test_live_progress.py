"""Progress that people watch moves between two writes of a job's row, and does without Redis."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from advtex_contract.jobs import Progress
from advtex_store import live_progress
from advtex_store.live_progress import KEY, LiveProgress
from advtex_store.queue import connect_redis_briefly
from advtex_store.settings import StoreSettings

pytestmark = pytest.mark.one_machine("the same Redis, wherever rows are")


def at(step: int) -> Progress:
    return Progress(stage="optimization", step=step, steps=1000)


@pytest.fixture
def live(make_live: Callable[..., Any], own_redis: Any) -> Any:
    return make_live(redis_url=own_redis.url)


@pytest.fixture
def job(live: Any, scan_zip: Path) -> str:
    """A running one, whose row is at step 10."""
    job_id = str(live.job(live.upload(scan_zip.read_bytes()))["id"])
    live.store.records.claim(job_id, 1, "w")
    live.store.records.heartbeat(job_id, 1, at(10))
    return job_id


@pytest.fixture
def worker(own_redis: Any) -> Iterator[LiveProgress]:
    """As a worker has it."""
    told = LiveProgress(connect_redis_briefly(StoreSettings(redis_url=own_redis.url)))
    yield told
    told.redis.close()


def shown(live: Any, job: str) -> tuple[int, str]:
    view = live.http.get(f"/v1/jobs/{job}").json()
    (listed,) = live.http.get("/v1/jobs").json()["jobs"]
    assert listed == view
    return view["progress"]["step"], view["waiting_reason"]


def test_the_newest_is_shown_while_the_attempt_runs(live: Any, job: str, worker: LiveProgress) -> None:
    assert shown(live, job) == (10, "")
    worker.tell(job, 1, at(20), "no room")
    assert shown(live, job) == (20, "no room")
    assert live.store.records.job(job).progress["step"] == 10
    assert 0 < worker.redis.ttl(KEY + job) <= live_progress.KEPT_SECONDS, "an attempt that died is not shown for long"
    worker.tell(job, 0, at(900), "")
    assert shown(live, job) == (10, ""), "told by an attempt that is no longer the job's"
    worker.tell(job, 1, at(30), "")
    live.store.records.succeed(job, 1, [])
    assert shown(live, job) == (10, "")


def test_streams_show_within_a_second_what_the_row_does_not_say_yet(live: Any, job: str, worker: LiveProgress) -> None:
    took = []
    with live.http.stream("GET", f"/v1/jobs/{job}/events") as response:
        lines = response.iter_lines()
        for step in range(20, 30):
            worker.tell(job, 1, at(step), "")
            told = time.monotonic()
            steps = (json.loads(line[6:])["progress"]["step"] for line in lines if line.startswith('data: {"id"'))
            assert next(found for found in steps if found >= step) == step
            took.append(time.monotonic() - told)
    assert sorted(took)[-2] < 1.0, "a busy machine may hold up one"
    assert live.store.records.job(job).progress["step"] == 10


def test_without_redis_the_row_is_shown_and_nobody_waits(
    live: Any, job: str, worker: LiveProgress, own_redis: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_progress, "REST_SECONDS", 60.0)
    worker.tell(job, 1, at(20), "")
    assert shown(live, job) == (20, "")
    own_redis.stop()
    worker.tell(job, 1, at(30), "")
    assert shown(live, job) == (10, "")
    asked: list[str] = []
    monkeypatch.setattr(live.store.live_progress.redis, "mget", asked.append)
    assert shown(live, job) == (10, "")
    assert asked == [], "it is not asked again at once"
    monkeypatch.undo()
    own_redis.start()
    for told in (live.store.live_progress, worker):
        told._rest_until = 0.0
    worker.tell(job, 1, at(40), "")
    assert shown(live, job) == (40, "")

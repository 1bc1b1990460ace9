"""What operators see in `/metrics`, and who may look."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from prometheus_client.parser import text_string_to_metric_families
from sqlalchemy import update

from advtex_contract.jobs import JobError, JobState, Progress
from advtex_server.embedded import free_port
from advtex_store.fleet import GpuReading, WorkerReport
from advtex_store.models import JobRow

GIB = 1 << 30
Samples = dict[tuple[Any, ...], float]


def samples(text: str) -> Samples:
    """(name, label, value, …) -> its number"""
    return {
        (sample.name, *(part for label in sorted(sample.labels.items()) for part in label)): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def told(live: Any) -> Samples:
    return samples(live.http.get("/metrics").text)


def give_memory(live: Any, job: str, memory_bytes: int) -> None:
    with live.store.database.write() as session:
        session.execute(update(JobRow).where(JobRow.id == job).values(memory_bytes=memory_bytes))


def test_jobs_that_wait_are_told_by_the_class_that_they_need(make_live: Callable[..., Any], scan_zip: Path) -> None:
    live = make_live()
    upload = live.upload(scan_zip.read_bytes())
    small = [live.job(upload)["id"] for _ in range(2)]
    large, running = live.job(upload)["id"], live.job(upload)["id"]
    give_memory(live, large, 11 * GIB + 1)
    for job in (small[0], running):
        live.store.records.claim(job, 1, "w")
    live.store.records.preempt(small[0], 1)
    found = told(live)
    gib = str(live.store.records.job(small[0]).memory_gib)
    assert found["advtex_jobs_waiting", "memory_gib", gib] == 2
    assert found["advtex_jobs_waiting", "memory_gib", "12"] == 1
    assert found["advtex_jobs_running", "memory_gib", gib] == 1
    oldest = found["advtex_jobs_waiting_oldest_seconds", "memory_gib", gib]
    assert 0 < found["advtex_jobs_waiting_oldest_seconds", "memory_gib", "12"] < oldest < 60
    assert [key for key in found if key[0] == "advtex_owner_jobs_waiting"] == [
        ("advtex_owner_jobs_waiting", "owner", "other")
    ], "where everybody reads them, they name no owner"


def test_bytes_of_workers_are_told_by_direction_and_what(live: Any, scan_zip: Path) -> None:
    def moved() -> dict[tuple[Any, ...], float]:
        return {(key[2], key[4]): value for key, value in told(live).items() if key[0] == "advtex_worker_bytes_total"}

    none = {("down", "checkpoint"): 0, ("down", "scan"): 0, ("up", "checkpoint"): 0, ("up", "result"): 0}
    assert moved() == none
    job = live.job(live.upload(scan_zip.read_bytes()))["id"]
    live.store.records.claim(job, 1, "w")
    for size in (100, 20):
        live.store.records.heartbeat(job, 1, moved={"down scan": size, "up checkpoint": 7})
    live.store.records.succeed(job, 1, [{"name": "a", "size": 5}, {"name": "b", "size": 6}])
    assert moved() == {**none, ("down", "scan"): 120, ("up", "checkpoint"): 14, ("up", "result"): 11}


@pytest.mark.one_machine("tests/store has the same on both databases")
def test_owners_with_the_longest_lines_are_named_for_those_with_a_key(
    make_live: Callable[..., Any], is_error: Any, scan_zip: Path
) -> None:
    live = make_live(metrics_key=True, metrics_owners=2)
    for owner, jobs in (("ada", 3), ("bob", 1), ("cy", 2)):
        live.become(owner)
        upload = live.upload(scan_zip.read_bytes())
        for _ in range(jobs):
            live.job(upload)
    is_error(live.http.get("/metrics"), 403, "forbidden")
    with live.client(None) as stranger:
        is_error(stranger.get("/metrics"), 401, "unauthorized")
    with live.client(live.store.accounts.create_key("prometheus", scopes=["admin"])) as prometheus:
        found = samples(prometheus.get("/metrics").text)
    waiting = {key[2]: value for key, value in found.items() if key[0] == "advtex_owner_jobs_waiting"}
    assert waiting == {"ada": 3, "cy": 2, "other": 1}
    assert found["advtex_owner_jobs_waiting_oldest_seconds", "owner", "ada"] > 0


@contextlib.contextmanager
def server_process(folder: Path, **settings: str) -> Iterator[str]:
    """-> its address"""
    given = os.environ | {"ADVTEX_DATA_DIR": str(folder), "ADVTEX_REDIS_URL": "redis://127.0.0.1:1/0", **settings}
    command = [sys.executable, "-m", "advtex_server.main", "serve", "--host", "127.0.0.1", "--port", "0"]
    with subprocess.Popen(command, env=given, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            yield str(json.loads(process.stdout.readline())["url"])
        finally:
            process.terminate()
    assert process.returncode == 0


@pytest.mark.one_machine("a port is a port")
def test_metrics_can_have_a_port_of_their_own(tmp_path: Path) -> None:
    port = free_port()
    with server_process(tmp_path, ADVTEX_METRICS_PORT=str(port)) as url:
        assert "advtex_jobs" in httpx.get(f"http://127.0.0.1:{port}/metrics").text
        assert httpx.get(f"http://127.0.0.1:{port}/healthz").status_code == 404
        refused = httpx.get(f"{url}/metrics")
        assert refused.status_code == 404
        assert "port of their own" in refused.json()["message"]


@pytest.mark.one_machine("Redis is Redis")
def test_workers_tell_of_their_gpus(make_live: Callable[..., Any], redis_url: str) -> None:
    live = make_live(redis_url=redis_url)
    queue, fleet = live.store.queue, live.store.fleet
    shared = GpuReading(uuid="GPU-a", memory_used_bytes=3 * GIB, memory_bytes=24 * GIB, utilization=0.5)
    for name, busy in (("one", True), ("two", False)):
        queue.announce(name, 12, busy=busy)
        fleet.tell(name, WorkerReport(host="h", gpu=shared))
    queue.announce("of an older release", 8)
    queue.announce("of a newer one", 8)
    queue.redis.set("advtex:report:of a newer one", '{"gpu": 7}')
    found = told(live)
    assert found["advtex_jobs_without_worker",] == 0
    assert found["advtex_workers", "gib", "12"] == 2
    assert found["advtex_workers_busy", "gib", "12"] == 1
    assert found["advtex_workers", "gib", "8"] == 2
    assert found["advtex_workers_busy", "gib", "8"] == 0
    gpu = ("gpu", "GPU-a", "host", "h")
    assert found["advtex_gpu_memory_used_bytes", *gpu] == 3 * GIB
    assert found["advtex_gpu_memory_bytes", *gpu] == 24 * GIB
    assert found["advtex_gpu_utilization_ratio", *gpu] == 0.5


@pytest.mark.one_machine("Redis is Redis")
def test_jobs_that_fit_no_living_worker(make_live: Callable[..., Any], redis_url: str, scan_zip: Path) -> None:
    live = make_live(redis_url=redis_url)
    upload = live.upload(scan_zip.read_bytes())
    jobs = [live.job(upload)["id"] for _ in range(3)]
    give_memory(live, jobs[0], 13 * GIB)
    assert told(live)["advtex_jobs_without_worker",] == 3
    live.store.queue.announce("w", 12)
    assert told(live)["advtex_jobs_without_worker",] == 1


@pytest.mark.one_machine("Redis is Redis")
def test_the_age_of_the_oldest_checkpoint(make_live: Callable[..., Any], redis_url: str, scan_zip: Path) -> None:
    live = make_live(redis_url=redis_url)
    upload = live.upload(scan_zip.read_bytes())
    jobs = [live.job(upload)["id"] for _ in range(2)]
    assert told(live)["advtex_checkpoint_age_seconds",] == 0
    for job in jobs:
        live.store.records.claim(job, 1, "w")
        live.store.live_progress.saved(job, 1)
    key = f"advtex:checkpoint:{jobs[0]}-1"
    live.store.queue.redis.expire(key, live.store.queue.redis.ttl(key) - 100)
    assert 99 < told(live)["advtex_checkpoint_age_seconds",] < 130
    live.store.live_progress.saved(jobs[0], 1)
    assert told(live)["advtex_checkpoint_age_seconds",] < 30


@pytest.mark.one_machine("tests/store has the same on both databases")
def test_stages_are_a_histogram_of_all_jobs_that_ended(live: Any, scan_zip: Path) -> None:
    upload = live.upload(scan_zip.read_bytes())
    for seconds in (2.0, 3.0, 50_000.0):
        job = live.job(upload)["id"]
        live.store.records.claim(job, 1, "w")
        live.store.records.heartbeat(job, 1, Progress(stage="atlas", stage_seconds={"atlas": seconds}))
        live.store.records.fail(job, 1, JobError(code="engine_error", message="no"))
    found = told(live)
    below = {
        bound: found["advtex_stage_seconds_bucket", "le", bound, "stage", "atlas"]
        for bound in ("1.0", "3.0", "36000.0", "+Inf")
    }
    assert below == {"1.0": 0, "3.0": 2, "36000.0": 2, "+Inf": 3}
    assert found["advtex_stage_seconds_sum", "stage", "atlas"] == 50_005
    assert found["advtex_failures_total", "cause", "engine_error"] == 3


@pytest.mark.one_machine("tests/store has the same on both databases")
def test_bytes_rounds_and_deliveries_are_counted_where_they_happen(live: Any) -> None:
    before = told(live)
    assert before["advtex_failures_total", "cause", "poison"] == 0
    assert before["advtex_attempts_ended_early_total", "how", "lost"] == 0
    live.upload(b"x" * 100_000)
    live.store.webhooks.create("me", "https://127.0.0.1:9/hook", list(JobState))
    found = told(live)
    assert found["advtex_http_received_bytes_total",] - before["advtex_http_received_bytes_total",] == 100_000
    assert found["advtex_http_sent_bytes_total",] > before["advtex_http_sent_bytes_total",] + 1000
    assert found["advtex_dispatcher_round_seconds_count", "kind", "reconcile"] >= 1
    assert found["advtex_webhook_tries_total", "outcome", "failed"] == 0
    live.job(live.upload(b"no zip"))
    deadline = time.monotonic() + 30
    while not told(live)["advtex_webhook_tries_total", "outcome", "failed"]:
        assert time.monotonic() < deadline, "its address is refused"
        time.sleep(0.05)

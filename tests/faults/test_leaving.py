"""Every way in which a worker goes by itself, with real processes: no job is lost, and none is made twice."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import httpx
import pytest
from live_fleet import Place, fleet
from live_service import LiveService, process_tree, wait_until
from outcomes import assert_done_once
from tiny_scan import write_zip

from advtex_contract.jobs import JobState
from advtex_contract.options import JobOptions
from advtex_worker.leaving import AGAIN

GRACE_SECONDS = 15.0  # nobody needs it: a busy machine makes everything take longer
STEPS = 9000


@pytest.fixture
def service(service: LiveService) -> LiveService:
    """Its workers keep their leases on a busy machine too: nobody dies here."""
    service.environment["ADVTEX_LEASE_SECONDS"] = "60"
    return service


def to_all(worker: subprocess.Popen[bytes]) -> None:
    """As SLURM signals a step: every process of it, runner and all."""
    for pid in process_tree(worker.pid):
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGUSR1)


@pytest.mark.slow
def test_a_job_in_hand_is_given_back_and_goes_on_elsewhere(service: LiveService, scan: Path, tmp_path: Path) -> None:
    going, hurry = tmp_path / "going", tmp_path / "hurry"
    service.environment |= {"ADVTEX_GRACE_SECONDS": str(GRACE_SECONDS), "ADVTEX_ENGINE_HURRY": str(hurry)}
    ways: list[tuple[tuple[str, ...], Callable[[subprocess.Popen[bytes]], object]]] = [
        (("--exit-when-idle", "60"), to_all),
        (("--notice", str(going)), lambda _: going.touch()),
        (("--until", "in time"), lambda _: None),
    ]
    with service.client() as client:
        job_id = client.submit(scan, JobOptions(steps=STEPS)).id
        took = 0.0
        for attempt, (arguments, leave) in enumerate(ways, 1):
            began = time.time()
            end = began + 2 * took + 2 * GRACE_SECONDS + 1  # a busy machine starts a worker slowly
            worker = service.start_worker("leisurely", *(str(end) if word == "in time" else word for word in arguments))
            reached = client.get_job(job_id).progress.step
            wait_until(lambda: client.get_job(job_id).progress.step > reached, 150)  # noqa: B023
            took = time.time() - began
            tree = process_tree(worker.pid)
            leave(worker)
            assert worker.wait(150) == AGAIN, arguments
            row = service.store.records.job(job_id)
            assert (row.state, row.attempt, row.deaths) == (JobState.preempted, attempt + 1, 0)
            assert not any(process_tree(pid) for pid in tree)
            assert service.store.queue.workers() == []
        assert time.time() < end, "it was gone in time"
        hurry.touch()
        service.start_worker("leisurely")
        state = assert_done_once(service, client, job_id, STEPS)
        assert len(state["began"]) == len(ways) + 1
        assert state["began"] == sorted(set(state["began"])), "each attempt went on from a checkpoint of the last"


def test_a_worker_has_its_jobs_and_leaves_the_others(service: LiveService, scan: Path) -> None:
    with service.client() as client:
        jobs = [client.submit(scan, JobOptions(steps=20, seed=seed)).id for seed in range(3)]
        assert service.start_worker("stepping", "--max-jobs", "2").wait(60) == 0
        states = [client.get_job(job).state for job in jobs]
        assert (states.count(JobState.succeeded), states.count(JobState.queued)) == (2, 1)
        while client.get_job(jobs[states.index(JobState.queued)]).state == JobState.queued:
            assert service.start_worker("stepping", "--exit-when-idle", "1").wait(60) == 0
        for job in jobs:
            assert_done_once(service, client, job, 20)
            assert client.get_job(job).attempt == 1


@pytest.mark.slow
def test_no_job_goes_with_workers_that_come_and_go_all_the_time(service: LiveService, scan: Path) -> None:
    """Workers that leave after a job or a second's idleness, until a batch is done."""
    with service.client() as client:
        jobs = [client.submit(scan, JobOptions(steps=10, seed=seed)).id for seed in range(6)]
        done = lambda: all(client.get_job(job).state == JobState.succeeded for job in jobs)  # noqa: E731
        deadline = time.monotonic() + 240
        while not done() and time.monotonic() < deadline:
            workers = [service.start_worker("stepping", "--max-jobs", "2", "--exit-when-idle", "1") for _ in range(2)]
            assert [worker.wait(60) for worker in workers] == [0, 0]
        for job in jobs:
            assert_done_once(service, client, job, 10)
            assert client.get_job(job).attempt == 1, "none was given back"


@pytest.mark.slow
def test_a_job_whose_scan_was_downloaded_ahead_is_nobodys(
    tmp_path: Path, scan: Path, postgres_url: str, s3_url: str
) -> None:
    """The worker goes with the scan of a job that waits: the job has lost no attempt, and another worker takes it."""
    place = Place(
        tmp_path / "data", postgres_url, s3_url, {k: v for k, v in os.environ.items() if k.startswith("AWS_")}
    )
    hurry = tmp_path / "hurry"
    patient = {"ADVTEX_LEASE_SECONDS": "60", "ADVTEX_ENGINE_HURRY": str(hurry)}
    with fleet(tmp_path, place, workers=1, engine="leisurely", variables=patient) as running:
        records, key = running.store.records, running.store.accounts.create_key("fleet", owner="fleet")
        data = write_zip(tmp_path / "scan.zip", scan).read_bytes()
        with httpx.Client(base_url=running.urls[0], headers={"Authorization": f"Bearer {key}"}, timeout=30) as http:
            uploads = [http.post("/v1/uploads", content=data).json()["id"] for _ in range(2)]
            jobs = []
            for upload, steps in zip(uploads, (2500, 10), strict=True):
                body = {"upload_id": upload, "options": {"steps": steps}}
                jobs.append(str(http.post("/v1/jobs", json=body).json()["id"]))
                wait_until(lambda: records.job(jobs[0]).state == JobState.running, 60)  # else the other may overtake it
            first, second = jobs
        cached = [place.data / "scans" / f"{upload}.zip" for upload in uploads]
        wait_until(lambda: all(path.exists() for path in cached), 60)
        row = records.job(second)
        assert (row.state, row.attempt, row.worker) == (JobState.queued, 1, None)
        running.workers[0].terminate()
        assert running.workers[0].wait(60) == 0
        hurry.touch()
        running.workers[0] = running.start_worker(0)
        wait_until(lambda: records.count_by_state().get("succeeded") == 2, 90)
        assert (records.job(first).attempt, records.job(second).attempt) == (2, 1)

"""kill -9 in the middle of a job, wherever it may hit: the job goes on from its checkpoint and succeeds, once."""

from __future__ import annotations

import contextlib
import os
import signal
import sqlite3
import time
from pathlib import Path

import pytest
from live_service import LiveService, process_tree, wait_until
from outcomes import assert_done_once

from advtex_client import Client
from advtex_contract.jobs import JobState
from advtex_contract.options import JobOptions
from advtex_store import keys
from advtex_store.models import JobRow

STEPS = 120


def begin(service: LiveService, client: Client, scan: Path, steps: int = STEPS) -> tuple[str, list[int]]:
    """A job in the middle of its work, with a checkpoint stored. -> its id; worker, work-horse and runner."""
    worker = service.start_worker("stepping")
    job = client.submit(scan, JobOptions(steps=steps))
    index = keys.checkpoint_prefix(job.id, 1) + "index.json"
    wait_until(lambda: service.store.blobs.exists(index) and client.get_job(job.id).progress.step >= 15)
    tree = process_tree(worker.pid)
    assert len(tree) == 3
    return job.id, tree


def kill_all(tree: list[int]) -> None:
    """At once; some are gone with their parent before it is their turn."""
    for pid in tree:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def test_the_runner_alone(service: LiveService, scan: Path) -> None:
    with service.client() as client:
        job_id, (_, _, runner) = begin(service, client, scan)
        os.kill(runner, signal.SIGKILL)
        state = assert_done_once(service, client, job_id, STEPS)
        assert len(state["began"]) == 2
        assert state["began"][1] >= 10
        assert client.get_job(job_id).attempt == 2


def test_the_work_horse_alone(service: LiveService, scan: Path) -> None:
    with service.client() as client:
        job_id, (_, horse, runner) = begin(service, client, scan)
        os.kill(horse, signal.SIGKILL)
        wait_until(lambda: runner not in process_tree(runner), seconds=2.0)
        state = assert_done_once(service, client, job_id, STEPS)
        assert state["began"][1] >= 10


def test_the_worker_alone_takes_its_horse_and_runner_with_it(service: LiveService, scan: Path) -> None:
    with service.client() as client:
        job_id, tree = begin(service, client, scan)
        os.kill(tree[0], signal.SIGKILL)
        wait_until(lambda: not any(process_tree(pid) for pid in tree[1:]), seconds=5.0)
        assert client.get_job(job_id).state is JobState.preempted, "the horse had time to give its job back"
        service.start_worker("stepping")
        state = assert_done_once(service, client, job_id, STEPS)
        assert state["began"][1] >= 15


def test_the_whole_tree(service: LiveService, scan: Path) -> None:
    with service.client() as client:
        job_id, tree = begin(service, client, scan)
        kill_all(tree)
        service.start_worker("stepping")
        state = assert_done_once(service, client, job_id, STEPS)
        assert state["began"][1] >= 10
        assert client.get_job(job_id).attempt == 2


def test_a_stopped_worker_that_wakes_up_late_commits_nothing(service: LiveService, scan: Path) -> None:
    """SIGSTOP is what a swapping or suspended machine looks like: the lease runs out, and then it goes on.

    It is stopped between two of its writes: SQLite's lock would stop with it, and everybody wait for its return.
    """
    with service.client() as client:
        job_id, tree = begin(service, client, scan)
        with contextlib.closing(
            sqlite3.connect(service.folder / "data" / "advtex.db", timeout=15, isolation_level=None)
        ) as database:
            database.execute("BEGIN IMMEDIATE")
            for pid in tree:
                os.kill(pid, signal.SIGSTOP)
        service.start_worker("stepping")
        wait_until(lambda: client.get_job(job_id).attempt == 2)
        for pid in reversed(tree):  # a parent that goes on may take leave of a child that has ended
            os.kill(pid, signal.SIGCONT)
        state = assert_done_once(service, client, job_id, STEPS)
        assert len(state["began"]) == 2
        wait_until(lambda: len(process_tree(tree[0])) == 1, seconds=5.0)  # it waits for the next job


@pytest.mark.slow
def test_again_and_again(service: LiveService, scan: Path, tmp_path: Path) -> None:
    """However long everything takes: the leases of those who live hold, and those of the killed end when they do."""
    hurry, steps = tmp_path / "hurry", 9000
    service.environment |= {"ADVTEX_LEASE_SECONDS": "20", "ADVTEX_ENGINE_HURRY": str(hurry)}
    records = service.store.records
    with service.client() as client:
        job_id = client.submit(scan, JobOptions(steps=steps)).id
        for attempt in (1, 2, 3):
            reached = records.job(job_id).reached
            worker = service.start_worker("leisurely")
            index = keys.checkpoint_prefix(job_id, attempt) + "index.json"
            wait_until(lambda: records.job(job_id).reached > reached, 90)  # noqa: B023
            wait_until(lambda: service.store.blobs.exists(index), 90)  # noqa: B023
            assert records.job(job_id).attempt == attempt
            kill_all(process_tree(worker.pid))
            with service.store.database.write() as session:
                session.get_one(JobRow, job_id).lease_expires_at = 0.0
        hurry.touch()
        service.start_worker("leisurely")
        state = assert_done_once(service, client, job_id, steps)
        assert len(state["began"]) == 4
        assert state["began"] == sorted(set(state["began"])), "each attempt went on from a checkpoint of the last"


def test_cancel_stops_a_running_job_within_two_seconds_and_retry_goes_on(service: LiveService, scan: Path) -> None:
    with service.client() as client:
        job_id, tree = begin(service, client, scan)
        asked = time.monotonic()
        client.cancel_job(job_id)
        wait_until(lambda: client.get_job(job_id).state is JobState.canceled)
        assert time.monotonic() - asked < 2.0
        reached = client.get_job(job_id).progress.step
        wait_until(lambda: len(process_tree(tree[0])) == 1, seconds=5.0)  # horse and runner are gone
        client.retry_job(job_id)
        state = assert_done_once(service, client, job_id, STEPS)
        assert state["began"][1] >= reached

"""kill -9 in the middle of a check: the job has one outcome all the same, from whichever server."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import pytest
from large_scan import write_large_zip
from live_service import LiveService, process_tree, wait_until

from advtex_client import Client
from advtex_contract.jobs import JobSpec, JobState

FACES = 200_000


@pytest.fixture
def large(tmp_path: Path) -> Path:
    """A scan whose check takes some seconds."""
    return write_large_zip(tmp_path / "large.zip", FACES)


def submit(client: Client, scan: Path) -> str:
    return client.create_job(JobSpec(upload_id=client.upload(scan).id), idempotency_key="k").id


def checkers(service: LiveService) -> list[int]:
    """Processes of the newest server that check a scan now."""
    found = []
    for pid in process_tree(service.server.pid)[1:]:
        line = Path(f"/proc/{pid}/cmdline")
        if line.exists() and b"advtex_server.check_process" in line.read_bytes():
            found.append(pid)
    return found


def outcome(service: LiveService, job_id: str) -> list[str]:
    """All states that the job was in, once it is no longer checked."""
    wait_until(lambda: service.store.records.job(job_id).state != "checking", 60)
    return [event.data["state"] for event in service.store.records.events(job_id, 0)]


def test_the_server_is_killed(service: LiveService, large: Path) -> None:
    with service.client() as client:
        job = submit(client, large)
    wait_until(lambda: checkers(service))
    (checker,) = checkers(service)
    service.server.kill()
    service.server.wait()
    wait_until(lambda: not Path(f"/proc/{checker}").exists())
    assert service.store.records.job(job).state == "checking"
    service.restart_server()
    assert outcome(service, job) == ["checking", "queued"]
    assert service.store.records.job(job).deaths == 0


def test_the_check_is_killed(service: LiveService, large: Path) -> None:
    with service.client() as client:
        job = submit(client, large)
        wait_until(lambda: checkers(service))
        os.kill(checkers(service)[0], signal.SIGKILL)
        assert outcome(service, job) == ["checking", "queued"]
        assert client.get_job(job).state is JobState.queued


def test_a_check_that_is_always_killed_ends(service: LiveService, large: Path) -> None:
    with service.client() as client:
        job = submit(client, large)
        killed = set[int]()
        deadline = time.monotonic() + 60
        while client.get_job(job).state is JobState.checking:
            assert time.monotonic() < deadline
            for pid in checkers(service):
                os.kill(pid, signal.SIGKILL)
                killed.add(pid)
            time.sleep(0.02)
        ended = client.get_job(job)
    assert (ended.state, len(killed)) == (JobState.failed, 3)
    assert ended.error is not None
    assert (ended.error.code, "SIGKILL" in ended.error.message) == ("check_died", True)


def test_a_server_that_hangs_is_too_late(service: LiveService, large: Path) -> None:
    """It is stopped as a whole, its claim runs out, another server does the work; going on, it changes nothing."""
    with service.client() as client:
        job = submit(client, large)
    wait_until(lambda: checkers(service))
    frozen = process_tree(service.server.pid)
    for pid in frozen:
        os.kill(pid, signal.SIGSTOP)
    service.restart_server()
    try:
        assert outcome(service, job) == ["checking", "queued"]
    finally:
        for pid in reversed(frozen):  # a parent that goes on may take leave of a child that has ended
            os.kill(pid, signal.SIGCONT)
    wait_until(lambda: not Path(f"/proc/{frozen[-1]}").exists(), 30)
    time.sleep(1)
    assert outcome(service, job) == ["checking", "queued"]
    assert service.store.records.job(job).attempt == 1


def test_two_servers_share_the_checks(service: LiveService, scan: Path) -> None:
    with service.client() as client:
        upload = client.upload(scan).id
        urls = [service.url]
        service.restart_server()
        urls.append(service.url)
        jobs = []
        for number in range(24):
            with Client(urls[number % 2], service.key) as one:
                jobs.append(one.create_job(JobSpec(upload_id=upload), idempotency_key=f"k{number}").id)
    for job in jobs:
        assert outcome(service, job) == ["checking", "queued"]
    checked = [line for line in service.log.read_text().splitlines() if "scan checked" in line]
    assert len(checked) == len(jobs), "none was checked twice"

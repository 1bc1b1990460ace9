"""What happens around a job: Redis is lost, disks are full, clients are impatient."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import httpx
import pytest
from live_service import LiveService, live_service, process_tree, wait_until
from redis import Redis
from tiny_scan import write_zip

from advtex_client import BusyError, Client
from advtex_contract.jobs import JobState
from advtex_contract.options import JobOptions


def test_redis_killed_and_emptied_in_the_middle_of_a_job_costs_nothing(service: LiveService, scan: Path) -> None:
    worker = service.start_worker("stepping")
    with service.client() as client:
        running = client.submit(scan, JobOptions(steps=200))
        waiting = client.submit(scan, JobOptions(steps=20))
        wait_until(lambda: client.get_job(running.id).progress.step >= 20)
        tree = process_tree(worker.pid)
        service.redis.send_signal(signal.SIGKILL)
        service.redis.wait()
        begun = client.get_job(running.id).progress.step
        wait_until(lambda: client.get_job(running.id).progress.step >= begun + 20)
        service.start_redis()  # without a file of its own: it knows nothing
        done = client.wait_for_job(running.id, timeout=30)
        assert done.attempt == 1, "the running job was disturbed"
        assert client.wait_for_job(waiting.id, timeout=60).state is JobState.succeeded
        assert process_tree(worker.pid)[0] == tree[0], "the worker did not survive"


def wait_for_classes(service: LiveService) -> list[int]:
    wait_until(service.store.queue.classes)
    return [found.gib for found in service.store.queue.classes()]


def test_redis_flushed_while_jobs_wait(service: LiveService, scan: Path) -> None:
    with service.client() as client:
        service.start_worker("stepping")
        jobs = [client.submit(scan, JobOptions(seed=seed, steps=30)) for seed in range(3)]
        (gib,) = wait_for_classes(service)
        with Redis(port=service.redis_port) as redis:
            wait_until(lambda: service.store.queue.waiting_ids(gib))
            redis.flushall()
        for job in jobs:
            assert client.wait_for_job(job.id, timeout=30).state is JobState.succeeded


def test_a_worker_waits_for_a_redis_that_is_not_there_yet(service: LiveService, scan: Path) -> None:
    service.redis.kill()
    service.redis.wait()
    worker = service.start_worker("quick")
    with service.client() as client:
        job = client.submit(scan)
        wait_until(lambda: "Redis cannot be reached" in service.log.read_text())
        assert worker.poll() is None
        service.start_redis()
        assert client.wait_for_job(job.id, timeout=30).state is JobState.succeeded


def test_two_submissions_at_once_make_one_job(service: LiveService, scan: Path) -> None:
    ids: list[str] = []

    def submit() -> None:
        with service.client() as client:
            ids.append(client.submit(scan, label="twice").id)

    threads = [threading.Thread(target=submit) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    with service.client() as client:
        assert [job.id for job in client.list_jobs()] == [ids[0]]
    assert ids == [ids[0]] * 4


def test_one_idempotency_key_for_two_bodies_is_refused(service: LiveService, scan: Path) -> None:
    with service.client() as client:
        upload = client.upload(scan)
    headers = {"Authorization": f"Bearer {service.key}", "Idempotency-Key": "the same"}
    bodies = [{"upload_id": upload.id, "options": {"seed": seed}} for seed in (0, 0, 1)]
    answers = [httpx.post(f"{service.url}/v1/jobs", json=body, headers=headers) for body in bodies]
    assert [answer.status_code for answer in answers] == [201, 200, 422]
    assert answers[0].json()["id"] == answers[1].json()["id"]
    assert answers[2].json()["code"] == "idempotency_mismatch"


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 4 MiB."""
    folder = tmp_path / "small"
    folder.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=4m", "tmpfs", str(folder)], capture_output=True, text=True, check=False
    )
    if mounted.returncode != 0:
        pytest.skip(f"a small tmpfs cannot be mounted here: {mounted.stderr.strip()}")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


def test_a_disk_that_is_full_refuses_the_upload_and_keeps_the_service(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small_disk: Path, scan: Path
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    (scan / "color" / "large.bin").write_bytes(bytes(6 << 20))
    with live_service(tmp_path / "live", blobs=small_disk) as service:
        service.start_worker("quick")
        with Client(service.url, service.key, retries=0) as client:
            with pytest.raises(BusyError) as caught:
                client.upload(scan)
            assert caught.value.status == 507
            (scan / "color" / "large.bin").unlink()
            job = client.submit(scan)
            assert client.wait_for_job(job.id, timeout=30).state is JobState.succeeded
        left = sum(path.stat().st_size for path in small_disk.rglob("*") if path.is_file())
        assert left < 1 << 20, "pieces of the refused upload were kept"


def fill(disk: Path) -> Path:
    """A file that takes all the room there is."""
    ballast = disk / "ballast"
    with suppress(OSError), ballast.open("wb", buffering=0) as file:
        while shutil.disk_usage(disk).free:
            file.write(bytes(1 << 12))
    return ballast


def test_a_full_disk_of_a_worker_pauses_its_job_and_everybody_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small_disk: Path, scan: Path
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    with live_service(tmp_path / "live", settings={"ADVTEX_WORK_DIR": str(small_disk)}) as service:

        def workers() -> Any:
            return httpx.get(f"{service.url}/readyz").json()["checks"]["workers"]

        service.start_worker("quick")
        wait_until(lambda: workers()["ok"])
        ballast = fill(small_disk)
        with service.client() as client:
            job = client.submit(scan)
            wait_until(lambda: "disk" in client.get_job(job.id).waiting_reason)
            assert client.get_job(job.id).state is JobState.running
            assert not workers()["ok"]
            assert str(small_disk) in workers()["message"]
            doctor = subprocess.run(
                [sys.executable, "-m", "advtex_server.main", "doctor"],
                env=service.environment,
                capture_output=True,
                text=True,
                check=False,
            )
            assert str(small_disk) in doctor.stdout + doctor.stderr
            ballast.unlink()
            done = client.wait_for_job(job.id, timeout=30)
        assert (done.state, done.attempt, done.waiting_reason) == (JobState.succeeded, 1, "")
        assert workers()["ok"]


@pytest.mark.parametrize("engine", ["hangs", "hangs_alone"])
def test_a_cancel_is_over_two_seconds_after_its_post(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, scan: Path, engine: str
) -> None:
    """With the heartbeat and the grace period that workers have by default, in a stage that never ends."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    usual = {"ADVTEX_HEARTBEAT_SECONDS": "0.5", "ADVTEX_GRACE_SECONDS": "30"}
    with live_service(tmp_path / "live", settings=usual) as service, service.client() as client:
        service.start_worker(engine)
        job = client.submit(scan)
        wait_until(lambda: client.get_job(job.id).progress.stage)
        asked = time.monotonic()
        client.cancel_job(job.id)
        wait_until(lambda: client.get_job(job.id).state is JobState.canceled)
        assert time.monotonic() - asked < 2.0


def test_a_disk_that_fills_up_during_an_upload_keeps_nothing_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small_disk: Path, scan: Path
) -> None:
    """The announced size fits when the upload begins; something else takes the room meanwhile."""
    (scan / "color" / "large.bin").write_bytes(bytes(2 << 20))
    archive = write_zip(tmp_path / "scan.zip", scan)
    with live_service(tmp_path / "live", blobs=small_disk) as service:

        def body() -> Iterator[bytes]:
            data = archive.read_bytes()
            yield data[: 1 << 20]
            (small_disk / "ballast").write_bytes(bytes(2 << 20))
            yield data[1 << 20 :]

        headers = {"Authorization": f"Bearer {service.key}", "Content-Length": str(archive.stat().st_size)}
        answer = httpx.post(f"{service.url}/v1/uploads", content=body(), headers=headers)
        assert (answer.status_code, answer.json()["code"]) == (507, "insufficient_storage")
        (small_disk / "ballast").unlink()
        with service.client() as client:
            assert client.upload(archive).complete

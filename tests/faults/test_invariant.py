"""Accepted means never lost: 40 jobs of three owners, while all around them is killed, cut, filled or emptied."""

from __future__ import annotations

import os
import shutil
import subprocess
import threading
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest
from chaos import Chaos, check_outcome, insist
from live_fleet import Fleet, Place, fleet
from live_service import wait_until
from tiny_scan import write_zip

from advtex_contract.jobs import TERMINAL

JOBS, JOBS_OF_SOAK = 24, 40
OWNERS = ("ada", "bea", "cid")
SECONDS = 240.0  # after the last fault


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path | None]:
    """A file system of 64 MiB, None where none can be mounted: then no disk is filled."""
    folder = tmp_path / "disk"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=64m", "tmpfs", str(folder)]
    mounted = subprocess.run(command, capture_output=True, check=False).returncode == 0
    yield folder if mounted else None
    if mounted:
        subprocess.run(["umount", "-l", str(folder)], check=True)


@pytest.fixture
def machine(tmp_path: Path, small_disk: Path | None) -> Place:
    """SQLite, blobs, Redis's file and workspaces in one folder on a small disk."""
    return Place((small_disk or tmp_path) / "data", ballast=small_disk)


@pytest.fixture
def distributed(tmp_path: Path, small_disk: Path | None, postgres_url: str, s3_url: str) -> Place:
    """PostgreSQL and S3; spool and workspaces on a small disk."""
    s3 = {name: value for name, value in os.environ.items() if name.startswith("AWS_")}
    return Place((small_disk or tmp_path) / "data", postgres_url, s3_url, s3, ballast=small_disk)


def test_a_disk_can_be_filled_here(small_disk: Path | None) -> None:
    """So that a summary without a skip means that the schedules below had all their faults."""
    if small_disk is None:
        pytest.skip("a small tmpfs cannot be mounted here (it takes root): no schedule of faults fills a disk")
    assert shutil.disk_usage(small_disk).total == 64 << 20


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1])
def test_everything_breaks_on_one_machine(tmp_path: Path, scan: Path, machine: Place, seed: int) -> None:
    survive(tmp_path, scan, machine, seed, JOBS, until_finished=0)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2])
def test_everything_breaks_in_a_fleet(tmp_path: Path, scan: Path, distributed: Place, seed: int) -> None:
    survive(tmp_path, scan, distributed, seed, JOBS, until_finished=0)


@pytest.mark.slow
@pytest.mark.soak
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("seed", range(101, 111))
def test_everything_breaks_on_one_machine_again(tmp_path: Path, scan: Path, machine: Place, seed: int) -> None:
    survive(tmp_path, scan, machine, seed, JOBS_OF_SOAK, until_finished=30)


@pytest.mark.slow
@pytest.mark.soak
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("seed", range(201, 211))
def test_everything_breaks_in_a_fleet_again(tmp_path: Path, scan: Path, distributed: Place, seed: int) -> None:
    survive(tmp_path, scan, distributed, seed, JOBS_OF_SOAK, until_finished=30)


def survive(folder: Path, scan: Path, place: Place, seed: int, count: int, *, until_finished: int) -> None:
    """Faults come until `count` jobs are submitted, every kind of fault has come, and so many jobs have finished."""
    archive = write_zip(folder / "scan.zip", scan).read_bytes()
    with fleet(folder, place, servers=2, workers=3, engine="journaled") as running:
        keys = {owner: running.store.accounts.create_key(owner, owner=owner) for owner in OWNERS}
        chaos = Chaos(running, seed)
        began = time.monotonic()
        chaos.start()
        try:
            jobs, canceled = submit_all(running, keys, archive, seed, count)
            enough = count - until_finished
            wait_until(lambda: chaos.has_done_all and unfinished(running) <= enough, seconds=SECONDS)
        finally:
            chaos.stop()
        wait_until(lambda: unfinished(running) == 0, seconds=SECONDS)
        states = check_outcome(running, jobs, canceled)
    print(f"seed {seed}: {states} in {time.monotonic() - began:.0f} s after {dict(chaos.done)}")


def submit_all(
    running: Fleet, keys: Mapping[str, str], archive: bytes, seed: int, count: int
) -> tuple[dict[str, tuple[str, int, int]], set[str]]:
    """One upload and a third of the jobs per owner, at the same time. Some jobs are canceled on their way."""
    made: dict[str, tuple[str, int, int]] = {}
    canceled: set[str] = set()
    errors: list[BaseException] = []

    def submit(owner: str, key: str, numbers: range) -> None:
        try:
            upload = insist(running, key, "POST", "/v1/uploads", content=archive).json()["id"]
            for number in numbers:
                steps = 20 + (number * seed) % 50
                body = {"upload_id": upload, "options": {"seed": number, "steps": steps}, "priority": number % 3}
                headers = {"Idempotency-Key": f"{seed}-{number}"}
                answer = insist(running, key, "POST", "/v1/jobs", json=body, headers=headers)
                assert answer.status_code in (200, 201), answer.text
                made[answer.json()["id"]] = (owner, number, steps)
                if number % 9 == 4:
                    canceled.add(answer.json()["id"])
                    insist(running, key, "POST", f"/v1/jobs/{answer.json()['id']}/cancel")
        except BaseException as error:
            errors.append(error)

    threads = [
        threading.Thread(target=submit, args=(owner, keys[owner], range(n, count, len(OWNERS))))
        for n, owner in enumerate(OWNERS)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if errors:
        raise errors[0]
    assert len(made) == count
    return made, canceled


def unfinished(running: Fleet) -> int:
    counts = running.store.records.count_by_state()
    return sum(count for state, count in counts.items() if state not in TERMINAL)

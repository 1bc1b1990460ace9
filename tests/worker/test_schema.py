"""What a worker does when it starts on the database of another release."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest
from databases import give_revision
from live_service import wait_until
from redis import Redis

from advtex_store.database import migrate_database, upgrade_database
from advtex_store.queue import JobQueue
from advtex_store.schema import GENERATION_DIGITS, revisions
from advtex_worker.settings import WorkerSettings

NEWEST = revisions()[-1]


@contextmanager
def worker(settings: WorkerSettings, redis_url: str, log: Path) -> Iterator[subprocess.Popen[bytes]]:
    told = {
        "ADVTEX_DATA_DIR": str(settings.data_dir),
        "ADVTEX_DATABASE_URL": settings.database,
        "ADVTEX_BLOB_URL": settings.blobs,
        "ADVTEX_REDIS_URL": redis_url,
        "ADVTEX_DEVICE": "cpu",
    }
    with log.open("wb") as file:
        command = [sys.executable, "-m", "advtex_worker.main"]
        process = subprocess.Popen(command, env=os.environ | told, stdout=file, stderr=file)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def test_a_worker_that_is_newer_than_the_schema_waits_for_it(
    settings: WorkerSettings, redis_url: str, tmp_path: Path
) -> None:
    """Its release's servers bring the schema up to date; until then it is not offered any job."""
    migrate_database(settings.database, revisions()[0])
    log = tmp_path / "log"
    with worker(settings, redis_url, log), closing(Redis.from_url(redis_url)) as redis:
        queue = JobQueue(redis)
        wait_until(lambda: "worker takes no jobs yet" in log.read_text(), seconds=30)
        assert f"has schema {revisions()[0]} and this release needs {NEWEST}" in log.read_text()
        assert queue.workers() == []
        upgrade_database(settings.database)
        wait_until(queue.workers, seconds=30)


@pytest.mark.one_machine("both databases answer the same question")
def test_a_worker_goes_on_with_a_schema_that_a_newer_release_has_added_to(
    settings: WorkerSettings, redis_url: str, tmp_path: Path
) -> None:
    upgrade_database(settings.database)
    give_revision(settings.database, f"{NEWEST[:GENERATION_DIGITS]}99")
    with worker(settings, redis_url, tmp_path / "log"), closing(Redis.from_url(redis_url)) as redis:
        wait_until(JobQueue(redis).workers, seconds=30)


@pytest.mark.one_machine("both databases answer the same question")
def test_a_worker_refuses_a_schema_that_it_does_not_know_with_a_sentence(
    settings: WorkerSettings, redis_url: str, tmp_path: Path
) -> None:
    """Nothing that it could wait for would help: it ends."""
    upgrade_database(settings.database)
    give_revision(settings.database, "9901")
    log = tmp_path / "log"
    with worker(settings, redis_url, log) as process:
        assert process.wait(timeout=30) == 1
    told = log.read_text()
    assert "advtex-worker: the database has schema 9901, which this release does not know" in told
    assert "Traceback" not in told

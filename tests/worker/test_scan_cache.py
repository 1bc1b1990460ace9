"""Downloaded scans: fetched once for a machine, kept while they are used, and given up for room."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any

import pytest
from attempts import result
from live_service import wait_until

from advtex_contract.jobs import JobSpec, JobState
from advtex_contract.options import JobOptions
from advtex_store.blobs import Blobs
from advtex_store.errors import NoSpace
from advtex_store.store import Store
from advtex_worker import scan_cache
from advtex_worker.attempt import Attempt
from advtex_worker.scan_cache import ScanCache
from advtex_worker.settings import WorkerSettings
from advtex_worker.tasks import Host, run_attempt


class Source:
    """Where scans are downloaded from, which counts."""

    def __init__(self, data: bytes = b"a scan", seconds: float = 0.0) -> None:
        self.data, self.seconds, self.times = data, seconds, 0

    def __call__(self, file: IO[bytes]) -> None:
        self.times += 1
        file.write(self.data)
        time.sleep(self.seconds)


def nothing() -> None:
    """No reason to end."""


@pytest.fixture
def cache(tmp_path: Path) -> ScanCache:
    return ScanCache(tmp_path / "scans", 100)


def names(tmp_path: Path) -> set[str]:
    return {path.name for path in (tmp_path / "scans").iterdir()}


def test_a_scan_is_downloaded_once_for_all_that_want_it_at_a_time(cache: ScanCache, tmp_path: Path) -> None:
    source, read = Source(seconds=0.3), list[bytes]()

    def use() -> None:
        with ScanCache(tmp_path / "scans", 100).held("one.zip", source, nothing) as path:
            read.append(path.read_bytes())

    threads = [threading.Thread(target=use) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert read == [b"a scan"] * 6
    assert source.times == 1
    assert names(tmp_path) == {"one.zip"}
    with cache.held("one.zip", source, nothing) as path:
        assert not path.stat().st_mode & 0o222
    assert source.times == 1


def test_the_longest_unused_goes_for_room_and_what_is_used_stays(cache: ScanCache, tmp_path: Path) -> None:
    source = Source(bytes(40))
    with cache.held("used.zip", source, nothing) as used:
        for name in ("old.zip", "new.zip", "newest.zip"):
            with cache.held(name, source, nothing):
                time.sleep(0.01)
        assert names(tmp_path) == {"used.zip", "newest.zip"}
        cache.shrink(0)
        assert names(tmp_path) == {"used.zip"}
        assert used.read_bytes() == bytes(40)
    cache.shrink(0)
    assert names(tmp_path) == set()


def test_a_scan_that_nobody_used_for_a_day_goes(cache: ScanCache, tmp_path: Path) -> None:
    source = Source()
    for name in ("old.zip", "new.zip"):
        with cache.held(name, source, nothing):
            pass
    yesterday = time.time() - scan_cache.KEPT_SECONDS - 1
    os.utime(tmp_path / "scans" / "old.zip", (yesterday, yesterday))
    cache.shrink(100)
    assert names(tmp_path) == {"new.zip"}


def test_a_scan_larger_than_the_cache_is_there_while_it_is_used(cache: ScanCache, tmp_path: Path) -> None:
    with cache.held("large.zip", Source(bytes(200)), nothing) as path:
        assert path.stat().st_size == 200
    assert names(tmp_path) == set()


def test_a_download_that_fails_leaves_nothing_and_the_next_one_begins_anew(cache: ScanCache, tmp_path: Path) -> None:
    def fail(file: IO[bytes]) -> None:
        file.write(b"half of")
        raise NoSpace("the disk is full")

    with pytest.raises(NoSpace), cache.held("one.zip", fail, nothing):
        pass
    assert names(tmp_path) == set()
    with cache.held("one.zip", Source(), nothing) as path:
        assert path.read_bytes() == b"a scan"


HALF = """
import sys, time
from pathlib import Path
from advtex_worker.scan_cache import ScanCache
def fill(file):
    file.write(b"half of a much longer scan")
    file.flush()
    time.sleep(600)
with ScanCache(Path(sys.argv[1]), 100).held("one.zip", fill, lambda: None):
    pass
"""


@pytest.fixture
def downloading(cache: ScanCache, tmp_path: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A process in the middle of a download."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen([sys.executable, "-c", HALF, str(tmp_path / "scans")], env=environment) as process:
        part = tmp_path / "scans" / "one.zip.part"
        try:
            wait_until(lambda: part.exists() and part.stat().st_size > 0, 30)
            yield process
        finally:
            process.kill()


def test_who_waits_for_a_download_goes_on_with_it_when_its_process_dies(
    cache: ScanCache, tmp_path: Path, downloading: subprocess.Popen[bytes]
) -> None:
    source, asked = Source(), list[int]()

    def check() -> None:
        asked.append(1)
        if len(asked) == 2:
            assert source.times == 0
            downloading.send_signal(signal.SIGKILL)

    with cache.held("one.zip", source, check) as path:
        assert path.read_bytes() == b"a scan"
    assert len(asked) >= 2
    assert names(tmp_path) == {"one.zip"}


def test_a_wait_can_be_ended_and_room_is_not_made_of_a_download(
    cache: ScanCache, tmp_path: Path, downloading: subprocess.Popen[bytes]
) -> None:
    def check() -> None:
        raise InterruptedError

    with pytest.raises(InterruptedError), cache.held("one.zip", Source(), check):
        pass
    cache.shrink(0)
    assert names(tmp_path) == {"one.zip.part"}
    downloading.kill()
    downloading.wait()
    cache.shrink(0)
    assert names(tmp_path) == set()


@pytest.fixture
def downloads(monkeypatch: pytest.MonkeyPatch, store: Store) -> list[str]:
    """The keys of the scans that attempts have read from the storage."""
    told, stream = list[str](), type(store.blobs).stream

    def noted(self: Blobs, key: str, *arguments: Any) -> Iterator[bytes]:
        if key.startswith("scans/"):
            told.append(key)
        return stream(self, key, *arguments)

    monkeypatch.setattr(type(store.blobs), "stream", noted)
    return told


def same_scan(store: Store, job_id: str, seed: int) -> str:
    from checked import queued_job

    upload_id = store.records.job(job_id).upload_id
    return queued_job(store, "owner", JobSpec(upload_id=upload_id, options=JobOptions(seed=seed)))


def test_jobs_on_one_scan_download_it_once_from_object_storage(
    store: Store,
    settings: WorkerSettings,
    host: Callable[[str], Host],
    new_job: Callable[..., str],
    downloads: list[str],
) -> None:
    first = new_job(seed=1)
    second = same_scan(store, first, 2)
    for job in (first, second):
        run_attempt(host("quick"), job, 1)
        assert store.records.job(job).state == JobState.succeeded
    assert "seed 2" in result(store, second)
    far = settings.blobs.startswith("s3")
    assert len(downloads) == (1 if far else 2), "a folder is near enough"
    assert list(settings.workspaces.iterdir()) == []
    if far:
        assert [path.name for path in settings.scan_cache.iterdir()] == [store.records.job(first).upload_id + ".zip"]
    else:
        assert not settings.scan_cache.exists()


@pytest.mark.one_machine("how engines end, wherever rows and blobs are")
def test_a_full_disk_takes_the_room_of_scans_that_nobody_uses(
    store: Store, settings: WorkerSettings, new_job: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("advtex_worker.patience.RETRY_SECONDS", 0.5)
    given = Host(settings.model_copy(update={"cache_bytes": 1000}), engine="fake_engines:quick")
    run_attempt(given, new_job(), 1)
    assert len(list(settings.scan_cache.iterdir())) == 1
    download, left = Attempt._download, list[int]()

    def full(self: Attempt, file: IO[bytes]) -> None:
        left.append(len([path for path in settings.scan_cache.iterdir() if path.suffix == ".zip"]))
        if len(left) == 1:
            raise NoSpace("the disk is full")
        download(self, file)

    monkeypatch.setattr(Attempt, "_download", full)
    job = new_job()
    run_attempt(given, job, 1)
    assert left == [1, 0]
    assert store.records.job(job).state == JobState.succeeded


def test_another_process_leaves_what_is_used(cache: ScanCache, tmp_path: Path) -> None:
    with cache.held("one.zip", Source(), nothing):
        child = os.fork()
        if child == 0:
            ScanCache(tmp_path / "scans", 0).shrink(0)
            os._exit(len(names(tmp_path)))
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 1
    cache.shrink(0)
    assert names(tmp_path) == set()

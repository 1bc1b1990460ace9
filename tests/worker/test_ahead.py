"""Scans of waiting attempts, downloaded ahead: nothing is taken, no scan comes twice, and who has it takes it first."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from live_service import wait_until

from advtex_store import keys
from advtex_store.database import upgrade_database
from advtex_store.queue import PASSES, rq_id
from advtex_store.store import Store, open_store
from advtex_worker.ahead import Ahead
from advtex_worker.scan_cache import ScanCache
from advtex_worker.settings import WorkerSettings

GIB = 8
pytestmark = pytest.mark.one_machine("both databases answer the same question")


@pytest.fixture
def store(settings: WorkerSettings, redis_url: str) -> Iterator[Store]:
    upgrade_database(settings.database)
    opened = open_store(settings.model_copy(update={"redis_url": redis_url}))
    yield opened
    opened.close()


@pytest.fixture
def waiting(store: Store, new_job: Callable[..., str]) -> list[str]:
    """Three attempts in the queue, each on a scan of its own."""
    jobs = [new_job(seed=seed) for seed in range(3)]
    assert all(store.queue.offer(job, 1, GIB) for job in jobs)
    return [rq_id(job, 1) for job in jobs]


@pytest.fixture
def machine(store: Store, tmp_path: Path) -> Callable[..., Ahead]:
    def make(host: str, limit: int = 1000) -> Ahead:
        ahead = Ahead(store, ScanCache(tmp_path / host, limit), GIB)
        ahead._host = host
        return ahead

    return make


def scans(folder: Path) -> int:
    return len(list(folder.glob("*.zip"))) if folder.exists() else 0


def test_each_machine_has_one_scan_ahead_and_takes_its_attempt_first(
    store: Store, waiting: list[str], machine: Callable[..., Ahead], tmp_path: Path
) -> None:
    one, two = machine("one"), machine("two")
    for _ in range(3):
        one.look()
        two.look()
    assert (scans(tmp_path / "one"), scans(tmp_path / "two")) == (1, 1)
    assert store.queue.waiting_ids(GIB) == waiting, "they wait as they did"
    assert all(store.records.job(name[:-2]).state == "queued" for name in waiting)
    store.queue.prefer_near("two", GIB)
    assert store.queue.waiting_ids(GIB) == [waiting[1], waiting[0], waiting[2]]
    store.queue.prefer_near("one", GIB)
    assert store.queue.waiting_ids(GIB) == waiting
    store.queue.take_back(GIB, 3)
    store.queue.prefer_near("one", GIB)
    assert store.queue.waiting_ids(GIB) == [], "what somebody took does not come back"


def test_when_its_attempt_is_taken_the_next_scan_comes(
    store: Store, waiting: list[str], machine: Callable[..., Ahead], tmp_path: Path
) -> None:
    one = machine("one")
    one.look()
    store.queue.redis.lpop(f"rq:queue:advtex-{GIB}")
    one.look()
    assert scans(tmp_path / "one") == 2


def test_nothing_is_passed_over_for_ever(store: Store, waiting: list[str]) -> None:
    first, *others = waiting
    store.queue.tell_near("one", others)
    for _ in range(PASSES):
        store.queue.prefer_near("one", GIB)
        assert store.queue.waiting_ids(GIB)[0] != first
        store.queue.redis.lrem(f"rq:queue:advtex-{GIB}", 1, first)
        store.queue.redis.lpush(f"rq:queue:advtex-{GIB}", first)
    store.queue.prefer_near("one", GIB)
    assert store.queue.waiting_ids(GIB)[0] == first


def test_what_does_not_fit_the_cache_or_the_disk_is_not_downloaded(
    waiting: list[str], machine: Callable[..., Ahead], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine("small", 3).look()
    assert scans(tmp_path / "small") == 0
    monkeypatch.setattr(ScanCache, "free_bytes", lambda _: 10)
    machine("full").look()
    assert scans(tmp_path / "full") == 0


def test_a_scan_that_is_gone_or_a_redis_that_is_away_ends_nothing(
    store: Store, waiting: list[str], machine: Callable[..., Ahead], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("advtex_worker.ahead.LOOK_SECONDS", 0.01)
    looks = list[int]()
    look = Ahead.look

    def counted(self: Ahead) -> None:
        looks.append(1)
        look(self)

    monkeypatch.setattr(Ahead, "look", counted)
    for name in waiting:
        store.blobs.delete(keys.scan_key(store.records.job(name[:-2]).upload_id))
    ahead = machine("one")
    ahead.start()
    try:
        wait_until(lambda: len(looks) >= 5)
        assert ahead._thread.is_alive()
    finally:
        ahead.stop()


def test_the_end_of_the_attempt_ends_a_download(
    store: Store, waiting: list[str], machine: Callable[..., Ahead], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("advtex_worker.ahead.LOOK_SECONDS", 0.01)
    ahead, begun = machine("one"), list[int]()

    def endless(*_: Any) -> Iterator[bytes]:
        while True:
            begun.append(1)
            yield b"."

    monkeypatch.setattr(type(store.blobs), "stream", endless)
    ahead.start()
    try:
        wait_until(lambda: begun)
    finally:
        ahead.stop()
    assert list((tmp_path / "one").iterdir()) == []

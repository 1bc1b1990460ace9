"""Waiting rows reach Redis, whatever happens to Redis, to leases and to other servers."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import redis

from advtex_contract.jobs import JobSpec
from advtex_server.dispatch import Dispatcher
from advtex_server.settings import ServerSettings
from advtex_store import keys
from advtex_store.database import upgrade_database
from advtex_store.store import Store, open_store


@pytest.fixture
def store(database_url: str, redis_url: str, tmp_path: Path) -> Any:
    opened = open_store(ServerSettings(database_url=database_url, redis_url=redis_url, data_dir=tmp_path))
    yield opened
    opened.close()


def settings(store: Store, **values: Any) -> ServerSettings:
    assert isinstance(store.settings, ServerSettings)
    return store.settings.model_copy(update=values)


def submit(store: Store) -> str:
    upload = store.uploads.create("me", 3)
    store.uploads.finish(upload.id, "ab" * 32)
    return store.submissions.create_job("me", JobSpec(upload_id=upload.id)).id


def in_redis(store: Store) -> list[str]:
    return list(store.queue.rq.job_ids)


def test_rows_are_offered_once_oldest_first(store: Store) -> None:
    jobs = [submit(store) for _ in range(3)]
    dispatcher = Dispatcher(store, settings(store))
    assert dispatcher.dispatch() == 3
    assert dispatcher.dispatch() == 0
    assert in_redis(store) == [f"{job}-1" for job in jobs]


def test_redis_stays_shallow(store: Store) -> None:
    jobs = [submit(store) for _ in range(5)]
    dispatcher = Dispatcher(store, settings(store, queue_depth=2))
    dispatcher.dispatch()
    assert in_redis(store) == [f"{job}-1" for job in jobs[:2]]
    store.records.claim(jobs[0], 1, "w")
    dispatcher.dispatch()
    assert in_redis(store)[-1] == f"{jobs[2]}-1"


def test_many_servers_dispatch_at_once(store: Store) -> None:
    jobs = [submit(store) for _ in range(8)]
    dispatchers = [Dispatcher(store, settings(store)) for _ in range(4)]
    threads = [threading.Thread(target=d.dispatch) for d in dispatchers]
    threads += [threading.Thread(target=d.reconcile) for d in dispatchers]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(in_redis(store)) == [f"{job}-1" for job in jobs]


def test_an_emptied_redis_costs_nothing(store: Store) -> None:
    job = submit(store)
    dispatcher = Dispatcher(store, settings(store))
    dispatcher.dispatch()
    store.queue.redis.flushall()
    dispatcher.dispatch()
    assert in_redis(store) == [f"{job}-1"]


def test_a_preempted_job_is_next(store: Store) -> None:
    first, second = submit(store), submit(store)
    dispatcher = Dispatcher(store, settings(store))
    dispatcher.dispatch()
    store.records.claim(second, 1, "w")
    store.records.preempt(second, 1)
    dispatcher.dispatch()
    assert in_redis(store)[:2] == [f"{second}-2", f"{first}-1"]


def test_an_expired_lease_becomes_the_next_attempt(store: Store) -> None:
    job = submit(store)
    dispatcher = Dispatcher(store, settings(store))
    store.records.claim(job, 1, "w", lease_seconds=-1)
    dispatcher.reconcile()
    dispatcher.dispatch()
    assert in_redis(store) == [f"{job}-2"]


@pytest.mark.parametrize("state", ["running", "queued"])
def test_a_finished_result_is_adopted(store: Store, state: str) -> None:
    job = submit(store)
    store.records.claim(job, 1, "w", lease_seconds=-1)
    if state == "queued":
        store.records.lost(job, 1)
    store.blobs.put(keys.result_manifest_key(job), b'{"attempt": 1, "files": []}')
    Dispatcher(store, settings(store)).reconcile()
    assert store.records.job(job).state == "succeeded"


def test_nothing_ends_the_loop(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    """Errors that are expected, and ones that are not, cost one round each."""
    dispatcher = Dispatcher(store, settings(store, dispatch_seconds=0.01))
    rounds: list[int] = []
    errors = [redis.ConnectionError("away"), OSError("disk"), ZeroDivisionError("a flaw")]

    def dispatch() -> int:
        rounds.append(len(rounds))
        if len(rounds) <= len(errors):
            raise errors[len(rounds) - 1]
        return 0

    monkeypatch.setattr(dispatcher, "dispatch", dispatch)

    async def run() -> None:
        task = asyncio.create_task(dispatcher.run())
        while len(rounds) < 5:
            await asyncio.sleep(0.01)
        task.cancel()

    asyncio.run(asyncio.wait_for(run(), 10))


def test_jobs_are_accepted_while_redis_is_away_and_start_when_it_is_back(
    make_live: Callable[..., Any], own_redis: Any, scan_zip: Path
) -> None:
    live = make_live(redis_url=own_redis.url)
    pause = threading.Event()

    def until(condition: Callable[[], object]) -> None:
        for _ in range(500):
            if condition():
                return
            pause.wait(0.02)
        pytest.fail("not in time")

    upload = live.upload(scan_zip.read_bytes())
    first = live.job(upload)["id"]
    until(lambda: in_redis(live.store) == [f"{first}-1"])
    own_redis.stop()
    second = live.job(upload)["id"]
    assert live.http.get("/readyz").json()["checks"]["redis"]["ok"] is False
    own_redis.start()  # empty: what was in it is gone
    until(lambda: in_redis(live.store) == [f"{first}-1", f"{second}-1"])


def test_the_whole_api_on_postgresql(
    make_live: Callable[..., Any], postgres_url: str, redis_url: str, scan_zip: Path, tmp_path: Path
) -> None:
    upgrade_database(postgres_url.replace("postgresql:", "postgresql+psycopg:"))
    live = make_live(database_url=postgres_url, redis_url=redis_url)
    (tmp_path / "a.glb").write_bytes(b"glb")
    job = live.finished_job(scan_zip, {"a.glb": tmp_path / "a.glb"})
    assert live.http.get(f"/v1/jobs/{job}/results/a.glb").content == b"glb"
    assert '"succeeded"' in live.http.get(f"/v1/jobs/{job}/events").text
    assert live.http.delete(f"/v1/jobs/{job}").status_code == 204

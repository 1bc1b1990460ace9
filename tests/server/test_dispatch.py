"""Waiting rows reach Redis, whatever happens to Redis, to leases and to other servers."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import redis
from checked import queued_job

from advtex_contract.jobs import JobSpec
from advtex_server.dispatch import Dispatcher
from advtex_server.service import job_view
from advtex_server.settings import ServerSettings
from advtex_server.waiting import IN_LINE
from advtex_store import keys, queue
from advtex_store.queue import PRESENCE, queue_name
from advtex_store.store import Store, open_store

GIB = 8  # the class of the workers that there are unless a test says otherwise


@pytest.fixture
def store(database_url: str, redis_url: str, tmp_path: Path) -> Any:
    opened = open_store(ServerSettings(database_url=database_url, redis_url=redis_url, data_dir=tmp_path))
    for number in range(8):
        opened.queue.announce(f"worker-{number}", GIB)
    yield opened
    opened.close()


def settings(store: Store, **values: Any) -> ServerSettings:
    assert isinstance(store.settings, ServerSettings)
    return store.settings.model_copy(update=values)


def submit(store: Store, owner: str = "me", *, gib: int = 0, priority: int = 0, batch: str | None = None) -> str:
    upload = store.uploads.create(owner, 3)
    store.uploads.finish(upload.id, "ab" * 32)
    spec = JobSpec(upload_id=upload.id, priority=priority, batch=batch)
    return queued_job(store, owner, spec, gib << 30)


def only_workers(store: Store, *classes: int) -> None:
    """These and no others."""
    for key in store.queue.redis.keys(PRESENCE + "*"):
        store.queue.redis.delete(key)
    for number, gib in enumerate(classes):
        store.queue.announce(f"only-{number}", gib)


def in_redis(store: Store, gib: int = GIB) -> list[str]:
    return store.queue.waiting_ids(gib)


def reason(store: Store, job: str) -> str:
    return job_view(store.records.job(job)).waiting_reason


def test_rows_are_offered_once_oldest_first(store: Store) -> None:
    jobs = [submit(store) for _ in range(3)]
    dispatcher = Dispatcher(store, settings(store))
    assert dispatcher.dispatch() == 3
    assert dispatcher.dispatch() == 0
    assert in_redis(store) == [f"{job}-1" for job in jobs]


def test_redis_stays_shallow(store: Store) -> None:
    jobs = [submit(store) for _ in range(5)]
    only_workers(store, GIB, GIB)
    dispatcher = Dispatcher(store, settings(store))
    dispatcher.dispatch()
    assert in_redis(store) == [f"{job}-1" for job in jobs[:2]]
    store.queue.redis.lpop(f"rq:queue:{queue_name(GIB)}")
    store.records.claim(jobs[0], 1, "w")
    dispatcher.dispatch()
    assert in_redis(store) == [f"{job}-1" for job in jobs[1:3]]


def test_many_servers_dispatch_at_once(store: Store) -> None:
    jobs = [submit(store) for _ in range(8)]
    only_workers(store, *[GIB] * 20)
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
    only_workers(store, GIB)
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


def test_a_preempted_job_is_next_even_if_no_place_is_free(store: Store) -> None:
    only_workers(store, GIB)
    first, second = submit(store), submit(store)
    store.records.claim(second, 1, "w")
    dispatcher = Dispatcher(store, settings(store))
    dispatcher.dispatch()
    store.records.preempt(second, 1)
    dispatcher.dispatch()
    assert in_redis(store) == [f"{second}-2", f"{first}-1"]


def test_no_job_waits_behind_a_busy_worker_while_another_is_idle(store: Store) -> None:
    only_workers(store, GIB, 2 * GIB)
    store.queue.announce("only-0", GIB, busy=True)
    jobs = [submit(store, gib=1) for _ in range(3)]
    Dispatcher(store, settings(store)).dispatch()
    assert in_redis(store, 2 * GIB) == [f"{jobs[0]}-1"]
    assert in_redis(store) == [f"{jobs[1]}-1"], "one may wait"


def test_what_waits_behind_a_busy_worker_goes_to_a_larger_one_that_becomes_idle(store: Store) -> None:
    only_workers(store)
    for name, gib in (("small", 8), ("large", 24)):
        store.queue.announce(name, gib, busy=True)
    jobs = [submit(store, gib=2) for _ in range(2)]
    dispatcher = Dispatcher(store, settings(store))
    dispatcher.dispatch()
    assert (in_redis(store, 8), in_redis(store, 24)) == ([f"{jobs[0]}-1"], [f"{jobs[1]}-1"])
    store.queue.redis.lpop(f"rq:queue:{queue_name(24)}")
    store.records.claim(jobs[1], 1, "large")
    store.queue.announce("large", 24)
    dispatcher.dispatch()
    assert (in_redis(store, 8), in_redis(store, 24)) == ([], [f"{jobs[0]}-1"])
    assert store.records.job(jobs[0]).attempt == 1


def test_preempted_jobs_spread_over_all_workers(store: Store) -> None:
    only_workers(store, GIB, GIB, 2 * GIB)
    jobs = [submit(store, gib=1) for _ in range(3)]
    for job in jobs:
        store.records.claim(job, 1, "w")
        store.records.preempt(job, 1)
    Dispatcher(store, settings(store)).dispatch()
    assert (len(in_redis(store)), len(in_redis(store, 2 * GIB))) == (2, 1)


def test_owners_take_turns_and_their_priorities_are_their_own(store: Store) -> None:
    many = [submit(store, "many", priority=priority) for priority in (0, 0, 5, 100)]
    few = [submit(store, "few") for _ in range(2)]
    Dispatcher(store, settings(store)).dispatch()
    expected = [many[3], few[0], many[2], few[1], many[0], many[1]]
    assert in_redis(store) == [f"{job}-1" for job in expected]


def test_who_has_jobs_running_waits_for_those_who_have_none(store: Store) -> None:
    only_workers(store, GIB, GIB)
    running = [submit(store, "many") for _ in range(3)]
    for job in running:
        store.records.claim(job, 1, "w")
    waits, newcomer = submit(store, "many"), submit(store, "new")
    Dispatcher(store, settings(store)).dispatch()
    assert in_redis(store) == [f"{newcomer}-1", f"{waits}-1"]


def test_a_job_goes_to_the_smallest_worker_that_it_fits(store: Store) -> None:
    only_workers(store, 8, 24)
    large, small, other = submit(store, gib=20), submit(store, gib=2), submit(store, gib=8)
    Dispatcher(store, settings(store)).dispatch()
    assert in_redis(store, 8) == [f"{small}-1"]
    assert in_redis(store, 24) == [f"{large}-1"]
    assert reason(store, other) == IN_LINE


def test_large_workers_take_small_jobs_when_nothing_else_waits(store: Store) -> None:
    only_workers(store, 8, 24)
    jobs = [submit(store, gib=2) for _ in range(2)]
    Dispatcher(store, settings(store)).dispatch()
    assert (in_redis(store, 8), in_redis(store, 24)) == ([f"{jobs[0]}-1"], [f"{jobs[1]}-1"])


def test_what_fits_nowhere_waits_with_a_reason_and_holds_up_nobody(store: Store) -> None:
    only_workers(store, 8)
    huge, small = submit(store, gib=30), submit(store, gib=2)
    dispatcher = Dispatcher(store, settings(store))
    dispatcher.dispatch()
    assert in_redis(store, 8) == [f"{small}-1"]
    assert "more memory than the 8 GiB of the largest worker" in reason(store, huge)
    version = store.records.job(huge).version
    dispatcher.dispatch()
    assert store.records.job(huge).version == version, "the same reason is no news"
    only_workers(store, 8, 32)
    dispatcher.dispatch()
    assert in_redis(store, 32) == [f"{huge}-1"]
    assert reason(store, huge) == IN_LINE
    store.records.claim(huge, 1, "w")
    assert reason(store, huge) == ""


def test_without_workers_nothing_is_offered_and_what_was_is_taken_back(store: Store) -> None:
    job = submit(store)
    dispatcher = Dispatcher(store, settings(store))
    dispatcher.dispatch()
    only_workers(store)
    assert dispatcher.dispatch() == 0
    assert in_redis(store) == []
    assert "no worker is running" in reason(store, job)
    only_workers(store, 16)
    assert dispatcher.dispatch() == 1


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


@pytest.mark.one_machine("the queue is the same")
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

    only_workers(live.store, GIB, GIB)
    upload = live.upload(scan_zip.read_bytes())
    first = live.job(upload)["id"]
    until(lambda: in_redis(live.store) == [f"{first}-1"])
    own_redis.stop()
    second = live.job(upload)["id"]
    assert live.http.get("/readyz").json()["checks"]["redis"]["ok"] is False
    until(lambda: "Redis" in live.http.get(f"/v1/jobs/{second}").json()["waiting_reason"])
    own_redis.start()  # empty: what was in it is gone
    only_workers(live.store, GIB, GIB)
    until(lambda: in_redis(live.store) == [f"{first}-1", f"{second}-1"])


def test_what_a_worker_declined_keeps_nobody_waiting(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    only_workers(store, GIB)
    declined, others = [submit(store) for _ in range(12)], [submit(store) for _ in range(2)]
    for job in declined:
        store.queue.decline(job, 1)
    dispatcher = Dispatcher(store, settings(store))
    dispatcher.dispatch()
    assert in_redis(store) == [f"{others[0]}-1"]
    store.queue.redis.lpop(f"rq:queue:{queue_name(GIB)}")
    store.records.claim(others[0], 1, "w")
    now = time.time()
    monkeypatch.setattr(queue.time, "time", lambda: now + queue.DECLINED_SECONDS + 1)
    dispatcher.dispatch()
    assert in_redis(store) == [f"{declined[0]}-1"]


def test_what_was_offered_of_a_batch_comes_back_when_it_is_paused(store: Store) -> None:
    """And other jobs take the places; after a restart too, as it is in the rows."""
    night = [submit(store, batch="night") for _ in range(3)]
    other = submit(store)
    only_workers(store, GIB, GIB)
    Dispatcher(store, settings(store)).dispatch()
    assert in_redis(store) == [f"{job}-1" for job in night[:1]] + [f"{other}-1"]
    store.batches.pause("me", "night", True)
    Dispatcher(store, settings(store)).dispatch()
    assert in_redis(store) == [f"{other}-1"]
    store.batches.pause("me", "night", False)
    Dispatcher(store, settings(store)).dispatch()
    assert in_redis(store) == [f"{other}-1", f"{night[0]}-1"]


@pytest.mark.parametrize("limited", ["batch", "owner"])
def test_no_more_jobs_are_on_their_way_than_may_run(store: Store, limited: str) -> None:
    """Also where each class of workers would begin with another one, and one more urgent comes later."""
    if limited == "batch":
        store.batches.limit("me", "night", 2)
    else:
        store.accounts.create_key(owner="me", max_running_jobs=2)
    only_workers(store, GIB, GIB, GIB, 3 * GIB, 3 * GIB)
    submit(store, gib=2 * GIB, batch="night")
    small = [submit(store, batch="night") for _ in range(4)]
    theirs = submit(store, "somebody else", batch="night")
    dispatcher = Dispatcher(store, settings(store))

    def on_their_way() -> list[str]:
        names = in_redis(store) + in_redis(store, 3 * GIB)
        return [name.rpartition("-")[0] for name in names if name != f"{theirs}-1"]

    dispatcher.dispatch()
    assert on_their_way() == small[:2]
    submit(store, priority=50, gib=2 * GIB, batch="night")
    dispatcher.dispatch()
    assert on_their_way() == small[:2]
    assert f"{theirs}-1" in in_redis(store), "others are not held up"
    store.queue.redis.lrem(f"rq:queue:{queue_name(GIB)}", 1, f"{small[0]}-1")
    store.records.claim(small[0], 1, "w")
    dispatcher.dispatch()
    assert on_their_way() == small[1:2]
    store.records.succeed(small[0], 1, [])
    dispatcher.dispatch()
    assert len(on_their_way()) == 2

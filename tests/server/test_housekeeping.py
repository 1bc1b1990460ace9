"""One job or upload that cannot be put right stops no other; it is told of, and set aside in the end."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from checked import queued_job
from prometheus_client import CollectorRegistry, generate_latest

from advtex_contract.jobs import JobSpec
from advtex_server.dispatch import Dispatcher
from advtex_server.health import checks
from advtex_server.metrics import FleetCollector
from advtex_server.settings import ServerSettings
from advtex_store import keys
from advtex_store.blobs import FolderBlobs
from advtex_store.consistency import disagreements
from advtex_store.errors import BlobsUnavailable
from advtex_store.models import JobRow
from advtex_store.retention import ORPHAN_SECONDS
from advtex_store.store import Store, open_store
from advtex_store.troubles import ASIDE_SECONDS, ROUNDS

LEASE = 60.0
UNREADABLE = b'{"attempt": 1}'


@pytest.fixture
def world(database_url: str, redis_url: str, tmp_path: Path) -> Iterator[tuple[Store, Dispatcher, list[float]]]:
    """A store, a dispatcher, and the clock of both."""
    settings = ServerSettings(database_url=database_url, redis_url=redis_url, data_dir=tmp_path)
    store = open_store(settings)
    clock = [1_700_000_000.0]
    store.database._clock = lambda: clock[0]
    yield store, Dispatcher(store, settings), clock
    store.close()


def submit(store: Store) -> str:
    upload = store.uploads.create("me", 3)
    store.blobs.put(keys.scan_key(upload.id), b"abc")
    store.uploads.finish(upload.id, "ab" * 32)
    return queued_job(store, "me", JobSpec(upload_id=upload.id))


def told(store: Store, settings: ServerSettings) -> str:
    (check,) = [check for check in checks(store, settings) if check.name == "housekeeping"]
    assert check.ok is (check.message == "")
    assert not check.essential
    return check.message


def metric(store: Store, task: str, aside: str) -> float:
    registry = CollectorRegistry()
    registry.register(FleetCollector(store))
    name = f'advtex_housekeeping_troubles{{set_aside="{aside}",task="{task}"}}'
    lines = [line for line in generate_latest(registry).decode().splitlines() if line.startswith(name)]
    return float(lines[0].split()[-1]) if lines else 0.0


def test_an_unreadable_result_keeps_no_other_job_from_its_next_attempt(world: Any) -> None:
    store, dispatcher, clock = world
    bad, good = submit(store), submit(store)
    for job in (bad, good):
        store.records.claim(job, 1, "w", lease_seconds=LEASE)
    store.blobs.put(keys.result_manifest_key(bad), UNREADABLE)
    clock[0] += LEASE + 1
    dispatcher.reconcile()
    assert store.records.job(good).state == "queued"
    assert f"adopt {bad} failed 1 times: ResultsUnreadable" in told(store, dispatcher.settings)
    assert metric(store, "adopt", "no") == 1
    for _ in range(ROUNDS - 2):
        dispatcher.reconcile()
    assert store.records.job(bad).state == "running", "it may be readable again the next time"

    dispatcher.reconcile()
    row = store.records.job(bad)
    assert row.state == "failed"
    assert row.error is not None
    assert row.error["code"] == "results_lost"
    assert "retry the job" in row.error["message"]
    assert store.troubles.all() == []
    assert told(store, dispatcher.settings) == ""
    store.records.retry(bad)
    assert not store.results.adopt(bad), "the next attempt makes them again"


def test_a_result_that_only_the_storage_keeps_back_is_adopted_by_a_retry(
    world: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, dispatcher, clock = world
    job = submit(store)
    store.records.claim(job, 1, "w", lease_seconds=LEASE)
    store.blobs.put(keys.result_manifest_key(job), b'{"attempt": 1, "files": []}')
    clock[0] += LEASE + 1
    with monkeypatch.context() as context:
        context.setattr(FolderBlobs, "get", lambda *_: (_ for _ in ()).throw(OSError(5, "Input/output error")))
        for _ in range(ROUNDS):
            dispatcher.reconcile()
    row = store.records.job(job)
    assert row.error is not None
    assert (row.state, row.error["code"]) == ("failed", "storage_refused")
    store.records.retry(job)
    assert store.results.adopt(job)


def test_doctor_ends_such_a_job_at_once(world: Any) -> None:
    store, _, clock = world
    job = submit(store)
    store.records.claim(job, 1, "w", lease_seconds=LEASE)
    store.blobs.put(keys.result_manifest_key(job), UNREADABLE)
    clock[0] += LEASE + 1
    (found,) = [one for one in disagreements(store) if one.kind == "leases"]
    assert found.mend is not None
    assert found.mend().startswith("failed: the list of the job's results is damaged")
    assert store.records.job(job).state == "failed"


def test_an_unreadable_result_of_a_waiting_job_does_so_neither(world: Any) -> None:
    store, dispatcher, clock = world
    bad, good = submit(store), submit(store)
    for job in (bad, good):
        store.records.claim(job, 1, "w", lease_seconds=LEASE)
        clock[0] += LEASE + 1
        store.records.lost(job, 1)
    store.blobs.put(keys.result_manifest_key(bad), UNREADABLE)
    store.blobs.put(keys.result_manifest_key(good), b'{"attempt": 1, "files": []}')
    for _ in range(ROUNDS + 3):
        dispatcher.reconcile()
    assert store.records.job(good).state == "succeeded"
    assert store.records.job(bad).state == "queued"
    (row,) = store.troubles.all()
    assert (row.item, row.rounds) == (bad, ROUNDS)


@pytest.fixture
def guarded(monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """Ids whose blobs nobody may delete."""
    ids = set[str]()
    delete = FolderBlobs.delete

    def refused(self: FolderBlobs, key: str) -> None:
        if any(one in key for one in ids):
            raise PermissionError(13, "Permission denied", key)
        delete(self, key)

    monkeypatch.setattr(FolderBlobs, "delete", refused)
    return ids


def purged(store: Store, job: str) -> bool:
    with store.database.read() as session:
        row = session.get(JobRow, job)
        assert row is not None
        return row.purged_at is not None


def test_blobs_that_cannot_be_deleted_keep_no_others(world: Any, guarded: set[str]) -> None:
    store, dispatcher, clock = world
    bad, good = submit(store), submit(store)
    for job in (bad, good):
        store.blobs.put(keys.checkpoints_prefix(job) + "1", b"x")
        store.records.cancel(job)
        store.records.delete(job)
    guarded.add(bad)
    for _ in range(ROUNDS + 3):
        dispatcher.reconcile()
    assert (purged(store, bad), purged(store, good)) == (False, True)
    assert f"purge {bad} failed {ROUNDS} times and is set aside" in told(store, dispatcher.settings)
    assert "Permission denied" in told(store, dispatcher.settings)
    guarded.clear()
    clock[0] += ASIDE_SECONDS + 1
    dispatcher.reconcile()
    assert purged(store, bad)
    assert store.troubles.all() == []


def test_orphans_are_swept_past_one_that_cannot_be(world: Any, guarded: set[str]) -> None:
    store, dispatcher, clock = world
    orphans = [submit(store) for _ in range(3)]
    with store.database.write() as session:
        for orphan in orphans:
            session.delete(session.get(JobRow, orphan))
    for orphan in orphans:
        store.blobs.put(keys.checkpoints_prefix(orphan) + "1", b"x")
    clock[0] += ORPHAN_SECONDS
    guarded.add(orphans[1])
    assert dispatcher.retention.sweep() == 2
    assert [row.item for row in store.troubles.all()] == [orphans[1]]


def test_a_storage_that_is_away_is_nobodys_own_trouble(world: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Hours of it set nothing aside."""
    store, dispatcher, _clock = world
    job = submit(store)
    store.records.cancel(job)
    store.records.delete(job)

    def away(self: FolderBlobs, *_: object) -> None:
        raise BlobsUnavailable("away")

    monkeypatch.setattr(FolderBlobs, "check", away)
    monkeypatch.setattr(FolderBlobs, "delete_prefix", away)
    for _ in range(ROUNDS + 1):
        with pytest.raises(BlobsUnavailable):
            dispatcher.reconcile()
    assert store.troubles.all() == []

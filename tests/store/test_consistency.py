"""What rows and blobs disagree on after a restore is found, told, and mended."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from checked import queued_job

from advtex_contract.jobs import JobSpec
from advtex_store import keys
from advtex_store.consistency import Disagreement, disagreements
from advtex_store.database import upgrade_database
from advtex_store.ids import new_id
from advtex_store.models import CounterRow, JobRow
from advtex_store.partials import Hold
from advtex_store.settings import StoreSettings
from advtex_store.store import Store, open_store

SCAN = b"the bytes of a scan"


@pytest.fixture
def store(tmp_path: Path, place: dict[str, str]) -> Iterator[Store]:
    settings = StoreSettings(data_dir=tmp_path / "data", redis_url="redis://127.0.0.1:1/0", **place)
    upgrade_database(settings.database)
    opened = open_store(settings)
    yield opened
    opened.close()


def uploaded(store: Store) -> str:
    row = store.uploads.create("me", len(SCAN))
    written = store.blobs.put(keys.scan_key(row.id), SCAN)
    return store.uploads.finish(row.id, written.sha256).id


def submitted(store: Store) -> str:
    return queued_job(store, "me", JobSpec(upload_id=uploaded(store)))


def succeeded(store: Store, tmp_path: Path) -> str:
    job = submitted(store)
    store.records.claim(job, 1, "test")
    (tmp_path / "model.obj").write_bytes(b"a model")
    store.results.commit(job, 1, {"model.obj": tmp_path / "model.obj"})
    return job


def scan_of(store: Store, job: str) -> str:
    return keys.scan_key(store.records.job(job).upload_id)


def found(store: Store) -> list[tuple[str, str]]:
    return [(one.kind, one.item) for one in disagreements(store)]


def mend(store: Store) -> list[str]:
    return [one.mend() for one in disagreements(store) if one.mend is not None]


def test_a_store_that_is_whole_is_left_alone(store: Store, tmp_path: Path) -> None:
    succeeded(store, tmp_path)
    submitted(store)
    store.uploads.create("me", 7)
    assert found(store) == []


def test_a_job_whose_scan_is_gone_ends_with_that_reason_and_its_upload_can_be_sent_again(store: Store) -> None:
    job = submitted(store)
    upload = store.records.job(job).upload_id
    sha256 = store.uploads.upload(upload).sha256
    store.blobs.delete(scan_of(store, job))
    assert found(store) == [("scans", job), ("uploads", upload)]
    assert (store.records.job(job).state, store.uploads.upload(upload).sha256) == ("queued", sha256), (
        "looking changes nothing"
    )
    assert mend(store)[0] == "failed: its scan is gone"
    row = store.records.job(job)
    assert (row.state, (row.error or {})["code"]) == ("failed", "scan_missing")
    assert found(store) == []
    again = store.uploads.find("me", str(sha256))[0]
    assert (again.id, again.offset, again.sha256) == (upload, 0, None)
    with store.blobs.resume(keys.scan_key(upload), len(SCAN), 0, Hold("h", None, lambda: None)) as partial:
        partial.write(SCAN)
        partial.flush()
        partial.publish()
    store.uploads.finish(upload, str(sha256))
    assert store.records.retry(job).state == "queued"
    assert found(store) == []


def test_results_that_are_gone_are_made_again_if_the_scan_is_there(store: Store, tmp_path: Path) -> None:
    job = succeeded(store, tmp_path)
    store.blobs.delete(keys.result_key(job, 1, "model.obj"))
    assert found(store) == [("results", job)]
    assert mend(store) == ["queued: its results are made again"]
    assert not store.results.adopt(job), "the manifest names what is gone"
    claim = store.records.claim(job, 2, "test")
    store.results.commit(job, claim.attempt, {"model.obj": tmp_path / "model.obj"})
    assert found(store) == []
    states = [event.data["state"] for event in store.records.events(job, 0)]
    assert states == ["checking", "queued", "running", "succeeded", "failed", "queued", "running", "succeeded"]


def test_a_job_whose_results_and_scan_are_gone_has_failed(store: Store, tmp_path: Path) -> None:
    job = succeeded(store, tmp_path)
    store.blobs.delete_prefix(keys.job_prefix(job))
    store.blobs.delete(scan_of(store, job))
    assert {kind for kind, _ in found(store)} == {"results", "uploads"}
    assert "failed: its results are gone, and so is its scan" in mend(store)
    row = store.records.job(job)
    assert (row.state, (row.error or {})["code"], row.results) == ("failed", "results_lost", [])
    assert found(store) == []


def test_blobs_without_a_row_are_told_and_stay(store: Store) -> None:
    orphan = new_id(1_700_000_000)
    store.blobs.put(keys.scan_key(orphan), SCAN)
    store.blobs.put(keys.result_manifest_key(orphan), b"{}")
    (scan, results) = disagreements(store)
    for one in (scan, results):
        assert (one.kind, one.item, one.mend) == ("orphans", orphan, None)
        assert "have no row; servers remove them from 2023-11-21" in one.message
    assert store.blobs.exists(keys.scan_key(orphan))


@pytest.mark.parametrize("lease", [None, 1.0])
def test_an_attempt_that_nobody_holds_is_given_up(store: Store, lease: float | None) -> None:
    job = submitted(store)
    store.records.claim(job, 1, "test")
    assert found(store) == [], "its lease holds"
    with store.database.write() as session:
        session.get_one(JobRow, job).lease_expires_at = lease
    assert found(store) == [("leases", job)]
    assert mend(store) == ["queued: nobody has its attempt 1"]
    assert (store.records.job(job).state, store.records.job(job).attempt) == ("queued", 2)


@pytest.mark.parametrize(("told", "whole"), [(5, True), (4, True), (19, False)])
def test_an_upload_begins_anew_if_fewer_bytes_are_held_than_its_row_says(store: Store, told: int, whole: bool) -> None:
    """Of an older storage; one that holds more than the row of an older database knows of is gone on with."""
    upload = store.uploads.create("me", 1000)
    holder = str(store.uploads.seize(upload.id, "me").holder)
    with store.blobs.resume(keys.scan_key(upload.id), 1000, 0, Hold(holder, None, lambda: None)) as partial:
        partial.write(SCAN[:4])
        partial.flush()
        partial.write(SCAN[4:5])
        partial.flush()
    store.uploads.advance(upload.id, holder, told)
    if whole:
        assert found(store) == []
        return
    assert found(store) == [("partials", upload.id)]
    assert mend(store) == ["begins anew: its client sends it from the first byte on"]
    assert store.uploads.upload(upload.id).offset == 0
    assert found(store) == []
    store.blobs.resume(keys.scan_key(upload.id), 1000, 0, Hold("h", None, lambda: None)).close()


def test_jobs_that_ended_are_counted(store: Store, tmp_path: Path) -> None:
    succeeded(store, tmp_path)
    with store.database.write() as session:
        session.query(CounterRow).delete()
    assert found(store) == [("counters", "succeeded")]
    assert mend(store) == ["counted: 1"]
    assert found(store) == []


def test_what_has_changed_meanwhile_is_left_alone(store: Store, tmp_path: Path) -> None:
    """Between the look and the mend a worker takes the job, or its owner deletes it."""
    waits, done = submitted(store), succeeded(store, tmp_path)
    store.blobs.delete(scan_of(store, waits))
    store.blobs.delete(keys.result_key(done, 1, "model.obj"))
    looked: dict[str, Disagreement] = {one.kind: one for one in disagreements(store)}
    store.records.claim(waits, 1, "a worker")
    store.records.delete(done)
    for kind in ("scans", "results"):
        mended = looked[kind].mend
        assert mended is not None
        assert mended() == "it has changed meanwhile; nothing was done"
    assert store.records.job(waits).state == "running"

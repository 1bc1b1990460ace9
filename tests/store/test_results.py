"""The commit of results: at most one manifest, whoever is late."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import pytest

from advtex_store import keys
from advtex_store.blobs import FolderBlobs
from advtex_store.errors import StaleAttempt
from advtex_store.results import Results, content_type
from advtex_store.retention import Retention


@pytest.fixture
def results(bench: Any, tmp_path: Path) -> Results:
    return Results(bench.records, FolderBlobs(tmp_path / "blobs"))


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    found = {}
    for name in ("model.glb", "previews/front.png"):
        found[name] = tmp_path / name.replace("/", "-")
        found[name].write_bytes(name.encode())
    return found


def test_commit(bench: Any, results: Results, files: dict[str, Path]) -> None:
    job = bench.job()
    bench.records.claim(job, 1, "w")
    manifest = results.commit(job, 1, files)
    assert bench.state(job) == ("succeeded", 1)
    stored = bench.records.job(job).results
    assert [f["name"] for f in stored] == ["model.glb", "previews/front.png"]
    assert [f.content_type for f in manifest.files] == ["model/gltf-binary", "image/png"]
    for file in manifest.files:
        assert results.blobs.get(file.key) == file.name.encode()
        assert file.sha256 == hashlib.sha256(file.name.encode()).hexdigest()
    assert results.manifest(job) == manifest


def test_a_stale_attempt_cannot_commit(bench: Any, results: Results, files: dict[str, Path]) -> None:
    job = bench.job()
    bench.records.claim(job, 1, "w")
    bench.records.lost(job, 1)
    with pytest.raises(StaleAttempt):
        results.commit(job, 1, files)
    assert not results.blobs.exists(keys.result_manifest_key(job))


def test_the_first_manifest_counts(
    bench: Any, results: Results, files: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Attempt 1 is killed between its manifest and its row; attempt 2 finds the manifest at its own end."""
    job = bench.job()
    bench.records.claim(job, 1, "w")
    with monkeypatch.context() as patch:
        patch.setattr(bench.records, "succeed", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            results.commit(job, 1, files)
    assert bench.state(job) == ("running", 1)
    bench.records.lost(job, 1)
    bench.records.claim(job, 2, "w")
    files["model.glb"].write_bytes(b"another")
    manifest = results.commit(job, 2, files)
    assert manifest.attempt == 1
    assert bench.state(job) == ("succeeded", 2)
    (glb, _) = bench.records.job(job).results
    assert results.blobs.get(glb["key"]) == b"model.glb"


@pytest.mark.parametrize("state", ["running", "queued", "preempted"])
def test_adopt(bench: Any, results: Results, state: str) -> None:
    job = bench.job()
    bench.records.claim(job, 1, "w")
    {
        "running": lambda: None,
        "queued": lambda: bench.records.lost(job, 1),
        "preempted": lambda: bench.records.preempt(job, 1),
    }[state]()
    assert not results.adopt(job)
    results.blobs.put(keys.result_manifest_key(job), b'{"attempt": 1, "files": []}')
    assert results.adopt(job)
    assert bench.state(job)[0] == "succeeded"
    assert results.adopt(job)


def test_a_canceled_job_is_not_brought_back(bench: Any, results: Results) -> None:
    job = bench.job()
    bench.records.cancel(job)
    results.blobs.put(keys.result_manifest_key(job), b'{"attempt": 1, "files": []}')
    assert not results.adopt(job)
    assert bench.state(job)[0] == "canceled"


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("a.obj", "model/obj"),
        ("a.mtl", "model/mtl"),
        ("a.png", "image/png"),
        ("report.json", "application/json"),
        ("engine.log", "text/plain"),
        ("model.3tz", "application/vnd.maxar.archive.3tz+zip"),
        ("a.unknown-kind", "application/octet-stream"),
    ],
)
def test_content_types(name: str, kind: str) -> None:
    assert content_type(name) == kind


def test_what_has_expired_goes_row_first(bench: Any, results: Results, files: dict[str, Path]) -> None:
    blobs = results.blobs
    retention = Retention(bench.database, blobs)
    ended, waiting = bench.job(), bench.job()
    for job in (ended, waiting):
        blobs.put(keys.scan_key(bench.records.job(job).upload_id), b"scan")
    alone = bench.finished_upload()
    blobs.put(keys.scan_key(alone), b"scan")
    bench.records.claim(ended, 1, "w")
    results.commit(ended, 1, files)

    def kept() -> set[str]:
        return {info.key.split("/")[1] for prefix in ("jobs/", "scans/") for info in blobs.list(prefix)}

    uploads = {job: bench.records.job(job).upload_id for job in (ended, waiting)}
    everything = {ended, alone, *uploads.values()}
    retention.expire()
    assert retention.purge() == 0
    assert kept() == everything
    bench.clock.now += 1001
    retention.expire()
    assert kept() == everything, "blobs go with purge, after the rows"
    retention.purge()
    assert kept() - {uploads[ended]} == {uploads[waiting]}, "a waiting job keeps its scan, however old"
    retention.expire()
    retention.purge()
    assert kept() == {uploads[waiting]}
    assert retention.purge() == 0
    assert bench.state(waiting) == ("queued", 1)

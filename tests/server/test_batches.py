"""Batches and scans by reference over HTTP."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from advtex_contract.jobs import JobError


@pytest.fixture
def scans(tmp_path: Path, scan_zip: Path) -> Path:
    """An allowed folder: `good` and `bad` scans in it, and a zip."""
    root = tmp_path / "scans"
    shutil.unpack_archive(scan_zip, root / "good")
    shutil.copytree(root / "good", root / "bad")
    (root / "bad" / "scan.json").write_text("{")
    shutil.copy(scan_zip, root / "packed.zip")
    return root


@pytest.fixture
def live(make_live: Callable[..., Any], scans: Path) -> Any:
    return make_live(reference_roots=scans.as_uri())


def test_a_job_by_reference(live: Any, scans: Path, is_error: Any) -> None:
    for name, state in (("good", "queued"), ("packed.zip", "queued"), ("bad", "rejected")):
        source = (scans / name).as_uri()
        job = live.job(source=source, batch="night")
        assert (job["state"], job["source"], job["batch"]) == (state, source, "night")
        shown = live.http.get(f"/v1/jobs/{job['id']}").json()
        assert (shown["source"], shown["batch"]) == (source, "night")
    assert job["error"]["details"][0]["where"] == "scan.json"
    claim = live.store.records.claim(live.http.get("/v1/jobs").json()["jobs"][-1]["id"], 1, "test")
    assert claim.source == (scans / "good").as_uri()
    assert live.store.uploads.expected_bytes() == 0


@pytest.mark.one_machine("pure validation")
@pytest.mark.parametrize("source", ["file:///etc", "file:///etc/passwd", "http://127.0.0.1/", "s3://bucket/x", ""])
def test_what_may_not_be_read_is_refused(live: Any, is_error: Any, source: str) -> None:
    response = live.http.post("/v1/jobs", json={"source": source})
    assert "allowed" in is_error(response, 422, "invalid_source") or source[:4] in ("http", "")
    assert response.json()["details"][0]["where"] == "body.source"
    assert live.http.get("/v1/jobs").json()["jobs"] == []


@pytest.mark.one_machine("pure validation")
def test_what_is_not_there_is_named(live: Any, scans: Path, is_error: Any) -> None:
    response = live.http.post("/v1/jobs", json={"source": f"{scans.as_uri()}/none"})
    assert "nothing at" in is_error(response, 422, "invalid_source")


@pytest.mark.one_machine("pure validation")
@pytest.mark.parametrize("spec", [{}, {"upload_id": "x", "source": "file:///x"}, {"upload_id": "x", "batch": "a b"}])
def test_one_scan_and_a_plain_name_are_needed(live: Any, is_error: Any, spec: dict[str, str]) -> None:
    is_error(live.http.post("/v1/jobs", json=spec), 422, "bad_request")


def test_an_upload_held_by_reference_takes_no_bytes(live: Any, scans: Path, is_error: Any) -> None:
    job = live.job(source=(scans / "good").as_uri())
    headers = {
        "Tus-Resumable": "1.0.0",
        "Upload-Offset": "0",
        "Content-Type": "application/offset+octet-stream",
    }
    url = f"/v1/uploads/{job['upload_id']}"
    is_error(live.http.patch(url, content=b"", headers=headers), 409, "conflict")
    assert live.http.head(url, headers=headers).status_code == 409
    is_error(live.http.post("/v1/jobs", json={"upload_id": job["upload_id"]}), 409, "not_ready")


def test_a_batch_from_beginning_to_end(live: Any, scans: Path, is_error: Any) -> None:
    source = (scans / "good").as_uri()
    jobs = [live.job(source=source, batch="night")["id"] for _ in range(4)]
    live.job(source=(scans / "bad").as_uri(), batch="night")
    records = live.store.records
    for job in jobs[:2]:
        records.claim(job, 1, "test")
        records.fail(job, 1, JobError(code="engine_error", message="no"))
    batch = live.http.get("/v1/batches/night").json()
    assert (batch["jobs"], batch["finished"]) == (5, False)
    assert batch["states"] == {"failed": 2, "queued": 2, "rejected": 1}
    listed = live.http.get("/v1/jobs", params={"batch": "night", "state": "failed"}).json()["jobs"]
    assert [job["id"] for job in listed] == jobs[1::-1]
    again = live.http.post("/v1/batches/night/retry-failed").json()
    assert again["states"] == {"queued": 4, "rejected": 1}
    records.claim(jobs[2], 1, "test")
    canceled = live.http.post("/v1/batches/night/cancel").json()
    assert canceled["states"] == {"canceled": 3, "running": 1, "rejected": 1}
    assert records.job(jobs[2]).cancel_requested
    records.canceled(jobs[2], 1)
    ended = live.http.get("/v1/batches/night").json()
    assert (ended["finished"], ended["eta_seconds"]) == (True, 0.0)
    assert [b["id"] for b in live.http.get("/v1/batches").json()["batches"]] == ["night"]


@pytest.mark.one_machine("tests/store has the same on both databases")
def test_batches_belong_to_their_owner(live: Any, scans: Path, is_error: Any) -> None:
    live.job(source=(scans / "good").as_uri(), batch="night")
    with live.client(live.store.accounts.create_key("other")) as other:
        is_error(other.get("/v1/batches/night"), 404, "not_found")
        is_error(other.post("/v1/batches/night/cancel"), 404, "not_found")
        is_error(other.post("/v1/batches/night/retry-failed"), 404, "not_found")
        assert other.get("/v1/batches").json() == {"batches": [], "next_cursor": None}
    with live.client(live.store.accounts.create_key(owner="me", scopes=["read"])) as reader:
        assert reader.get("/v1/batches/night").status_code == 200
        is_error(reader.post("/v1/batches/night/cancel"), 403, "forbidden")
    assert live.http.get("/v1/batches/night").json()["states"] == {"queued": 1}


def test_a_batch_is_paused_and_resumed(live: Any, scans: Path, is_error: Any) -> None:
    source = (scans / "good").as_uri()
    runs, waits = (live.job(source=source, batch="night")["id"] for _ in range(2))
    alone = live.job(source=source)["id"]
    live.store.records.claim(runs, 1, "test")
    paused = live.http.post("/v1/batches/night/pause").json()
    assert (paused["paused"], paused["states"]) == (True, {"running": 1, "queued": 1})
    assert live.http.get("/v1/batches").json()["batches"][0]["paused"]
    assert "its batch is paused" in live.http.get(f"/v1/jobs/{waits}").json()["waiting_reason"]
    reasons = {job["id"]: job["waiting_reason"] for job in live.http.get("/v1/jobs").json()["jobs"]}
    assert [name for name, reason in reasons.items() if "paused" in reason] == [waits]
    assert [job.id for job in live.store.records.waiting(10)] == [alone]
    assert live.http.post("/v1/batches/night/pause").status_code == 200, "once more changes nothing"
    with live.client(live.store.accounts.create_key("other")) as other:
        is_error(other.post("/v1/batches/night/resume"), 404, "not_found")
    with live.client(live.store.accounts.create_key(owner="me", scopes=["read"])) as reader:
        is_error(reader.post("/v1/batches/night/resume"), 403, "forbidden")
        is_error(reader.put("/v1/batches/night/limits", json={}), 403, "forbidden")
    assert live.http.post("/v1/batches/night/resume").json()["paused"] is False
    assert "paused" not in live.http.get(f"/v1/jobs/{waits}").json()["waiting_reason"]
    assert {job.id for job in live.store.records.waiting(10)} == {waits, alone}
    is_error(live.http.post("/v1/batches/none/pause"), 404, "not_found")


@pytest.mark.one_machine("tests/store has the same on both databases")
def test_how_many_jobs_of_a_batch_run_is_said_before_the_first(live: Any, scans: Path, is_error: Any) -> None:
    assert live.http.put("/v1/batches/night/limits", json={"max_running": 1}).status_code == 204
    is_error(live.http.put("/v1/batches/night/limits", json={"max_running": 0}), 422, "bad_request")
    is_error(live.http.get("/v1/batches/night"), 404, "not_found")
    for _ in range(2):
        live.job(source=(scans / "good").as_uri(), batch="night")
    assert live.http.get("/v1/batches/night").json()["max_running"] == 1
    assert len(live.store.records.waiting(10)) == 1
    live.http.put("/v1/batches/night/limits", json={})
    assert len(live.store.records.waiting(10)) == 2


@pytest.mark.one_machine("tests/store has the same on both databases")
def test_a_job_is_shown_as_late_and_is_still_done(live: Any, scans: Path, is_error: Any) -> None:
    source = (scans / "good").as_uri()
    for deadline, late in (("2001-01-01T08:00:00Z", True), ("2101-01-01T08:00:00+02:00", False)):
        body = {"source": source, "deadline": deadline}
        made = live.http.post("/v1/jobs", json=body, headers={"Idempotency-Key": deadline}).json()
        again = live.http.post("/v1/jobs", json=body, headers={"Idempotency-Key": deadline})
        assert (again.status_code, again.json()["id"]) == (200, made["id"])
        assert (made["late"], made["deadline"][:4]) == (late, deadline[:4])
    other = {"source": source, "deadline": "2101-01-02T08:00:00Z"}
    repeated = live.http.post("/v1/jobs", json=other, headers={"Idempotency-Key": deadline})
    is_error(repeated, 422, "idempotency_mismatch")
    is_error(live.http.post("/v1/jobs", json={"source": source, "deadline": "2101-01-02T08:00:00"}), 422, "bad_request")

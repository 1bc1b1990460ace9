"""The check of a scan, beside the requests: the same report as ever, wherever the scan lies and whatever dies."""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import boto3
import pytest
from large_scan import write_large_zip
from live_service import process_tree, wait_until
from tiny_scan import write_scan, write_zip

from advtex_contract.jobs import ANY_STATE_HEADER, JobSpec
from advtex_scan import check_scan
from advtex_server import checking

FACES = 2_500_000


@pytest.fixture
def bad_scan(tmp_path: Path) -> Path:
    folder = write_scan(tmp_path / "bad", frames=5)
    (folder / "color" / "3.png").write_bytes(b"no image")
    (folder / "color" / "4.png").unlink()
    (folder / "spare.txt").write_text("not used")
    return folder


def findings(scan: Path) -> list[dict[str, str]]:
    return [
        {name: finding[name] for name in ("severity", "code", "where", "message", "remedy")}
        for finding in check_scan(scan).to_dict()["findings"]
    ]


def put(url: str, scan: Path) -> None:
    """Below an s3:// URL, by the same names."""
    bucket, _, prefix = url.removeprefix("s3://").partition("/")
    s3 = boto3.client("s3", endpoint_url=os.environ["AWS_ENDPOINT_URL"])
    if scan.is_file():
        s3.upload_file(str(scan), bucket, f"{prefix}/{scan.name}")
    for path in scan.rglob("*"):
        if path.is_file():
            s3.upload_file(str(path), bucket, f"{prefix}/{scan.name}/{path.relative_to(scan).as_posix()}")


def check_pids() -> list[int]:
    """Processes that check a scan for a server of this process."""
    found = []
    for pid in process_tree(os.getpid())[1:]:
        try:
            line = Path(f"/proc/{pid}/cmdline").read_bytes()
        except OSError:
            continue
        if b"advtex_server.check_process" in line:
            found.append(pid)
    return found


def spooled(live: Any) -> list[Path]:
    return list(live.store.blobs.spool_dir.glob("*")) if live.store.blobs.spool_dir.exists() else []


def test_the_report_is_the_clients(live: Any, bad_scan: Path, tmp_path: Path) -> None:
    packed = write_zip(tmp_path / "bad.zip", bad_scan)
    job = live.job(live.upload(packed.read_bytes()))
    assert (job["state"], job["error"]["code"], job["attempt"]) == ("rejected", "invalid_scan", 0)
    assert job["error"]["details"] == findings(packed)
    told = [
        json.loads(line[6:])
        for line in live.http.get(f"/v1/jobs/{job['id']}/events").text.splitlines()
        if line.startswith("data: ")
    ]
    assert [event["state"] for event in told] == ["checking", "rejected", "rejected"]


@pytest.mark.one_machine("the scan is in S3 anyway")
@pytest.mark.parametrize("kind", ["folder", "zip"])
def test_a_scan_in_s3_is_read_where_it_lies(
    make_live: Callable[..., Any], s3_url: str, bad_scan: Path, tmp_path: Path, kind: str
) -> None:
    live = make_live(reference_roots=s3_url)
    scan = bad_scan if kind == "folder" else write_zip(tmp_path / "bad.zip", bad_scan)
    put(s3_url, scan)
    job = live.job(source=f"{s3_url}/{scan.name}")
    assert (job["state"], job["error"]["details"]) == ("rejected", findings(scan))
    (bad_scan / "color" / "3.png").unlink()
    good = write_scan(tmp_path / "good")
    put(s3_url, good)
    assert live.job(source=f"{s3_url}/good")["state"] == "queued"
    assert spooled(live) == []


@pytest.mark.one_machine("the scan is in S3 anyway")
def test_of_a_large_scan_in_s3_little_is_fetched_and_nothing_spooled(
    make_live: Callable[..., Any], s3_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from advtex_store.bucket import Bucket

    folder, fetched, read = write_scan(tmp_path / "large"), list[int](), Bucket.get
    for number in range(20):
        (folder / f"extra-{number}.bin").write_bytes(os.urandom(2 << 20))
    packed = write_zip(tmp_path / "large.zip", folder)
    put(s3_url, packed)

    def counted(self: Any, name: str, start: int, end: int) -> bytes:
        fetched.append(end - start)
        return read(self, name, start, end)

    monkeypatch.setattr(Bucket, "get", counted)
    live = make_live(reference_roots=s3_url)
    assert live.job(source=f"{s3_url}/large.zip")["state"] == "queued"
    assert 0 < sum(fetched) < 0.2 * packed.stat().st_size
    assert spooled(live) == []


@pytest.mark.one_machine("pure validation")
def test_what_needs_no_look_into_the_scan_is_refused_at_once(
    make_live: Callable[..., Any], s3_url: str, is_error: Any
) -> None:
    live = make_live(reference_roots=s3_url)
    for source in (f"{s3_url}/none", "s3://other/scan"):
        is_error(live.http.post("/v1/jobs", json={"source": source}), 422, "invalid_source")
    is_error(live.http.post("/v1/jobs", json={"upload_id": "none"}), 404, "not_found")
    assert live.http.get("/v1/jobs").json()["jobs"] == []


@pytest.mark.slow
@pytest.mark.one_machine("the check is the same")
def test_requests_are_answered_while_a_million_faces_are_checked(live: Any, tmp_path: Path) -> None:
    upload = live.upload(write_large_zip(tmp_path / "large.zip", FACES).read_bytes())
    answer = threading.Event()

    def times(enough: Callable[[int], bool]) -> list[float]:
        taken: list[float] = []
        while not enough(len(taken)):
            began = time.perf_counter()
            assert live.http.get("/v1/jobs").status_code == 200
            taken.append(time.perf_counter() - began)
            answer.wait(0.02)
        return taken

    idle = times(lambda made: made == 50)
    began = time.perf_counter()
    job = live.http.post("/v1/jobs", json={"upload_id": upload}).json()
    posted = time.perf_counter() - began
    assert job["state"] == "checking"
    busy = times(lambda _: live.store.records.job(job["id"]).state != "checking")
    took = time.perf_counter() - began
    assert live.checked(job["id"])["state"] == "queued"
    assert took > 1, "else this shows nothing"
    assert posted < took / 3
    assert max(busy) < took / 3, "no request waits for the check"
    assert statistics.median(busy) < 10 * statistics.median(idle) + 0.05


@pytest.mark.one_machine("the check is the same")
def test_a_check_that_kills_its_process_ends_the_job_the_third_time(
    live: Any, scan_zip: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    count = "import os, signal; open({!r}, 'a').write('x'); os.kill(os.getpid(), signal.SIGKILL)"
    tries = live.settings.data_dir / "tries"
    monkeypatch.setattr(checking, "COMMAND", (sys.executable, "-c", count.format(str(tries))))
    job = live.job(live.upload(scan_zip.read_bytes()))
    assert tries.read_text() == "xxx"
    assert (job["state"], job["error"]["code"], job["attempt"]) == ("failed", "check_died", 0)
    assert "was killed (out of memory?): SIGKILL" in job["error"]["message"]
    monkeypatch.undo()
    assert live.http.post(f"/v1/jobs/{job['id']}/retry").json()["state"] == "checking"
    assert live.checked(job["id"])["state"] == "queued"


@pytest.mark.one_machine("the check is the same")
def test_a_check_has_its_time(live: Any, scan_zip: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checking, "COMMAND", (sys.executable, "-c", "import time; time.sleep(60)"))
    monkeypatch.setattr(checking, "CHECK_SECONDS", 0.3)
    job = live.job(live.upload(scan_zip.read_bytes()))
    assert (job["state"], job["error"]["code"]) == ("failed", "check_died")
    assert "had not ended after" in job["error"]["message"]


def sleeping(monkeypatch: pytest.MonkeyPatch) -> None:
    """Checks do not end from now on."""
    command = (sys.executable, "-c", "import time; time.sleep(60)", "advtex_server.check_process")
    monkeypatch.setattr(checking, "COMMAND", command)


@pytest.mark.one_machine("the check is the same")
def test_a_canceled_check_ends_with_its_process(
    make_live: Callable[..., Any], scan_zip: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    live = make_live(lease_seconds=1.0)
    sleeping(monkeypatch)
    job = live.http.post("/v1/jobs", json={"upload_id": live.upload(scan_zip.read_bytes())}).json()["id"]
    wait_until(check_pids)
    assert live.http.post(f"/v1/jobs/{job}/cancel").json()["state"] == "canceled"
    wait_until(lambda: not check_pids())
    assert live.http.get(f"/v1/jobs/{job}").json()["state"] == "canceled"
    monkeypatch.undo()
    assert live.http.post(f"/v1/jobs/{job}/retry").json()["state"] == "checking"
    assert live.checked(job)["state"] == "queued"


def test_a_server_that_stops_leaves_its_checks_to_others_at_once(
    make_live: Callable[..., Any], scan_zip: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = make_live(lease_seconds=600.0)
    with monkeypatch.context() as patched:
        sleeping(patched)
        job = first.http.post("/v1/jobs", json={"upload_id": first.upload(scan_zip.read_bytes())}).json()["id"]
        wait_until(check_pids)
    checks = check_pids()
    second = make_live(lease_seconds=600.0)
    time.sleep(0.5)
    assert second.http.get(f"/v1/jobs/{job}").json()["state"] == "checking", "it is the first one's"
    first.stop()
    assert not set(checks) & set(check_pids()), "the second one's may run already"
    assert second.checked(job)["state"] == "queued"


@pytest.mark.one_machine("the check is the same")
def test_a_scan_that_is_gone_by_then_fails_the_job(make_live: Callable[..., Any], tmp_path: Path) -> None:
    live = make_live(reference_roots=tmp_path.as_uri())
    spec = JobSpec(source=(tmp_path / "gone").as_uri())
    shown = live.checked(live.store.submissions.create_job("me", spec).id)
    assert (shown["state"], shown["error"]["code"]) == ("failed", "scan_missing")
    assert "nothing at" in shown["error"]["message"]


@pytest.mark.one_machine("the check is the same")
def test_an_error_of_the_server_ends_the_job_too(live: Any, scan_zip: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checking, "needed_memory", lambda *_args, **_more: 1 // 0)
    job = live.job(live.upload(scan_zip.read_bytes()))
    assert (job["state"], job["error"]["code"]) == ("failed", "check_died")
    assert "ZeroDivisionError" in job["error"]["message"]


@pytest.mark.one_machine("the check is the same")
def test_the_process_knows_no_secrets(live: Any, scan_zip: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "geheim")
    monkeypatch.setenv("ADVTEX_DATABASE_URL", "postgresql://geheim")
    sleeping(monkeypatch)
    job = live.http.post("/v1/jobs", json={"upload_id": live.upload(scan_zip.read_bytes())}).json()["id"]
    wait_until(check_pids)
    told = Path(f"/proc/{check_pids()[0]}/environ").read_bytes()
    live.http.post(f"/v1/jobs/{job}/cancel")
    assert b"PATH=" in told
    assert b"geheim" not in told


@pytest.mark.one_machine("what is told is the same")
def test_older_clients_are_told_what_they_can_read(live: Any, scan_zip: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sleeping(monkeypatch)
    older = {"User-Agent": "advtex-client/0.1.0"}
    newer = older | {ANY_STATE_HEADER: "yes"}
    spec = {"upload_id": live.upload(scan_zip.read_bytes()), "batch": "night"}
    for headers, state in ((older, "queued"), (newer, "checking"), ({}, "checking")):
        job = live.http.post("/v1/jobs", json=spec, headers=headers).json()
        assert job["state"] == state
        path = f"/v1/jobs/{job['id']}"
        shown = live.http.get(path, headers=headers).json()
        assert (shown["state"], shown["waiting_reason"]) == (state, "its scan is being checked")
        assert {job["state"] for job in live.http.get("/v1/jobs", headers=headers).json()["jobs"]} == {state}
        assert set(live.http.get("/v1/batches/night", headers=headers).json()["states"]) == {state}
        live.http.post(f"{path}/cancel")
        live.http.delete(path)


def test_jobs_that_are_checked_are_counted_and_listed(
    live: Any, scan_zip: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sleeping(monkeypatch)
    upload = live.upload(scan_zip.read_bytes())
    jobs = [live.http.post("/v1/jobs", json={"upload_id": upload, "batch": "b"}).json()["id"] for _ in range(3)]
    assert 'advtex_jobs{state="checking"} 3.0' in live.http.get("/metrics").text
    listed = live.http.get("/v1/jobs", params={"state": "checking"}).json()["jobs"]
    assert [job["id"] for job in listed] == jobs[::-1]
    batch = live.http.get("/v1/batches/b").json()
    assert (batch["states"], batch["finished"]) == ({"checking": 3}, False)
    assert live.http.post("/v1/batches/b/cancel").json()["states"] == {"canceled": 3}


def test_the_process_of_a_check_begins_with_little() -> None:
    """Each scan waits for what its process imports first."""
    loaded = "import sys, advtex_server.check_process; print(*sys.modules)"
    modules = subprocess.run([sys.executable, "-c", loaded], capture_output=True, text=True, check=True).stdout.split()
    assert {"advtex_scan", "advtex_store"} <= set(modules)
    assert not {"structlog", "rich", "asyncio", "pydantic", "sqlalchemy", "httpx"} & set(modules)

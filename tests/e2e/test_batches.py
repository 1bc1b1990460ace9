"""Batches by the command line, through the whole service."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from live_service import live_service, wait_until

if TYPE_CHECKING:
    from collections.abc import Iterator

    from live_service import LiveService


@pytest.fixture
def scenes(tmp_path: Path, scan: Path) -> Path:
    """Four scans, all different; a folder that is none."""
    root = tmp_path / "scenes"
    for number in range(4):
        shutil.copytree(scan, root / f"scene{number}")
        (root / f"scene{number}" / "note.txt").write_text(str(number))
    return root


@pytest.fixture
def service(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, scenes: Path) -> Iterator[LiveService]:
    for name in ("HOME", "XDG_STATE_HOME", "XDG_CONFIG_HOME"):
        monkeypatch.setenv(name, str(tmp_path / name))
    with live_service(tmp_path / "live", settings={"ADVTEX_REFERENCE_ROOTS": scenes.as_uri()}) as running:
        yield running


def data(ran: subprocess.CompletedProcess[str], exit_code: int = 0) -> Any:
    assert ran.returncode == exit_code, ran.stderr
    return json.loads(ran.stdout)


def test_a_folder_from_the_submission_to_the_scores(service: LiveService, scenes: Path) -> None:
    service.start_worker("scored")
    ran = service.run_client("batch", "submit", str(scenes), "--preset", "preview", "--wait", "--json")
    found = data(ran)
    assert found["batch"]["states"] == {"succeeded": 4}
    assert [row["label"] for row in found["jobs"]] == [f"scene{number}" for number in range(4)]
    assert [row["scores"] for row in found["jobs"]] == [{"lpips": 0.25, "s3_ratio": 0.9}] * 4
    table = service.run_client("batch", "status", "scenes", "--table").stdout
    assert "lpips" in table.splitlines()[0]
    assert "0.25" in table
    assert service.run_client("batch", "list").stdout == "scenes: 4 jobs, 4 succeeded\n"
    listed = data(service.run_client("list", "--batch", "scenes", "--state", "succeeded", "--json"))
    assert len(listed) == 4


def test_a_submission_that_is_killed_goes_on_without_a_second_job_or_upload(service: LiveService, scenes: Path) -> None:
    command = [sys.executable, "-m", "advtex_client.cli", "batch", "submit", str(scenes), "--id", "night"]
    environment = service.environment | {"ADVTEX_URL": service.url, "ADVTEX_API_KEY": service.key}
    with subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL) as process, service.client() as client:
        wait_until(lambda: list(client.list_jobs()))
        process.send_signal(signal.SIGKILL)
        process.wait()
        begun = [job.id for job in client.list_jobs()]
    assert data(service.run_client("batch", "resume", "night", "--json"))["jobs"] == 4
    with service.client() as client:
        wait_until(lambda: client.get_batch("night").states == {"queued": 4})
    assert data(service.run_client("batch", "submit", str(scenes), "--id", "night", "--json"))["jobs"] == 4
    with service.client() as client:
        jobs = list(client.list_jobs(batch="night"))
    assert set(begun) <= {job.id for job in jobs}
    assert len({job.upload_id for job in jobs}) == len(jobs) == 4
    assert service.run_client("batch", "resume", "other").returncode == 2


def test_by_reference_nothing_is_sent_and_bad_scans_are_named(service: LiveService, scenes: Path) -> None:
    (scenes / "scene1" / "scan.json").write_text("{")
    (scenes / "nothing").mkdir()
    service.start_worker("quick")
    ran = service.run_client("batch", "submit", str(scenes), "--by-reference", "--wait", "--json")
    found = data(ran, exit_code=5)
    assert found["batch"]["states"] == {"rejected": 2, "succeeded": 3}
    assert [row["label"] for row in found["jobs"] if row["state"] == "rejected"] == ["nothing", "scene1"]
    assert list(service.store.blobs.list("scans/")) == []
    outside = service.run_client("batch", "submit", str(scenes.parent), "--by-reference", "--id", "outside")
    assert outside.returncode == 4
    assert "allowed is what lies below" in outside.stderr


def test_a_manifest_with_a_bad_scan_fails_and_retries(service: LiveService, scenes: Path) -> None:
    rows = [
        {"path": "scene0", "label": "first", "options": {"seed": 1}, "priority": 5},
        {"path": (scenes / "scene1").as_uri(), "label": "referred"},
        {"path": "scene2/none", "label": "missing"},
    ]
    manifest = scenes / "night.jsonl"
    manifest.write_text("\n".join(map(json.dumps, rows)))
    service.start_worker("raises")
    ran = service.run_client("batch", "submit", str(manifest))
    assert ran.returncode == 4, ran.stderr
    assert "missing: " in ran.stderr
    assert ran.stdout.startswith("night: 2 jobs")
    assert service.run_client("batch", "status", "night", "--wait").returncode == 5
    with service.client() as client:
        jobs = {job.label: job for job in client.list_jobs(batch="night")}
    assert (jobs["first"].priority, jobs["first"].options.seed, jobs["first"].source) == (5, 1, None)
    assert jobs["referred"].source == (scenes / "scene1").as_uri()
    again = data(service.run_client("batch", "retry-failed", "night", "--json"))
    assert "failed" not in again["states"] or again["states"]["failed"] < 2
    service.run_client("batch", "cancel", "night")
    with service.client() as client:
        wait_until(lambda: client.get_batch("night").finished)

"""Client, server, queue and worker as separate processes, with an engine that only pretends."""

from __future__ import annotations

import json
import math
import signal
import subprocess
import sys
from pathlib import Path

import anyio
import fake_engines
import pytest
from live_service import LiveService, wait_until
from tiny_scan import HEIGHT, WIDTH, png, write_scan

from advtex_client import AsyncClient, AuthError, JobFailedError, NotFoundError, ScanRejectedError
from advtex_contract.jobs import JobSpec, JobState
from advtex_contract.options import JobOptions


def test_submit_watch_download_delete(service: LiveService, scan: Path, tmp_path: Path) -> None:
    service.start_worker("quick")
    with service.client() as client:
        job = client.submit(scan, JobOptions(seed=5), label="kitchen")
        seen = list(client.watch_job(job.id, timeout=30.0))
        assert seen[-1].state is JobState.succeeded
        assert seen[-1].warnings[0].where == "color/9.png"
        assert [listed.id for listed in client.list_jobs(label="kitchen")] == [job.id]
        assert list(client.list_jobs(state=JobState.failed)) == []
        paths = client.download_results(seen[-1], tmp_path / "out")
        assert {path.relative_to(tmp_path / "out").as_posix() for path in paths} == set(fake_engines.RESULTS)
        assert (tmp_path / "out" / "model.obj").read_text() == "model.obj\nseed 5 size None\n"
        assert client.submit(scan, JobOptions(seed=5), label="kitchen").id == job.id
        client.delete_job(job.id)
        with pytest.raises(NotFoundError):
            client.get_job(job.id)


def test_the_async_client_does_the_same(service: LiveService, scan: Path, tmp_path: Path) -> None:
    service.start_worker("quick")

    async def main() -> None:
        async with AsyncClient(service.url, service.key) as client:
            job = await client.submit(scan, label="async")
            done = await client.wait_for_job(job.id, timeout=30.0)
            assert [listed.id async for listed in client.list_jobs()] == [job.id]
            paths = await client.download_results(done, tmp_path / "out", names=["model.glb"])
            assert [path.read_text() for path in paths] == ["model.glb\nseed 0 size None\n"]
            await client.delete_job(job.id)

    anyio.run(main)


def test_the_command_line_from_check_to_download(service: LiveService, scan: Path, tmp_path: Path) -> None:
    service.start_worker("quick")
    out = tmp_path / "out"
    checked = service.run_client("check", str(scan), "--json")
    assert checked.returncode == 0
    assert json.loads(checked.stdout)["ok"] is True
    submitted = service.run_client("submit", str(scan), "--preset", "preview", "--size", "320x240", "-o", str(out))
    assert submitted.returncode == 0, submitted.stderr
    assert sorted(submitted.stdout.splitlines()) == sorted(str(out / name) for name in fake_engines.RESULTS)
    (listed,) = json.loads(service.run_client("list", "--json").stdout)
    assert (listed["state"], listed["options"]["width"]) == ("succeeded", 320)
    status = service.run_client("status", listed["id"])
    assert "state    succeeded" in status.stdout
    watched = service.run_client("watch", listed["id"], "--json")
    assert json.loads(watched.stdout.splitlines()[-1])["state"] == "succeeded"
    (out / "model.obj").write_text("overwritten by hand")
    assert service.run_client("download", listed["id"], "-o", str(out), "--name", "model.obj").returncode == 0
    assert (out / "model.obj").read_text().startswith("model.obj\n")
    assert service.run_client("delete", listed["id"]).returncode == 0
    assert service.run_client("status", listed["id"]).returncode == 2


def test_a_bad_scan_is_refused_before_it_is_sent_and_by_the_server_too(service: LiveService, scan: Path) -> None:
    (scan / "mesh.ply").unlink()
    refused = service.run_client("submit", str(scan))
    assert refused.returncode == 4
    assert "mesh.ply" in refused.stderr
    with service.client() as client:
        assert list(client.list_jobs()) == []
        upload = client.upload(scan)  # as a client without the check would do
        job = client.create_job(JobSpec(upload_id=upload.id), idempotency_key="k")
        assert job.state is JobState.checking
        with pytest.raises(ScanRejectedError) as caught:
            client.wait_for_job(job.id)
    assert any("mesh.ply" in detail.where + detail.message for detail in caught.value.details)


def test_the_check_and_the_server_say_the_same(service: LiveService, tmp_path: Path) -> None:
    folder = write_scan(tmp_path / "bad", frames=7)
    scan = json.loads((folder / "scan.json").read_text())
    scan["frames"][1]["camera_to_world"] = [[-math.inf] * 4] * 4
    scan["frames"][2]["camera_to_world"][0][0] = 2.0
    scan["frames"][3]["color"] = "color/gone.png"
    del scan["mesh"]
    (folder / "scan.json").write_text(json.dumps(scan))
    cut, half = folder / "color/4.png", folder / "color/5.png"
    cut.write_bytes(cut.read_bytes()[:-100])
    half.write_bytes(png(WIDTH // 2, HEIGHT // 2, 0))
    checked = service.run_client("check", str(folder), "--json")
    assert checked.returncode == 4
    findings = json.loads(checked.stdout)["findings"]
    assert {(finding["severity"], finding["code"]) for finding in findings} >= {
        ("error", "bad_pose"),
        ("error", "missing_file"),
        ("error", "no_mesh"),
        ("error", "truncated_image"),
        ("warning", "lost_tracking"),
        ("warning", "color_scaled"),
    }
    with service.client() as client:
        upload = client.upload(folder)  # as a client without the check would do
        job = client.create_job(JobSpec(upload_id=upload.id), idempotency_key="k")
        *_, job = client.watch_job(job.id)
    assert job.state is JobState.rejected
    assert job.error is not None
    assert [detail.model_dump() for detail in job.error.details] == findings


def test_a_failed_job_says_why(service: LiveService, scan: Path) -> None:
    service.start_worker("raises")
    done = service.run_client("submit", str(scan), "--wait", "--json")
    assert done.returncode == 5
    assert json.loads(done.stdout)["error"]["code"] == "engine_error"
    assert "the widget is not a gadget" in json.loads(done.stderr.splitlines()[-1])["error"]["message"]
    with service.client() as client, pytest.raises(JobFailedError, match="widget"):
        client.wait_for_job(json.loads(done.stdout)["id"])


def test_a_wrong_key_is_an_auth_error(service: LiveService, scan: Path) -> None:
    wrong = service.key[:-1] + ("a" if service.key[-1] != "a" else "b")
    with service.client(wrong) as client, pytest.raises(AuthError):
        client.submit(scan)
    assert service.run_client("list", ADVTEX_API_KEY=wrong).returncode == 3
    assert service.run_client("list", ADVTEX_API_KEY="").returncode == 3


def test_waiting_ends_at_its_timeout_while_the_job_goes_on(service: LiveService, scan: Path) -> None:
    service.start_worker("stepping")
    waited = service.run_client("submit", str(scan), "--wait", "--timeout", "1", "--steps", "100000")
    assert waited.returncode == 7
    with service.client() as client:
        (job,) = client.list_jobs()
        wait_until(lambda: client.get_job(job.id).state is JobState.running)
        client.cancel_job(job.id)


def test_ctrl_c_leaves_the_job_alone(service: LiveService, scan: Path) -> None:
    command = ["advtex_client.cli", "submit", str(scan), "--wait"]
    environment = service.environment | {"ADVTEX_URL": service.url, "ADVTEX_API_KEY": service.key}
    process = subprocess.Popen([sys.executable, "-m", *command], env=environment, stderr=subprocess.PIPE, text=True)
    with service.client() as client, process:
        wait_until(lambda: list(client.list_jobs()))
        process.send_signal(signal.SIGINT)
        _, notes = process.communicate(timeout=10)
        assert process.returncode == 130, notes
        wait_until(lambda: next(client.list_jobs()).state is JobState.queued)


def test_the_worker_leaves_when_asked(service: LiveService, scan: Path) -> None:
    idle = service.start_worker("stepping")
    with service.client() as client:
        job = client.submit(scan, JobOptions(steps=60))
        wait_until(lambda: client.get_job(job.id).progress.step >= 10)
        idle.terminate()
        assert idle.wait(timeout=10) == 0
        wait_until(lambda: client.get_job(job.id).state is JobState.preempted)
        service.start_worker("stepping")
        assert client.wait_for_job(job.id, timeout=30).attempt == 2

"""The whole line with the real engine: what a user with one machine does, on a scan small enough to wait for."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from live_service import RHYTHM, process_tree, wait_until

from advtex_client import Client, load_config
from advtex_contract.jobs import JobState
from advtex_contract.options import JobOptions, Preset

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def synthetic_scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("synthetic") / "scan.zip"
    command = [sys.executable, "-m", "advtex_engine", "synthesize", str(path), "--views", "12", "--size", "96x72"]
    subprocess.run(command, check=True, capture_output=True, timeout=120)
    return path


@pytest.fixture
def all_in_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[subprocess.Popen[str]]:
    """`advtex-server up` on an empty folder; clients find it without being told anything."""
    for name in ("ADVTEX_URL", "ADVTEX_API_KEY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("ADVTEX_DATA_DIR", str(tmp_path / "data"))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    path = os.pathsep.join(str(Path(entry).absolute()) for entry in sys.path if entry)
    command = [sys.executable, "-m", "advtex_server.main", "up", "--port", "0"]
    environment = dict(os.environ) | RHYTHM | {"PYTHONPATH": path, "ADVTEX_LEASE_SECONDS": "5"}
    with (tmp_path / "up.log").open("w") as log:
        process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=log, text=True)
    with process:
        try:
            assert process.stdout is not None
            assert json.loads(process.stdout.readline())["event"] == "ready", (tmp_path / "up.log").read_text()
            yield process
        finally:
            for pid in reversed(process_tree(process.pid)):
                os.kill(pid, signal.SIGKILL)
            print((tmp_path / "up.log").read_text()[-6000:])


def test_a_scan_becomes_a_model_through_a_kill_and_everything_stops(
    all_in_one: subprocess.Popen[str], synthetic_scan: Path, tmp_path: Path
) -> None:
    options = JobOptions(preset=Preset.preview, steps=200, face_budget=2000, max_texture_size=512, holdout=6)
    with Client() as client:
        assert client.config == load_config()
        job = client.submit(synthetic_scan, options, label="real")
        wait_until(lambda: client.get_job(job.id).progress.step >= 20, seconds=150)
        (runner,) = [pid for pid in process_tree(all_in_one.pid) if b"advtex_worker.runner" in _command(pid)]
        os.kill(runner, signal.SIGKILL)
        done = client.wait_for_job(job.id, timeout=200)
        assert (done.state, done.attempt) == (JobState.succeeded, 2)
        assert done.progress.step == done.progress.steps == 200
        paths = client.download_results(done, tmp_path / "out")
    names = {path.relative_to(tmp_path / "out").as_posix() for path in paths}
    assert {"model.obj", "model.mtl", "model.png", "model.glb", "report.json", "index.html"} <= names
    manifest = json.loads((tmp_path / "out" / "previews" / "manifest.json").read_text())
    pictures = [view[kind] for view in manifest["views"] for kind in ("photo", "render", "mean")]
    assert {*pictures, *manifest["turntable"], *manifest["atlas"], manifest["thumbnail"]} <= names
    curves = json.loads((tmp_path / "out" / manifest["curves"]).read_text())
    assert curves["steps"] == list(range(1, 201)), "also of the attempt that was killed"
    assert curves["quality"]["steps"][-1] == 200
    assert set(done.progress.stage_peak_bytes) == set(done.progress.stage_seconds)
    assert (tmp_path / "out" / "model.glb").read_bytes()[:4] == b"glTF"
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["heldout"], "two views were held out and not scored"

    family = process_tree(all_in_one.pid)
    all_in_one.terminate()
    assert all_in_one.wait(timeout=30) == 0
    assert [pid for pid in family if process_tree(pid)] == [], "something outlived the service"


def _command(pid: int) -> bytes:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""

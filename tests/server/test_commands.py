"""`advtex-server` as users run it: real processes."""

from __future__ import annotations

import json
import os
import signal
import stat
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import psutil
import pytest
from checked import queued_job
from click.testing import Result
from databases import give_revision
from typer.testing import CliRunner

from advtex_contract.jobs import JobSpec
from advtex_server import embedded
from advtex_server.embedded import SetupError, free_port, only_one, redis_binary, write_private
from advtex_server.main import app
from advtex_store.schema import revisions
from advtex_store.settings import StoreSettings
from advtex_store.store import open_store

COMMAND = [sys.executable, "-m", "advtex_server.main"]

# Stands in for the worker: `advtex_worker.main` of this folder is found first.
FAKE_WORKER = """
import os, signal, sys, time
from pathlib import Path
from advtex_store.settings import StoreSettings
from advtex_store.store import open_store
folder = StoreSettings().data_dir
store = open_store(StoreSettings())
store.queue.redis.ping()
def stop(*_):
    time.sleep(0.3)
    store.queue.redis.ping()  # still there: it is stopped after the worker
    with (folder / "stopped").open("a") as file:
        file.write("stopped")
    sys.exit(0)
signal.signal(signal.SIGTERM, stop)
(folder / "worker.pid").write_text(str(os.getpid()))
while True:
    signal.pause()
"""


def until(condition: Callable[[], Any], seconds: float = 20) -> Any:
    deadline = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < deadline, "not in time"
        time.sleep(0.02)
    return found


class Up:
    """`advtex-server up` on a folder of its own."""

    def __init__(self, folder: Path) -> None:
        self.data = folder / "data"
        package = folder / "fake" / "advtex_worker"
        package.mkdir(parents=True, exist_ok=True)
        (package / "__init__.py").write_text("")
        (package / "main.py").write_text(FAKE_WORKER)
        path = os.pathsep.join([str(package.parent), *[p for p in sys.path if p]])
        self.environment = {**os.environ, "PYTHONPATH": path, "ADVTEX_DISK_RESERVE_BYTES": "0"}
        self.log = (folder / "log").open("a")
        command = [*COMMAND, "up", "--port", "0", "--data-dir", str(self.data)]
        self.process = subprocess.Popen(command, env=self.environment, stdout=subprocess.PIPE, stderr=self.log)
        assert self.process.stdout is not None
        self.ready = json.loads(self.process.stdout.readline() or "{}")
        assert self.ready, (folder / "log").read_text()
        self.client = json.loads((self.data / "client.json").read_text())
        self.http = httpx.Client(
            base_url=self.client["url"], timeout=20, headers={"Authorization": f"Bearer {self.client['api_key']}"}
        )

    def children(self) -> dict[str, psutil.Process]:
        found = psutil.Process(self.process.pid).children()
        return {"redis" if "redis-server" in p.name() else "worker": p for p in found}

    def worker_pid(self) -> int:
        try:
            return int((self.data / "worker.pid").read_text())
        except (FileNotFoundError, ValueError):
            return 0

    def stop(self, number: int = signal.SIGTERM) -> int:
        self.http.close()
        self.process.send_signal(number)
        code = self.process.wait(30)
        self.close()
        return code

    def close(self) -> None:
        assert self.process.stdout is not None
        self.process.stdout.close()
        self.log.close()


@pytest.fixture
def up(tmp_path: Path) -> Iterator[Up]:
    service = Up(tmp_path)
    yield service
    if service.process.poll() is None:
        service.stop()


def test_up(up: Up, tmp_path: Path, scan_zip: Path) -> None:
    """One command: everything runs, is private, is told to clients, and ends in order."""
    page = up.ready.pop("page")
    assert up.ready == {"event": "ready", "url": up.client["url"], "data_dir": str(up.data), "pid": up.process.pid}
    assert "Sign out" in httpx.get(page, follow_redirects=True).text, "the printed link signs a browser in"
    assert httpx.get(page).status_code == 401, "once"
    for private in ("client.json", "redis/password"):
        assert stat.S_IMODE((up.data / private).stat().st_mode) == 0o600
    until(up.worker_pid)
    checks = up.http.get("/readyz").json()["checks"]
    # The stand-in for the worker does not announce itself.
    assert {name for name, check in checks.items() if not check["ok"]} == {"workers"}
    password = (up.data / "redis" / "password").read_text()
    for child in up.children().values():
        assert not any(password in argument for argument in child.cmdline())

    upload = up.http.post("/v1/uploads", content=scan_zip.read_bytes()).json()["id"]
    job = up.http.post("/v1/jobs", json={"upload_id": upload}).json()
    until(lambda: up.http.get(f"/v1/jobs/{job['id']}").json()["state"] == "queued")
    with up.http.stream("GET", f"/v1/jobs/{job['id']}/events") as response:
        next(response.iter_lines())
        children = up.children()
        assert set(children) == {"redis", "worker"}
        started = time.monotonic()
        assert up.stop() == 0
    assert time.monotonic() - started < 8, "an open stream must not hold the service"
    assert (up.data / "stopped").read_text() == "stopped"
    assert not any(child.is_running() for child in children.values())

    again = Up(tmp_path)
    assert again.client["api_key"] == up.client["api_key"]
    assert again.http.get(f"/v1/jobs/{job['id']}").json()["state"] == "queued"
    assert again.stop(signal.SIGINT) == 0


def test_children_that_die_are_started_again(up: Up) -> None:
    first = until(up.worker_pid)
    os.kill(first, signal.SIGKILL)
    until(lambda: up.worker_pid() not in (0, first))
    redis = up.children()["redis"]
    redis.kill()
    until(lambda: not redis.is_running())
    until(lambda: up.http.get("/readyz").json()["checks"]["redis"]["ok"])


@pytest.mark.skipif(sys.platform != "linux", reason="other systems keep their range elsewhere")
def test_no_outgoing_connection_gets_the_port_of_a_redis_that_is_started_again() -> None:
    lowest_outgoing = int(Path("/proc/sys/net/ipv4/ip_local_port_range").read_text().split()[0])
    if lowest_outgoing <= 20_000:
        pytest.skip(f"this system gives outgoing connections every port from {lowest_outgoing}")
    assert all(free_port() < lowest_outgoing for _ in range(100))


def test_children_die_with_the_service(up: Up) -> None:
    until(up.worker_pid)
    children = up.children()
    up.process.kill()
    up.process.wait()
    up.close()
    up.http.close()
    until(lambda: not any(child.is_running() for child in children.values()))


def test_an_unreadable_append_only_file_stops_nothing(tmp_path: Path) -> None:
    """Redis is transport: after a crash of the machine it starts empty rather than not at all."""
    (tmp_path / "data" / "redis").mkdir(parents=True)
    (tmp_path / "data" / "redis" / "appendonly.aof").write_bytes(b"*1\r\n$3\r\nnonsense" * 20)
    up = Up(tmp_path)
    assert up.http.get("/readyz").json()["checks"]["redis"]["ok"]
    assert (tmp_path / "data" / "redis" / "appendonly.unreadable").exists()
    assert up.stop() == 0


def test_a_second_one_on_the_same_folder_is_refused(up: Up, tmp_path: Path) -> None:
    command = [*COMMAND, "up", "--port", "0", "--data-dir", str(up.data)]
    second = subprocess.run(command, env=up.environment, capture_output=True, text=True, timeout=30)
    assert second.returncode == 1
    assert "already running" in second.stderr
    assert "Traceback" not in second.stderr
    port = up.client["url"].rpartition(":")[2]
    command = [*COMMAND, "up", "--port", port, "--data-dir", str(tmp_path / "other")]
    third = subprocess.run(command, env=up.environment, capture_output=True, text=True, timeout=30)
    assert third.returncode == 1
    assert "choose another --port" in third.stderr


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Result]:
    def invoke(data: Path, *arguments: str) -> Result:
        monkeypatch.setenv("ADVTEX_DATA_DIR", str(data))
        monkeypatch.setenv("ADVTEX_DISK_RESERVE_BYTES", "0")
        monkeypatch.setenv("ADVTEX_REDIS_URL", "redis://127.0.0.1:1/0")
        return CliRunner().invoke(app, arguments)

    return invoke


def test_keys_and_doctor(tmp_path: Path, run: Callable[..., Result]) -> None:
    created = run(tmp_path, "keys", "create", "laptop", "--scope", "read", "--days", "3")
    key = created.stdout.strip()
    assert key.startswith("adv_"), created.output
    (row,) = [json.loads(line) for line in run(tmp_path, "keys", "list").stdout.splitlines()]
    assert (row["name"], row["scopes"], row["revoked_at"]) == ("laptop", ["read"], None)
    assert abs(row["expires_at"] - row["created_at"] - 3 * 86400) < 60
    assert run(tmp_path, "keys", "revoke", row["id"]).exit_code == 0
    assert json.loads(run(tmp_path, "keys", "list").stdout)["revoked_at"] is not None
    assert run(tmp_path, "keys", "revoke", "none").exit_code == 1
    assert run(tmp_path, "keys", "create", "--scope", "fly").exit_code == 2
    doctor = run(tmp_path, "doctor")
    assert doctor.exit_code == 0
    assert "FAIL redis: Redis does not answer" in doctor.stdout
    assert run(tmp_path / "empty", "doctor").exit_code == 1


def test_the_schema_goes_up_and_down(tmp_path: Path, run: Callable[..., Result]) -> None:
    newest = revisions()[-1]
    assert run(tmp_path, "migrate").stdout == f"the schema was empty and is {newest}\n"
    assert run(tmp_path, "migrate", "--to", "0001").stdout == f"the schema was {newest} and is 0001\n"
    doctor = run(tmp_path, "doctor")
    assert doctor.exit_code == 1
    assert f"FAIL database: the database has schema 0001 and this release needs {newest}: start" in doctor.stdout
    assert run(tmp_path, "keys", "create").exit_code == 0, "brings it up to date"
    assert run(tmp_path, "migrate").stdout == f"the schema was {newest} and is {newest}\n"
    failed = run(tmp_path, "migrate", "--to", "7")
    assert (failed.exit_code, failed.stdout) == (1, "")
    assert "there is no schema '7': this release knows 0001" in failed.stderr


def test_doctor_mends_what_rows_and_blobs_disagree_on(tmp_path: Path, run: Callable[..., Result]) -> None:
    run(tmp_path, "migrate")
    assert "ok   rows and blobs" in run(tmp_path, "doctor").stdout
    store = open_store(StoreSettings(data_dir=tmp_path))
    upload = store.uploads.create("me", 3)
    store.uploads.finish(upload.id, "ab" * 32)
    job = queued_job(store, "me", JobSpec(upload_id=upload.id))
    found = run(tmp_path, "doctor")
    assert found.exit_code == 3
    assert f"FAIL scans: 1 (--repair mends it): {job}: it waits for a scan whose bytes are gone" in found.stdout
    assert store.records.job(job).state == "queued"
    mended = run(tmp_path, "doctor", "--repair")
    assert mended.exit_code == 0
    assert f"mend scans {job}: " in mended.stdout
    assert store.records.job(job).state == "failed"
    store.close()


def test_a_server_refuses_a_schema_that_it_does_not_know_with_a_sentence(
    tmp_path: Path, run: Callable[..., Result]
) -> None:
    run(tmp_path, "migrate")
    give_revision(f"sqlite:///{tmp_path}/advtex.db", "9901")
    environment = {**os.environ, "ADVTEX_DATA_DIR": str(tmp_path), "ADVTEX_REDIS_URL": "redis://127.0.0.1:1/0"}
    for arguments in (("serve", "--port", "0"), ("up", "--port", "0"), ("dispatch",)):
        started = [*COMMAND, *arguments]
        ended = subprocess.run(started, env=environment, capture_output=True, text=True, timeout=30)
        assert ended.returncode == 1
        assert ended.stderr.startswith("advtex-server: the database has schema 9901, which this release does not know")
        assert "Traceback" not in ended.stderr
    for refused in (("keys", "create"), ("migrate",), ("doctor",)):
        failed = run(tmp_path, *refused)
        assert failed.exit_code == 1
        assert "the database has schema 9901, which this release does not know" in failed.output


def test_keys_are_limited_and_rotated(tmp_path: Path, run: Callable[..., Result]) -> None:
    def rows() -> list[dict[str, Any]]:
        return [json.loads(line) for line in run(tmp_path, "keys", "list").stdout.splitlines()]

    limits = ("--max-active-jobs", "2", "--max-bytes", "1000", "--max-running-jobs", "1")
    key = run(tmp_path, "keys", "create", "ada", "--owner", "team", *limits).stdout.strip()
    (row,) = rows()
    assert (row["owner"], row["max_active_jobs"], row["max_bytes"]) == ("team", 2, 1000)
    assert row["max_running_jobs"] == 1
    assert (row["active_jobs"], row["bytes"]) == (0, 0)
    assert run(tmp_path, "keys", "limit", row["id"], "--max-active-jobs", "5").exit_code == 0
    assert [(r["max_active_jobs"], r["max_bytes"], r["max_running_jobs"]) for r in rows()] == [(5, None, None)]
    assert run(tmp_path, "keys", "limit", row["id"], "--max-active-jobs", "5", "--max-running-jobs", "3").exit_code == 0

    now = time.time()
    new = run(tmp_path, "keys", "rotate", row["id"], "--keep-hours", "2").stdout.strip()
    assert new.startswith("adv_")
    assert new != key
    old, fresh = rows()
    assert abs(old["expires_at"] - now - 7200) < 60
    assert (fresh["id"], fresh["expires_at"]) == (new.split("_")[1], None)
    assert all(fresh[name] == row[name] for name in ("name", "owner", "scopes"))
    assert (fresh["max_active_jobs"], fresh["max_bytes"], fresh["max_running_jobs"]) == (5, None, 3)
    run(tmp_path, "keys", "rotate", fresh["id"])
    assert rows()[1]["expires_at"] <= time.time()

    for refused in (("rotate", "none"), ("limit", "none", "--max-bytes", "1")):
        failed = run(tmp_path, "keys", *refused)
        assert failed.exit_code == 1
        assert "there is no key none" in failed.stderr
    assert run(tmp_path, "keys", "create", "--max-bytes", "-1").exit_code == 2


def test_without_any_redis_the_message_helps(monkeypatch: pytest.MonkeyPatch) -> None:
    assert os.access(redis_binary(), os.X_OK)
    monkeypatch.setattr(embedded.importlib.util, "find_spec", lambda _: None)
    monkeypatch.setenv("PATH", "")
    with pytest.raises(SetupError, match=r"advtex\[embedded\]"):
        redis_binary()


def test_private_files(tmp_path: Path) -> None:
    path = tmp_path / "secret"
    path.write_text("old")
    path.chmod(0o644)
    write_private(path, "new")
    assert (path.read_text(), stat.S_IMODE(path.stat().st_mode)) == ("new", 0o600)
    assert list(tmp_path.iterdir()) == [path]
    with only_one(tmp_path / "data"), pytest.raises(SetupError), only_one(tmp_path / "data"):
        pass
    with only_one(tmp_path / "data"):
        pass

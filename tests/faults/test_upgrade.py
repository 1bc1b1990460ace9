"""Two releases on one PostgreSQL, Redis and S3, as real processes: jobs that one has begun end on the other.

The order is that of an upgrade, and then of a rollback: the database first (additions only, `advtex_store/schema.py`),
then the servers, then the workers.
"""

from __future__ import annotations

import base64
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import fake_engines
import httpx
import pytest
from attempts import result
from live_fleet import Fleet, Place, is_up, kill_tree
from live_service import wait_until
from releases import PRESENT, Release, checked_out
from tiny_scan import write_zip

from advtex_contract.jobs import JobState
from advtex_store import keys
from advtex_store.database import migrate_database, read_schema
from advtex_store.schema import revisions

PREVIOUS = "e9690fc253851f22219ac26860ec7c41e4fc0316"  # the commit that stands for the release before this one
REAL = "advtex_engine.pipeline:texture_scan"
EARLIER_SIDE, PRESENT_SIDE = 0, 1  # numbers of servers and workers
STEPS = 60
# Steps like `fake_engines.stepping`, for either release. A job holds still at step 20, or at 20 and 40, as often as its
# seed says, until its process is stopped or killed; the next attempt goes on beyond.
PATIENT = """
import time
from fake_engines import _steps

def engine(scan, out, config, *, work, resume, monitor):
    first = []
    def told(step):
        first.append(step)
        while step % 20 == 0 and step <= 20 * config.seed and step - first[0] > 10 and not monitor.stop_requested():
            time.sleep(0.05)
    _steps(out, config.steps, work / "state.json", resume, monitor, told)
"""

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]


@pytest.fixture(scope="module")
def earlier(tmp_path_factory: pytest.TempPathFactory) -> Release:
    return checked_out(PREVIOUS, tmp_path_factory.mktemp("earlier"))


@pytest.fixture
def distributed(tmp_path: Path, postgres_url: str, s3_url: str) -> Place:
    s3 = {name: value for name, value in os.environ.items() if name.startswith("AWS_")}
    return Place(tmp_path / "data", postgres_url, s3_url, s3)


@contextmanager
def earlier_fleet(folder: Path, place: Place, earlier: Release, engine: str) -> Iterator[Fleet]:
    """One server and one worker of the earlier release, on its own schema; there is room for as many of the present."""
    with ExitStack() as stack:
        running = Fleet(folder, place, stack, servers=2, workers=2, engine=engine, variables={}, dispatch=True)
        try:
            running.start_redis()
            migrate_database(running.settings.database, earlier.newest_schema)
            running.servers.append(running.start_server(EARLIER_SIDE, earlier))
            running.workers.append(running.start_worker(EARLIER_SIDE, earlier))
            wait_until(lambda: is_up(running.urls[EARLIER_SIDE]), seconds=90)
            yield running
        except BaseException:
            print(running.log.read_text(errors="replace")[-12_000:])
            raise
        finally:
            running.stop()


def make_key(running: Fleet, earlier: Release) -> str:
    """By the earlier release: the present one does not know its schema any more."""
    environment = {**os.environ, "ADVTEX_DATABASE_URL": running.place.database_url}
    environment |= {"ADVTEX_DATA_DIR": str(running.place.data), "PYTHONPATH": ""}
    command = [earlier.python, "-m", "advtex_server.main", "keys", "create", "fleet", "--owner", "fleet"]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.strip()


class User:
    """Speaks to both servers."""

    def __init__(self, running: Fleet, key: str) -> None:
        self.running, self.headers = running, {"Authorization": f"Bearer {key}"}

    def ask(self, side: int, method: str, path: str, status: int = 200, **request: object) -> httpx.Response:
        headers = {**self.headers, **request.pop("headers", {})}  # type: ignore[dict-item]
        url = self.running.urls[side] + path
        answer = httpx.request(method, url, headers=headers, timeout=30, **request)  # type: ignore[arg-type]
        assert answer.status_code == status, f"{method} {url}: {answer.status_code} {answer.text}"
        return answer

    def upload(self, side: int, data: bytes) -> str:
        return str(self.ask(side, "POST", "/v1/uploads", 201, content=data).json()["id"])

    def begin_upload(self, side: int, data: bytes) -> str:
        """-> its place, with the first half of the bytes sent"""
        name = base64.b64encode(b"scan.zip").decode()
        headers = {"Tus-Resumable": "1.0.0", "Upload-Length": str(len(data)), "Upload-Metadata": f"filename {name}"}
        made = self.ask(side, "POST", "/v1/uploads", 201, headers=headers)
        path = "/v1/uploads/" + made.headers["Location"].rpartition("/")[2]
        self.send(side, path, 0, data[: len(data) // 2])
        return path

    def go_on_with_upload(self, side: int, path: str, data: bytes) -> str:
        """-> its id, with the rest of the bytes sent"""
        half = int(self.ask(side, "HEAD", path, headers={"Tus-Resumable": "1.0.0"}).headers["Upload-Offset"])
        assert half == len(data) // 2
        self.send(side, path, half, data[half:])
        assert self.ask(side, "GET", path).json()["complete"]
        return path.rpartition("/")[2]

    def send(self, side: int, path: str, offset: int, data: bytes) -> None:
        headers = {"Tus-Resumable": "1.0.0", "Content-Type": "application/offset+octet-stream"}
        self.ask(side, "PATCH", path, 204, content=data, headers=headers | {"Upload-Offset": str(offset)})

    def submit(self, side: int, upload: str, **options: object) -> str:
        body = {"upload_id": upload, "options": options, "batch": "night"}
        return str(self.ask(side, "POST", "/v1/jobs", 201, json=body).json()["id"])

    def jobs(self, side: int) -> list[dict[str, Any]]:
        """All of them, with the options that were given: the earlier release tells null or its own of others."""
        found: list[dict[str, Any]] = self.ask(side, "GET", "/v1/jobs").json()["jobs"]
        for job in found:
            job["options"] = {name: value for name, value in job["options"].items() if value is not None}
            if side == EARLIER_SIDE:
                assert job["options"].pop("method") == "adversarial", "nobody has asked for one"
        return found

    def step_of(self, job: str) -> int:
        """The step that the newest server tells: the database may be one that this release cannot read yet."""
        view = self.ask(len(self.running.servers) - 1, "GET", f"/v1/jobs/{job}").json()
        return int(view["progress"]["step"])

    def wait_for_checkpoint(self, job: str, attempt: int, step: int = 20) -> None:
        """Until the attempt holds still before this step is told, with a checkpoint in the storage."""
        index = keys.checkpoint_prefix(job, attempt) + "index.json"
        wait_until(lambda: self.running.store.blobs.exists(index) and self.step_of(job) == step - 1, seconds=60)

    def wait_for_end(self, job: str, seconds: float = 90) -> None:
        wait_until(lambda: self.running.store.records.job(job).finished_at is not None, seconds=seconds)
        row = self.running.store.records.job(job)
        assert row.state == JobState.succeeded, (row.error, row.attempt)


def without_additions(newer: Any, older: Any) -> Any:
    """What the newer release tells under the names that the older one knows, in every object of it."""
    if isinstance(older, dict):
        return {name: without_additions(newer[name], told) for name, told in older.items()}
    if isinstance(older, list):
        return [without_additions(*pair) for pair in zip(newer, older, strict=True)]
    return newer


def assert_made_once(running: Fleet, job: str, steps: int, attempts: int) -> None:
    """Every step counts once in the result, and each attempt went on where the one before had come to."""
    state = json.loads(result(running.store, job).split("\n", 1)[1])
    assert (state["step"], state["chain"]) == (steps, fake_engines.chain(steps))
    assert len(state["began"]) == running.store.records.job(job).attempt == attempts
    assert all(began >= 10 for began in state["began"][1:]), "a checkpoint was left aside"


def use_everything(user: User, side: int, upload: str) -> None:
    """What users do that no worker is needed for, with the server of one side."""
    job = user.submit(side, upload, steps=10**6, seed=1)
    user.ask(side, "POST", f"/v1/jobs/{job}/cancel")
    wait_until(lambda: user.ask(side, "GET", f"/v1/jobs/{job}").json()["state"] == "canceled", seconds=30)
    user.ask(side, "POST", f"/v1/jobs/{job}/retry")
    user.ask(side, "POST", f"/v1/jobs/{job}/cancel")
    wait_until(lambda: user.ask(side, "GET", f"/v1/jobs/{job}").json()["state"] == "canceled", seconds=30)
    with httpx.stream("GET", f"{user.running.urls[side]}/v1/jobs/{job}/events", headers=user.headers) as events:
        assert any('"canceled"' in line for line in events.iter_lines())
    hook = user.ask(side, "POST", "/v1/webhooks", 201, json={"url": "https://1.1.1.1/hook"}).json()["id"]
    user.ask(side, "DELETE", f"/v1/webhooks/{hook}", 204)
    user.ask(side, "POST", "/v1/batches/night/retry-failed")
    user.ask(side, "DELETE", f"/v1/jobs/{job}", 204)
    for path in ("/v1/jobs", "/v1/batches", "/v1/batches/night", "/v1/key", "/v1/storage", "/metrics", "/readyz"):
        user.ask(side, "GET", path)


def test_a_fleet_is_upgraded_and_rolled_back_while_it_works(
    tmp_path: Path, scan: Path, earlier: Release, distributed: Place
) -> None:
    data = write_zip(tmp_path / "scan.zip", scan).read_bytes()
    (tmp_path / "patient.py").write_text(PATIENT)
    earlier, present = (replace(one, path=(*one.path, str(tmp_path))) for one in (earlier, PRESENT))
    with earlier_fleet(tmp_path, distributed, earlier, "patient:engine") as running:
        user = User(running, make_key(running, earlier))
        scan_of_old = user.upload(EARLIER_SIDE, data)
        begun_by_old = user.submit(EARLIER_SIDE, scan_of_old, steps=STEPS, seed=1)
        waits = user.submit(EARLIER_SIDE, scan_of_old, steps=30)
        upload_of_old = user.begin_upload(EARLIER_SIDE, data)
        user.wait_for_checkpoint(begun_by_old, 1)

        # The database and the servers: what runs goes on, and both servers do all that users ask for.
        running.servers.append(running.start_server(PRESENT_SIDE))
        wait_until(lambda: is_up(running.urls[PRESENT_SIDE]), seconds=90)
        assert read_schema(running.settings.database).revision == revisions()[-1]
        upload_of_new = user.begin_upload(PRESENT_SIDE, data)
        from_both = user.go_on_with_upload(PRESENT_SIDE, upload_of_old, data)
        # Where its bytes lie is nothing that the older release knows: its client has to begin anew.
        half = str(len(data) // 2)
        patch = {"Tus-Resumable": "1.0.0", "Content-Type": "application/offset+octet-stream", "Upload-Offset": half}
        user.ask(EARLIER_SIDE, "PATCH", upload_of_new, 404, content=data[len(data) // 2 :], headers=patch)
        user.go_on_with_upload(PRESENT_SIDE, user.begin_upload(PRESENT_SIDE, data), data)
        for side in (EARLIER_SIDE, PRESENT_SIDE):
            use_everything(user, side, scan_of_old)
        row = running.store.records.job(begun_by_old)
        assert (row.state, row.attempt) == (JobState.running, 1), "what ran did not go on"

        # The workers: what the old one has begun ends on the new one.
        running.workers.append(running.start_worker(PRESENT_SIDE, present))
        wait_until(lambda: len(running.store.queue.workers()) == 2, seconds=60)
        running.workers[EARLIER_SIDE].terminate()
        running.workers[EARLIER_SIDE].wait(30)
        user.wait_for_end(begun_by_old)
        assert_made_once(running, begun_by_old, STEPS, attempts=2)
        user.wait_for_end(waits)

        # And back: what the new one has begun ends on the old one, and what is killed there on the new one.
        begun_by_new = user.submit(PRESENT_SIDE, from_both, steps=STEPS, seed=2)
        user.wait_for_checkpoint(begun_by_new, 1)
        running.workers[PRESENT_SIDE].terminate()
        running.workers[PRESENT_SIDE].wait(30)
        running.workers[EARLIER_SIDE] = running.start_worker(EARLIER_SIDE, earlier)
        user.wait_for_checkpoint(begun_by_new, 2, step=40)
        running.workers[PRESENT_SIDE] = running.start_worker(PRESENT_SIDE, present)
        kill_tree(running.workers[EARLIER_SIDE].pid)
        user.wait_for_end(begun_by_new)
        assert_made_once(running, begun_by_new, STEPS, attempts=3)
        told = [user.jobs(side) for side in (EARLIER_SIDE, PRESENT_SIDE)]
        assert told[0] == without_additions(told[1], told[0]), "the newer one only adds to what is told of a job"
        assert {job["state"] for job in told[0]} == {"succeeded"}


def test_the_real_engine_goes_on_with_what_an_older_one_has_begun(
    tmp_path: Path, earlier: Release, distributed: Place
) -> None:
    """Of its caches and checkpoints it takes what it knows the format of, and makes the rest anew."""
    made = tmp_path / "scan.zip"
    command = [sys.executable, "-m", "advtex_engine", "synthesize", str(made), "--views", "8", "--size", "96x72"]
    subprocess.run(command, check=True, capture_output=True, timeout=120)
    with earlier_fleet(tmp_path, distributed, earlier, REAL) as running:
        user = User(running, make_key(running, earlier))
        options = {"preset": "standard", "steps": 200, "face_budget": 1000, "max_texture_size": 256}
        job = user.submit(EARLIER_SIDE, user.upload(EARLIER_SIDE, made.read_bytes()), **options)
        wait_until(lambda: user.step_of(job) >= 10, seconds=120)
        running.workers[EARLIER_SIDE].terminate()
        running.workers[EARLIER_SIDE].wait(60)
        running.servers.append(running.start_server(PRESENT_SIDE))
        wait_until(lambda: is_up(running.urls[PRESENT_SIDE]), seconds=90)
        assert running.store.records.job(job).state == JobState.preempted
        running.workers.append(running.start_worker(PRESENT_SIDE))
        user.wait_for_end(job, seconds=150)
        told = user.ask(PRESENT_SIDE, "GET", f"/v1/jobs/{job}").json()
        assert (told["attempt"], told["progress"]["step"], told["progress"]["steps"]) == (2, 200, 200)
        assert {"model.obj", "model.glb", "report.json"} <= {file["name"] for file in told["results"]}

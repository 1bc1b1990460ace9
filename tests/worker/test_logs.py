"""What a worker's processes log: one JSON object per line, with the job from the claim to its end."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from attempts import step_of
from live_service import RHYTHM, SUPPORT, process_tree, wait_until

from advtex_contract.jobs import JobState
from advtex_store.queue import JobQueue, connect_redis
from advtex_store.store import Store
from advtex_worker.settings import WorkerSettings

Start = Callable[..., subprocess.Popen[bytes]]


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return tmp_path / "worker.log"


@pytest.fixture
def start(settings: WorkerSettings, redis_url: str, log: Path) -> Iterator[Start]:
    """Starts a worker's command on the `store`, with its output in `log`."""
    started: list[subprocess.Popen[bytes]] = []
    variables = {"ADVTEX_DATA_DIR": str(settings.data_dir), "ADVTEX_REDIS_URL": redis_url}

    def run(*command: str) -> subprocess.Popen[bytes]:
        with log.open("wb") as file:
            environment = {**os.environ, **RHYTHM, **variables}
            started.append(subprocess.Popen([sys.executable, *command], env=environment, stdout=file, stderr=file))
        return started[-1]

    yield run
    for process in started:
        for pid in reversed(process_tree(process.pid)):
            os.kill(pid, signal.SIGKILL)
        process.wait()


def told(log: Path) -> list[dict[str, Any]]:
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    assert all({"event", "level", "logger", "timestamp"} <= line.keys() for line in lines)
    return lines


@pytest.mark.one_machine("about the lines of a log")
@pytest.mark.usefixtures("store")  # a schema that the worker needs
def test_the_command_logs_json(start: Start, log: Path) -> None:
    start("-m", "advtex_worker.main")
    wait_until(lambda: "takes jobs" in log.read_text(), seconds=60)
    events = [line["event"] for line in told(log)]
    if os.geteuid() == 0:
        assert "passwords included" in events.pop(0)
    assert events == ["worker begins", "worker takes jobs"]


@pytest.mark.one_machine("about the lines of a log")
def test_every_line_about_a_job_names_it(
    store: Store, start: Start, log: Path, redis_url: str, settings: WorkerSettings, new_job: Callable[..., str]
) -> None:
    """Also RQ's own, here about a work-horse that was killed."""
    queue = JobQueue(connect_redis(settings.model_copy(update={"redis_url": redis_url})))
    worker = start(str(SUPPORT / "run_worker.py"), "stepping")
    wait_until(queue.classes, seconds=60)
    (found,) = queue.classes()
    done, killed = new_job(steps=5), new_job(steps=100_000)
    queue.offer(done, 1, found.gib)
    wait_until(lambda: store.records.job(done).state == JobState.succeeded, seconds=60)
    queue.offer(killed, 1, found.gib)
    wait_until(lambda: step_of(store, killed) >= 1, seconds=60)
    os.kill(process_tree(worker.pid)[1], signal.SIGKILL)
    wait_until(lambda: "rq.worker" in log.read_text(), seconds=30)
    worker.terminate()
    worker.wait(30)
    queue.redis.close()
    lines = told(log)
    for job_id in (done, killed):
        mine = [number for number, line in enumerate(lines) if line.get("job") == job_id]
        assert {"attempt begins", "runner started"} <= {lines[number]["event"] for number in mine}
        assert mine == list(range(mine[0], mine[-1] + 1)), "a line in between does not name the job"
        assert {lines[number]["attempt"] for number in mine} == {1}
    assert {line["job"] for line in lines if line["logger"] == "rq.worker"} == {killed}
    assert [line["event"] for line in lines if "job" not in line] == ["worker takes jobs", "worker ends"]

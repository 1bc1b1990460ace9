"""When a worker goes by itself: what its command line says, notices, exit codes, and slots that are not begun again."""

from __future__ import annotations

import argparse
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from datetime import datetime
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from rq.exceptions import StopRequested

from advtex_store.queue import JobQueue, connect_redis
from advtex_worker import leaving
from advtex_worker.leaving import AGAIN, Departure, Notice, Reason, Stay, add_arguments, parent_of, read_stay
from advtex_worker.main import JobWorker
from advtex_worker.settings import WorkerSettings
from advtex_worker.slots import Slot, supervise
from advtex_worker.tasks import Host


def stay(*arguments: str) -> Stay:
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    return read_stay(parser.parse_args(arguments))


def test_the_command_line_says_how_long() -> None:
    assert stay() == Stay()
    assert stay("--max-jobs", "3", "--exit-when-idle", "60") == Stay(max_jobs=3, idle_seconds=60)
    assert stay("--until", "1800000000").until == 1_800_000_000
    assert stay("--until", "2027-01-15T08:00:00+00:00").until == 1_800_000_000
    assert stay("--until", "2027-01-15T09:30").until == datetime(2027, 1, 15, 9, 30).timestamp()
    assert stay("--notice", "/run/going").notice == "/run/going"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--max-jobs", "0"), "0 is less than 1"),
        (("--exit-when-idle", "soon"), "invalid"),
        (("--until", "tomorrow"), "'tomorrow' is neither seconds since 1970 nor a time"),
    ],
)
def test_wrong_arguments_end_it_with_two(
    arguments: tuple[str, str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        stay(*arguments)
    assert ended.value.code == 2
    assert words in capsys.readouterr().err


def test_slots_are_told_what_is_theirs() -> None:
    told = Stay(max_jobs=3, idle_seconds=60, until=1.0, notice="/run/going").slot_arguments()
    assert stay(*told) == Stay(max_jobs=3, idle_seconds=60)
    assert Stay().slot_arguments() == []


def test_the_first_reason_counts() -> None:
    departure = Departure(Stay(), 1.0)
    assert (departure.is_due(), departure.exit_code) == (False, 0)
    departure.begin_on_signal(signal.SIGUSR1)
    departure.begin_on_signal(signal.SIGTERM)
    assert (departure.reason, departure.exit_code) == (Reason.evicted, AGAIN)


def test_it_goes_early_enough_to_be_gone_in_time() -> None:
    assert not Departure(Stay(until=time.time() + 63), 30.0).is_due()
    departure = Departure(Stay(until=time.time() + 59), 30.0)
    with pytest.raises(StopRequested):
        departure.wait(60)
    assert (departure.reason, departure.exit_code) == (Reason.limit, AGAIN)


def test_it_goes_after_its_last_job() -> None:
    departure = Departure(Stay(max_jobs=2), 1.0)
    departure.count_job()
    assert departure.reason is None
    departure.count_job()
    assert (departure.reason, departure.exit_code) == (Reason.jobs, 0)


class Metadata(BaseHTTPRequestHandler):
    """What clouds answer, by the path."""

    going = False
    token = "a token"

    def do_GET(self) -> None:
        token = self.headers.get("X-aws-ec2-metadata-token")
        if self.path == "/ec2" and token != self.token:
            self._answer(401, "")
        elif self.path == "/ec2":
            self._answer(200 if self.going else 404, '{"action": "terminate"}')
        elif self.path == "/google" and self.headers.get("Metadata-Flavor") == "Google":
            self._answer(200, "TRUE" if self.going else "FALSE")
        else:
            self._answer(403, "")

    def do_PUT(self) -> None:
        there = self.path == "/latest/api/token" and self.headers.get("X-aws-ec2-metadata-token-ttl-seconds")
        self._answer(200 if there else 403, self.token)

    def log_message(self, *_: object) -> None:
        """Nothing."""

    def _answer(self, status: int, text: str) -> None:
        self.send_response(status)
        self.send_header("Content-Length", str(len(text)))
        self.end_headers()
        self.wfile.write(text.encode())


@pytest.fixture
def metadata(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    monkeypatch.setattr(leaving, "NOTICE_SECONDS", 0.0)
    monkeypatch.setattr(Metadata, "going", False)
    with ThreadingHTTPServer(("127.0.0.1", 0), Metadata) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


@pytest.mark.parametrize("cloud", ["ec2", "google"])
def test_a_cloud_gives_notice(metadata: str, cloud: str, monkeypatch: pytest.MonkeyPatch) -> None:
    notice = Notice(f"{metadata}/{cloud}")
    assert not notice.is_given()
    monkeypatch.setattr(Metadata, "going", True)
    assert notice.is_given()


def test_what_does_not_answer_is_no_notice(metadata: str) -> None:
    assert not Notice(f"{metadata}/elsewhere").is_given()
    assert not Notice("http://127.0.0.1:1/").is_given()


def test_a_file_is_a_notice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(leaving, "NOTICE_SECONDS", 0.0)
    departure = Departure(Stay(notice=str(tmp_path / "going")), 1.0)
    assert not departure.is_due()
    (tmp_path / "going").touch()
    assert departure.is_due()
    assert departure.exit_code == AGAIN


def test_slots_of_one_worker_are_idle_together(redis_url: str, tmp_path: Path) -> None:
    """Those of others are not waited for: another task of SLURM may have its job on the same machine for hours."""
    settings = WorkerSettings(data_dir=tmp_path, redis_url=redis_url)
    worker = JobWorker(Host(settings), connect_redis(settings), Departure(Stay(), 1.0), 8)
    queue, host, mine = JobQueue(worker.connection), socket.gethostname(), os.getpid()
    with subprocess.Popen(["sleep", "60"]) as others:
        queue.announce(f"{host}-{others.pid}", 8, busy=True)
        queue.announce(f"elsewhere-{mine}", 8, busy=True)
        queue.announce(f"{host}-{mine}", 8)
        assert not worker._is_sibling_busy()
        queue.announce(f"{host}-{mine}", 24, busy=True)
        assert worker._is_sibling_busy()
        others.kill()
    assert parent_of(others.pid) is None
    worker.connection.close()


# Notes that it has begun, tells the worker to go once five have, and ends with a code that is its GPU's number.
ENDING = """
import os, sys
begun, going = sys.argv[1:]
with open(begun, "a") as file:
    file.write("x")
if os.path.getsize(begun) >= 5:
    open(going, "w").close()
sys.exit(int(os.environ["ADVTEX_GPU"][-1]))
"""


def test_slots_that_have_left_are_not_begun_again_and_those_that_died_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("advtex_store.supervision.RESTART_SECONDS", (0.01,))
    monkeypatch.setattr(leaving, "NOTICE_SECONDS", 0.0)
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    begun, going, settings = tmp_path / "begun", tmp_path / "going", WorkerSettings(data_dir=tmp_path)
    command = [sys.executable, "-c", ENDING, str(begun), str(going)]
    departure = Departure(Stay(max_jobs=1), 1.0)
    supervise(command, [Slot("GPU-0", 1), Slot("GPU-0", 1)], settings, departure)
    assert begun.read_text() == "xx"
    assert departure.exit_code == 0
    noticed = Departure(Stay(max_jobs=1, notice=str(going)), 1.0)
    supervise(command, [Slot("GPU-0", 1), Slot("GPU-1", 1)], settings, noticed)
    assert len(begun.read_text()) >= 5, "the one that dies goes on being started"
    assert noticed.exit_code == AGAIN


def test_a_worker_whose_time_is_up_takes_nothing(tmp_path: Path) -> None:
    """Not even a database is needed for that."""
    command = [sys.executable, "-m", "advtex_worker.main", "--until", "1000"]
    environment = {"ADVTEX_DATA_DIR": str(tmp_path), "PYTHONPATH": ":".join(sys.path), "ADVTEX_DEVICE": "cpu"}
    assert subprocess.run(command, env=environment, timeout=60, check=False).returncode == AGAIN

"""Workers of a fleet that come and go by every way there is, and are started again as SLURM, systemd and KEDA would."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import psutil
from live_fleet import Fleet, kill_tree

from advtex_store.models import JobRow
from advtex_store.records import POISON_DEATHS
from advtex_worker.leaving import AGAIN

IDLE = "--exit-when-idle"
IDLE_SECONDS = 15
RUNNER = "advtex_worker.runner"
LOOK_SECONDS = 0.3


@dataclass(frozen=True)
class Span:
    """Seconds that a worker is there before it goes, from and to, and the grace that it is given."""

    least: float
    most: float
    grace: float


class Comings:
    """A thread per worker keeps one there until `stop`: each life ends in a way of its own, drawn from all of them
    before any comes again. `ends` counts (way, exit code); `starts` counts why the next one was started."""

    def __init__(self, fleet: Fleet, workers: int, folder: Path, span: Span, seed: int = 0) -> None:
        self._fleet, self._folder, self._span = fleet, folder, span
        self._random = random.Random(seed)
        self._choosing = threading.Lock()
        self._ways: list[str] = []
        self._done = threading.Event()
        self.ends: Counter[tuple[str, int]] = Counter()
        self.starts: Counter[str] = Counter()
        self.runners_killed = 0
        self.failures: list[str] = []
        fleet.workers = [fleet.start_worker(number, arguments=(IDLE, str(IDLE_SECONDS))) for number in range(workers)]
        self._threads = [threading.Thread(target=self._keep, args=(n,), daemon=True) for n in range(workers)]
        for thread in self._threads:
            thread.start()

    def abandon(self) -> None:
        """No more are started."""
        self._done.set()

    def stop(self) -> None:
        """The same; and wait until those that are there have gone, having been idle for long enough."""
        self.abandon()
        for thread in self._threads:
            thread.join()

    @property
    def idle_ends(self) -> int:
        return self.ends[IDLE, 0]

    def _keep(self, number: int) -> None:
        code = self._end(self._fleet.workers[number], "SIGTERM", lambda worker: worker.terminate())
        while not self._done.is_set():
            if (
                code == 0
            ):  # nothing to start again; but jobs wait, which is what KEDA, or the next sbatch, starts one for
                self.starts["exit code 0, and jobs wait"] += 1
                self._done.wait(self._random.uniform(1, 4))
            elif code == AGAIN:
                self.starts["exit code 75"] += 1
            elif code < 0:
                self.starts["killed"] += 1
            else:
                self.failures.append(f"a worker ended with exit code {code}")
                return
            if not self._done.is_set():
                code = self._live(number)

    def _live(self, number: int) -> int:
        """One worker from its start to its end. -> its exit code"""
        way = self._next_way()
        notice = self._folder / f"notice-{number}"
        notice.unlink(missing_ok=True)
        seconds = self._random.uniform(self._span.least, self._span.most)
        arguments, leave = self._how(way, notice, seconds)
        worker = self._fleet.workers[number] = self._fleet.start_worker(
            number, arguments=(IDLE, str(IDLE_SECONDS), *arguments)
        )
        return self._end(worker, way, leave, seconds)

    def _how(self, way: str, notice: Path, seconds: float) -> tuple[tuple[str, ...], Callable[..., object] | None]:
        """-> a worker's arguments, and what is done to it in the end; None where it goes by itself."""
        if way == "--max-jobs":
            return (way, str(self._random.randint(1, 5))), None
        if way == "--until":
            return (way, str(time.time() + seconds + 2 * self._span.grace)), None
        if way == "--notice":
            return (way, str(notice)), lambda _: notice.touch()
        return (), {
            "SIGTERM": lambda worker: worker.terminate(),
            "SIGUSR1 to all its processes": _signal_all,
            "kill -9 of all its processes": lambda worker: kill_tree(worker.pid),
            "kill -9 of the worker alone": lambda worker: worker.kill(),
            "kill -9 of its runner, then SIGTERM": self._kill_runner,
        }[way]

    def _next_way(self) -> str:
        with self._choosing:
            if not self._ways:
                self._ways = [
                    "--max-jobs",
                    "--until",
                    "--notice",
                    "SIGTERM",
                    "SIGUSR1 to all its processes",
                    "kill -9 of all its processes",
                    "kill -9 of the worker alone",
                    "kill -9 of its runner, then SIGTERM",
                ]
                self._random.shuffle(self._ways)
            return self._ways.pop()

    def _end(
        self, worker: subprocess.Popen[bytes], way: str, leave: Callable[..., object] | None, seconds: float = 30.0
    ) -> int:
        """Wait for its end, and bring it about when its time has come."""
        until = time.monotonic() + seconds
        while worker.poll() is None:
            due = leave is not None and time.monotonic() > until and not self._done.is_set()
            if due and not (way.startswith("kill") and self._is_spared(worker)):
                assert leave is not None
                leave(worker)
                worker.wait()
                self.ends[way, worker.returncode] += 1
                return worker.returncode
            time.sleep(LOOK_SECONDS)
        by_itself = leave is None and (way != "--max-jobs" or not self._done.is_set())
        self.ends[way if by_itself else IDLE, worker.returncode] += 1
        return worker.returncode

    def _is_spared(self, worker: subprocess.Popen[bytes]) -> bool:
        """Whether it has no job to be killed with, or one that a third death would make poison."""
        runner = _runner(worker)
        if runner is None:
            return True
        tree = {worker.pid, *(found.pid for found in psutil.Process(worker.pid).children(recursive=True))}
        with self._fleet.store.database.read() as session:
            at_risk = session.query(JobRow).filter(JobRow.state == "running", JobRow.deaths >= POISON_DEATHS - 1)
            return any(int(str(row.worker).rpartition("-")[2]) in tree for row in at_risk)

    def _kill_runner(self, worker: subprocess.Popen[bytes]) -> None:
        runner = _runner(worker)
        if runner is not None:
            runner.kill()
            self.runners_killed += 1
        self._done.wait(self._span.least)
        worker.terminate()


def _runner(worker: subprocess.Popen[bytes]) -> psutil.Process | None:
    """The process that owns the engine, if the worker has a job."""
    with suppress(psutil.Error):
        for found in psutil.Process(worker.pid).children(recursive=True):
            with suppress(psutil.Error):
                if RUNNER in found.cmdline():
                    return found
    return None


def _signal_all(worker: subprocess.Popen[bytes]) -> None:
    """As SLURM signals a step."""
    for found in [psutil.Process(worker.pid), *psutil.Process(worker.pid).children(recursive=True)]:
        with suppress(ProcessLookupError):
            os.kill(found.pid, signal.SIGUSR1)

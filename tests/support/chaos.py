"""A random schedule of everything that can go wrong around a fleet, and what must hold afterwards."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Mapping
from contextlib import suppress
from itertools import pairwise

import fake_engines
import httpx
from live_fleet import Fleet, is_up, kill_tree
from live_service import process_tree

from advtex_contract.jobs import TERMINAL, JobState
from advtex_store.errors import BlobNotFound
from advtex_store.models import JobRow

LEASE_SECONDS = 3.0
PROGRESS_SECONDS = 60.0


class Chaos:
    """Hurts a fleet on a thread of its own until `stop`, then leaves everything running and whole. Every kind of fault
    comes once in random order, then they come as chance will have it."""

    def __init__(self, fleet: Fleet, seed: int) -> None:
        self._fleet = fleet
        self._random = random.Random(seed)
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._run, name="chaos")
        self._seen = (0, 0)
        self.failure: BaseException | None = None
        self.done: dict[str, int] = defaultdict(int)
        self._actions: dict[Callable[[], None], float] = {
            self.kill_server: 3,
            self.kill_worker: 3,
            self.kill_runner: 4,
            self.kill_tree_of_worker: 2,
            self.restart_redis: 1,
            self.empty_redis: 1,
            self.terminate_all: 1,
            self.cut_lines: 2,
        }
        if fleet.place.ballast is not None:
            self._actions[self.fill_disk] = 1.5

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._done.set()
        self._thread.join()
        if self.failure is not None:
            raise self.failure

    @property
    def has_done_all(self) -> bool:
        """Whether every kind of fault has come."""
        return len(self.done) == len(self._actions) or self.failure is not None

    def _run(self) -> None:
        order = list(self._actions)
        self._random.shuffle(order)
        try:
            while not self._done.wait(self._random.uniform(0.2, 1.5)):
                self._wait_for_progress()
                chosen = order.pop() if order else self._random.choices(*zip(*self._actions.items(), strict=True))[0]
                chosen()
                self.done[chosen.__name__] += 1
                self._revive()
        except BaseException as error:
            self.failure = error
        finally:
            self._revive()

    def _wait_for_progress(self) -> None:
        """Until a server answers, and a job was made or a step was done since the last fault. On a busy machine,
        everything would else be killed again and again before it has started."""
        deadline = time.monotonic() + PROGRESS_SECONDS
        while not self._done.is_set() and time.monotonic() < deadline:
            seen = (self._fleet.journal.stat().st_size, sum(self._fleet.store.records.count_by_state().values()))
            if seen != self._seen and any(is_up(url) for url in self._fleet.urls):
                self._seen = seen
                return
            self._done.wait(0.1)

    # -- faults -------------------------------------------------------------------------------------------------

    def kill_server(self) -> None:
        """With its dispatcher."""
        _kill(self._random.choice(self._fleet.servers))

    def kill_worker(self) -> None:
        """RQ's parent alone."""
        _kill(self._random.choice(self._fleet.workers))

    def kill_runner(self) -> None:
        """The deepest process of a worker: the runner if there is one, else the work-horse."""
        tree = process_tree(self._random.choice(self._fleet.workers).pid)
        if len(tree) > 1:
            with suppress(ProcessLookupError):
                os.kill(self._random.choice(tree[1:]), signal.SIGKILL)

    def kill_tree_of_worker(self) -> None:
        worker = self._random.choice(self._fleet.workers)
        kill_tree(worker.pid)
        worker.wait()

    def restart_redis(self) -> None:
        _kill(self._fleet.redis)
        self._pause(0.0, 2.0)

    def empty_redis(self) -> None:
        _kill(self._fleet.redis)
        for path in self._fleet.redis_folder.iterdir():
            path.unlink()

    def terminate_all(self) -> None:
        for process in (*self._fleet.workers, *self._fleet.servers):
            process.terminate()
        for process in (*self._fleet.workers, *self._fleet.servers):
            process.wait(30)

    def cut_lines(self) -> None:
        """Between the workers and all that they need, for less or more than their leases."""
        chosen = [line for line in self._fleet.lines.values() if self._random.random() < 0.7]
        silently = self._random.random() < 0.5
        for line in chosen:
            line.cut(silently=silently)
        self._pause(0.2, 1.5 * LEASE_SECONDS)
        for line in chosen:
            line.mend()

    def fill_disk(self) -> None:
        folder = self._fleet.place.ballast
        assert folder is not None
        ballast = folder / "ballast"
        with suppress(OSError), ballast.open("wb", buffering=0) as file:
            while shutil.disk_usage(folder).free:
                file.write(bytes(1 << 16))
        self._pause(0.5, 2.0)
        ballast.unlink()

    def _pause(self, least: float, most: float) -> None:
        self._done.wait(self._random.uniform(least, most))

    def _revive(self) -> None:
        fleet = self._fleet
        if fleet.redis.poll() is not None:
            fleet.start_redis()
        fleet.servers = [
            fleet.start_server(n) if server.poll() is not None else server for n, server in enumerate(fleet.servers)
        ]
        fleet.workers = [
            fleet.start_worker(n) if worker.poll() is not None else worker for n, worker in enumerate(fleet.workers)
        ]


def _kill(process: subprocess.Popen[bytes]) -> None:
    """Until it is gone: one that is still going would not be started again."""
    process.kill()
    process.wait()


def insist(fleet: Fleet, key: str, method: str, path: str, **request: object) -> httpx.Response:
    """Send it until some server has answered it, as the clients do: what comes twice carries an idempotency key."""
    headers = {"Authorization": f"Bearer {key}", **request.pop("headers", {})}  # type: ignore[dict-item]
    deadline = time.monotonic() + 300
    number = 0
    while time.monotonic() < deadline:
        number += 1
        url = fleet.urls[number % len(fleet.urls)] + path
        with suppress(httpx.HTTPError):
            answer = httpx.request(method, url, headers=headers, timeout=10, **request)  # type: ignore[arg-type]
            busy = answer.status_code >= 500 or "in_flight" in answer.text
            if not busy:
                return answer
        time.sleep(0.1)
    raise AssertionError(f"{method} {path} was not answered in time")


def check_outcome(fleet: Fleet, jobs: Mapping[str, tuple[str, int, int]], canceled: set[str]) -> dict[str, int]:
    """`jobs`: id -> owner, seed, steps. -> how many ended in which state."""
    with fleet.store.database.read() as session:
        rows = list(session.query(JobRow))
    assert sorted(row.id for row in rows) == sorted(jobs), "a job was lost, or made twice"
    starts = _started(fleet)
    states: dict[str, int] = defaultdict(int)
    for row in rows:
        owner, seed, steps = jobs[row.id]
        assert row.owner == owner
        states[row.state] += 1
        events = [event.data for event in fleet.store.records.events(row.id, 0) if event.data["kind"] == "state"]
        terminal = [event["state"] for event in events if JobState(event["state"]) in TERMINAL]
        assert terminal == [row.state], f"job {row.id} ended {terminal}"
        assert events[-1]["state"] == row.state
        expected = {7: {"failed"}, 13: {"rejected"}}.get(seed % 20, {"succeeded"})
        allowed = expected | ({"canceled"} if row.id in canceled else set())
        died_for_nothing = row.state == "failed" and row.error is not None and row.error["code"] == "poison"
        assert row.state in allowed or (died_for_nothing and row.deaths >= 3), (row.id, row.state, row.error)
        _check_manifest(fleet, row, events, steps)
        _check_runners(row.id, starts[row.id])
    return dict(states)


def _check_manifest(fleet: Fleet, row: JobRow, events: list[dict[str, object]], steps: int) -> None:
    """One whole result, made from every step once, by an attempt that had been given the job."""
    try:
        manifest = fleet.store.results.manifest(row.id)
    except BlobNotFound:
        assert row.state != "succeeded"
        return
    if row.state != "succeeded":
        assert row.state == "canceled", "a result of a job that did not succeed"
        return
    assert row.results == [file.model_dump() for file in manifest.files]
    assert {file.key.split("/")[3] for file in manifest.files} == {str(manifest.attempt)}
    ran = [event["attempt"] for event in events if event["state"] == "running"]
    assert ran == sorted(set(ran)), "an attempt was given out twice"  # type: ignore[type-var]
    assert manifest.attempt == ran[-1], "committed by an attempt that had lost its job"
    (model,) = [file for file in manifest.files if file.name == "model.obj"]
    state = json.loads(fleet.store.blobs.get(model.key).decode().split("\n", 1)[1])
    assert (state["step"], state["chain"]) == (steps, fake_engines.chain(steps))


def _started(fleet: Fleet) -> dict[str, dict[int, list[float]]]:
    """Job -> attempt -> times of its steps, from the engines' journal."""
    found: dict[str, dict[int, list[float]]] = defaultdict(lambda: defaultdict(list))
    for line in fleet.journal.read_text().splitlines():
        when, workspace, _step = line.split()
        _, job_id, attempt = workspace.split("-")
        found[job_id][int(attempt)].append(float(when))
    return found


def _check_runners(job_id: str, steps: Mapping[int, list[float]]) -> None:
    """No two at once: an attempt's last step comes before the first of the next."""
    order = sorted(steps)
    for earlier, later in pairwise(order):
        overlap = max(steps[earlier]) - min(steps[later])
        assert overlap < 0, f"job {job_id}: attempts {earlier} and {later} ran at once for {overlap:.2f} s"

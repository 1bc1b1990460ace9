"""An hour of work and kills: nothing is lost, and the memory of those who live through it does not grow.

`ADVTEX_SOAK_MINUTES` sets another length; a few minutes tell whether the test itself works.
"""

from __future__ import annotations

import os
import random
import statistics
import threading
import time
from contextlib import suppress
from pathlib import Path

import httpx
import psutil
import pytest
from chaos import LEASE_SECONDS, check_outcome, insist
from live_fleet import Fleet, Place, fleet, kill_tree
from live_service import process_tree, wait_until
from tiny_scan import write_zip

from advtex_contract.jobs import TERMINAL

MINUTES = float(os.environ.get("ADVTEX_SOAK_MINUTES", "60"))
WARM_SHARE = 0.25  # of the time, in which pools and caches fill
GROWTH = 1 << 20  # bytes per hour; in shorter runs no more than that in all
AT_ONCE = 12  # jobs that are not done yet
SAMPLE_SECONDS = 1.0


@pytest.mark.soak
@pytest.mark.timeout(60 * MINUTES + 1200)
def test_memory_does_not_grow(tmp_path: Path, scan: Path, postgres_url: str, s3_url: str) -> None:
    s3 = {name: value for name, value in os.environ.items() if name.startswith("AWS_")}
    place = Place(tmp_path / "data", postgres_url, s3_url, s3)
    archive = write_zip(tmp_path / "scan.zip", scan).read_bytes()
    with fleet(tmp_path, place, servers=2, workers=3, engine="journaled") as running:
        key = running.store.accounts.create_key("soak", owner="soak")
        users = Users(running, key, archive)
        watch = Watch({"server with its dispatcher": running.servers[0].pid, "worker": running.workers[0].pid})
        done = threading.Event()
        threads = [threading.Thread(target=act, args=(done,)) for act in (users.submit, users.look, watch.sample)]
        for thread in threads:
            thread.start()
        try:
            kills = hurt_others(running, 60 * MINUTES)
        finally:
            done.set()
            for thread in threads:
                thread.join()
        wait_until(lambda: unfinished(running) == 0, seconds=240)
        states = check_outcome(running, users.jobs, set())
    grown = {name: watch.growth(name) for name in watch.samples}
    for name, (first, last, slope) in grown.items():
        print(f"{name}: {first / 2**20:.1f} to {last / 2**20:.1f} MiB, fitted {slope / 2**20:+.2f} MiB per hour")
    print(f"{states} in {MINUTES:g} min, {kills} faults, {users.looks} looks")
    assert users.looks > 0
    assert kills > MINUTES, "hardly anything happened"
    hours = MINUTES * (1 - WARM_SHARE) / 60
    for name, (_, _, slope) in grown.items():
        assert slope * hours < GROWTH * max(hours, 1.0), f"{name} grows by {slope / 2**20:.2f} MiB per hour"


class Users:
    """They always have some jobs, and follow them."""

    def __init__(self, running: Fleet, key: str, archive: bytes) -> None:
        self._fleet, self._key, self._archive = running, key, archive
        self.jobs: dict[str, tuple[str, int, int]] = {}
        self.looks = 0

    def submit(self, done: threading.Event) -> None:
        upload = insist(self._fleet, self._key, "POST", "/v1/uploads", content=self._archive).json()["id"]
        number = 0
        while not done.wait(0.2):
            if unfinished(self._fleet) >= AT_ONCE:
                continue
            number += 1
            steps = 20 + number % 50
            body = {"upload_id": upload, "options": {"seed": number, "steps": steps}}
            headers = {"Idempotency-Key": f"soak-{number}"}
            answer = insist(self._fleet, self._key, "POST", "/v1/jobs", json=body, headers=headers)
            self.jobs[answer.json()["id"]] = ("soak", number, steps)

    def look(self, done: threading.Event) -> None:
        """What pages, clients and monitoring ask of the server that is watched."""
        headers = {"Authorization": f"Bearer {self._key}"}
        with httpx.Client(base_url=self._fleet.urls[0], headers=headers, timeout=20) as http:
            while not done.wait(0.2):
                with suppress(httpx.HTTPError):
                    newest = http.get("/v1/jobs").raise_for_status().json()["jobs"]
                    http.get("/metrics")
                    http.get("/readyz")
                    for job in newest[:1]:
                        with http.stream("GET", f"/v1/jobs/{job['id']}/events") as stream:
                            for line in stream.iter_lines():
                                if done.is_set() or line == "event: state":
                                    break
                    self.looks += 1


class Watch:
    """Resident memory of processes that nobody kills."""

    def __init__(self, pids: dict[str, int]) -> None:
        self._processes = {name: psutil.Process(pid) for name, pid in pids.items()}
        self.samples: dict[str, list[tuple[float, int]]] = {name: [] for name in pids}

    def sample(self, done: threading.Event) -> None:
        while not done.wait(SAMPLE_SECONDS):
            for name, process in self._processes.items():
                self.samples[name].append((time.monotonic(), process.memory_info().rss))

    def growth(self, name: str) -> tuple[int, int, float]:
        """-> bytes after warming up, bytes in the end, and bytes per hour of a line through all in between."""
        warm = self.samples[name][int(WARM_SHARE * len(self.samples[name])) :]
        slope = statistics.linear_regression([at / 3600 for at, _ in warm], [size for _, size in warm]).slope
        return warm[0][1], warm[-1][1], slope


def hurt_others(running: Fleet, seconds: float) -> int:
    """Faults of all kinds that the first server and the first worker live through. -> how many"""
    chance = random.Random(5)

    def kill_server() -> None:
        running.servers[1].kill()

    def kill_worker() -> None:
        kill_tree(running.workers[chance.choice([1, 2])].pid)

    def kill_runner() -> None:
        tree = process_tree(chance.choice(running.workers).pid)
        if len(tree) > 1:
            with suppress(ProcessLookupError):
                os.kill(tree[-1], 9)

    def restart_redis() -> None:
        running.redis.kill()

    def cut_lines() -> None:
        for line in running.lines.values():
            line.cut(silently=chance.random() < 0.5)
        time.sleep(chance.uniform(0.2, 1.5 * LEASE_SECONDS))
        for line in running.lines.values():
            line.mend()

    count, until = 0, time.monotonic() + seconds
    while time.monotonic() < until:
        chance.choice([kill_server, kill_worker, kill_runner, kill_runner, restart_redis, cut_lines])()
        count += 1
        time.sleep(chance.uniform(0.5, 2.0))
        if running.redis.poll() is not None:
            running.start_redis()
        if running.servers[1].poll() is not None:
            running.servers[1] = running.start_server(1)
        for number in (1, 2):
            if running.workers[number].poll() is not None:
                running.workers[number] = running.start_worker(number)
        time.sleep(chance.uniform(2.0, 8.0))
    assert running.servers[0].poll() is None
    assert running.workers[0].poll() is None
    return count


def unfinished(running: Fleet) -> int:
    counts = running.store.records.count_by_state()
    return sum(count for state, count in counts.items() if state not in TERMINAL)

"""A thousand workers and a hundred thousand jobs: `python tests/benchmarks/fleet.py`.

Real are the store, its database and Redis, the dispatcher, and of a worker all that it does with them: it announces
itself, takes attempts, claims them, beats. Simulated is the work. For each number of jobs that wait it measures rounds
of the dispatcher, claims, how soon an idle worker has its next job while the fleet is at work, and what the heartbeats
of all workers cost; for each number of jobs that have ended, the size of the database and the time of lists, metrics
and housekeeping. Everything runs on this one machine, the database included. Prints whether each limit holds.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import logging
import math
import random
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psycopg
import structlog
from harness import RESULTS, Results, Stopwatch, markdown_table, write_report
from sqlalchemy import insert, text

from advtex_contract.jobs import JobState, Progress
from advtex_contract.options import JobOptions
from advtex_server.dispatch import Dispatcher
from advtex_server.embedded import free_port, redis_binary
from advtex_server.metrics import Metrics
from advtex_server.settings import ServerSettings
from advtex_store.database import upgrade_database
from advtex_store.errors import StaleAttempt
from advtex_store.ids import new_id
from advtex_store.memory_estimate import GIB
from advtex_store.models import EventRow, JobRow, UploadRow
from advtex_store.queue import attempt_of, queue_name
from advtex_store.retention import HIDDEN, Retention
from advtex_store.store import Store, open_store
from advtex_store.submissions import JobFilter
from advtex_worker.lease import LeaseKeeper

sys.path.append(str(Path(__file__).parents[1] / "support"))

from postgres import postgres

CLASSES = (8, 16, 24)  # GiB
OWNERS = 50
LEASE_SECONDS = 3600.0  # attempts are begun long before their heartbeats are
THREADS = 12
BEATING_PROCESSES = 2
TURN_SECONDS = 0.5  # a worker's default
ENDING_PER_SECOND = 20.0  # jobs of the whole fleet: a thousand that take 50 s each
ROUNDS = 20
ROWS = 1000  # inserted at once
EVENTS = 8  # of a finished job
LIMITS = {"idle_round_ms": 50.0, "offer_s": 2.0, "next_job_p95_s": 2.0, "commits_per_s": 300.0}
SQLITE_FACTOR = 5.0
WAITING = {
    "idle_round_ms": "round, nothing to do (ms)",
    "offer_s": "offering each worker one (s)",
    "reconcile_ms": "reconciling (ms)",
    "claims_per_s": "claims/s",
    "next_job_p50_s": "next job, median (s)",
    "next_job_p95_s": "next job, p95 (s)",
    "commits_per_s": "commits/s of heartbeats",
    "looks_per_s": "looks/s",
}
ENDED = {
    "database_mib": "database (MiB)",
    "list_ms": "list (ms)",
    "list_by_state_ms": "list by state (ms)",
    "list_end_ms": "last page (ms)",
    "metrics_ms": "metrics (ms)",
    "housekeeping_ms": "housekeeping, nothing due (ms)",
    "expire_ms": "hiding 1,000 (ms)",
    "purge_ms": "removing 100 (ms)",
}


@dataclass(frozen=True)
class Fleet:
    """How many there are, and for how many seconds they are watched at work."""

    database: str
    jobs: int
    workers: int
    seconds: float = 30.0


@dataclass
class Worker:
    """One that is simulated, and the attempt that it has."""

    name: str
    gib: int
    held: tuple[str, int] | None = None


@contextmanager
def opened(fleet: Fleet, server: str | None) -> Iterator[Store]:
    """A store on an empty database. server: the URL of a PostgreSQL, None for SQLite."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        port = free_port()
        command = [redis_binary(), "--port", str(port), "--bind", "127.0.0.1", "--save", "", "--dir", str(folder)]
        redis = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        stack.callback(redis.wait)
        stack.callback(redis.kill)
        database = ""
        if server is not None:
            name = f"fleet_{new_id(time.time())}"
            with psycopg.connect(server + "postgres", autocommit=True) as connection:
                connection.execute(f"create database {name}")
            database = server + name
        settings = ServerSettings(
            data_dir=folder / "data",
            database_url=database,
            redis_url=f"redis://127.0.0.1:{port}/0",
            lease_seconds=LEASE_SECONDS,
        )
        upgrade_database(settings.database)
        store = open_store(settings)
        stack.callback(store.close)
        while True:
            try:
                store.queue.redis.ping()
                break
            except OSError:
                time.sleep(0.1)
        yield store


def rows_of_jobs(store: Store, count: int, state: JobState) -> None:
    """That many jobs with their uploads, of fifty owners, made one second after another until now."""
    options, progress = JobOptions().model_dump(mode="json"), Progress(stage="previews").model_dump(mode="json")
    result = {"name": "model.glb", "key": "k", "size": 1, "sha256": "ab" * 32, "content_type": "model/gltf-binary"}
    ended = state == JobState.succeeded
    now = time.time()
    for start in range(0, count, ROWS):
        jobs = []
        for number in range(start, min(start + ROWS, count)):
            made = now - count + number
            jobs.append(
                {
                    "id": new_id(made),
                    "owner": f"owner-{number % OWNERS}",
                    "upload_id": new_id(made),
                    "state": state,
                    "priority": number % 3,
                    "memory_bytes": (1 + number % max(CLASSES)) * GIB - number % 7,
                    "options": options,
                    "progress": progress,
                    "warnings": [],
                    "results": [result] * 6 if ended else [],
                    "created_at": made,
                    "updated_at": made,
                    "finished_at": made if ended else None,
                    "expires_at": now + 86400.0 if ended else None,
                    "tidied_at": made if ended else None,
                    "retention_seconds": 86400,
                }
            )
        uploads = [
            {"id": job["upload_id"], "owner": job["owner"], "filename": "scan.zip", "size": 1, "offset": 1}
            | {"sha256": "ab" * 32, "created_at": job["created_at"], "expires_at": now + 86400.0}
            for job in jobs
        ]
        events = [
            {"job_id": job["id"], "version": version, "data": {"kind": "state", "state": state, "attempt": 1}}
            for job in jobs
            for version in range(1, EVENTS + 1 if ended else 2)
        ]
        with store.database.write() as session:
            session.execute(insert(UploadRow), uploads)
            session.execute(insert(JobRow), jobs)
            session.execute(insert(EventRow), events)


def seconds_of(act: Callable[[], object]) -> float:
    watch = Stopwatch()
    act()
    return watch.seconds


def median_ms(act: Callable[[], object], times: int = 5) -> float:
    return 1e3 * statistics.median(seconds_of(act) for _ in range(times))


class Simulation:
    """The fleet's workers, which share a few threads."""

    def __init__(self, store: Store, count: int) -> None:
        self.store = store
        self.workers = [Worker(f"host-{number}", CLASSES[number % len(CLASSES)]) for number in range(count)]
        self._done = threading.Event()

    def announce(self) -> None:
        pipeline = self.store.queue.redis.pipeline(transaction=False)
        for worker in self.workers:
            self.store.queue.announce(worker.name, worker.gib, pipeline, busy=worker.held is not None)
        pipeline.execute()

    def take(self, worker: Worker) -> bool:
        """What RQ and the work-horse do with the next attempt of the worker's queue. -> whether it now has one."""
        redis = self.store.queue.redis
        taken = redis.lpop(f"rq:queue:{queue_name(worker.gib)}")
        if taken is None:
            return False
        job_id, attempt = attempt_of(taken.decode())
        try:
            self.store.records.claim(job_id, attempt, worker.name)
        except StaleAttempt:
            return False
        worker.held = (job_id, attempt)
        self.store.queue.announce(worker.name, worker.gib, busy=True)
        redis.delete(f"rq:job:{taken.decode()}")
        return True

    def claim_all(self) -> float:
        """Every worker takes one. -> claims per second."""
        watch = Stopwatch()
        with ThreadPoolExecutor(THREADS) as threads:
            taken = sum(threads.map(self.take, self.workers))
        return taken / watch.seconds

    def next_job(self, worker: Worker) -> float:
        """The worker ends its job, somebody sends another, and it takes the next. -> seconds that it had none."""
        assert worker.held is not None
        rows_of_jobs(self.store, 1, JobState.queued)
        self.store.records.succeed(*worker.held, [])
        worker.held = None
        watch = Stopwatch()
        self.store.queue.announce(worker.name, worker.gib)
        while not self.take(worker):
            time.sleep(0.02)
        return watch.seconds

    def churn(self, seconds: float) -> list[float]:
        """Jobs end and workers take the next ones, while a dispatcher does its rounds. -> seconds of each with none."""
        assert isinstance(self.store.settings, ServerSettings)
        dispatcher = Dispatcher(self.store, self.store.settings)
        rounds = threading.Thread(target=lambda: asyncio.run(self._dispatch(dispatcher)))
        signs = threading.Thread(target=self._live)
        for thread in (rounds, signs):
            thread.start()
        busy = [worker for worker in self.workers if worker.held]
        random.Random(0).shuffle(busy)
        try:
            with ThreadPoolExecutor(THREADS) as threads:
                waits = []
                for worker in busy[: int(seconds * ENDING_PER_SECOND)]:
                    waits.append(threads.submit(self.next_job, worker))
                    time.sleep(1 / ENDING_PER_SECOND)
                return [wait.result() for wait in waits]
        finally:
            self._done.set()
            for thread in (rounds, signs):
                thread.join()

    async def _dispatch(self, dispatcher: Dispatcher) -> None:
        task = asyncio.create_task(dispatcher.run())
        while not self._done.is_set():
            await asyncio.sleep(0.1)
        task.cancel()

    def _live(self) -> None:
        while not self._done.wait(5.0):
            self.announce()


def measure_waiting(store: Store, fleet: Fleet) -> dict[str, float]:
    assert isinstance(store.settings, ServerSettings)
    rows_of_jobs(store, fleet.jobs, JobState.queued)
    dispatcher = Dispatcher(store, store.settings)
    simulation = Simulation(store, fleet.workers)
    simulation.announce()
    offering = [seconds_of(dispatcher.dispatch)]  # an attempt for each idle worker
    claims = simulation.claim_all()
    offering.append(seconds_of(dispatcher.dispatch))  # and one behind each
    found = {
        "offer_s": max(offering),
        "idle_round_ms": median_ms(dispatcher.dispatch, ROUNDS),
        "reconcile_ms": median_ms(dispatcher.reconcile),
        "claims_per_s": claims,
    }
    waits = statistics.quantiles(simulation.churn(fleet.seconds), n=20)
    found |= {"next_job_p50_s": waits[9], "next_job_p95_s": waits[18]}
    return found | measure_heartbeats(
        store, [worker.held for worker in simulation.workers if worker.held], fleet.seconds
    )


def measure_heartbeats(store: Store, held: Sequence[tuple[str, int]], seconds: float) -> dict[str, float]:
    """Of all running jobs, by processes of their own."""
    settings = store.settings.model_dump(
        mode="json", include={"data_dir", "database_url", "redis_url", "lease_seconds"}
    )
    command = [sys.executable, __file__, "--beat"]
    processes = []
    for number in range(BEATING_PROCESSES):
        told = {"settings": settings, "held": held[number::BEATING_PROCESSES], "seconds": seconds}
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert process.stdin is not None
        process.stdin.write(json.dumps(told) + "\n")
        process.stdin.flush()
        processes.append(process)
    reports = [json.loads(process.communicate()[0]) for process in processes]
    return {name: sum(report[name] for report in reports) for name in ("commits_per_s", "looks_per_s")}


def beat(told: Mapping[str, Any]) -> dict[str, float]:
    """The heartbeats of some workers, for so many seconds after a turn of each. -> how many of both kinds there were.

    What was committed is counted where it is, in `Records.heartbeat`: PostgreSQL counts reads as well.
    """
    store = open_store(ServerSettings(**told["settings"]))
    commits, looks = Counted(store.records, "heartbeat"), Counted(store.records, "lease")
    keepers = [keeper_of(store, job_id, attempt) for job_id, attempt in told["held"]]
    generator = random.Random(0)
    begin = time.monotonic() + 1.0
    due = [begin + generator.uniform(0, TURN_SECONDS) for _ in keepers]
    until = begin + told["seconds"]

    def work(mine: range) -> None:
        turn = 0
        while time.monotonic() < until:
            turn += 1
            for number in mine:
                time.sleep(max(0.0, due[number] - time.monotonic()))
                keepers[number].report(Progress(stage="optimization", step=turn, steps=4000), turn)
                keepers[number].turn()
                due[number] += TURN_SECONDS

    with ThreadPoolExecutor(THREADS) as threads:
        list(threads.map(work, [range(start, len(keepers), THREADS) for start in range(THREADS)]))
    store.close()
    spent = time.monotonic() - begin
    return {"commits_per_s": commits.count / spent, "looks_per_s": looks.count / spent}


class Counted:
    """Calls of one method, counted."""

    def __init__(self, owner: object, name: str) -> None:
        self.count = 0
        method = getattr(owner, name)

        def counting(*arguments: Any, **named: Any) -> Any:
            self.count += 1
            return method(*arguments, **named)

        setattr(owner, name, counting)


def keeper_of(store: Store, job_id: str, attempt: int) -> LeaseKeeper:
    return LeaseKeeper(
        store.records,
        job_id,
        attempt,
        interval=TURN_SECONDS,
        on_ending=lambda _: None,
        log_tail=lambda: "",
        show=lambda progress, paused: store.live_progress.tell(job_id, attempt, progress, paused),
    )


def measure_ended(store: Store, fleet: Fleet) -> dict[str, float]:
    rows_of_jobs(store, fleet.jobs, JobState.succeeded)
    metrics, retention = Metrics(store), Retention(store.database, store.blobs)
    listing, owner = store.submissions.list_jobs, "owner-7"
    oldest, last = "f" * 32, None
    while last is None or last[1] is not None:
        last = listing(owner, cursor=None if last is None else last[1], limit=200)
        oldest = last[0][0].id

    def keep_house() -> None:
        retention.expire()
        retention.purge()
        retention.tidy()

    found = {
        "database_mib": database_mib(store),
        "list_ms": median_ms(lambda: listing(owner)),
        "list_by_state_ms": median_ms(lambda: listing(owner, JobFilter(state=JobState.succeeded))),
        "list_end_ms": median_ms(lambda: listing(owner, cursor=oldest)),
        "metrics_ms": median_ms(metrics.exposition),
        "housekeeping_ms": median_ms(keep_house),
    }
    with store.database.write() as session:
        session.execute(text("update jobs set expires_at = created_at"))
    found["expire_ms"] = 1e3 * seconds_of(retention.expire) * HIDDEN / min(HIDDEN, fleet.jobs)
    found["purge_ms"] = 1e3 * seconds_of(retention.purge)
    return found


def database_mib(store: Store) -> float:
    with store.database.read() as session:
        if store.database.engine.dialect.name == "postgresql":
            size = session.scalar(text("select pg_database_size(current_database())"))
        else:
            session.execute(text("pragma wal_checkpoint(truncate)"))
            size = session.scalar(text("select page_count * page_size from pragma_page_count(), pragma_page_size()"))
    return float(size or 0) / (1 << 20)


def exponent(jobs: Sequence[float], values: Sequence[float]) -> float:
    """Of the power of the number of jobs that fits best: 0 where the values do not grow, 1 where they grow alike."""
    if min(values) <= 0:
        return math.nan
    return statistics.linear_regression([math.log(n) for n in jobs], [math.log(value) for value in values]).slope


def limits_of(fleet: Mapping[str, Any]) -> dict[str, float]:
    """Of rates and times of this database; the rate of commits is PostgreSQL's."""
    if fleet["database"] == "postgresql":
        return LIMITS
    return {name: SQLITE_FACTOR * limit for name, limit in LIMITS.items() if name != "commits_per_s"}


def verdicts(cells: Sequence[Mapping[str, Any]]) -> list[tuple[str, float, float]]:
    """(what, measured, limit) of the largest fleet on each database."""
    found = []
    for database in sorted({cell["settings"]["database"] for cell in cells}):
        mine = [cell for cell in cells if cell["settings"]["database"] == database and "claims_per_s" in cell["scores"]]
        if mine:
            largest = max(mine, key=lambda cell: cell["settings"]["jobs"])
            for name, limit in limits_of(largest["settings"]).items():
                found.append((f"{database}, {WAITING[name]}", largest["scores"][name], limit))
    return found


def report(cells: Sequence[Mapping[str, Any]]) -> str:
    parts = []
    for title, names in (("Jobs that wait", WAITING), ("Jobs that have ended", ENDED)):
        mine = [cell for cell in cells if next(iter(names)) in cell["scores"]]
        rows: list[list[object]] = []
        for database in sorted({cell["settings"]["database"] for cell in mine}):
            of_it = [cell for cell in mine if cell["settings"]["database"] == database]
            of_it.sort(key=lambda cell: cell["settings"]["jobs"])
            for cell in of_it:
                settings = cell["settings"]
                head = [database, f"{settings['jobs']:,}", f"{settings['workers']:,}"]
                rows.append([*head, *(float(cell["scores"][name]) for name in names)])
            if len(of_it) > 1:
                jobs = [cell["settings"]["jobs"] for cell in of_it]
                grown = [exponent(jobs, [cell["scores"][name] for cell in of_it]) for name in names]
                rows.append([f"{database}, grows with jobs to the power of", "", "", *(f"{g:+.2f}" for g in grown)])
        parts.append(f"## {title}\n\n" + markdown_table(["database", "jobs", "workers", *names.values()], rows))
    lines = [
        f"- {'holds' if value < limit else 'does not hold'}: {what}: {value:.3g}, limit {limit:g}"
        for what, value, limit in verdicts(cells)
    ]
    return "\n".join([*parts, "## Limits, at the most jobs\n", *lines, ""])


def run(fleet: Fleet, ended: bool, results: Results, server: str | None) -> None:
    """One cell, unless it is there."""
    kind = "ended" if ended else "waiting"
    settings = {"jobs_are": kind, "database": fleet.database, "jobs": fleet.jobs, "workers": fleet.workers}
    if results.find(settings) is None:
        watch = Stopwatch()
        with opened(fleet, server) as store:
            scores = (measure_ended if ended else measure_waiting)(store, fleet)
        results.add(settings, scores, watch.seconds)


def main() -> int:
    """-> the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, nargs="+", default=[1_000, 10_000, 100_000])
    parser.add_argument("--workers", type=int, default=1_000)
    parser.add_argument("--sqlite-jobs", type=int, nargs="+", default=[1_000, 10_000])
    parser.add_argument("--sqlite-workers", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=30.0, help="that each fleet is watched at work")
    parser.add_argument("--results", type=Path, default=RESULTS / "fleet", help="folder of the results")
    parser.add_argument("--beat", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.WARNING))
    if arguments.beat:
        print(json.dumps(beat(json.loads(sys.stdin.readline()))))
        return 0
    results = Results(arguments.results / "fleet.json")
    for ended in (False, True):
        for jobs in arguments.sqlite_jobs:
            run(Fleet("sqlite", jobs, arguments.sqlite_workers, arguments.seconds), ended, results, None)
        with postgres(durable=True) as server:
            for jobs in arguments.jobs:
                run(Fleet("postgresql", jobs, arguments.workers, arguments.seconds), ended, results, server)
    write_report(arguments.results / "fleet.md", "A fleet, simulated", results.cells, report(results.cells))
    for what, value, limit in verdicts(results.cells):
        print(f"{'PASS' if value < limit else 'FAIL'} {what}: {value:.3g}, limit {limit:g}")
    return 0 if all(value < limit for _, value, limit in verdicts(results.cells)) else 1


if __name__ == "__main__":
    sys.exit(main())

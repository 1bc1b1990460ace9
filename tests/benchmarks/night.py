"""A night of small scenes with workers that come and go: `python tests/benchmarks/night.py --scenes 300 --workers 3`.

Everything is real: a server, a dispatcher of its own, PostgreSQL, Redis, S3 (moto's), `advtex-worker` with the engine,
and `advtex-client batch submit` of a root like ScanNet's. Workers leave by every way there is, and are started again
as systemd, SLURM and KEDA do; Redis is emptied once, server and dispatcher are restarted once, and the batch is paused
once. Two scenes are broken. A smaller second night is compared with the first. It ends with `night.md`, the report
of the batch, and the trace of a job that lost a worker; exit code 1 if a job was lost, or done twice.

While it runs, the server's address and a key for `/fleet` are in `place.json` of the folder.
"""

from __future__ import annotations

import argparse
import datetime
import json
import logging
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import boto3
import psycopg
from harness import RESULTS, command, markdown_table
from moto.server import ThreadedMotoServer

sys.path.append(str(Path(__file__).parents[1] / "support"))

from collector import Collector, Received, collector
from comings import Comings, Span
from live_fleet import Fleet, Place, fleet, is_up
from live_service import wait_until
from postgres import postgres
from scannet_root import scene_name, write_root
from waterfall import draw_trace, worth_showing

from advtex_contract.jobs import TERMINAL, JobState
from advtex_engine.runtime.files import write_atomically
from advtex_server.embedded import free_port
from advtex_store.accounts import SCOPES
from advtex_store.errors import BlobNotFound
from advtex_store.models import JobRow
from advtex_store.store import Store

SMALL = ["--preset", "paper", "--size", "96x72", "--holdout", "4", "--max-texture-size", "256", "--outputs", "glb"]
FIRST = ["--method", "mean", *SMALL]
SECOND = ["--steps", "12", *SMALL]
SECOND_SHARE = 25  # the second night has so many times fewer scenes
LOOK_SECONDS = 2.0
SETTINGS = {
    "ADVTEX_LEASE_SECONDS": "20",
    "ADVTEX_DISPATCH_SECONDS": "1",
    "ADVTEX_RECONCILE_SECONDS": "5",
    "ADVTEX_HEARTBEAT_SECONDS": "0.5",
    "ADVTEX_GRACE_SECONDS": "10",
    "ADVTEX_QUEUE_DEPTH": "1",
    "ADVTEX_MEMORY_BYTES": str(4 << 30),
    "ADVTEX_WEBHOOK_ALLOW_HTTP": "true",
    "ADVTEX_WEBHOOK_NETWORKS": '["127.0.0.0/8"]',
}
SPAN = Span(least=40.0, most=160.0, grace=10.0)


@dataclass
class Night:
    """A fleet at work, and what came of it. `told`: what was done to it, in the order of time."""

    fleet: Fleet
    folder: Path
    key: str
    began: float = field(default_factory=time.time)
    told: list[str] = field(default_factory=list)
    submission: Future[str] = field(default_factory=Future)

    def client(self, *arguments: str, check: bool = True) -> str:
        """What `advtex-client` says, as its user runs it. RuntimeError if it ends with another exit code than 0."""
        home = str(self.folder / "home")
        environment = {**os.environ, "HOME": home, "XDG_STATE_HOME": home, "XDG_CONFIG_HOME": home}
        environment |= {"ADVTEX_URL": self.fleet.urls[0], "ADVTEX_API_KEY": self.key}
        line = [sys.executable, "-m", "advtex_client.cli", *arguments]
        ran = subprocess.run(line, env=environment, capture_output=True, text=True, check=False)
        if check and ran.returncode != 0:
            raise RuntimeError(f"advtex-client {' '.join(arguments)}: {ran.stderr}")
        return ran.stdout

    def tell(self, what: str) -> None:
        self.told.append(f"{(time.time() - self.began) / 60:.0f} min: {what}")
        print(self.told[-1], flush=True)


@contextmanager
def surroundings() -> Iterator[tuple[str, str, Mapping[str, str]]]:
    """-> the URL of an empty database, of a bucket, and the variables that lead to it."""
    with ExitStack() as stack:
        server = stack.enter_context(postgres())
        with psycopg.connect(server + "postgres", autocommit=True) as connection:
            connection.execute("create database night")
        moto = ThreadedMotoServer("127.0.0.1", free_port(), verbose=False)
        logging.getLogger("werkzeug").setLevel(logging.ERROR)  # which tells of each request
        moto.start()
        stack.callback(moto.stop)
        endpoint = f"http://127.0.0.1:{moto._port}"
        given = {"AWS_ENDPOINT_URL": endpoint, "AWS_ACCESS_KEY_ID": "night", "AWS_SECRET_ACCESS_KEY": "night"}
        keys = {"aws_access_key_id": "night", "aws_secret_access_key": "night"}
        boto3.client("s3", region_name="us-east-1", endpoint_url=endpoint, **keys).create_bucket(Bucket="night")
        yield f"{server}night", "s3://night/advtex", {**given, "AWS_REGION": "us-east-1"}


def ended(store: Store) -> int:
    counts = store.records.count_by_state()
    return sum(count for state, count in counts.items() if state in TERMINAL)


def run_nights(night: Night, roots: Sequence[Path], scenes: Sequence[int], workers: int) -> Comings:
    """Submit and carry out both, and disturb the first."""
    running = night.fleet
    with ThreadPoolExecutor(1) as pool, ExitStack() as stack:
        night.submission = pool.submit(night.client, "batch", "submit", str(roots[0]), "--id", "night", *FIRST)
        wait_until(lambda: running.store.records.count_by_state() or night.submission.done(), seconds=300)
        comings = Comings(running, workers, night.folder, SPAN)
        stack.callback(comings.abandon)
        disturb(night, comings, scenes[0])
        _wait(night, scenes[0], comings)
        night.tell("the first night has ended")
        night.client("batch", "submit", str(roots[1]), "--id", "night2", *SECOND)
        _wait(night, sum(scenes), comings)
        night.tell("the second night has ended")
        comings.stop()
    return comings


def disturb(night: Night, comings: Comings, scenes: int) -> None:
    """What happens to the rest of the service: at a quarter, half, and three quarters of the night."""
    running = night.fleet
    _wait(night, scenes // 4, comings)
    running.redis.kill()
    running.redis.wait()
    for path in running.redis_folder.iterdir():
        path.unlink()
    running.start_redis()
    night.tell("Redis was killed, its files removed, and started again")
    _wait(night, scenes // 2, comings)
    running.servers[0].terminate()
    running.servers[0].wait()
    running.servers = [running.start_server(0)]
    wait_until(lambda: is_up(running.urls[0]), seconds=120)
    night.tell("the server was restarted")
    _wait(night, 5 * scenes // 8, comings)
    dispatcher = running.dispatchers[-1]
    dispatcher.kill()
    dispatcher.wait()
    running.start_dispatcher()
    night.tell("the dispatcher was killed, and started again")
    _wait(night, 3 * scenes // 4, comings)
    idle = comings.idle_ends
    night.client("batch", "pause", "night")
    wait_until(lambda: comings.idle_ends >= idle + 2, seconds=400)
    night.client("batch", "resume", "night")
    night.tell(f"the batch was paused, until {comings.idle_ends - idle} workers had gone, and resumed")


def _wait(night: Night, jobs: int, comings: Comings) -> None:
    """Until so many have ended."""
    while (count := ended(night.fleet.store)) < jobs:
        if comings.failures:
            raise RuntimeError(comings.failures[0])
        if night.submission.done():
            night.submission.result()  # raises what went wrong
        minutes, gone = (time.time() - night.began) / 60, sum(comings.ends.values())
        print(f"{minutes:.1f} min: {count} ended, {gone} workers gone", end="\r", flush=True)
        time.sleep(LOOK_SECONDS)


def check(store: Store, rows: Sequence[JobRow], spans: Sequence[Received]) -> list[str]:
    """-> what is wrong: jobs that are missing or twice there, that did not end once, or whose results are not those of
    their last attempt."""
    wrong = []
    labels = sorted(row.label for row in rows if row.batch == "night")
    if labels != [scene_name(number) for number in range(len(labels))]:
        wrong.append("the jobs are not those of the scenes")
    finished = Counter(
        str(span.attributes["advtex.job"])
        for span in spans
        if span.name == "attempt" and span.attributes.get("advtex.state") == "succeeded"
    )
    for row in rows:
        events = [event.data for event in store.records.events(row.id, 0) if event.data["kind"] == "state"]
        terminal = [event["state"] for event in events if JobState(event["state"]) in TERMINAL]
        if terminal != [row.state]:
            wrong.append(f"{row.label}: ended {terminal or 'never'}")
        if finished[row.id] > 1:
            wrong.append(f"{row.label}: {finished[row.id]} attempts were carried to the end")
        if (row.state in (JobState.failed, JobState.rejected)) != (row.error is not None):
            wrong.append(f"{row.label}: {row.state} with the error {row.error}")
        try:
            made_by = store.results.manifest(row.id).attempt
        except BlobNotFound:
            made_by = None
        last = [event["attempt"] for event in events if event["state"] == JobState.running][-1:]
        if row.state == JobState.succeeded and [made_by] != last:
            wrong.append(f"{row.label}: results of attempt {made_by}, the last one was {last}")
    return wrong


def write_page(out: Path, night: Night, comings: Comings, rows: Sequence[JobRow], found: Mapping[str, Any]) -> None:
    """The table of the night."""
    first = [row for row in rows if row.batch == "night"]
    states = Counter(row.state for row in first)
    failed = [row for row in rows if row.error is not None]
    attempts = Counter(row.attempt for row in first)
    worked = sum(sum(row.progress["stage_seconds"].values()) for row in first)
    hours = found["seconds"] / 3600
    facts = [
        ("jobs", len(first)),
        ("ended", ", ".join(f"{count} {state}" for state, count in sorted(states.items()))),
        ("lost, or carried to the end twice", "none" if not found["wrong"] else "; ".join(found["wrong"])),
        ("attempts a job: jobs", ", ".join(f"{number}: {count}" for number, count in sorted(attempts.items()))),
        ("workers that went", sum(comings.ends.values())),
        ("attempts that died with their worker, and were given out again when their lease ran out", found["lost"]),
        ("runners that were killed, their workers not", comings.runners_killed),
        ("wall time", f"{60 * hours:.0f} min"),
        ("jobs per hour", f"{len(first) / hours:.0f}"),
        ("seconds in the engine's stages, as the report's GPU seconds count them", f"{worked / len(first):.1f} a job"),
        ("CPU time of all processes, both nights", f"{found['cpu'] / 60:.0f} min"),
        ("webhooks delivered, both nights", f"{found['webhooks']} of {len(rows)}"),
        ("traces, both nights", found["traces"]),
        ("the report", found["report"]),
    ]
    ways = [(way, code, count) for (way, code), count in sorted(comings.ends.items())]
    starts = sorted(comings.starts.items())
    named = [(row.batch, row.label, row.error["code"], row.error["message"].replace("|", "\\|")) for row in failed]
    body = [
        f"# A night of {len(first)} small scenes\n",
        f"{datetime.datetime.now(datetime.UTC).date()}, on a machine of two cores that others used too, by\n",
        f"    {command()}\n",
        markdown_table(["what", "came of it"], facts),
        "## How workers went\n",
        markdown_table(["way", "exit code", "how often"], ways),
        "And why the next one was started: " + ", ".join(f"{why} {count}" for why, count in starts) + ".\n",
        "## What else happened\n",
        "".join(f"- {line}\n" for line in night.told),
        "## Failures\n",
        markdown_table(["batch", "scene", "code", "message"], named),
        "## One job's trace\n",
        f"{found['picture']}\n\n![A job's trace, from the upload to the webhook](trace.png)\n",
        "## The two nights beside each other\n",
        f"The last lines of `advtex-client batch compare night night2`:\n\n{found['compared']}",
    ]
    write_atomically(out / "night.md", "\n".join(body).encode())


def draw(out: Path, spans: Sequence[Received], rows: Sequence[JobRow]) -> str:
    """The trace of a job that lost a worker, if any has. -> what it shows"""
    job, chosen = worth_showing(spans)
    draw_trace(out / "trace.png", chosen)
    label = next((row.label for row in rows if row.id == job), job)
    attempts = sum(span.name == "attempt" for span in chosen) + sum(span.name == "lost" for span in chosen)
    return f"{label}: {len(chosen)} spans, {attempts} attempts, as OTLP exporters of all processes sent them."


def report(night: Night, out: Path) -> tuple[str, str]:
    """`batch report` and `batch compare`, as a user runs them. -> what the report weighs; the comparison's end"""
    began = time.monotonic()
    night.client("batch", "report", "night", "-o", str(out / "report.html"))
    seconds = time.monotonic() - began
    sizes = ", ".join(
        f".{name} {(out / f'report.{name}').stat().st_size / 1e6:.2f} MB" for name in ("html", "csv", "json")
    )
    compared = night.client("batch", "compare", "night", "night2", check=False)  # 5, for what failed
    (out / "compared.txt").write_text(compared)
    lines = [line for line in compared.splitlines() if ": mean " in line]
    return f"{sizes}; made in {seconds:.0f} s", "".join(f"    {line}\n" for line in lines)


def finish(night: Night, comings: Comings, traces: Collector, out: Path, report_folder: Path) -> list[str]:
    """Check, report, and write what is kept. -> what is wrong"""
    store = night.fleet.store
    with store.database.read() as session:
        rows = list(session.query(JobRow).order_by(JobRow.batch, JobRow.label))
    wait_until(lambda: len(traces.others) >= len(rows), seconds=120)
    first = [row for row in rows if row.batch == "night"]
    wrong = check(store, rows, traces.spans)
    report_folder.mkdir(parents=True, exist_ok=True)
    weight, compared = report(night, report_folder)
    found = {
        "wrong": wrong,
        "seconds": max(row.finished_at or 0.0 for row in first) - min(row.created_at for row in first),
        "cpu": sum(resource.getrusage(resource.RUSAGE_CHILDREN)[:2]),
        "lost": sum(span.name == "lost" for span in traces.spans),
        "webhooks": len(traces.others),
        "traces": f"{len({span.trace for span in traces.spans})} of {len(traces.spans)} spans",
        "report": weight,
        "picture": draw(out, traces.spans, rows),
        "compared": compared,
    }
    write_page(out, night, comings, rows, found)
    return wrong


def main() -> int:
    """-> the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=300)
    parser.add_argument("--workers", type=int, default=3)
    parser.add_argument("--roots", type=Path, help="where scenes are kept; else they are made anew", metavar="FOLDER")
    parser.add_argument("--out", type=Path, default=RESULTS / "night", help="of night.md and the trace")
    parser.add_argument("--report", type=Path, help="where the batch's report goes", metavar="FOLDER")
    told = parser.parse_args()
    told.out.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="advtex-night-")))
        scenes = [told.scenes, max(told.scenes // SECOND_SHARE, 1)]
        roots = [(told.roots or folder) / name for name in ("root", "root2")]
        for root, count in zip(roots, scenes, strict=True):
            write_root(root, count)
        database, bucket, s3 = stack.enter_context(surroundings())
        traces: Collector = stack.enter_context(collector())
        place = Place(folder / "data", database, bucket, s3)
        given = {**SETTINGS, "OTEL_EXPORTER_OTLP_ENDPOINT": traces.url}
        running = stack.enter_context(
            fleet(folder, place, servers=1, workers=0, engine="", variables=given, dispatch=False)
        )
        running.lines.clear()  # nothing is cut: workers need no detour
        running.start_dispatcher()
        key = running.store.accounts.create_key("night", owner="night", scopes=SCOPES)
        found_at = {"url": running.urls[0], "key": key, "variables": running.server_variables("top")}
        (folder / "place.json").write_text(json.dumps(found_at))
        print(f"{folder}/place.json", flush=True)
        running.store.webhooks.create("night", f"{traces.url}/hook", sorted(TERMINAL))
        night = Night(running, folder, key)
        comings = run_nights(night, roots, scenes, told.workers)
        wrong = finish(night, comings, traces, told.out, told.report or folder)
    print((told.out / "night.md").read_text())
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())

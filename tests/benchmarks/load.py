"""How the API answers under load: `python tests/benchmarks/load.py`. One server process, SQLite, and the load itself,
all on two cores together.

200 clients ask for a running job, each once a second, 20 listen to its events, and 4 upload 4 MB per second each;
afterwards 10,000 finished jobs are listed page by page. Prints one JSON object and whether each limit holds; exit
code 1 if one does not.
"""

from __future__ import annotations

import asyncio
import json
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil

from advtex_contract.jobs import JobSpec, JobState, Progress
from advtex_contract.options import JobOptions
from advtex_server.settings import ServerSettings
from advtex_store.database import upgrade_database
from advtex_store.ids import new_id
from advtex_store.models import JobRow
from advtex_store.store import Store, open_store

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
from checked import queued_job

CORES = 2
UPLOAD_BYTES = 16_000_000
UPLOAD_SECONDS = 4.0
PAGE = 50
P99_LIMITS_MS = {"get_job": 100.0, "list_jobs": 50.0}


@dataclass(frozen=True)
class Load:
    """How many of each there are, and for how many seconds they go on. `finished`: jobs that are there already."""

    pollers: int = 200
    streams: int = 20
    uploads: int = 4
    seconds: float = 20.0
    finished: int = 10_000


class Line:
    """A kept connection that speaks just enough HTTP, so that the load costs little beside what it measures."""

    def __init__(self, port: int, key: str) -> None:
        self._port = port
        self._headers = f"Host: 127.0.0.1\r\nAuthorization: Bearer {key}\r\n"

    async def open(self) -> None:
        self._reader, self._writer = await asyncio.open_connection("127.0.0.1", self._port)

    def close(self) -> None:
        self._writer.close()

    async def request(self, method: str, path: str, body: bytes = b"", pieces: int = 1) -> bytes:
        """-> the body of a 2xx answer. A body in pieces is sent over `UPLOAD_SECONDS`."""
        length = f"Content-Length: {len(body)}\r\n" if body else ""
        self._writer.write(f"{method} {path} HTTP/1.1\r\n{self._headers}{length}\r\n".encode())
        step = len(body) // pieces
        for start in range(0, len(body), max(1, step)):
            self._writer.write(body[start : start + step])
            await self._writer.drain()
            if pieces > 1:
                await asyncio.sleep(UPLOAD_SECONDS / pieces)
        head = await self._reader.readuntil(b"\r\n\r\n")
        size = int(head.lower().partition(b"content-length:")[2].split(b"\r\n")[0])
        answer = await self._reader.readexactly(size)
        if head[9:10] != b"2":
            raise RuntimeError(f"{method} {path}: {head[:15]!r} {answer[:300]!r}")
        return answer

    async def listen(self, path: str) -> None:
        """Read a stream of events until it is canceled."""
        self._writer.write(f"GET {path} HTTP/1.1\r\n{self._headers}\r\n".encode())
        while await self._reader.read(1 << 16):
            pass


async def poll(line: Line, path: str, begin: float, until: float, times: list[float]) -> None:
    """Once a second, beginning at `begin`: a late answer must not let the pollers fall into step."""
    due = begin
    while due < until:
        await asyncio.sleep(max(0.0, due - time.perf_counter()))
        began = time.perf_counter()
        await line.request("GET", path)
        times.append(time.perf_counter() - began)
        due += 1.0


async def upload(line: Line, body: bytes, until: float, sizes: list[int]) -> None:
    while time.perf_counter() < until:
        began = time.perf_counter()
        await line.request("POST", "/v1/uploads", body, pieces=100)
        sizes.append(UPLOAD_BYTES)
        await asyncio.sleep(max(0.0, UPLOAD_SECONDS - (time.perf_counter() - began)))


async def page_through(line: Line, times: list[float]) -> int:
    cursor, seen = "", 0
    while True:
        began = time.perf_counter()
        page = json.loads(await line.request("GET", f"/v1/jobs?state=succeeded&limit={PAGE}{cursor}"))
        times.append(time.perf_counter() - began)
        seen += len(page["jobs"])
        if page["next_cursor"] is None:
            return seen
        cursor = f"&cursor={page['next_cursor']}"


async def measure(load: Load, port: int, key: str, job: str, server: psutil.Process) -> dict[str, Any]:
    lines = [Line(port, key) for _ in range(load.pollers + load.streams + load.uploads + 1)]
    for line in lines:
        await line.open()
    asking: list[float] = []
    sizes: list[int] = []
    listing: list[float] = []
    bodies = [os.urandom(UPLOAD_BYTES) for _ in range(load.uploads)]
    path = f"/v1/jobs/{job}"
    await lines[0].request("GET", path)  # a server's very first answer takes long
    spent = sum(server.cpu_times()[:2])
    begin = time.perf_counter() + 0.1
    until = begin + load.seconds
    streaming = load.pollers + load.streams
    listeners = [asyncio.create_task(line.listen(f"{path}/events")) for line in lines[load.pollers : streaming]]
    pollers = [
        poll(line, path, begin + n / load.pollers, until, asking) for n, line in enumerate(lines[: load.pollers])
    ]
    uploads = [upload(line, body, until, sizes) for line, body in zip(lines[streaming:-1], bodies, strict=True)]
    await asyncio.gather(*pollers, *uploads)
    spent = sum(server.cpu_times()[:2]) - spent
    for task in listeners:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task
    seen = await page_through(lines[-1], listing)
    for line in lines:
        line.close()
    assert seen == load.finished
    return {
        "get_job": summary(asking),
        "list_jobs": summary(listing),
        "requests_per_second": round(len(asking) / load.seconds, 1),
        "uploaded_mb_per_second": round(sum(sizes) / load.seconds / 1e6, 1),
        "server_cpu_share": round(spent / load.seconds, 2),
        "load_average": os.getloadavg()[0],
    }


def summary(times: list[float]) -> dict[str, float]:
    """Milliseconds."""
    cuts = statistics.quantiles(times, n=100)
    return {"count": len(times), "p50_ms": round(cuts[49] * 1e3, 1), "p99_ms": round(cuts[98] * 1e3, 1)}


def verdicts(found: dict[str, Any]) -> dict[str, bool]:
    """Whether each limit holds."""
    return {name: found[name]["p99_ms"] < limit for name, limit in P99_LIMITS_MS.items()}


def fill(store: Store, finished: int) -> str:
    """That many finished jobs. -> a running one."""
    upload_row = store.uploads.create("load", 1)
    store.uploads.finish(upload_row.id, "ab" * 32)
    running = queued_job(store, "load", JobSpec(upload_id=upload_row.id))
    result = {"name": "model.glb", "key": "k", "size": 1, "sha256": "ab" * 32, "content_type": "model/gltf-binary"}
    with store.database.write() as session:
        now = store.database.now(session)
        for number in range(finished):
            made = now - finished + number
            session.add(
                JobRow(
                    id=new_id(made),
                    owner="load",
                    upload_id=upload_row.id,
                    state=JobState.succeeded,
                    options=JobOptions().model_dump(mode="json"),
                    progress=Progress(stage="previews").model_dump(mode="json"),
                    warnings=[],
                    results=[result] * 6,
                    created_at=made,
                    updated_at=made,
                    finished_at=made,
                    retention_seconds=86400 * 30,
                    expires_at=made + 86400 * 30,
                    tidied_at=made,
                )
            )
    store.records.claim(running, 1, "load")
    return running


def keep_running(store: Store, job: str, done: threading.Event) -> None:
    """What a worker's heartbeats do."""
    step = 0
    while not done.wait(0.5):
        step += 1
        progress = Progress(stage="optimization", step=step, steps=4000, losses={"l1": 1.0 / step})
        store.records.heartbeat(job, 1, progress, reached=step)


def run(load: Load) -> dict[str, Any]:
    """Start a server with its jobs, put the load on it, and measure."""
    with tempfile.TemporaryDirectory() as folder:
        settings = ServerSettings(data_dir=Path(folder), redis_url="redis://127.0.0.1:1/0")
        upgrade_database(settings.database)
        store = open_store(settings)
        key = store.accounts.create_key("load", owner="load")
        job = fill(store, load.finished)
        environment = os.environ | {"ADVTEX_DATA_DIR": folder, "ADVTEX_REDIS_URL": settings.redis_url}
        command = [sys.executable, "-m", "advtex_server.main", "serve", "--host", "127.0.0.1", "--port", "0"]
        server = subprocess.Popen(
            command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        done = threading.Event()
        heart = threading.Thread(target=keep_running, args=(store, job, done))
        heart.start()
        try:
            assert server.stdout is not None
            port = int(json.loads(server.stdout.readline())["url"].rpartition(":")[2])
            return asyncio.run(measure(load, port, key, job, psutil.Process(server.pid)))
        finally:
            done.set()
            heart.join()
            server.terminate()
            server.wait()
            if server.stdout is not None:
                server.stdout.close()
            store.close()


def main() -> int:
    """-> the exit code."""
    cores = sorted(os.sched_getaffinity(0))[:CORES]
    os.sched_setaffinity(0, cores)  # the server inherits it
    found = run(Load())
    print(json.dumps({"cores": len(cores)} | found, indent=1))
    for name, holds in verdicts(found).items():
        measured = found[name]["p99_ms"]
        print(f"{'PASS' if holds else 'FAIL'} {name}: p99 {measured} ms, limit {P99_LIMITS_MS[name]:g} ms")
    return 0 if all(verdicts(found).values()) else 1


if __name__ == "__main__":
    sys.exit(main())

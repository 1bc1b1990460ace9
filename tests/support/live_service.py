"""A whole service of real processes for one test: Redis, the server, and workers with engines of `fake_engines`."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from redis import Redis
from redis.exceptions import RedisError

from advtex_client import Client
from advtex_server.embedded import free_port, redis_binary
from advtex_store.accounts import SCOPES, Accounts
from advtex_store.settings import StoreSettings
from advtex_store.store import Store, open_store

SUPPORT = Path(__file__).parent
RHYTHM = {
    "ADVTEX_LEASE_SECONDS": "2",
    "ADVTEX_DISPATCH_SECONDS": "0.1",
    "ADVTEX_RECONCILE_SECONDS": "0.3",
    "ADVTEX_HEARTBEAT_SECONDS": "0.1",
    "ADVTEX_GRACE_SECONDS": "5",
    "ADVTEX_DISK_RESERVE_BYTES": "0",
    "ADVTEX_DEVICE": "cpu",
    "ADVTEX_THREADS": "1",
}


def wait_until(condition: Callable[[], object], seconds: float = 15.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it did not happen in time"
        time.sleep(0.02)


def process_tree(pid: int) -> list[int]:
    """The process and its descendants, parents first; empty if it is gone."""
    try:
        tasks = list(Path(f"/proc/{pid}/task").iterdir())
    except OSError:
        return []
    children: list[int] = []
    for task in tasks:
        with suppress(OSError):  # a thread that has ended since: its process may go on
            children += map(int, (task / "children").read_text().split())
    return [pid, *(found for child in children for found in process_tree(child))]


class LiveService:
    """Started by `live_service`. `store` looks at the same rows and blobs as the server and its workers."""

    def __init__(self, folder: Path, blobs: Path | None = None, settings: Mapping[str, str] | None = None) -> None:
        self.folder = folder
        folder.mkdir(exist_ok=True)
        self.redis_port = free_port()
        self._processes: list[subprocess.Popen[bytes]] = []
        self.log = folder / "service.log"
        path = [str(Path(entry).absolute()) for entry in (*sys.path, SUPPORT) if entry]
        self.environment = {name: value for name, value in os.environ.items() if not name.startswith("ADVTEX_")} | {
            **RHYTHM,
            "ADVTEX_DATA_DIR": str(folder / "data"),
            "ADVTEX_REDIS_URL": f"redis://127.0.0.1:{self.redis_port}/0",
            "PYTHONPATH": os.pathsep.join(path),
            **(settings or {}),
        }
        blob_url = "" if blobs is None else blobs.as_uri()
        if blob_url:
            self.environment["ADVTEX_BLOB_URL"] = blob_url
        self.redis = self.start_redis()
        self.url = self._start_server()
        places = StoreSettings(
            data_dir=folder / "data", blob_url=blob_url, redis_url=self.environment["ADVTEX_REDIS_URL"]
        )
        self.store: Store = open_store(places)
        self.key = Accounts(self.store.database).create_key("tests", owner="tests", scopes=SCOPES)

    def start_redis(self) -> subprocess.Popen[bytes]:
        options = ["--port", str(self.redis_port), "--bind", "127.0.0.1", "--save", "", "--appendonly", "no"]
        process = self._start([redis_binary(), *options, "--dir", str(self.folder)])
        with Redis(port=self.redis_port) as client:
            wait_until(lambda: _answers(client))
        return process

    def start_worker(self, engine: str, *arguments: str) -> subprocess.Popen[bytes]:
        return self._start([sys.executable, str(SUPPORT / "run_worker.py"), engine, *arguments])

    def restart_server(self) -> None:
        """A new server process, at another address, after the old one was killed."""
        self.url = self._start_server()

    def client(self, key: str | None = None) -> Client:
        return Client(self.url, key or self.key)

    def run_client(self, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
        """`advtex-client` in a process of its own."""
        command = [sys.executable, "-m", "advtex_client.cli", *arguments]
        given = self.environment | {"ADVTEX_URL": self.url, "ADVTEX_API_KEY": self.key} | environment
        return subprocess.run(command, env=given, capture_output=True, text=True, timeout=120, check=False)

    def stop(self) -> None:
        self.store.close()
        for process in reversed(self._processes):
            for pid in reversed(process_tree(process.pid)):
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            process.wait()
            if process.stdout:
                process.stdout.close()

    def _start_server(self) -> str:
        command = [sys.executable, "-m", "advtex_server.main", "serve", "--host", "127.0.0.1", "--port", "0"]
        process = self.server = self._start(command, stdout=subprocess.PIPE)
        assert process.stdout is not None
        line = process.stdout.readline()
        assert line, f"the server did not start:\n{self.log.read_text()}"
        return str(json.loads(line)["url"])

    def _start(self, command: list[str], stdout: int | None = None) -> subprocess.Popen[bytes]:
        with self.log.open("ab") as log:
            process = subprocess.Popen(command, env=self.environment, stdout=stdout or log, stderr=log)
        self._processes.append(process)
        return process


@contextmanager
def live_service(
    folder: Path, blobs: Path | None = None, settings: Mapping[str, str] | None = None
) -> Iterator[LiveService]:
    service = LiveService(folder, blobs, settings)
    try:
        yield service
    except BaseException:
        print(service.log.read_text()[-8000:])
        raise
    finally:
        service.stop()


def _answers(client: Redis) -> bool:
    try:
        return bool(client.ping())
    except RedisError:
        return False

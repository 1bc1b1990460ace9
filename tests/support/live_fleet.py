"""A fleet on one machine: servers, workers and a Redis of their own, each a real process that can be killed and started
again, and lines between workers and what they need that can be cut."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from urllib.parse import urlsplit, urlunsplit

import httpx
from live_service import RHYTHM, process_tree, wait_until
from redis import Redis
from redis.exceptions import RedisError
from releases import PRESENT, Release
from tcp_proxy import TcpProxy

from advtex_server.embedded import free_port, redis_binary
from advtex_store.database import upgrade_database
from advtex_store.settings import StoreSettings
from advtex_store.store import Store, open_store

REAL_WORKER = ["-m", "advtex_worker.main"]


@dataclass(frozen=True)
class Place:
    """Where a fleet keeps what. `ballast`: a folder on the disk that the fleet writes to, to be filled in tests."""

    data: Path
    database_url: str = ""
    blob_url: str = ""
    s3: Mapping[str, str] | None = None  # the `AWS_*` variables
    ballast: Path | None = None


class Fleet:
    """`servers` and `workers` are started by `start`; `store` looks at the same rows and blobs, over uncut lines."""

    def __init__(
        self,
        folder: Path,
        place: Place,
        stack: ExitStack,
        *,
        servers: int,
        workers: int,
        engine: str,
        variables: Mapping[str, str],
        dispatch: bool,
    ) -> None:
        self.place = place
        self.log, self.redis_log = folder / "fleet.log", folder / "redis.log"
        self.journal = folder / "journal"
        self.journal.touch()
        self.redis_folder = place.data / "redis"
        self.redis_folder.mkdir(parents=True)
        self.redis_port = free_port()
        self.ports = [free_port() for _ in range(servers)]
        self.lines = {"redis": stack.enter_context(TcpProxy(self.redis_port))}
        for name, url in (("database", place.database_url), ("blobs", (place.s3 or {}).get("AWS_ENDPOINT_URL", ""))):
            if port := urlsplit(url).port:
                self.lines[name] = stack.enter_context(TcpProxy(port))
        self._engine = engine
        self._given = variables
        self.redis: subprocess.Popen[bytes]
        self.servers: list[subprocess.Popen[bytes]] = []
        self.workers: list[subprocess.Popen[bytes]] = []
        self._workers = workers
        self._dispatch = dispatch
        self.dispatchers: list[subprocess.Popen[bytes]] = []
        for name, value in (place.s3 or {}).items():
            os.environ[name] = value  # for the store of the test's own process; `fleet` puts them back
        self.settings = StoreSettings(
            data_dir=place.data,
            database_url=place.database_url,
            blob_url=place.blob_url,
            redis_url=f"redis://127.0.0.1:{self.redis_port}/0",
        )
        upgrade_database(self.settings.database)
        self.store: Store = open_store(self.settings)

    def start(self) -> None:
        self.start_redis()
        self.servers = [self.start_server(number) for number in range(len(self.ports))]
        self.workers = [self.start_worker(number) for number in range(self._workers)]
        for url in self.urls:
            wait_until(lambda: is_up(url), seconds=90)  # noqa: B023

    @property
    def urls(self) -> list[str]:
        return [f"http://127.0.0.1:{port}" for port in self.ports]

    def start_redis(self) -> None:
        options = ["--port", str(self.redis_port), "--bind", "127.0.0.1", "--save", "", "--appendonly", "yes"]
        self.redis = self._start([redis_binary(), *options, "--dir", str(self.redis_folder)], {})
        with Redis(port=self.redis_port) as client:
            wait_until(lambda: self.redis.poll() is not None or _answers(client))

    def start_server(self, number: int, release: Release = PRESENT) -> subprocess.Popen[bytes]:
        command = [release.python, "-m", "advtex_server.main", "serve", "--host", "127.0.0.1"]
        command += ["--port", str(self.ports[number])]
        if not self._dispatch:
            command.append("--no-dispatch")
        return self._start(command, self.server_variables(f"server-{number}"), release)

    def start_dispatcher(self) -> subprocess.Popen[bytes]:
        command = [PRESENT.python, "-m", "advtex_server.main", "dispatch"]
        self.dispatchers.append(self._start(command, self.server_variables("dispatcher")))
        return self.dispatchers[-1]

    def start_worker(
        self, number: int, release: Release = PRESENT, arguments: Sequence[str] = ()
    ) -> subprocess.Popen[bytes]:
        """Its lines to Redis, database and object storage go through `lines`."""

        def through(name: str, url: str) -> str:
            if name not in self.lines:
                return url
            parts = urlsplit(url)
            return urlunsplit(parts._replace(netloc=f"{parts.netloc.rpartition(':')[0]}:{self.lines[name].port}"))

        variables = self._variables(through) | {"ADVTEX_WORK_DIR": str(self.place.data / f"work-{number}")}
        program = [str(release.support / "run_worker.py"), self._engine] if self._engine else REAL_WORKER
        return self._start([release.python, *program, *arguments], variables, release)

    def stop(self) -> None:
        self.store.close()
        for process in (*self.workers, *self.servers, *self.dispatchers, self.redis):
            kill_tree(process.pid)
            process.wait()

    def server_variables(self, name: str) -> dict[str, str]:
        """Where rows and blobs are elsewhere, it shares no folder with any other."""
        variables = self._variables(lambda _name, url: url)
        if self.place.database_url and self.place.blob_url:
            variables["ADVTEX_DATA_DIR"] = str(self.place.data / name)
        return variables

    def _variables(self, url_for: Callable[[str, str], str]) -> dict[str, str]:
        s3 = dict(self.place.s3 or {})
        if s3:
            s3["AWS_ENDPOINT_URL"] = url_for("blobs", s3["AWS_ENDPOINT_URL"])
        return {
            **s3,
            "ADVTEX_DATA_DIR": str(self.place.data),
            "ADVTEX_DATABASE_URL": url_for("database", self.place.database_url),
            "ADVTEX_BLOB_URL": self.place.blob_url,
            "ADVTEX_REDIS_URL": url_for("redis", self.settings.redis_url),
            "ADVTEX_LEASE_SECONDS": "3",
            "ADVTEX_QUEUE_DEPTH": "2",
            **self._given,
        }

    def _start(
        self, command: list[str], variables: Mapping[str, str], release: Release = PRESENT
    ) -> subprocess.Popen[bytes]:
        path = os.pathsep.join(release.path)
        kept = {name: value for name, value in os.environ.items() if not name.startswith(("ADVTEX_", "AWS_"))}
        environment = {**kept, **RHYTHM, **variables, "PYTHONPATH": path, "ADVTEX_ENGINE_JOURNAL": str(self.journal)}
        with (self.redis_log if command[0] == redis_binary() else self.log).open("ab") as log:
            return subprocess.Popen(command, env=environment, stdout=log, stderr=log)


@contextmanager
def fleet(
    folder: Path,
    place: Place,
    *,
    servers: int = 1,
    workers: int = 3,
    engine: str,
    variables: Mapping[str, str] = MappingProxyType({}),
    dispatch: bool = True,
) -> Iterator[Fleet]:
    """Started, and stopped at the end with everything it has started. `engine`: of `fake_engines`; empty for
    advtex-worker itself, with the real one. `variables`: settings of all its processes.
    `dispatch`: whether the servers do; else `start_dispatcher` starts one that does nothing else."""
    with ExitStack() as stack:
        before = dict(os.environ)
        running = Fleet(
            folder,
            place,
            stack,
            servers=servers,
            workers=workers,
            engine=engine,
            variables=variables,
            dispatch=dispatch,
        )
        try:
            running.start()
            yield running
        except BaseException:
            print(running.log.read_text(errors="replace")[-12_000:])
            print(running.redis_log.read_text(errors="replace")[-3_000:])
            raise
        finally:
            running.stop()
            for name in place.s3 or {}:
                os.environ.pop(name, None)
                if name in before:
                    os.environ[name] = before[name]


def kill_tree(pid: int) -> None:
    """kill -9 of a process and all that it has started, children first."""
    for found in reversed(process_tree(pid)):
        with suppress(ProcessLookupError):
            os.kill(found, signal.SIGKILL)


def is_up(url: str) -> bool:
    """Whether the server answers."""
    try:
        return httpx.get(f"{url}/healthz", timeout=5).status_code == 200
    except httpx.HTTPError:
        return False


def _answers(client: Redis) -> bool:
    try:
        return bool(client.ping())
    except RedisError:
        return False

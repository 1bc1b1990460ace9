"""A server on a real socket, in a thread of the test's process."""

from __future__ import annotations

import contextlib
import functools
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import pytest
import structlog
import uvicorn
from fastapi.routing import APIRoute

from advtex_server.app import create_app
from advtex_server.settings import ServerSettings

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

QUICK: dict[str, Any] = {
    "redis_url": "redis://127.0.0.1:1/0",
    "dispatch_seconds": 0.1,
    "reconcile_seconds": 0.2,
    "disk_reserve_bytes": 0,
}


@functools.cache
def description() -> dict[str, Any]:
    """The description of the API: the same for all servers, and slow to make."""
    return create_app(ServerSettings()).openapi()


@dataclass
class Live:
    """A running server, one key, and a client that sends it."""

    settings: ServerSettings
    app: Any = field(init=False)
    url: str = field(init=False)
    key: str = field(init=False)
    http: httpx.Client = field(init=False)

    def __post_init__(self) -> None:
        self.app = create_app(self.settings)
        config = uvicorn.Config(self.app, port=0, log_config=None, timeout_graceful_shutdown=3)
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._server.run)

    def start(self) -> None:
        self._thread.start()
        while not self._server.started:
            assert self._thread.is_alive(), "the server did not start"
            self._thread.join(0.01)
        host, port = self._server.servers[0].sockets[0].getsockname()
        self.url = f"http://{host}:{port}"
        self.key = self.store.accounts.create_key("test", owner="me")
        self.http = self.client(self.key)

    def become(self, owner: str) -> None:
        """Another tenant, who has nothing yet."""
        self.http.close()
        self.key = self.store.accounts.create_key("test", owner=owner)
        self.http = self.client(self.key)

    def stop(self) -> None:
        self.http.close()
        self._server.should_exit = True
        self._thread.join()

    def client(self, key: str | None) -> httpx.Client:
        headers = {} if key is None else {"Authorization": f"Bearer {key}"}
        hooks = {"response": [self.check_described]}
        return httpx.Client(base_url=self.url, headers=headers, timeout=20, event_hooks=hooks)

    def check_described(self, response: httpx.Response) -> None:
        """Whatever a test provokes: the description has the status."""
        method, path = response.request.method, response.request.url.path
        for route in self.app.routes:
            if (
                isinstance(route, APIRoute)
                and route.include_in_schema
                and method in route.methods
                and route.path_regex.match(path)
            ):
                operation = description()["paths"][route.path_format][method.lower()]
                assert str(response.status_code) in operation["responses"], (method, path, response.status_code)

    @property
    def store(self) -> Any:
        return self.app.state.service.store

    def upload(self, data: bytes = b"not a zip") -> str:
        response = self.http.post("/v1/uploads", content=data)
        assert response.status_code == 201, response.text
        return str(response.json()["id"])

    def job(self, upload_id: str | None = None, key: str | None = None, **spec: object) -> dict[str, Any]:
        """A new job once its scan is checked."""
        headers = {} if key is None else {"Idempotency-Key": key}
        response = self.http.post("/v1/jobs", json={"upload_id": upload_id, **spec}, headers=headers)
        assert response.status_code == 201, response.text
        return self.checked(response.json()["id"])

    def checked(self, job_id: str) -> dict[str, Any]:
        """The job once its scan is checked."""
        deadline = time.monotonic() + 30
        while (job := self.http.get(f"/v1/jobs/{job_id}").json())["state"] == "checking":
            assert time.monotonic() < deadline, job
            time.sleep(0.02)
        return dict(job)

    def finished_job(self, scan: Path, files: dict[str, Path]) -> str:
        """Do what a worker does."""
        job_id = str(self.job(self.upload(scan.read_bytes()))["id"])
        self.store.records.claim(job_id, 1, "test")
        self.store.results.commit(job_id, 1, files)
        return job_id


@pytest.fixture(scope="session", autouse=True)
def _plain_logs() -> Iterator[None]:
    """The default draws tracebacks with all local variables, which takes seconds."""
    structlog.configure(processors=[structlog.processors.format_exc_info, structlog.processors.KeyValueRenderer()])
    yield
    structlog.reset_defaults()


@pytest.fixture
def make_live(tmp_path: Path, place: dict[str, str]) -> Iterator[Callable[..., Live]]:
    """Servers with settings of the test's choice; Redis is away unless the test gives one."""
    with contextlib.ExitStack() as stack:

        def make(**values: Any) -> Live:
            live = Live(ServerSettings(**{"data_dir": tmp_path / "data", **QUICK, **place, **values}))
            live.start()
            stack.callback(live.stop)
            return live

        yield make


@pytest.fixture
def live(make_live: Callable[..., Live]) -> Live:
    """A server that needs no Redis."""
    return make_live()


@pytest.fixture(scope="module")
def shared_live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    """One server for many tests, each of which becomes a tenant of its own."""
    live = Live(ServerSettings(data_dir=tmp_path_factory.mktemp("shared") / "data", **QUICK))
    live.start()
    yield live
    live.stop()


def is_error(response: httpx.Response, status: int, code: str) -> str:
    """Whether it is the one error body. -> the message"""
    assert response.status_code == status, response.text
    body = response.json()
    assert set(body) == {"code", "message", "details", "help"}
    assert (body["code"], body["help"]) == (code, f"/errors#{code}")
    assert body["message"]
    return str(body["message"])


@pytest.fixture(name="is_error")
def _is_error() -> Callable[[httpx.Response, int, str], str]:
    return is_error

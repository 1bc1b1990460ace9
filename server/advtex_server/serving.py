"""Running the application: alone (`serve`), its background alone (`dispatch`), or both with a Redis and one worker
(`up`)."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import json
import os
import signal
import socket
import sys
from collections.abc import AsyncIterator, Callable, Iterator, Sequence

import uvicorn
from starlette.types import ASGIApp

from advtex_options.methods import known_methods
from advtex_server.app import create_app
from advtex_server.authentication import Authenticator
from advtex_server.background import Background
from advtex_server.embedded import EmbeddedRedis, SetupError, client_key, only_one
from advtex_server.metrics import Metrics
from advtex_server.metrics_access import MetricsAccess, metrics_app
from advtex_server.settings import ServerSettings
from advtex_store.accounts import Accounts, key_id
from advtex_store.database import Database, upgrade_database
from advtex_store.secrecy import hide_environment
from advtex_store.sessions import Sessions
from advtex_store.store import open_store
from advtex_store.supervision import Supervised
from advtex_store.tracing import open_traces

WORKER_STOP_SECONDS = 60.0  # a worker writes its checkpoint in this time
WATCH_SECONDS = 0.5


class _Server(uvicorn.Server):
    """Signals are handled in `run`: uvicorn would raise them again at its end, before the children are stopped."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield


def serve(settings: ServerSettings, host: str, port: int, *, dispatch: bool = True) -> None:
    """The API, with its dispatcher or without, until a signal comes. SetupError, SchemaRefused."""
    upgrade_database(settings.database)
    with _listen(host, port) as listener:
        run(settings, listener, [], lambda: _say_ready(settings, _url(listener)), dispatch=dispatch)


def dispatch(settings: ServerSettings) -> None:
    """The background alone, until SIGTERM or SIGINT. SchemaRefused."""
    upgrade_database(settings.database)
    asyncio.run(_dispatch(settings))


async def _dispatch(settings: ServerSettings) -> None:
    known_methods()  # the log says at once which ones of other packages cannot be used
    stopping = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, stopping.set)
    store, traces = open_store(settings), open_traces("advtex-dispatcher")
    metrics = Metrics(store, settings.metrics_owners)
    access = MetricsAccess(metrics, Authenticator(store.accounts, settings.auth_failures_per_minute), settings)
    async with _metrics(access, settings, "0.0.0.0"), Background(store, settings, metrics, traces).running():  # noqa: S104
        print(json.dumps({"event": "ready", "pid": os.getpid()}), flush=True)
        await stopping.wait()
    await asyncio.to_thread(traces.close)
    store.close()


def up(settings: ServerSettings, host: str, port: int) -> None:
    """Everything on this machine: Redis, database, one key, one worker, and the API. SetupError, SchemaRefused."""
    hide_environment()  # from the worker's runners; where it cannot be hidden, the worker says so
    with only_one(settings.data_dir), _listen(host, port) as listener:
        children = []
        if "redis_url" not in settings.model_fields_set:
            embedded = EmbeddedRedis(settings.data_dir)
            embedded.start()
            children.append(embedded.child)
            settings = settings.model_copy(
                update={"redis_url": embedded.url, "redis_password_file": embedded.password_file}
            )
        try:
            upgrade_database(settings.database)
            database = Database(settings.database)
            key = client_key(settings.data_dir, Accounts(database), _url(listener))
            token = Sessions(database).offer(key_id(key))
            database.close()
            worker = Supervised(
                "worker",
                [sys.executable, "-m", "advtex_worker.main"],
                environment(settings),
                stop_seconds=WORKER_STOP_SECONDS,
            )
            worker.start()
            children.append(worker)
        except BaseException:
            for child in reversed(children):
                child.ask_to_stop()
                child.wait()
            raise
        run(settings, listener, children, lambda: _say_ready(settings, _url(listener), token))


def run(
    settings: ServerSettings,
    listener: socket.socket,
    children: Sequence[Supervised],
    ready: Callable[[], None],
    *,
    dispatch: bool = True,
) -> None:
    """Serve until SIGTERM or SIGINT; then stop the API and the children, the last one first."""
    asyncio.run(_run(settings, listener, children, ready, dispatch))


async def _run(
    settings: ServerSettings,
    listener: socket.socket,
    children: Sequence[Supervised],
    ready: Callable[[], None],
    dispatch: bool,
) -> None:
    app = create_app(settings, dispatch=dispatch)
    # What was made so far lives as long as the process: looked through by every full collection, it stops all answers
    # for a tenth of a second.
    gc.collect()
    gc.freeze()
    server = _server(app, settings)

    def stop() -> None:
        server.force_exit = server.should_exit  # the second signal does not wait for open requests
        server.should_exit = True
        app.state.stopping.set()
        if children:
            children[-1].ask_to_stop()

    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop)
    watcher = asyncio.create_task(_watch(server, children, ready))
    try:
        async with _metrics(app.state.metrics_access, settings, listener.getsockname()[0]):
            await server.serve(sockets=[listener])
    finally:
        watcher.cancel()
        for child in reversed(children):
            child.ask_to_stop()
            await asyncio.to_thread(child.wait)


def _server(app: ASGIApp, settings: ServerSettings) -> _Server:
    config = uvicorn.Config(
        app,
        log_config=None,
        access_log=False,
        timeout_graceful_shutdown=settings.shutdown_seconds,
        server_header=False,
    )
    return _Server(config)


@contextlib.asynccontextmanager
async def _metrics(access: MetricsAccess, settings: ServerSettings, host: str) -> AsyncIterator[None]:
    """Serve the metrics at a port of their own, if they have one. SetupError."""
    if settings.metrics_port is None:
        yield
        return
    with _listen(host, settings.metrics_port) as listener:
        server = _server(metrics_app(access), settings)
        serving = asyncio.create_task(server.serve(sockets=[listener]))
        try:
            yield
        finally:
            server.should_exit = True
            await serving


async def _watch(server: uvicorn.Server, children: Sequence[Supervised], ready: Callable[[], None]) -> None:
    while not server.started:
        await asyncio.sleep(0.02)
    ready()
    while not server.should_exit:
        for child in children:
            child.watch()
        await asyncio.sleep(WATCH_SECONDS)


def environment(settings: ServerSettings) -> dict[str, str]:
    """The environment in which a worker finds the same database, blobs and queue."""
    found = {
        "ADVTEX_DATA_DIR": str(settings.data_dir.absolute()),
        "ADVTEX_DATABASE_URL": settings.database,
        "ADVTEX_BLOB_URL": settings.blobs,
        "ADVTEX_REDIS_URL": settings.redis_url,
        "ADVTEX_LEASE_SECONDS": str(settings.lease_seconds),
    }
    if settings.redis_password_file is not None:
        found["ADVTEX_REDIS_PASSWORD_FILE"] = str(settings.redis_password_file.absolute())
    return dict(os.environ) | found


def _listen(host: str, port: int) -> socket.socket:
    try:
        return socket.create_server(
            (host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET, backlog=256
        )
    except OSError as error:
        raise SetupError(f"cannot listen on {host}:{port}: {error.strerror}; choose another --port, or 0") from error


def _url(listener: socket.socket) -> str:
    host, port = listener.getsockname()[:2]
    host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)  # noqa: S104  compared, not bound
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


def _say_ready(settings: ServerSettings, url: str, token: str | None = None) -> None:
    """token: of a link that signs a browser in, once."""
    page = url if token is None else f"{url}/sign-in?token={token}"
    print(f"advtex is ready at {url} (data in {settings.data_dir}); its page: {page}", file=sys.stderr, flush=True)
    line = {"event": "ready", "url": url, "data_dir": str(settings.data_dir.absolute()), "pid": os.getpid()}
    if token is not None:
        line["page"] = page
    print(json.dumps(line), flush=True)

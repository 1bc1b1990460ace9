"""The application: routes around one `Service`, with what runs in the background beside them."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager

from fastapi import FastAPI

from advtex_options.methods import known_methods
from advtex_scan.version import product_version
from advtex_server import errors
from advtex_server.access import AccessMiddleware
from advtex_server.authentication import Authenticator
from advtex_server.background import Background
from advtex_server.bodies import OpenBodies
from advtex_server.browsers import BrowserHeadersMiddleware, BrowserSessions
from advtex_server.deliveries import rules
from advtex_server.events import Lookout
from advtex_server.intake import Intake
from advtex_server.metrics import Metrics, MetricsMiddleware
from advtex_server.metrics_access import MetricsAccess
from advtex_server.older_clients import OlderClientsMiddleware
from advtex_server.refusal import ANYWHERE
from advtex_server.routes import batches, health, jobs, links, pages, uploads, webhooks
from advtex_server.service import Service
from advtex_server.settings import ServerSettings
from advtex_server.tus import TusMiddleware
from advtex_server.webhooks import WebhookService
from advtex_store.database import upgrade_database
from advtex_store.store import open_store
from advtex_store.tracing import open_traces


def create_app(settings: ServerSettings, *, dispatch: bool = True) -> FastAPI:
    """Nothing is contacted before the application starts; then the schema is brought up to date.

    dispatch: whether it does what is to be done in the background; else another process has to.
    `app.state.stopping` is set by whoever stops the server, so that open event streams end at once.
    """
    store = open_store(settings)
    traces = open_traces("advtex-server")
    metrics = Metrics(store, settings.metrics_owners if settings.metrics_guarded else 0)
    background = Background(store, settings, metrics, traces) if dispatch else None

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        await asyncio.to_thread(upgrade_database, settings.database)
        known_methods()  # the log says at once which ones of other packages cannot be used
        async with AsyncExitStack() as stack:
            stack.push_async_callback(asyncio.to_thread, traces.close)
            if background is not None:
                await stack.enter_async_context(background.running())
            yield
            app.state.stopping.set()
        store.close()

    def wake() -> None:
        if background is not None:
            background.wake()

    app = FastAPI(
        title="advtex",
        version=product_version(),
        summary="Sharp textures from RGB-D scans",
        lifespan=lifespan,
        responses=ANYWHERE,
        docs_url=None,  # their pages load scripts from elsewhere
        redoc_url=None,
    )
    app.state.service = Service(store, settings, wake, traces, background.loops if background else ())
    app.state.webhooks = WebhookService(store.webhooks, rules(settings))
    app.state.stopping = asyncio.Event()
    app.state.intake = Intake(store, settings, traces)
    app.state.bodies = OpenBodies()
    app.state.lookout = Lookout(app.state.service)
    errors.install(app)
    authenticator = Authenticator(store.accounts, settings.auth_failures_per_minute)
    browser_sessions = BrowserSessions(store.sessions)
    app.state.metrics_access = MetricsAccess(metrics, authenticator, settings)
    app.state.authenticator, app.state.browser_sessions = authenticator, browser_sessions
    app.add_middleware(
        AccessMiddleware,
        authenticator=authenticator,
        browser_sessions=browser_sessions,
        max_body_bytes=settings.max_body_bytes,
    )
    app.add_middleware(OlderClientsMiddleware)
    app.add_middleware(TusMiddleware)
    app.add_middleware(MetricsMiddleware, metrics=metrics)
    app.add_middleware(BrowserHeadersMiddleware)
    for module in (webhooks, uploads, jobs, links, batches, health, pages):
        app.include_router(module.router)
    return app

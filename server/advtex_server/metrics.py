"""Prometheus metrics of one server process, and of the rows at the time of asking."""

from __future__ import annotations

import time

from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, Counter, Gauge, Histogram, generate_latest
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from advtex_contract.jobs import JobState
from advtex_store.store import Store


class Metrics:
    """One registry per application, so that tests can have several."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        self.requests = Counter(
            "advtex_http_requests_total", "Answered requests", ["method", "route", "status"], registry=self.registry
        )
        self.seconds = Histogram(
            "advtex_http_request_seconds", "Time until the answer began", ["route"], registry=self.registry
        )
        self.jobs = Gauge("advtex_jobs", "Jobs by state", ["state"], registry=self.registry)
        self.free_bytes = Gauge("advtex_disk_free_bytes", "Room for uploads", registry=self.registry)


class MetricsMiddleware:
    """Counts answers by route template, not by path: ids would make endless series."""

    def __init__(self, app: ASGIApp, metrics: Metrics) -> None:
        self.app = app
        self.metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        started = time.perf_counter()

        async def counted(message: Message) -> None:
            if message["type"] == "http.response.start":
                route = scope.get("route")
                name = route.path if isinstance(route, Route) else "other"
                self.metrics.requests.labels(scope["method"], name, str(message["status"])).inc()
                self.metrics.seconds.labels(name).observe(time.perf_counter() - started)
            await send(message)

        await self.app(scope, receive, counted)


def exposition(metrics: Metrics, store: Store) -> tuple[bytes, str]:
    """Text and its media type."""
    counts = store.records.count_by_state()
    for state in JobState:
        metrics.jobs.labels(state.value).set(counts.get(state.value, 0))
    metrics.free_bytes.set(store.blobs.free_bytes())
    return generate_latest(metrics.registry), CONTENT_TYPE_LATEST

"""Prometheus metrics of one server process, and of the fleet from its rows at the time of asking."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterable

from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, Counter, Histogram, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric, SummaryMetricFamily
from prometheus_client.registry import Collector
from redis import RedisError
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from advtex_contract.jobs import WAITING, JobState
from advtex_store.counters import ATTEMPTS, FAILURES, JOBS, STAGES, Line
from advtex_store.store import Store


class Metrics:
    """One registry per application, so that tests can have several."""

    def __init__(self, store: Store) -> None:
        self.registry = CollectorRegistry()
        self.requests = Counter(
            "advtex_http_requests_total", "Answered requests", ["method", "route", "status"], registry=self.registry
        )
        self.seconds = Histogram(
            "advtex_http_request_seconds", "Time until the answer began", ["route"], registry=self.registry
        )
        self.registry.register(FleetCollector(store))

    def exposition(self) -> tuple[bytes, str]:
        """Text and its media type."""
        return generate_latest(self.registry), CONTENT_TYPE_LATEST


class FleetCollector(Collector):
    """Reads rows and Redis when it is asked: every server tells the same, and a restart changes nothing."""

    def __init__(self, store: Store) -> None:
        self.store = store

    def describe(self) -> Iterable[Metric]:
        return []  # else registering would already ask the database

    def collect(self) -> Iterable[Metric]:
        yield from self._now()
        yield from self._so_far()

    def _now(self) -> Iterable[Metric]:
        counts = self.store.records.count_by_state()
        jobs = GaugeMetricFamily("advtex_jobs", "Jobs by state", labels=["state"])
        for state in JobState:
            jobs.add_metric([state.value], counts.get(state.value, 0))
        yield jobs
        yield from _waiting(self.store.counters.lines())
        load = self.store.counters.load()
        yield GaugeMetricFamily("advtex_queue_depth", "Jobs that wait", sum(counts.get(state, 0) for state in WAITING))
        yield GaugeMetricFamily("advtex_queue_age_seconds", "Age of the oldest job that waits", load.oldest_seconds)
        yield GaugeMetricFamily("advtex_steps_per_second", "Of all running jobs together", load.steps_per_second)
        yield GaugeMetricFamily("advtex_webhook_deliveries", "Deliveries that wait", load.deliveries)
        troubles = GaugeMetricFamily(
            "advtex_housekeeping_troubles", "Jobs and uploads that housekeeping fails for", labels=["task", "set_aside"]
        )
        for (task, aside), count in self.store.troubles.counts().items():
            troubles.add_metric([task, "yes" if aside else "no"], count)
        yield troubles
        yield GaugeMetricFamily("advtex_disk_free_bytes", "Room for uploads", self.store.blobs.free_bytes())
        workers = GaugeMetricFamily("advtex_workers", "Living workers by memory for jobs", labels=["gib"])
        try:
            for found in self.store.queue.classes():
                workers.add_metric([str(found.gib)], found.workers)
        except RedisError:
            up = 0
        else:
            up = 1
            yield workers
        yield GaugeMetricFamily("advtex_redis_up", "Whether Redis answers", up)

    def _so_far(self) -> Iterable[Metric]:
        families = {
            ATTEMPTS: CounterMetricFamily("advtex_attempts_ended_early", "Lost or preempted attempts", labels=["how"]),
            FAILURES: CounterMetricFamily("advtex_failures", "Jobs failed or rejected, by cause", labels=["cause"]),
            JOBS: CounterMetricFamily("advtex_jobs_ended", "Jobs that ended, by state", labels=["state"]),
        }
        stages = SummaryMetricFamily("advtex_stage_seconds", "Time in stages, of jobs that ended", labels=["stage"])
        for row in self.store.counters.counts():
            if row.name == STAGES:
                stages.add_metric([row.label], count_value=row.count, sum_value=row.total)
            elif row.name in families:
                families[row.name].add_metric([row.label], row.count)
        yield from families.values()
        yield stages


def _waiting(lines: Iterable[Line]) -> Iterable[Metric]:
    """By class: the memory of the smallest worker that can take them."""
    waiting = GaugeMetricFamily("advtex_jobs_waiting", "Jobs that wait for a worker", labels=["memory_gib"])
    oldest = GaugeMetricFamily("advtex_jobs_waiting_oldest_seconds", "Age of the oldest", labels=["memory_gib"])
    classes = defaultdict[int, list[Line]](list)
    for line in lines:
        classes[line.memory_gib].append(line)
    for gib, found in sorted(classes.items()):
        waiting.add_metric([str(gib)], sum(line.jobs for line in found))
        oldest.add_metric([str(gib)], max(line.oldest_seconds for line in found))
    return waiting, oldest


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

"""Prometheus metrics of one server process, and of the fleet from its rows at the time of asking."""

from __future__ import annotations

import time
from collections import Counter as Tally
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TypeVar

from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, Counter, Gauge, Histogram, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric
from prometheus_client.registry import Collector
from redis import RedisError
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from advtex_contract.jobs import STATES, WAITING, JobState
from advtex_store.counters import (
    ACCURACY,
    ACCURACY_BOUNDS,
    ACCURACY_BUCKETS,
    ATTEMPTS,
    FAILURES,
    JOBS,
    STAGE_BOUNDS,
    STAGE_BUCKETS,
    STAGES,
    Line,
)
from advtex_store.fleet import LivingWorker
from advtex_store.models import CounterRow
from advtex_store.store import Store

READY = 1000  # that many are counted: no fleet begins more of them at once
OTHER = "other"  # owners that are not named
ROUND_BOUNDS = (0.01, 0.03, 0.1, 0.3, 1, 3, 10, 30)  # seconds

# What can be counted before it happens first: an alert sees a counter grow from nothing only if the nothing is told.
LABELS: Mapping[str, Sequence[str]] = {
    ATTEMPTS: ("lost", "preempted"),
    FAILURES: ("poison",),
    JOBS: [state for state in JobState if STATES[state].terminal],
}

T = TypeVar("T")


class Metrics:
    """One registry per application, so that tests can have several.

    owners: how many are named, those with the most waiting jobs first; all others are one.
    """

    def __init__(self, store: Store, owners: int = 0) -> None:
        self.registry = CollectorRegistry()
        self.requests = Counter(
            "advtex_http_requests_total", "Answered requests", ["method", "route", "status"], registry=self.registry
        )
        self.seconds = Histogram(
            "advtex_http_request_seconds", "Time until the answer began", ["route"], registry=self.registry
        )
        self.received = Counter("advtex_http_received_bytes", "Bytes of requests' bodies", registry=self.registry)
        self.sent = Counter("advtex_http_sent_bytes", "Bytes of answers' bodies", registry=self.registry)
        self.deliveries = Counter(
            "advtex_webhook_tries", "Deliveries of webhooks, by how they went", ["outcome"], registry=self.registry
        )
        for outcome in ("delivered", "failed"):
            self.deliveries.labels(outcome)
        self.rounds = Histogram(
            "advtex_dispatcher_round_seconds",
            "Time of the dispatcher's rounds that went well",
            ["kind"],
            buckets=ROUND_BOUNDS,
            registry=self.registry,
        )
        self.round_at = Gauge(
            "advtex_dispatcher_round_timestamp_seconds",
            "When the dispatcher's last round went well, since 1970; 0 where none has",
            registry=self.registry,
        )
        self.registry.register(FleetCollector(store, owners))

    def round(self, kind: str, act: Callable[[], T]) -> T:
        """Do a round of the dispatcher, and take its time if it goes well."""
        began = time.perf_counter()
        done = act()
        self.rounds.labels(kind).observe(time.perf_counter() - began)
        self.round_at.set_to_current_time()
        return done

    def delivered(self, outcome: str) -> None:
        """A delivery of a webhook was tried: `delivered` or `failed`."""
        self.deliveries.labels(outcome).inc()

    def exposition(self) -> tuple[bytes, str]:
        """Text and its media type."""
        return generate_latest(self.registry), CONTENT_TYPE_LATEST


class FleetCollector(Collector):
    """Reads rows and Redis when it is asked: every server tells the same, and a restart changes nothing."""

    def __init__(self, store: Store, owners: int = 0) -> None:
        self.store = store
        self.owners = owners

    def describe(self) -> Iterable[Metric]:
        return []  # else registering would already ask the database

    def collect(self) -> Iterable[Metric]:
        lines = self.store.counters.lines()
        yield from self._jobs(lines)
        yield from self._troubles()
        yield GaugeMetricFamily("advtex_disk_free_bytes", "Room for uploads", self.store.blobs.free_bytes())
        try:
            workers = self.store.fleet.workers()
        except RedisError:
            up = 0
        else:
            up = 1
            yield from _workers(workers)
            largest = max((worker.memory_gib for worker in workers), default=-1)
            nowhere = sum(line.jobs for line in lines if line.memory_gib > largest)
            yield GaugeMetricFamily("advtex_jobs_without_worker", "Jobs that wait and fit no living worker", nowhere)
        yield GaugeMetricFamily("advtex_redis_up", "Whether Redis answers", up)
        counts = self.store.counters.counts()
        yield from _so_far(counts)
        yield _told_apart(counts)

    def _jobs(self, lines: Sequence[Line]) -> Iterable[Metric]:
        counts = self.store.records.count_by_state()
        jobs = GaugeMetricFamily("advtex_jobs", "Jobs by state", labels=["state"])
        for state in JobState:
            jobs.add_metric([state.value], counts.get(state.value, 0))
        yield jobs
        yield from _waiting(lines, "advtex_jobs_waiting", "memory_gib", lambda line: str(line.memory_gib))
        named = _longest(lines, self.owners)
        yield from _waiting(
            lines, "advtex_owner_jobs_waiting", "owner", lambda line: line.owner if line.owner in named else OTHER
        )
        ready = GaugeMetricFamily(
            "advtex_jobs_ready", "Waiting jobs that begin as soon as they have workers", labels=["memory_gib"]
        )
        for gib, count in sorted(self.store.records.ready(READY).items()):
            ready.add_metric([str(gib)], count)
        yield ready
        load = self.store.counters.load()
        yield GaugeMetricFamily("advtex_queue_depth", "Jobs that wait", sum(counts.get(state, 0) for state in WAITING))
        yield GaugeMetricFamily("advtex_queue_age_seconds", "Age of the oldest job that waits", load.oldest_seconds)
        running = GaugeMetricFamily("advtex_jobs_running", "Jobs that have a worker", labels=["memory_gib"])
        for gib, number in sorted(Tally(job.memory_gib for job in load.running).items()):
            running.add_metric([str(gib)], number)
        yield running
        yield GaugeMetricFamily("advtex_steps_per_second", "Of all running jobs together", load.steps_per_second)
        ages = self.store.live_progress.checkpoint_ages([(job.id, job.attempt) for job in load.running])
        yield GaugeMetricFamily(
            "advtex_checkpoint_age_seconds",
            "What the running attempt would lose that has the oldest",
            max(ages, default=0),
        )
        yield GaugeMetricFamily("advtex_webhook_deliveries", "Deliveries that wait", load.deliveries)
        yield GaugeMetricFamily(
            "advtex_webhook_overdue_seconds", "How long the most urgent delivery has been due", load.overdue_seconds
        )

    def _troubles(self) -> Iterable[Metric]:
        troubles = GaugeMetricFamily(
            "advtex_housekeeping_troubles", "Jobs and uploads that housekeeping fails for", labels=["task", "set_aside"]
        )
        for (task, aside), count in self.store.troubles.counts().items():
            troubles.add_metric([task, "yes" if aside else "no"], count)
        yield troubles


def _longest(lines: Iterable[Line], owners: int) -> set[str]:
    jobs = Tally[str]()
    for line in lines:
        jobs[line.owner] += line.jobs
    return {owner for owner, _ in jobs.most_common(owners)}


def _waiting(lines: Iterable[Line], name: str, label: str, value: Callable[[Line], str]) -> Iterable[Metric]:
    """By class (the memory of the smallest worker that can take the job), or by owner."""
    waiting = GaugeMetricFamily(name, "Jobs that wait for a worker", labels=[label])
    oldest = GaugeMetricFamily(f"{name}_oldest_seconds", "Age of the oldest", labels=[label])
    groups = defaultdict[str, list[Line]](list)
    for line in lines:
        groups[value(line)].append(line)
    for group, found in sorted(groups.items()):
        waiting.add_metric([group], sum(line.jobs for line in found))
        oldest.add_metric([group], max(line.oldest_seconds for line in found))
    return waiting, oldest


def _workers(workers: Sequence[LivingWorker]) -> Iterable[Metric]:
    living = GaugeMetricFamily("advtex_workers", "Living workers by memory for jobs", labels=["gib"])
    busy = GaugeMetricFamily("advtex_workers_busy", "Of these, those that have a job", labels=["gib"])
    at_work = Tally(worker.memory_gib for worker in workers if worker.busy)
    for gib, number in sorted(Tally(worker.memory_gib for worker in workers).items()):
        living.add_metric([str(gib)], number)
        busy.add_metric([str(gib)], at_work[gib])
    labels = ["host", "gpu"]
    memory = GaugeMetricFamily("advtex_gpu_memory_bytes", "Memory of a worker's GPU", labels=labels)
    used = GaugeMetricFamily("advtex_gpu_memory_used_bytes", "What is taken of it", labels=labels)
    utilization = GaugeMetricFamily("advtex_gpu_utilization_ratio", "Share of time that it computes", labels=labels)
    # Workers that share a GPU tell of it each.
    gpus = {(worker.report.host, gpu.uuid): gpu for worker in workers if (gpu := worker.report.gpu) is not None}
    for place, gpu in sorted(gpus.items()):
        memory.add_metric(place, gpu.memory_bytes)
        used.add_metric(place, gpu.memory_used_bytes)
        if gpu.utilization is not None:
            utilization.add_metric(place, gpu.utilization)
    return living, busy, memory, used, utilization


def _so_far(counts: Iterable[CounterRow]) -> Iterable[Metric]:
    families = {
        ATTEMPTS: CounterMetricFamily("advtex_attempts_ended_early", "Lost or preempted attempts", labels=["how"]),
        FAILURES: CounterMetricFamily("advtex_failures", "Jobs failed or rejected, by cause", labels=["cause"]),
        JOBS: CounterMetricFamily("advtex_jobs_ended", "Jobs that ended, by state", labels=["state"]),
    }
    found = {name: Tally(dict.fromkeys(labels, 0)) for name, labels in LABELS.items()}
    within, spent = defaultdict[str, Tally[int]](Tally), list[CounterRow]()
    for row in counts:
        if row.name == STAGES:
            spent.append(row)
        elif row.name == STAGE_BUCKETS:
            stage, _, bound = row.label.rpartition(" ")
            within[stage][int(bound)] = row.count
        elif row.name in families:
            found[row.name][row.label] = row.count
    for name, labels in found.items():
        for label, count in sorted(labels.items()):
            families[name].add_metric([label], count)
    stages = HistogramMetricFamily("advtex_stage_seconds", "Time in stages, of jobs that ended", labels=["stage"])
    for row in spent:
        seen = within[row.label]
        buckets = [
            (f"{float(bound)}", float(sum(number for b, number in seen.items() if b <= bound)))
            for bound in STAGE_BOUNDS
        ]
        # Releases that know no buckets count the rest.
        stages.add_metric([row.label], [*buckets, ("+Inf", float(row.count))], row.total)
    yield from families.values()
    yield stages


def _told_apart(counts: Sequence[CounterRow]) -> Metric:
    told = HistogramMetricFamily(
        "advtex_discriminator_accuracy",
        "Share of patches that the discriminator told apart at the end of jobs that succeeded",
        labels=["preset"],
    )
    below = {row.label: row.count for row in counts if row.name == ACCURACY_BUCKETS}
    for row in counts:
        if row.name == ACCURACY:
            within, buckets = 0, list[tuple[str, float]]()
            for bound in ACCURACY_BOUNDS:
                within += below.get(f"{row.label} {bound}", 0)
                buckets.append((f"{bound}", float(within)))
            told.add_metric([row.label], [*buckets, ("+Inf", float(row.count))], row.total)
    return told


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

        async def heard() -> Message:
            message = await receive()
            self.metrics.received.inc(len(message.get("body", b"")))
            return message

        async def counted(message: Message) -> None:
            if message["type"] == "http.response.start":
                route = scope.get("route")
                name = route.path if isinstance(route, Route) else "other"
                self.metrics.requests.labels(scope["method"], name, str(message["status"])).inc()
                self.metrics.seconds.labels(name).observe(time.perf_counter() - started)
            await send(message)
            self.metrics.sent.inc(len(message.get("body", b"")))

        await self.app(scope, heard, counted)

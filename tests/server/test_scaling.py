"""Workers on Kubernetes that come and go with what waits: simulated are nodes, time and the work; `/metrics`, the rows
and Redis that it is asked of, and the objects of `docker/kubernetes` are real, and the arithmetic is KEDA's."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import httpx
import pytest
from kubernetes_objects import counted, scaled_jobs
from prometheus_client.parser import text_string_to_metric_families
from sqlalchemy import insert

from advtex_store.ids import new_id
from advtex_store.memory_estimate import GIB
from advtex_store.models import JobRow
from advtex_store.store import Store

TURN_SECONDS = 30.0  # between looks, of Prometheus and of KEDA

pytestmark = pytest.mark.one_machine("tests/store counts what waits on both databases")

Samples = dict[str, dict[str, float]]  # by metric, and by the value of its only label


@dataclass
class Pod:
    """A worker, from the Job that KEDA made for it until it ends."""

    name: str
    ready_at: float
    job: str | None = None
    done_at: float = 0.0
    idle_since: float = 0.0


@dataclass
class Class:
    """A ScaledJob, what waits for it, and its pods. node_seconds: until the n-th pod's node is there and its worker
    begins."""

    told: dict[str, Any]
    line: list[str]
    node_seconds: Callable[[int], float]
    pods: list[Pod] = field(default_factory=list)
    begun: int = 0
    idle: float = 0.0  # seconds of all its workers together

    @property
    def most(self) -> int:
        return int(self.told["spec"]["maxReplicaCount"])

    @property
    def gib(self) -> int:
        """Of the workers: that of the largest job that they take."""
        values = counted(self.told)[0][2]
        return max(gib for gib in range(1000) if values.fullmatch(str(gib)))

    @property
    def idle_seconds(self) -> float:
        return float(self.told["spec"]["jobTargetRef"]["template"]["spec"]["containers"][0]["args"][1])

    def wanted(self, samples: Samples) -> float:
        """What Prometheus answers to the query."""
        terms = counted(self.told)
        return sum(
            value for metric, _, label in terms for key, value in samples[metric].items() if label.fullmatch(key)
        )

    def to_create(self, wanted: float) -> int:
        """How many Jobs KEDA makes, by the strategy `default`: queue length by target, up to so many, less those that
        have not ended, wherever their pods are."""
        assert self.told["spec"]["scalingStrategy"] == {"strategy": "default"}
        (trigger,) = self.told["spec"]["triggers"]
        longest = min(math.ceil(wanted / float(trigger["metadata"]["threshold"])), self.most)
        return max(0, longest - len(self.pods))


@dataclass
class Cluster:
    """Prometheus, KEDA, nodes and workers, in simulated time."""

    store: Store
    http: httpx.Client
    classes: list[Class]
    job_seconds: Callable[[str], float]
    now: float = 0.0

    def run(self, seconds: float) -> None:
        """Until everything has ended, or for so long."""
        end = self.now + seconds
        while self.now < end and any(found.line or found.pods for found in self.classes):
            self._turn()

    def _turn(self) -> None:
        """A look of Prometheus and of KEDA, and what the workers do until the next."""
        samples = self._scrape()
        for found in self.classes:
            for _ in range(found.to_create(found.wanted(samples))):
                found.pods.append(Pod(f"{found.gib}-{found.begun}-1", self.now + found.node_seconds(found.begun)))
                found.begun += 1
            for pod in list(found.pods):
                if self.now >= pod.ready_at:
                    self._work(found, pod)
        pipeline = self.store.queue.redis.pipeline()
        for found in self.classes:
            for pod in found.pods:
                if self.now >= pod.ready_at:
                    self.store.queue.announce(pod.name, found.gib, pipeline, busy=pod.job is not None)
        pipeline.execute()
        self.now += TURN_SECONDS

    def _scrape(self) -> Samples:
        samples: Samples = {"advtex_jobs_waiting": {}, "advtex_workers_busy": {}}
        for family in text_string_to_metric_families(self.http.get("/metrics").text):
            if family.name in samples:
                samples[family.name] = {next(iter(sample.labels.values())): sample.value for sample in family.samples}
        return samples

    def _work(self, found: Class, pod: Pod) -> None:
        if pod.job is not None and self.now >= pod.done_at:
            self.store.records.succeed(pod.job, 1, [])
            pod.job, pod.idle_since = None, self.now
        if pod.job is None and found.line:
            found.idle += self.now - max(pod.idle_since, pod.ready_at)
            pod.job = found.line.pop(0)
            pod.done_at = self.now + self.job_seconds(pod.job)
            self.store.records.claim(pod.job, 1, pod.name)
        elif pod.job is None and self.now - max(pod.idle_since, pod.ready_at) >= found.idle_seconds:
            found.idle += self.now - max(pod.idle_since, pod.ready_at)
            found.pods.remove(pod)
            self.store.queue.depart(pod.name)


@pytest.fixture
def live(make_live: Callable[..., Any], redis_url: str) -> Any:
    """A server that leaves jobs and workers to the simulation."""
    return make_live(redis_url=redis_url, dispatch_seconds=3600.0, reconcile_seconds=3600.0)


def add_jobs(store: Store, memories: Iterable[int]) -> list[str]:
    """A job for each of them, the GiB that it needs. -> their ids; they wait."""
    upload, now = store.uploads.create("me", 1).id, time.time()
    rows = [
        {"id": new_id(now), "owner": "me", "upload_id": upload, "state": "queued", "memory_bytes": gib * GIB}
        | {"options": {}, "progress": {}, "warnings": [], "results": []}
        | {"created_at": now, "updated_at": now, "retention_seconds": 86400, "checked_at": now}
        for gib in memories
    ]
    with store.database.write() as session:
        session.execute(insert(JobRow), rows)
    return [str(row["id"]) for row in rows]


def every_third_is_slow(number: int) -> float:
    """Most nodes are there; a third has to be bought first."""
    return 900.0 if number % 3 == 2 else 30.0


@pytest.mark.slow
def test_five_hundred_jobs_bring_up_what_they_need_and_nothing_stays(live: Any) -> None:
    small, large = scaled_jobs()
    classes = [
        Class(small, add_jobs(live.store, (number % 23 for number in range(350))), every_third_is_slow),
        Class(large, add_jobs(live.store, (23 + number % 57 for number in range(150))), every_third_is_slow),
    ]
    fit_nowhere = add_jobs(live.store, (200, 300))
    Cluster(live.store, live.http, classes, lambda _: 180.0).run(24 * 3600)
    counts = live.store.records.count_by_state()
    assert (counts.get("succeeded"), counts.get("queued")) == (500, len(fit_nowhere))
    assert live.store.queue.workers() == []
    for found in classes:
        assert found.pods == []
        assert found.begun == found.most, "all that may be, each once"
        assert found.idle <= found.begun * (found.idle_seconds + 2 * TURN_SECONDS), "a GPU idles once, at the end"


def test_slow_nodes_are_waited_for_and_not_asked_for_again(live: Any) -> None:
    small, large = scaled_jobs()
    classes = [Class(small, add_jobs(live.store, [8] * 12), lambda _: 1800.0), Class(large, [], lambda _: 0.0)]
    Cluster(live.store, live.http, classes, lambda _: 60.0).run(24 * 3600)
    assert live.store.records.count_by_state().get("succeeded") == 12
    assert [found.begun for found in classes] == [12, 0]
    assert live.store.queue.workers() == []


def test_a_job_that_comes_while_others_run_has_a_worker_of_its_own(live: Any) -> None:
    """What waits is less than what runs; those who run are busy for long."""
    small, large = scaled_jobs()
    classes = [Class(small, add_jobs(live.store, [8] * 5), lambda _: 60.0), Class(large, [], lambda _: 60.0)]
    cluster = Cluster(live.store, live.http, classes, lambda _: 1800.0)
    cluster.run(600)
    classes[0].line += add_jobs(live.store, [8, 8])
    cluster.run(300)
    assert live.store.records.count_by_state().get("running") == 7
    assert classes[0].begun == 7
    cluster.run(24 * 3600)
    assert live.store.records.count_by_state().get("succeeded") == 7
    assert live.store.queue.workers() == []

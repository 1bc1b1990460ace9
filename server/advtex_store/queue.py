"""The RQ queues: transport only. Emptied, they cost nothing but a new enqueue by the dispatcher.

Workers of one class share one queue, and a worker listens to its own queue only (RQ then moves ids with BLMOVE, which
cannot drop one). A class is the memory that jobs may use on the worker, in whole GiB. Workers announce themselves, so
that the dispatcher knows which classes there are. JSON instead of pickle, no `Retry`, no time limit and no expiry in
Redis: attempts, leases and limits live in the rows.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from redis import Redis
from redis.backoff import NoBackoff
from redis.retry import Retry
from rq import Queue
from rq.exceptions import DuplicateJobError, NoSuchJobError
from rq.job import Job
from rq.serializers import JSONSerializer

from advtex_store.memory_estimate import GIB
from advtex_store.settings import StoreSettings

QUEUE = "advtex-"
TASK = "advtex_worker.tasks.run_job"
STARTED_GRACE_SECONDS = 10.0  # between taking an id and claiming the row; later the taker is held for dead
DECLINED = "advtex:declined"  # attempts, scored by when they may be offered again
DECLINED_SECONDS = 10.0
PRESENCE = "advtex:worker:"
BUSY = " busy"
SCANNED = 10_000  # keys that Redis looks at in one go, a few milliseconds; there are some per worker
PRESENCE_SECONDS = 20  # a worker that has not announced itself for so long is gone


@dataclass(frozen=True, slots=True)
class WorkerClass:
    """Living workers on which jobs may use `gib` GiB of memory; `idle` of them have none."""

    gib: int
    workers: int
    idle: int

    @property
    def memory_bytes(self) -> int:
        return self.gib * GIB


def class_of(memory_bytes: int) -> int:
    """The class of a worker: whole GiB, so that machines of one kind share a queue."""
    return memory_bytes // GIB


def attempt_of(name: str) -> tuple[str, int]:
    """(job, attempt) of what a worker has taken."""
    job_id, _, attempt = name.rpartition("-")
    return job_id, int(attempt)


def rq_id(job_id: str, attempt: int) -> str:
    """What Redis calls the attempt."""
    return f"{job_id}-{attempt}"


def queue_name(gib: int) -> str:
    return f"{QUEUE}{gib}"


def connect_redis(settings: StoreSettings) -> Redis:
    """A client that gives up after seconds when Redis is away; RQ's workers raise the limit for their own waits."""
    return _connect(settings, socket_connect_timeout=3, socket_timeout=10, health_check_interval=30)


def connect_redis_briefly(settings: StoreSettings) -> Redis:
    """A client for what is nice to have: it asks once, and gives up after a moment."""
    return _connect(settings, socket_connect_timeout=0.5, socket_timeout=0.5, retry=Retry(NoBackoff(), 0))


def _connect(settings: StoreSettings, **options: Any) -> Redis:
    if (password := settings.redis_password()) is not None:
        options["password"] = password
    return Redis.from_url(settings.redis_url, **options)


class JobQueue:
    """Attempts on their way to a worker. Every method raises `redis.RedisError` when Redis is away."""

    def __init__(self, redis: Redis) -> None:
        self.redis = redis
        self._queues: dict[int, Queue] = {}  # each asks Redis for its version, once

    def announce(self, name: str, gib: int, connection: Any = None, *, busy: bool = False) -> None:
        """The worker `name` lives. Called by it every few seconds; `connection` may be a pipeline."""
        told = f"{gib}{BUSY}" if busy else str(gib)
        (connection or self.redis).set(PRESENCE + name, told, ex=PRESENCE_SECONDS)

    def depart(self, name: str) -> None:
        """The worker has ended."""
        self.redis.delete(PRESENCE + name)

    def workers(self, host: str = "") -> list[str]:
        """Names of the living workers, of one host or of all."""
        found = self.redis.scan_iter(match=PRESENCE + "*", count=SCANNED)
        names = sorted(text_of(key).removeprefix(PRESENCE) for key in found)
        return [name for name in names if not host or name.rpartition("-")[0] == host]

    def classes(self) -> list[WorkerClass]:
        """The classes of which workers live, smallest first."""
        names = self.workers()
        told = self.redis.mget([PRESENCE + name for name in names]) if names else []
        known = [text_of(value) for value in told if value is not None]
        count = Counter(int(value.removesuffix(BUSY)) for value in known)
        idle = Counter(int(value) for value in known if not value.endswith(BUSY))
        return [WorkerClass(gib, workers, idle[gib]) for gib, workers in sorted(count.items())]

    def offer(self, job_id: str, attempt: int, gib: int, *, front: bool = False) -> bool:
        """Enqueue an attempt unless Redis holds it already, in whichever queue. -> whether it was enqueued.

        Offering the same attempt twice is harmless: the row can be claimed once.
        """
        if self._enqueue(job_id, attempt, gib, front):
            return True
        if self.holds(job_id, attempt):
            return False
        with suppress(NoSuchJobError):
            self._fetch(rq_id(job_id, attempt)).delete()
        return self._enqueue(job_id, attempt, gib, front)

    def holds(self, job_id: str, attempt: int) -> bool:
        """Whether Redis will deliver the attempt, or has just delivered it to a worker that may be claiming it."""
        name = rq_id(job_id, attempt)
        try:
            job = self._fetch(name)
        except NoSuchJobError:
            return False
        if self.redis.lpos(_key(job.origin), name) is not None:
            return True
        if job.is_finished or job.is_failed or job.is_canceled or job.is_stopped:
            return False
        since = job.started_at or job.enqueued_at
        if since is None:
            return False
        age = (datetime.now(UTC) - (since if since.tzinfo else since.replace(tzinfo=UTC))).total_seconds()
        return age < STARTED_GRACE_SECONDS

    def decline(self, job_id: str, attempt: int) -> None:
        """Keep the attempt from being offered for some seconds: who was offered it cannot carry it, others may."""
        self.redis.zadd(DECLINED, {rq_id(job_id, attempt): time.time() + DECLINED_SECONDS})

    def declined(self) -> list[str]:
        """`job-attempt` of what is not offered at the moment."""
        pipeline = self.redis.pipeline()
        pipeline.zremrangebyscore(DECLINED, "-inf", time.time())
        pipeline.zrange(DECLINED, 0, -1)
        return [text_of(name) for name in pipeline.execute()[1]]

    def withdraw(self, keep: set[int]) -> None:
        """Take back what waits for workers of classes that are not in `keep`: nobody listens there any more."""
        kept = {queue_name(gib) for gib in keep}
        for raw in self.redis.smembers(Queue.redis_queues_keys):
            name = text_of(raw).removeprefix(Queue.redis_queue_namespace_prefix)
            if not name.startswith(QUEUE) or name in kept:
                continue
            self._remove(name, 0)

    def take_back(self, gib: int, count: int) -> list[str]:
        """Of what waits for a class, the last `count`. -> what came back: a worker may have just taken some."""
        return self._remove(queue_name(gib), -count)

    def _remove(self, queue: str, first: int) -> list[str]:
        removed, key = [], _key(queue)
        for name in map(text_of, self.redis.lrange(key, first, -1)):
            if self.redis.lrem(key, 1, name):  # else a worker has just come and taken it
                removed.append(name)
                with suppress(NoSuchJobError):
                    self._fetch(name).delete()
        return removed

    def waiting_ids(self, gib: int) -> list[str]:
        """`job-attempt` of all that waits for a class, first to last."""
        return self.waiting_by_class([gib])[gib]

    def waiting_by_class(self, classes: Sequence[int]) -> dict[int, list[str]]:
        """The same for several classes, asked at once."""
        pipeline = self.redis.pipeline(transaction=False)
        for gib in classes:
            pipeline.lrange(_key(queue_name(gib)), 0, -1)
        return {gib: [text_of(name) for name in found] for gib, found in zip(classes, pipeline.execute(), strict=True)}

    def _fetch(self, name: str) -> Job:
        return Job.fetch(name, connection=self.redis, serializer=JSONSerializer)

    def _enqueue(self, job_id: str, attempt: int, gib: int, front: bool) -> bool:
        if gib not in self._queues:
            self._queues[gib] = Queue(queue_name(gib), connection=self.redis, serializer=JSONSerializer)
        try:
            self._queues[gib].enqueue_call(
                TASK,
                args=(job_id, attempt),
                job_id=rq_id(job_id, attempt),
                timeout=-1,
                ttl=None,
                result_ttl=0,
                failure_ttl=3600,
                at_front=front,
                unique=True,
            )
        except DuplicateJobError:
            return False
        return True


def _key(name: str) -> str:
    return f"{Queue.redis_queue_namespace_prefix}{name}"


def text_of(raw: bytes | str) -> str:
    """What Redis has answered."""
    return raw.decode() if isinstance(raw, bytes) else raw

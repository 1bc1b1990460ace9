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
from rq.intermediate_queue import IntermediateQueue
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
NEAR = "advtex:near:"  # attempts whose scans a machine has, by its name
NEAR_SECONDS = 30
DOWNLOAD = "advtex:download:"  # a scan that a machine downloads ahead, so that no other does
DOWNLOAD_SECONDS = 600
PASSED = "advtex:passed:"  # how often an attempt was passed over
PASSED_SECONDS = 86400
PASSES = 3  # and no more
SCANNED = 10_000  # keys that Redis looks at in one go, a few milliseconds; there are some per worker
PRESENCE_SECONDS = 20  # a worker that has not announced itself for so long is gone

# Puts the first attempt that the machine has the scan of in front of those that it has not.
_PREFER = """
local passed = {}
for _, name in ipairs(redis.call('lrange', KEYS[1], 0, -1)) do
  if redis.call('sismember', KEYS[2], name) == 1 then
    for _, other in ipairs(passed) do
      redis.call('incr', ARGV[1] .. other)
      redis.call('expire', ARGV[1] .. other, ARGV[3])
    end
    redis.call('lrem', KEYS[1], 1, name)
    redis.call('lpush', KEYS[1], name)
    return
  end
  if tonumber(redis.call('get', ARGV[1] .. name) or 0) >= tonumber(ARGV[2]) then
    return
  end
  passed[#passed + 1] = name
end
"""


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

    def busy_workers(self, host: str) -> list[str]:
        """Names of the host's workers that have a job."""
        return [name for name, told in self._announced(host).items() if told.endswith(BUSY)]

    def _announced(self, host: str = "") -> dict[str, str]:
        """What the living workers tell, by their names."""
        names = self.workers(host)
        told = self.redis.mget([PRESENCE + name for name in names]) if names else []
        return {name: text_of(value) for name, value in zip(names, told, strict=True) if value is not None}

    def classes(self) -> list[WorkerClass]:
        """The classes of which workers live, smallest first."""
        known = self._announced().values()
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
            name = rq_id(job_id, attempt)
            job = self._fetch(name)
            taken = IntermediateQueue(_key(job.origin), self.redis)
            taken.remove(name)
            self.redis.delete(taken.get_first_seen_key(name))
            job.delete()
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
        taken = IntermediateQueue(_key(job.origin), self.redis)
        if self.redis.lpos(taken.key, name) is not None:  # a worker has it, and is about to begin with it
            taken.set_first_seen(name)
            since = taken.get_first_seen(name)
        else:
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

    def tell_near(self, host: str, names: Sequence[str]) -> None:
        """Of what waits, the attempts (`job-attempt`) whose scans the machine has."""
        pipeline = self.redis.pipeline()
        pipeline.delete(NEAR + host)
        if names:
            pipeline.sadd(NEAR + host, *names)
            pipeline.expire(NEAR + host, NEAR_SECONDS)
        pipeline.execute()

    def prefer_near(self, host: str, gib: int) -> None:
        """Called before an attempt is taken: let the next one be one whose scan the machine has.

        It is delay scheduling (Zaharia et al. 2010): no attempt is passed over more than a few times.
        """
        keys = (_key(queue_name(gib)), NEAR + host)
        self.redis.eval(_PREFER, len(keys), *keys, PASSED, str(PASSES), str(PASSED_SECONDS))

    def download_ahead(self, upload_id: str) -> bool:
        """Whether the caller may download a scan for an attempt that it does not have; one machine at a time may."""
        return bool(self.redis.set(DOWNLOAD + upload_id, "", nx=True, ex=DOWNLOAD_SECONDS))

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

    def take_away(self, gib: int, names: Sequence[str]) -> list[str]:
        """Of what waits for a class, these. -> what came back."""
        return self._take(_key(queue_name(gib)), names)

    def _remove(self, queue: str, first: int) -> list[str]:
        key = _key(queue)
        return self._take(key, [text_of(raw) for raw in self.redis.lrange(key, first, -1)])

    def _take(self, key: str, names: Sequence[str]) -> list[str]:
        removed = []
        for name in names:
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

"""The RQ queue: transport only. Emptied, it costs nothing but a new enqueue by the dispatcher.

One queue (RQ then moves ids with BLMOVE, which cannot drop one), JSON instead of pickle, no `Retry`, no time limit and
no expiry in Redis: attempts, leases and limits live in the rows.
"""

from __future__ import annotations

from contextlib import suppress
from datetime import UTC, datetime

from redis import Redis
from rq import Queue
from rq.exceptions import DuplicateJobError, NoSuchJobError
from rq.job import Job
from rq.serializers import JSONSerializer

from advtex_store.settings import StoreSettings

QUEUE = "advtex"
TASK = "advtex_worker.tasks.run_job"
STARTED_GRACE_SECONDS = 30.0  # between taking an id and claiming the row; later the taker is held for dead


def connect_redis(settings: StoreSettings) -> Redis:
    """A client that gives up after seconds when Redis is away; RQ's workers raise the limit for their own waits."""
    password = settings.redis_password()
    extra = {} if password is None else {"password": password}
    return Redis.from_url(
        settings.redis_url, socket_connect_timeout=3, socket_timeout=10, health_check_interval=30, **extra
    )


class JobQueue:
    """Attempts on their way to a worker. Every method raises `redis.RedisError` when Redis is away."""

    def __init__(self, redis: Redis) -> None:
        self.redis = redis
        self.rq = Queue(QUEUE, connection=redis, serializer=JSONSerializer)

    def offer(self, job_id: str, attempt: int, *, front: bool = False) -> bool:
        """Enqueue an attempt unless Redis holds it already. -> whether it was enqueued.

        Offering the same attempt twice is harmless: the row can be claimed once.
        """
        if self._enqueue(job_id, attempt, front):
            return True
        if self.holds(job_id, attempt):
            return False
        with suppress(NoSuchJobError):
            Job.fetch(_rq_id(job_id, attempt), connection=self.redis, serializer=JSONSerializer).delete()
        return self._enqueue(job_id, attempt, front)

    def holds(self, job_id: str, attempt: int) -> bool:
        """Whether Redis will deliver the attempt, or has just delivered it to a worker that may be claiming it."""
        rq_id = _rq_id(job_id, attempt)
        if self.redis.lpos(self.rq.key, rq_id) is not None:
            return True
        try:
            job = Job.fetch(rq_id, connection=self.redis, serializer=JSONSerializer)
        except NoSuchJobError:
            return False
        if job.is_finished or job.is_failed or job.is_canceled or job.is_stopped:
            return False
        since = job.started_at or job.enqueued_at
        if since is None:
            return False
        age = (datetime.now(UTC) - (since if since.tzinfo else since.replace(tzinfo=UTC))).total_seconds()
        return age < STARTED_GRACE_SECONDS

    def depth(self) -> int:
        """Attempts that wait in Redis."""
        return int(self.rq.count)

    def _enqueue(self, job_id: str, attempt: int, front: bool) -> bool:
        try:
            self.rq.enqueue_call(
                TASK,
                args=(job_id, attempt),
                job_id=_rq_id(job_id, attempt),
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


def _rq_id(job_id: str, attempt: int) -> str:
    return f"{job_id}-{attempt}"

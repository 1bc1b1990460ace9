"""How far running attempts are, in Redis: there it moves every half second, while a row is written every few seconds.

Nothing depends on it. While Redis does not answer, those who watch see what the rows say.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from typing import TypeVar

from redis import Redis, RedisError

from advtex_contract.jobs import JobState, Progress
from advtex_store.models import JobRow
from advtex_store.queue import rq_id

KEY = "advtex:progress:"
CHECKPOINT = "advtex:checkpoint:"
CHECKPOINT_SECONDS = 7 * 86400  # a key lives so long, and tells by what is left how old it is: no clocks are compared
KEPT_SECONDS = 10  # longer than it takes until the row says the same
REST_SECONDS = 5.0  # after Redis did not answer; meanwhile nobody waits for it again

T = TypeVar("T")


class LiveProgress:
    """Told by the attempt that holds the job, seen by whoever watches it."""

    def __init__(self, redis: Redis) -> None:
        self.redis = redis
        self._rest_until = 0.0

    def tell(self, job_id: str, attempt: int, progress: Progress, waiting_reason: str) -> None:
        """What people see until the row says something newer. Nobody may watch, and Redis may be away."""
        told = {"attempt": attempt, "progress": progress.model_dump(mode="json"), "waiting_reason": waiting_reason}
        self._ask(lambda: self.redis.set(KEY + job_id, json.dumps(told), ex=KEPT_SECONDS))

    def show(self, rows: Sequence[JobRow]) -> None:
        """Put the newest into the rows of running jobs, which their session has let go of."""
        running = [row for row in rows if row.state == JobState.running]
        if not running or (newest := self._ask(lambda: self.redis.mget([KEY + row.id for row in running]))) is None:
            return
        for row, told in zip(running, newest, strict=True):
            found = json.loads(told) if told else {}
            if found.get("attempt") == row.attempt:  # a stale attempt may go on for a moment
                row.progress, row.waiting_reason = found["progress"], found["waiting_reason"]

    def saved(self, job_id: str, attempt: int) -> None:
        """All that the attempt has done so far would outlive it: it has just begun, or has a new checkpoint."""
        self._ask(lambda: self.redis.set(CHECKPOINT + rq_id(job_id, attempt), "", ex=CHECKPOINT_SECONDS))

    def checkpoint_ages(self, attempts: Sequence[tuple[str, int]]) -> list[float]:
        """Seconds since each (job, attempt) was `saved`; without those of which nothing is known."""
        pipeline = self.redis.pipeline(transaction=False)
        for job_id, attempt in attempts:
            pipeline.pttl(CHECKPOINT + rq_id(job_id, attempt))
        left = self._ask(pipeline.execute) or []
        return [CHECKPOINT_SECONDS - milliseconds / 1000 for milliseconds in left if milliseconds >= 0]

    def _ask(self, ask: Callable[[], T]) -> T | None:
        if time.monotonic() < self._rest_until:
            return None
        try:
            return ask()
        except RedisError:
            self._rest_until = time.monotonic() + REST_SECONDS
            return None

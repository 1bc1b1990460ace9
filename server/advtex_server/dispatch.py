"""Waiting rows -> Redis, and everything that must be put right from time to time.

Any number of servers may do this at once: an attempt is enqueued under a unique id and claimed once, and every change
of a row is a compare-and-set.
"""

from __future__ import annotations

import asyncio
import time

import structlog
from redis import RedisError
from sqlalchemy.exc import SQLAlchemyError
from starlette.concurrency import run_in_threadpool

from advtex_contract.jobs import JobState
from advtex_server.settings import ServerSettings
from advtex_store.errors import StaleAttempt, StoreError
from advtex_store.retention import Retention
from advtex_store.store import Store

SPOOL_SECONDS = 86400.0  # leftovers of killed uploads are removed after this long

log = structlog.get_logger("advtex.dispatch")


class Dispatcher:
    """Two rhythms in one task: look for waiting jobs, and reconcile."""

    def __init__(self, store: Store, settings: ServerSettings) -> None:
        self.store = store
        self.settings = settings
        self.retention = Retention(store.database, store.blobs)
        self._woken = asyncio.Event()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._ill = False

    def wake(self) -> None:
        """From any thread: look now."""
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._woken.set)

    async def run(self) -> None:
        """Until canceled. Nothing that fails ends it: the next round tries again."""
        self._loop = asyncio.get_running_loop()
        reconciled = 0.0
        while True:
            self._woken.clear()
            due = time.monotonic() - reconciled >= self.settings.reconcile_seconds
            try:
                if due:
                    reconciled = time.monotonic()
                    await run_in_threadpool(self.reconcile)
                await run_in_threadpool(self.dispatch)
                if self._ill:
                    log.info("dispatching again")
                self._ill = False
            except (RedisError, SQLAlchemyError, StoreError, OSError) as error:
                if not self._ill:
                    log.warning("cannot dispatch, jobs wait", error=str(error))
                self._ill = True
            except Exception:
                log.exception("dispatch failed")
            try:
                await asyncio.wait_for(self._woken.wait(), self.settings.dispatch_seconds)
            except TimeoutError:
                continue

    def dispatch(self) -> int:
        """Offer the attempts that are next. -> how many were new to Redis. RedisError when it is away."""
        offered = 0
        for row in self.store.records.waiting(self.settings.queue_depth):
            if self.store.queue.offer(row.id, row.attempt, front=row.state == JobState.preempted):
                log.info("enqueued", job=row.id, attempt=row.attempt)
                offered += 1
        return offered

    def reconcile(self) -> None:
        """Give up expired leases, adopt results that nobody told the rows about, let go what has expired."""
        for job_id, attempt in self.store.records.expired():
            if self.store.results.adopt(job_id):
                log.info("adopted a finished result", job=job_id)
                continue
            try:
                state = self.store.records.lost(job_id, attempt, expired_only=True)
            except StaleAttempt:
                continue
            log.warning("lease expired", job=job_id, attempt=attempt, state=state)
        for row in self.store.records.waiting(self.settings.queue_depth):
            if row.attempt > 1 and self.store.results.adopt(row.id):
                log.info("adopted a finished result", job=row.id)
        self.retention.expire()
        self.retention.purge()
        self.store.blobs.clear_spool(time.time() - SPOOL_SECONDS)

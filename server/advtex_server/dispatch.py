"""Waiting rows -> Redis, and everything that must be put right from time to time.

Any number of servers may do this at once: an attempt is enqueued under a unique id and claimed once, and every change
of a row is a compare-and-set.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress

import structlog
from redis import RedisError
from sqlalchemy.exc import SQLAlchemyError
from starlette.concurrency import run_in_threadpool

from advtex_contract.jobs import JobState
from advtex_server.loops import OUTAGES, Loop
from advtex_server.settings import ServerSettings
from advtex_store.errors import StaleAttempt
from advtex_store.fair_queue import WaitingJob
from advtex_store.queue import WorkerClass, attempt_of, rq_id
from advtex_store.retention import Retention
from advtex_store.store import Store
from advtex_store.tracing import OFF, Traces
from advtex_store.troubles import ADOPT

SPOOL_SECONDS = 86400.0  # leftovers of killed uploads are removed after this long
ADOPT_ROWS = 100  # waiting rows that are looked at for a finished result, each time
REDIS_AWAY = "the queue (Redis) does not answer; the job starts when it is back"
NO_WORKER = "no worker is running; the job starts when one does"
TOO_LARGE = (
    "it needs more memory than the {gib} GiB of the largest worker that is running; start a larger one, or submit it "
    "again with smaller views or a smaller texture"
)

Timed = Callable[[str, Callable[[], object]], object]

log = structlog.get_logger("advtex.dispatch")


class Held:
    """The attempts that wait in Redis, by class of workers, as one round has found them and changed them.

    declined: those that must not wait there now. They stand in the line of rows still, and count with the others.
    """

    def __init__(self, by_class: Mapping[int, Iterable[str]], declined: Iterable[str]) -> None:
        self._by_class = {gib: set(names) for gib, names in by_class.items()}
        self._declined = frozenset(declined)

    def __contains__(self, name: str) -> bool:
        return name in self._declined or any(name in names for names in self._by_class.values())

    @property
    def jobs(self) -> set[str]:
        """Ids of those that wait there."""
        return {attempt_of(name)[0] for names in self._by_class.values() for name in names}

    @property
    def total(self) -> int:
        return len(self._declined) + sum(map(len, self._by_class.values()))

    def names(self, of: WorkerClass) -> frozenset[str]:
        """Those that wait for a class."""
        return frozenset(self._by_class[of.gib])

    def waiting(self, found: WorkerClass) -> int:
        """How many wait for a class."""
        return len(self._by_class[found.gib])

    def add(self, to: WorkerClass, name: str) -> None:
        self._by_class[to.gib].add(name)

    def remove(self, of: WorkerClass, names: Iterable[str]) -> None:
        self._by_class[of.gib].difference_update(names)


class Dispatcher:
    """Two rhythms in one task: look for waiting jobs, and reconcile.

    timed: called with the kind of each round and what does it.
    """

    def __init__(
        self,
        store: Store,
        settings: ServerSettings,
        timed: Timed = lambda _kind, act: act(),
        traces: Traces = OFF,
    ) -> None:
        self.store = store
        self._traces = traces
        self.settings = settings
        self._timed = timed
        self.retention = Retention(store.database, store.blobs)
        self.loops = (Loop("dispatch"), Loop("housekeeping"))
        self._woken = asyncio.Event()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._next_sweep = 0.0

    def wake(self) -> None:
        """From any thread: look now."""
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._woken.set)

    async def run(self) -> None:
        """Until canceled."""
        self._loop = asyncio.get_running_loop()
        reconciled = 0.0
        dispatching, housekeeping = self.loops
        while True:
            self._woken.clear()
            if time.monotonic() - reconciled >= self.settings.reconcile_seconds:
                reconciled = time.monotonic()
                with housekeeping.turn():
                    await run_in_threadpool(self._timed, "reconcile", self.reconcile)
            with dispatching.turn():
                await run_in_threadpool(self._timed, "dispatch", self.dispatch)
            try:
                await asyncio.wait_for(self._woken.wait(), self.settings.dispatch_seconds)
            except TimeoutError:
                continue

    def dispatch(self) -> int:
        """Offer the attempts that are next to workers that they fit. -> how many were new to Redis.

        Idle workers come first, so that no attempt waits behind a busy one; then a few attempts are put where they will
        wait. Small workers choose first, so that large ones are free for what fits nowhere else. Few attempts are in
        Redis at a time: who comes next is decided here, from the rows, as late as possible. RedisError when Redis is
        away.
        """
        queue = self.store.queue
        try:
            classes = queue.classes()
            queue.withdraw({found.gib for found in classes})
            held = Held(queue.waiting_by_class([found.gib for found in classes]), queue.declined())
            before = held.total
            self._take_back(classes, held)
            self._take_back_paused(classes, held)
            for found in classes:
                self._offer(found, found.idle - held.waiting(found), held)
            for found in classes:
                self._offer(found, found.workers * self.settings.queue_depth - held.waiting(found), held)
            if self.store.records.any_preempted():
                for found in classes:
                    self._offer_preempted(found, held)
        except RedisError:
            self.store.records.explain(REDIS_AWAY)
            raise
        self._explain(classes)
        return held.total - before

    def _take_back(self, classes: Sequence[WorkerClass], held: Held) -> None:
        """What waits behind busy workers while larger ones are idle, which are offered it next."""
        for place, found in enumerate(classes):
            free = sum(max(0, larger.idle - held.waiting(larger)) for larger in classes[place + 1 :])
            behind = min(held.waiting(found) - found.idle, free)
            if behind > 0:
                held.remove(found, self.store.queue.take_back(found.gib, behind))

    def _take_back_paused(self, classes: Sequence[WorkerClass], held: Held) -> None:
        """What was offered before its batch was paused."""
        paused = self.store.records.paused(held.jobs)
        for found in classes if paused else ():
            names = [name for name in held.names(found) if attempt_of(name)[0] in paused]
            held.remove(found, self.store.queue.take_away(found.gib, names))

    def _offer(self, to: WorkerClass, room: int, held: Held) -> None:
        """The next attempts to one class, as far as there is room."""
        if room <= 0:
            return
        for job in self.store.records.waiting(room + held.total, to.memory_bytes, held.jobs):
            room -= self._offer_job(job, to, held)
            if room == 0:
                return

    def _offer_preempted(self, to: WorkerClass, held: Held) -> None:
        """What had to give its worker back is not kept waiting for room."""
        for job in self.store.records.waiting(1 + held.total, to.memory_bytes, held.jobs):
            if job.state == JobState.preempted:
                self._offer_job(job, to, held)

    def _offer_job(self, job: WaitingJob, to: WorkerClass, held: Held) -> bool:
        """-> whether it was new to Redis."""
        name = rq_id(job.id, job.attempt)
        if name in held or not self.store.queue.offer(
            job.id, job.attempt, to.gib, front=job.state == JobState.preempted
        ):
            return False
        held.add(to, name)
        log.info("enqueued", job=job.id, attempt=job.attempt, worker_gib=to.gib)
        return True

    def _explain(self, classes: Sequence[WorkerClass]) -> None:
        if not classes:
            self.store.records.explain(NO_WORKER)
            return
        largest = classes[-1]
        self.store.records.explain("", up_to=largest.memory_bytes)
        self.store.records.explain(TOO_LARGE.format(gib=largest.gib), above=largest.memory_bytes)

    def reconcile(self) -> None:
        """Give up expired leases, adopt results that nobody told the rows about, let go what has expired.

        What fails for one job or upload stops no other (`Troubles`), and a fault in one step no other step: the first
        one is raised in the end. An outage ends the round, as it would every step.
        """
        faults = []
        for step in (
            self._give_up_expired,
            self._adopt_waiting,
            self.retention.expire,
            self.retention.purge,
            self.retention.tidy,
            self.store.batches.forget,
            self._drop_old_deliveries,
            self._sweep,
            self._clear_spool,
        ):
            try:
                step()
            except OUTAGES:
                raise
            except Exception as fault:
                faults.append(fault)
        if faults:
            raise faults[0]

    def _give_up_expired(self) -> None:
        for job_id, attempt in self.store.records.expired():
            with self.store.troubles.of(ADOPT, job_id):
                self._give_up(job_id, attempt)
        for job_id, attempt in self.store.records.expired(aside=True):
            with self.store.troubles.of(ADOPT, job_id):
                self._end_unread(job_id, attempt)

    def _adopt_waiting(self) -> None:
        aside = self.store.troubles.aside(ADOPT)
        for row in self.store.records.waiting(ADOPT_ROWS):
            if row.attempt > 1 and row.id not in aside:
                with self.store.troubles.of(ADOPT, row.id):
                    if self.store.results.adopt(row.id):
                        log.info("adopted a finished result", job=row.id)

    def _drop_old_deliveries(self) -> None:
        if dropped := self.store.webhooks.drop_old():
            log.warning("webhook deliveries given up", count=dropped)

    def _sweep(self) -> None:
        if time.monotonic() >= self._next_sweep:
            self._next_sweep = time.monotonic() + self.settings.sweep_seconds
            if orphans := self.retention.sweep():
                log.info("orphans removed", count=orphans)

    def _clear_spool(self) -> None:
        self.store.blobs.clear_spool(time.time() - SPOOL_SECONDS)

    def _give_up(self, job_id: str, attempt: int) -> None:
        if self.store.results.adopt(job_id):
            log.info("adopted a finished result", job=job_id)
            return
        with suppress(StaleAttempt):
            state = self.store.records.lost(job_id, attempt, expired_only=True)
            log.warning("lease expired", job=job_id, attempt=attempt, state=state)
            if self._traces.on:
                lost = self._traces.span(
                    "lost", self.store.records.job(job_id).traceparent, job=job_id, attempt=attempt
                )
                lost.end("its worker died or cannot be reached", state=state)

    def _end_unread(self, job_id: str, attempt: int) -> None:
        """Nobody has it, and for many rounds nobody could read whether it has finished: it would run for ever."""
        try:
            self._give_up(job_id, attempt)
        except SQLAlchemyError:
            raise
        except Exception as error:
            self.store.blobs.check()  # a storage that is away as a whole is no job's own trouble
            with suppress(StaleAttempt):
                self.store.results.end_unread(job_id, attempt, error, expired_only=True)
                log.error("a job has failed, as its results cannot be read", job=job_id, error=str(error))

"""The hold on a job, kept from a thread that waits for nothing else."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import StrEnum

import structlog

from advtex_contract.jobs import Progress
from advtex_store.errors import StaleAttempt
from advtex_store.records import Lease, Records

ROW_SECONDS = 5.0  # between renewals: a commit each
ROW_SHARE = 0.1  # of the lease, where that is less
HELD_SHARE = 0.9  # of the lease; then the run is ended, so that it is over before another one may begin
WATCH_SECONDS = 1.0

log = structlog.get_logger()


class Ending(StrEnum):
    """Why a run has to end before it is done; the first reason counts, but a lost lease overrules the others."""

    cancel = "cancel"
    preempt = "preempt"
    lost = "lost"


class LeaseKeeper:
    """Renews the lease with the newest progress, and finds out that the user or the server wants the run ended.

    The row is looked at after every `interval`, and written every few seconds. `show` is given what changes meanwhile,
    for those who watch: the progress, and why the run pauses. A database that cannot be reached is no loss until the
    lease is about to run out; a second thread watches that, since a heartbeat may hang. `on_ending` is called from
    these threads, once per reason. `paused`: set from outside, why the run does not go on at the moment, for people.
    """

    def __init__(
        self,
        records: Records,
        job_id: str,
        attempt: int,
        *,
        interval: float,
        on_ending: Callable[[Ending], None],
        log_tail: Callable[[], str],
        show: Callable[[Progress, str], None],
    ) -> None:
        self._records = records
        self._job_id = job_id
        self._attempt = attempt
        self._interval = interval
        self._on_ending = on_ending
        self._log_tail = log_tail
        self._show = show
        self._told_tail = ""
        self._progress: tuple[Progress | None, int] = (None, 0)
        self._stages: list[Progress] = []
        self._moved = Counter[str]()
        self._shown: tuple[Progress | None, str] = (None, "")
        self._held_until = self._until()
        self._next_beat = _now() + self._rest()  # the claim has just been one
        self._done = threading.Event()
        self._closed = False
        self._beating = threading.Lock()
        self._deciding = threading.Lock()
        self._counting = threading.Lock()
        self.ending: Ending | None = None
        self.paused = ""
        self._told: set[Ending] = set()
        self._threads = [
            threading.Thread(target=self._work, name="lease", daemon=True),
            threading.Thread(target=self._watch, name="lease watch", daemon=True),
        ]

    def start(self) -> None:
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """End the threads; the lease is no longer renewed."""
        self._done.set()
        for thread in self._threads:
            thread.join()

    def report(self, progress: Progress, reached: int) -> None:
        """What the next heartbeat tells."""
        before, _ = self._progress
        if before is None or before.stage != progress.stage:
            self._stages.append(progress)
        self._progress = (progress, reached)

    def moved(self, move: str, size: int) -> None:
        """Bytes went from or to the storage (`counters.MOVES`). From any thread; the next renewal tells of them."""
        with self._counting:
            self._moved[move] += size

    def end(self, ending: Ending) -> None:
        """The run has to end."""
        with self._deciding:
            if ending in self._told or self.ending is Ending.lost:
                return
            self._told.add(ending)
            if self.ending is None or ending is Ending.lost:
                self.ending = ending
            self._on_ending(ending)

    @contextmanager
    def closing(self) -> Iterator[None]:
        """While the rows are told how the attempt ends, and after: a heartbeat that finds it ended has lost nothing.

        An error leaves the attempt as it was before.
        """
        self._closed = True
        try:
            yield
        except BaseException:
            self._closed = False
            raise

    def beat(self) -> bool:
        """Renew now. -> whether the attempt still holds its job."""
        with self._beating:
            return self._ask(self._renew)

    def held(self) -> bool:
        """Whether the attempt still holds its job, without a renewal."""
        return self._ask(lambda: self._records.lease(self._job_id, self._attempt))

    def turn(self) -> None:
        """What is due: tell those who watch, then renew the lease or see at least how it is."""
        news = (self._progress[0], self.paused)
        if news != self._shown and news[0] is not None:
            self._show(news[0], news[1])
            self._shown = news
        if _now() >= self._next_beat:
            self.beat()
        else:
            self.held()

    def _renew(self) -> Lease:
        progress, reached = self._progress
        stages = self._stages[:]
        tail = self._log_tail()
        with self._counting:
            moved = +self._moved  # without what is 0
        until = self._until()  # taken before it is asked for: the rows' lease ends later than this
        lease = self._records.heartbeat(
            self._job_id,
            self._attempt,
            progress,
            stages=stages,
            reached=reached,
            log_tail=tail if tail != self._told_tail else None,
            waiting_reason=self.paused,
            moved=moved,
        )
        with self._counting:
            self._moved -= moved
        self._held_until, self._told_tail = until, tail
        self._next_beat = _now() + self._rest()
        del self._stages[: len(stages)]
        return lease

    def _ask(self, ask: Callable[[], Lease]) -> bool:
        """The rows. -> whether the attempt still holds its job, as far as is known."""
        try:
            lease = ask()
        except StaleAttempt as error:
            if self._closed:
                return False
            log.warning("lease lost", job=self._job_id, attempt=self._attempt, reason=str(error))
            self.end(Ending.lost)
            return False
        except Exception as error:  # whatever the database driver calls its being away
            log.warning("heartbeat failed", job=self._job_id, attempt=self._attempt, error=str(error))
            return self.ending is not Ending.lost
        if lease.cancel_requested:
            self.end(Ending.cancel)
        return True

    def _work(self) -> None:
        while not self._done.wait(self._interval):
            self.turn()

    def _watch(self) -> None:
        while (left := self._held_until - _now()) > 0:
            if self._done.wait(min(left, WATCH_SECONDS)):
                return
        log.warning("no heartbeat got through in time", job=self._job_id, attempt=self._attempt)
        self.end(Ending.lost)

    def _rest(self) -> float:
        return min(ROW_SECONDS, self._records.lease_seconds * ROW_SHARE)

    def _until(self) -> float:
        return _now() + self._records.lease_seconds * HELD_SHARE


def _now() -> float:
    """Seconds that go on while the machine is suspended: leases do not wait for it."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)

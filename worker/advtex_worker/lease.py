"""The hold on a job, kept from a thread that waits for nothing else."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from enum import StrEnum

import structlog

from advtex_contract.jobs import Progress
from advtex_store.errors import StaleAttempt
from advtex_store.records import Records

log = structlog.get_logger()


class Ending(StrEnum):
    """Why a run has to end before it is done; the first reason counts, but a lost lease overrules the others."""

    cancel = "cancel"
    preempt = "preempt"
    lost = "lost"


class LeaseKeeper:
    """Renews the lease with the newest progress, and finds out that the user or the server wants the run ended.

    A database that cannot be reached is no loss until the lease must have run out. `on_ending` is called from this
    thread, once per reason.
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
    ) -> None:
        self._records = records
        self._job_id = job_id
        self._attempt = attempt
        self._interval = interval
        self._on_ending = on_ending
        self._log_tail = log_tail
        self._told_tail = ""
        self._progress: tuple[Progress | None, int] = (None, 0)
        self._good = time.monotonic()
        self._done = threading.Event()
        self._beating = threading.Lock()
        self._deciding = threading.Lock()
        self.ending: Ending | None = None
        self._thread = threading.Thread(target=self._work, name="lease", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        """End the thread; the lease is no longer renewed."""
        self._done.set()
        self._thread.join()

    def report(self, progress: Progress, reached: int) -> None:
        """What the next heartbeat tells."""
        self._progress = (progress, reached)

    def end(self, ending: Ending) -> None:
        """The run has to end."""
        with self._deciding:
            if self.ending is ending or self.ending is Ending.lost:
                return
            if self.ending is None or ending is Ending.lost:
                self.ending = ending
            self._on_ending(ending)

    def beat(self) -> bool:
        """Renew now. -> whether the attempt still holds its job."""
        with self._beating:
            progress, reached = self._progress
            tail = self._log_tail()
            news = tail if tail != self._told_tail else None
            try:
                lease = self._records.heartbeat(self._job_id, self._attempt, progress, reached=reached, log_tail=news)
            except StaleAttempt as error:
                log.warning("lease lost", job=self._job_id, attempt=self._attempt, reason=str(error))
                self.end(Ending.lost)
                return False
            except Exception as error:  # whatever the database driver calls its being away
                log.warning("heartbeat failed", job=self._job_id, attempt=self._attempt, error=str(error))
                if time.monotonic() - self._good > self._records.lease_seconds:
                    self.end(Ending.lost)
                return self.ending is not Ending.lost
            self._good, self._told_tail = time.monotonic(), tail
            if lease.cancel_requested:
                self.end(Ending.cancel)
            return True

    def _work(self) -> None:
        while not self._done.wait(self._interval):
            self.beat()

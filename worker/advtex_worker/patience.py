"""An attempt's patience with what it depends on: storage and rows that are away pause it, and end it only in time."""

from __future__ import annotations

import math
import socket
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from typing import Any, TypeVar

from sqlalchemy.exc import SQLAlchemyError

from advtex_store.errors import (
    BlobNotFound,
    BlobsRefused,
    NoSpace,
    ReferenceRefused,
    ReferenceUnreadable,
    ResultsUnreadable,
    ScanDamaged,
    StaleAttempt,
    StoreError,
)
from advtex_store.files import translated
from advtex_worker.lease import Ending, LeaseKeeper
from advtex_worker.scan_cache import ScanCache
from advtex_worker.settings import WorkerSettings

RETRY_SECONDS = 5.0
POLL_SECONDS = 0.05
REASON_LENGTH = 120

T = TypeVar("T")


class Interrupted(Exception):
    """The run has to end (`LeaseKeeper.ending` says why) while something waits for storage."""


class Refused(Exception):
    """The storage has refused what the attempt needs for too long."""


class Patience:
    """Does what may have to be tried again, and says meanwhile why the attempt pauses.

    canceled: whether the user wants the attempt ended. log: bound to the attempt.
    """

    def __init__(
        self, keeper: LeaseKeeper, cache: ScanCache, settings: WorkerSettings, canceled: Callable[[], bool], log: Any
    ) -> None:
        self._keeper = keeper
        self._cache = cache
        self._settings = settings
        self._canceled = canceled
        self._log = log

    def record(self, action: Callable[[], T]) -> T:
        """Tell the rows how it ended, again until they answer or the lease is lost (Interrupted)."""
        while self._keeper.ending is not Ending.lost:
            try:
                with self._keeper.closing():
                    return action()
            except SQLAlchemyError as error:
                self._log.warning("the end cannot be recorded, trying again", error=str(error))
            time.sleep(0.5)
        raise Interrupted

    def transfer(self, action: Callable[[], T]) -> T:
        """`persist` for what may take long. A cancel leaves it behind: nothing that it still writes counts."""
        return self.persist(lambda: self._unless_canceled(action))

    def persist(self, action: Callable[[], T]) -> T:
        """Try until the storage plays along: a full disk or an unreachable bucket pauses the work and loses nothing.

        Refused: it was no outage, but a refusal that did not change for `refused_seconds`.
        """
        refused_at = math.inf
        while True:
            try:
                done = action()
            except (OSError, StoreError, SQLAlchemyError) as error:
                if _is_answer(error):
                    raise
                if _is_disk_full(error):
                    self._cache.shrink(0)
                self._keeper.paused = self._why_paused(error)
                self._log.warning("storage is in trouble, trying again", error=f"{type(error).__name__}: {error}")
                refused_at = min(refused_at, time.monotonic()) if _is_refusal(error) else math.inf
                if time.monotonic() - refused_at >= self._settings.refused_seconds:
                    host, minutes = socket.gethostname(), self._settings.refused_seconds / 60
                    raise Refused(f"the worker {host} was refused for {minutes:.0f} min: {error}") from error
            else:
                self._keeper.paused = ""
                return done
            for _ in range(int(RETRY_SECONDS / 0.5)):
                if self._keeper.ending:
                    raise Interrupted
                time.sleep(0.5)

    def no_room(self, place: str) -> str:
        """Why the attempt pauses while a disk is full."""
        return f"the disk of its worker {socket.gethostname()} is full ({place}); it goes on when there is room"

    def _unless_canceled(self, action: Callable[[], T]) -> T:
        future: Future[T] = Future()

        def act() -> None:
            try:
                future.set_result(action())
            except BaseException as error:
                future.set_exception(error)

        threading.Thread(target=act, name="transfer", daemon=True).start()
        while not wait([future], timeout=POLL_SECONDS).done:
            if self._canceled():
                raise Interrupted
        return future.result()

    def _why_paused(self, error: Exception) -> str:
        if _is_disk_full(error):
            return self.no_room(f"{self._settings.workspaces} or the storage")
        reason = str(error)[:REASON_LENGTH]  # the row's column is short
        return f"its worker {socket.gethostname()[:64]} cannot use the storage ({reason}); it goes on when it can"


def _is_answer(error: Exception) -> bool:
    """Errors that say how things are: no other try would say otherwise."""
    if isinstance(error, ReferenceUnreadable):  # may be mended while the job waits
        return False
    return isinstance(error, StaleAttempt | BlobNotFound | ScanDamaged | ReferenceRefused | ResultsUnreadable)


def _is_refusal(error: Exception) -> bool:
    """Errors that stay until somebody mends rights or settings, unlike an outage or a full disk."""
    lasting = PermissionError | FileNotFoundError | NotADirectoryError | BlobsRefused | ReferenceUnreadable
    return isinstance(error, lasting)


def _is_disk_full(error: Exception) -> bool:
    return isinstance(translated(error) if isinstance(error, OSError) else error, NoSpace)

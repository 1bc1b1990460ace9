"""Looks at the texture on their way to the storage. Nothing waits for them, and the job goes on without them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import structlog

from advtex_contract.live import LiveRecord
from advtex_store.live import Live

REST_FACTOR = 4.0  # after a look was written, rest this many times as long as it took

log = structlog.get_logger()


class LivePoster:
    """Writes the newest look on a thread of its own, while the attempt holds its job; a look that is late is skipped.

    still_held: asks the rows, before every look.
    """

    def __init__(self, live: Live, job_id: str, attempt: int, still_held: Callable[[], bool]) -> None:
        self._live = live
        self._job_id = job_id
        self._attempt = attempt
        self._still_held = still_held
        self._newest: LiveRecord | None = None
        self._changed = threading.Condition()
        self._stopped = False
        self._thread = threading.Thread(target=self._work, name="live", daemon=True)
        self._thread.start()

    def post(self, record: LiveRecord) -> None:
        with self._changed:
            self._newest = record
            self._changed.notify()

    def stop(self) -> None:
        """Begin no other look. One that is being written may come late: it harms nothing, and retention finds it."""
        with self._changed:
            self._stopped = True
            self._changed.notify()

    def _work(self) -> None:
        first = True
        while (record := self._next()) is not None:
            began = time.monotonic()
            try:
                if not self._still_held():
                    return
                self._live.write(self._job_id, self._attempt, record)
                if first:
                    self._live.drop_earlier(self._job_id, self._attempt)
                first = False
            except Exception as error:  # a full disk, an unreachable storage
                log.warning("live view not written", job=self._job_id, error=str(error))
            with self._changed:
                self._changed.wait_for(lambda: self._stopped, timeout=REST_FACTOR * (time.monotonic() - began))

    def _next(self) -> LiveRecord | None:
        """The newest look, once there is one; None at the end."""
        with self._changed:
            self._changed.wait_for(lambda: self._stopped or self._newest is not None)
            record, self._newest = self._newest, None
            return None if self._stopped else record

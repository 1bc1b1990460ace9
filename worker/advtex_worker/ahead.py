"""The next scan, downloaded while an attempt runs, and which waiting attempts this machine has the scans of.

An attempt that waits is only looked at: it stays in its queue, and any worker may take it. What was downloaded for it
is then of no use here, and goes like any other scan in the cache.
"""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable
from typing import IO

import structlog
from redis import RedisError
from sqlalchemy.exc import SQLAlchemyError

from advtex_store import keys
from advtex_store.errors import StoreError
from advtex_store.queue import attempt_of
from advtex_store.store import Store
from advtex_worker.download import download_scan
from advtex_worker.scan_cache import ScanCache, cache_name

LOOK_SECONDS = 5.0  # between looks at what waits
STOP_SECONDS = 1.0  # a storage that hangs holds up no attempt
ROOM = 2  # times the scan's size that the disk must have free

log = structlog.get_logger()


class Stopping(Exception):
    """The attempt beside which this runs has ended."""


class Ahead:
    """A thread that looks at what waits for workers of the class `gib`, of which this one is. It never takes anything,
    and nothing depends on it.

    moved: told of the bytes of each scan that it downloads.
    """

    def __init__(self, store: Store, cache: ScanCache, gib: int, moved: Callable[[int], None] = lambda _: None) -> None:
        self._moved = moved
        self._store = store
        self._cache = cache
        self._gib = gib
        self._host = socket.gethostname()
        self._tried = ""
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._work, name="ahead", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        """End it, in the middle of a download too."""
        self._done.set()
        if self._thread.ident is not None:
            self._thread.join(STOP_SECONDS)

    def look(self) -> None:
        """Once. What it downloads is one scan at a time, for an attempt that waits until it is taken."""
        waiting = self._store.queue.waiting_ids(self._gib)
        uploads = self._store.records.uploads_of([attempt_of(name)[0] for name in waiting])
        found = [(name, uploads[job]) for name in waiting if (job := attempt_of(name)[0]) in uploads]
        near = [name for name, upload in found if self._cache.has(cache_name(upload))]
        self._store.queue.tell_near(self._host, near)
        if self._tried in waiting:
            return
        for name, upload in found:
            if name not in near and self._store.queue.download_ahead(upload):
                self._tried = name
                self._download(upload)
                self._store.queue.tell_near(self._host, [*near, name])
                return

    def _download(self, upload: str) -> None:
        size = self._store.blobs.head(keys.scan_key(upload)).size
        if size > self._cache.limit_bytes or ROOM * size > self._cache.free_bytes():
            return

        def arrived(size: int) -> None:
            self._moved(size)
            self._check()

        def fill(file: IO[bytes]) -> None:
            download_scan(self._store, upload, file, arrived)

        with self._cache.held(cache_name(upload), fill, self._check):
            log.info("the scan of a waiting job is here", upload=upload)

    def _check(self) -> None:
        if self._done.is_set():
            raise Stopping

    def _work(self) -> None:
        while not self._done.wait(LOOK_SECONDS):
            try:
                self.look()
            except Stopping:
                return
            except (RedisError, SQLAlchemyError, StoreError, OSError) as error:
                log.info("cannot look ahead", error=str(error))
            except Exception:
                log.exception("a look ahead failed")

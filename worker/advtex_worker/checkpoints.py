"""Checkpoints in the blob storage, so that the next attempt can go on on any machine.

    jobs/{job}/checkpoints/{attempt}/{sequence}/{number}     a file, never changed
    jobs/{job}/checkpoints/{attempt}/index.json              which files make up the attempt's newest checkpoint

The index is replaced in one go, after its files are durable: a half-uploaded checkpoint is never seen. It may name
files of earlier attempts that have not changed since. The newest attempt with an index has the job's checkpoint.
"""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import structlog
from pydantic import BaseModel, ConfigDict, ValidationError

from advtex_contract.errors import ErrorDetail
from advtex_store import keys
from advtex_store.blobs import Blobs
from advtex_store.errors import BlobNotFound

INDEX = "index.json"
REST_FACTOR = 4.0  # after an upload, rest this many times as long as it took
RETRY_SECONDS = 5.0
JOIN_SECONDS = 0.05

log = structlog.get_logger()


class CheckpointFile(BaseModel):
    """A blob and what must be in it."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    key: str
    size: int
    sha256: str


class CheckpointIndex(BaseModel):
    """A complete checkpoint: name below the work folder -> file; and what stages that need no repeating warned of."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    sequence: int
    files: dict[str, CheckpointFile]
    warnings: tuple[ErrorDetail, ...] = ()


EMPTY = CheckpointIndex(sequence=0, files={})


def restore(blobs: Blobs, job_id: str, before_attempt: int, work: Path) -> CheckpointIndex:
    """Fetch the newest checkpoint of an attempt below `before_attempt` into `work`. -> its index, or EMPTY.

    An attempt that has just lost its lease may still replace its index once, and drop files of the one just read: then
    the new one is read. A checkpoint that cannot be had whole is passed over for an older one.
    """
    for attempt in range(before_attempt - 1, 0, -1):
        seen: CheckpointIndex | None = None
        while (index := _read_index(blobs, job_id, attempt)) is not None and index != seen:
            seen = index
            shutil.rmtree(work, ignore_errors=True)
            work.mkdir(parents=True)
            if _fetched(blobs, index, work):
                return index
        if seen is not None:
            log.warning("checkpoint passed over: files are missing or damaged", job=job_id, attempt=attempt)
            shutil.rmtree(work, ignore_errors=True)
            work.mkdir(parents=True)
    return EMPTY


def _read_index(blobs: Blobs, job_id: str, attempt: int) -> CheckpointIndex | None:
    try:
        return CheckpointIndex.model_validate_json(blobs.get(_index_key(job_id, attempt)))
    except BlobNotFound:
        return None
    except ValidationError:
        log.warning("checkpoint passed over: its index is damaged", job=job_id, attempt=attempt)
        return None


def _fetched(blobs: Blobs, index: CheckpointIndex, work: Path) -> bool:
    """Whether every file of the index is now in `work`."""
    for name, file in index.files.items():
        try:
            if blobs.fetch(file.key, work / name).sha256 != file.sha256:
                return False
        except (BlobNotFound, ValueError):  # or the index names what is no key
            return False
    return True


def _index_key(job_id: str, attempt: int) -> str:
    return keys.checkpoint_prefix(job_id, attempt) + INDEX


class CheckpointUploader:
    """Uploads snapshots on a thread of its own; what a newer snapshot replaces while it waits is skipped.

    on_saved: called after each checkpoint that is complete. moved: told of the bytes of each file that is uploaded.
    """

    def __init__(
        self,
        blobs: Blobs,
        job_id: str,
        attempt: int,
        base: CheckpointIndex,
        still_held: Callable[[], bool],
        on_saved: Callable[[], None] = lambda: None,
        moved: Callable[[int], None] = lambda _: None,
    ) -> None:
        self._moved = moved
        self._blobs = blobs
        self._on_saved = on_saved
        self._still_held = still_held
        self._job_id = job_id
        self._attempt = attempt
        self._committed = base
        self._warnings = base.warnings
        self._pending: dict[str, Path] = {}
        self._changed = threading.Condition()
        self._closing = False
        self._abandoned = False
        self._thread = threading.Thread(target=self._work, name="checkpoints", daemon=True)
        self._thread.start()

    def add(self, files: Mapping[str, Path], warnings: Iterable[ErrorDetail] = ()) -> None:
        """Snapshot files by their name below the work folder, removed once they are no longer needed; all warnings."""
        with self._changed:
            self._warnings = tuple(warnings)
            replaced = [self._pending[name] for name in files if name in self._pending]
            self._pending.update(files)
            self._changed.notify()
        for path in replaced:
            path.unlink(missing_ok=True)

    def finish(self, out_of_time: Callable[[], bool] = lambda: False) -> None:
        """Upload what is left and end the thread; once `out_of_time`, leave it behind and commit nothing more."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        while self._thread.is_alive():
            if out_of_time():
                self._abandoned = True
                return
            self._thread.join(JOIN_SECONDS)

    def abandon(self, out_of_time: Callable[[], bool] = lambda: False) -> None:
        """Commit nothing more: the attempt no longer holds its job, or needs no checkpoint."""
        self._abandoned = True
        self.finish(out_of_time)

    def _work(self) -> None:
        rest = 0.0
        while self._wait(rest):
            with self._changed:
                batch, self._pending = self._pending, {}
                last_try = self._closing
            began = time.monotonic()
            try:
                self._commit(batch)
            except Exception as error:  # a full disk, an unreachable storage: the run goes on, and so do the tries
                log.warning("checkpoint not uploaded", job=self._job_id, error=str(error))
                with self._changed:
                    self._pending = batch | self._pending
                if last_try:
                    return
                rest = RETRY_SECONDS
            else:
                rest = REST_FACTOR * (time.monotonic() - began)

    def _wait(self, rest: float) -> bool:
        """Rest, then wait for snapshots. False when there is nothing more to do."""
        with self._changed:
            self._changed.wait_for(lambda: self._closing, timeout=rest)
            self._changed.wait_for(lambda: self._closing or self._pending)
            return bool(self._pending) and not self._abandoned

    def _commit(self, batch: Mapping[str, Path]) -> None:
        sequence = self._committed.sequence + 1
        prefix = keys.checkpoint_prefix(self._job_id, self._attempt)
        files = dict(self._committed.files)
        for number, (name, path) in enumerate(sorted(batch.items())):
            key = f"{prefix}{sequence}/{number}"
            written = self._blobs.upload(path, key)
            self._moved(written.size)
            files[name] = CheckpointFile(key=key, size=written.size, sha256=written.sha256)
        if self._abandoned or not self._still_held():
            return
        index = CheckpointIndex(sequence=sequence, files=files, warnings=self._warnings)
        self._blobs.put(_index_key(self._job_id, self._attempt), index.model_dump_json().encode())
        before, self._committed = self._committed, index
        self._on_saved()
        named = {file.key for file in files.values()}
        for file in before.files.values():  # earlier attempts' files stay: their own index still names them
            if file.key not in named and file.key.startswith(prefix):
                self._blobs.delete(file.key)
        for path in batch.values():
            path.unlink(missing_ok=True)

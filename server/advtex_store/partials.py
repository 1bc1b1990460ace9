"""Blobs that arrive in pieces, over days, servers and crashes.

The row of the upload says which request holds it, how many bytes are durable (`offset`), and which request made them so
(`kept_by`). A partial has at least those bytes. What lies beyond them was never acknowledged, and the next one to write
there writes over it.

A request that has lost the row may not know it yet: it is slow, frozen, or in the middle of a write. So

- bytes before the offset cannot be changed by it (a folder), or not without being noticed (S3);
- a blob gets its name only when the row says that all of it is durable. From then on nobody writes any more, and
  whoever comes gives it its name: it is the same blob whoever does, and however often.
"""

from __future__ import annotations

import fcntl
import os
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

from advtex_store.errors import BlobNotFound, BlobsUnavailable
from advtex_store.files import fsync_dir, translated

LOCK_SECONDS = 10.0  # much longer than a write takes; a process that is killed lets go at once
LOCK_PAUSE = 0.01


@dataclass(frozen=True, slots=True)
class Unpublished:
    """A multipart upload that was begun and not completed. `superseded`: another one has taken its place for good."""

    key: str
    upload_id: str
    superseded: bool


@dataclass(frozen=True, slots=True)
class Hold:
    """What a request knows of the row that it has seized.

    holder: the request, by a name that no other has. kept_by: the one that moved the offset last, None at the
    beginning. check: raises Superseded once the row is no longer this request's.
    """

    holder: str
    kept_by: str | None
    check: Callable[[], None]


class Partial(ABC):
    """One upload's bytes, written in order from `offset` on. All calls block and come from one thread at a time.

    The offset at the beginning is the row's, unless the storage knows better: the size of a blob that has its name
    already, or less, where another request replaced bytes. The row is to be told of it then.
    """

    def __init__(self, offset: int) -> None:
        self.offset = offset

    @abstractmethod
    def write(self, data: bytes) -> None:
        """Append. Superseded, NoSpace, BlobsUnavailable."""

    @abstractmethod
    def flush(self) -> None:
        """Everything before `offset` is durable from here on, and so is what was before the flush. Superseded."""

    def settle(self) -> None:  # noqa: B027  most have nothing to do
        """The row tells of the last flush: what only an earlier offset needs may go."""

    @abstractmethod
    def publish(self) -> None:
        """The row tells of all bytes: let the blob appear under its key. Doing it again changes nothing."""

    @abstractmethod
    def close(self) -> None:
        """Release what is held open; the bytes that were flushed stay."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()


class PublishedPartial(Partial):
    """A blob that got its name already, although its row does not know its SHA-256 yet. It takes no more bytes."""

    def write(self, data: bytes) -> None:
        if data:
            raise ValueError("a blob that has its name takes no more bytes")

    def flush(self) -> None:
        return

    def publish(self) -> None:
        return

    def close(self) -> None:
        return


class FolderPartial(Partial):
    """A file beside its final name, locked around every write.

    Under the lock a writer looks whether the row is still its own. Whoever seizes the row takes the lock once before it
    goes on: then the writes of earlier holders are over, and later ones are refused. The kernel frees the lock of a
    process that dies.
    """

    def __init__(self, path: Path, target: Path, size: int, offset: int, hold: Hold) -> None:
        super().__init__(offset)
        self._path = path
        self._target = target
        self._size = size
        self._hold = hold
        try:
            self._file = os.open(path, os.O_RDWR)
        except FileNotFoundError:
            raise BlobNotFound(path.name) from None
        try:
            if os.fstat(self._file).st_size < offset:
                raise BlobNotFound(f"{path.name}: the first {offset} bytes are not held any more")
            with self._alone():
                pass
        except BaseException:
            self.close()
            raise

    def write(self, data: bytes) -> None:
        view = memoryview(data)
        try:
            with self._alone():
                while view:
                    written = os.pwrite(self._file, view, self.offset)
                    self.offset += written
                    view = view[written:]
        except OSError as error:
            raise translated(error) from error

    def flush(self) -> None:
        try:
            os.fsync(self._file)
        except OSError as error:
            raise translated(error) from error

    def publish(self) -> None:
        try:
            self._path.replace(self._target)
        except FileNotFoundError:  # another request was faster
            if not self._target.exists() or self._target.stat().st_size != self._size:
                raise BlobNotFound(self._target.name) from None
        fsync_dir(self._target.parent)

    def close(self) -> None:
        os.close(self._file)

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """No other holder writes meanwhile. Superseded."""
        give_up = time.monotonic() + LOCK_SECONDS
        while not _locked(self._file):
            if time.monotonic() > give_up:
                raise BlobsUnavailable(f"{self._path} is locked by another process, which seems to be frozen")
            time.sleep(LOCK_PAUSE)
        try:
            self._hold.check()
            yield
        finally:
            fcntl.flock(self._file, fcntl.LOCK_UN)


def _locked(file: int) -> bool:
    """Whether this call took the lock: of the open file, so that requests of one process exclude one another too."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True

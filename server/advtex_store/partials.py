"""Blobs that arrive in pieces, over days, servers and crashes.

The row of the upload holds the offset; a partial holds at least that many bytes durably. What lies beyond the offset
(a piece that was never acknowledged) is overwritten by the next one to write there, so any number of writers that send
the same bytes do no harm to one another.
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

from advtex_store.errors import BlobNotFound
from advtex_store.files import fsync_dir, translated


@dataclass(frozen=True, slots=True)
class Unpublished:
    """A multipart upload that was begun and not completed. `superseded`: another one has taken its place for good."""

    key: str
    upload_id: str
    superseded: bool


class Partial(ABC):
    """One upload's bytes, written in order from `offset` on. All calls block and come from one thread at a time."""

    def __init__(self, offset: int) -> None:
        self.offset = offset

    @abstractmethod
    def write(self, data: bytes) -> None:
        """Append. NoSpace, BlobsUnavailable."""

    @abstractmethod
    def flush(self) -> None:
        """Everything before `offset` is durable from here on, and so is what was before the flush."""

    def settle(self) -> None:  # noqa: B027  most have nothing to do
        """The row tells of the last flush: what only an earlier offset needs may go."""

    @abstractmethod
    def publish(self) -> None:
        """All bytes are there: let the blob appear under its key. Doing it again changes nothing."""

    @abstractmethod
    def close(self) -> None:
        """Release what is held open; the bytes that were flushed stay."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()


class PublishedPartial(Partial):
    """For a blob that got its name just before a crash: its bytes are there, and are not written again."""

    def write(self, data: bytes) -> None:
        self.offset += len(data)

    def flush(self) -> None:
        return

    def publish(self) -> None:
        return

    def close(self) -> None:
        return


class FolderPartial(Partial):
    """A file beside its final name."""

    def __init__(self, path: Path, target: Path, size: int, offset: int) -> None:
        super().__init__(offset)
        self._path = path
        self._target = target
        self._size = size
        self._file = os.open(path, os.O_RDWR)
        if os.fstat(self._file).st_size < offset:
            self.close()
            raise BlobNotFound(f"{path.name}: the first {offset} bytes are not held any more")

    def write(self, data: bytes) -> None:
        view = memoryview(data)
        try:
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
        self.flush()
        try:
            self._path.replace(self._target)
        except FileNotFoundError:  # another request for the same bytes was faster
            if not self._target.exists() or self._target.stat().st_size != self._size:
                raise BlobNotFound(self._target.name) from None
        fsync_dir(self._target.parent)

    def close(self) -> None:
        os.close(self._file)

"""Blobs that arrive in pieces, over days, servers and crashes.

The row of the upload holds the offset; a partial holds at least that many bytes durably. What lies beyond the offset
(a piece that was never acknowledged) is overwritten by the next one to write there, so any number of writers that send
the same bytes do no harm to one another.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from types import TracebackType
from typing import Self


class Partial(ABC):
    """One upload's bytes, written in order from `offset` on. All calls block and come from one thread at a time."""

    def __init__(self, offset: int) -> None:
        self.offset = offset

    @abstractmethod
    def write(self, data: bytes) -> None:
        """Append. NoSpace, BlobsUnavailable."""

    @abstractmethod
    def flush(self) -> None:
        """Everything before `offset` is durable from here on."""

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

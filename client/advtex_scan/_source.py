"""Bytes at positions of one file."""

from __future__ import annotations

import os
import threading
from pathlib import Path
from typing import Protocol


class ByteSource(Protocol):
    """A file without a position of its own. Reading after `close` raises ValueError."""

    @property
    def size(self) -> int:
        """Bytes that it holds."""

    def read(self, length: int, offset: int) -> bytes:
        """`length` bytes from `offset`, fewer only at the end of the file."""

    def close(self) -> None:
        """Close the file."""


class FileSource:
    """A file of this machine, read from several threads, on every platform (`os.pread` is missing on Windows)."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("rb", buffering=0)
        self._lock = threading.Lock()
        self.size = os.fstat(self._file.fileno()).st_size

    def read(self, length: int, offset: int) -> bytes:
        """Return `length` bytes from `offset`, fewer only at the end of the file."""
        pieces = []
        with self._lock:
            self._file.seek(offset)
            while length > 0 and (piece := self._file.read(length)):
                pieces.append(piece)
                length -= len(piece)
        return b"".join(pieces)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

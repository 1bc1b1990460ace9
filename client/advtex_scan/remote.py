"""A scan that lies elsewhere, in an object storage say, and is read by ranges: nothing of it is copied to disk."""

from __future__ import annotations

import io
from collections import OrderedDict
from collections.abc import Callable, Mapping
from pathlib import Path

from advtex_scan._names import is_junk
from advtex_scan._zip_directory import ArchiveLimits, raise_errors, too_many_entries
from advtex_scan.archive import (
    ScanArchive,
    SourceStream,
    changed,
    check_name,
    check_size,
    check_total,
    checksum,
    lone_file,
)
from advtex_scan.errors import Findings

BLOCK = 64 << 10  # bytes that are fetched at least ...
AHEAD = 64  # ... or so many blocks at once where reads go forward ...
NEAR = 16  # ... with gaps of so many blocks at most
KEPT = 2048  # blocks


def open_remote(
    label: str,
    files: int | Mapping[str, int],
    fetch: Callable[[str, int, int], bytes],
    limits: ArchiveLimits | None = None,
) -> ScanArchive:
    """Open a scan that lies elsewhere, as `open_scan` would if it were here. Raises ArchiveError in the same way.

    label: the last part of its address.
    files: size of the zip or `.sens`, or sizes of a folder's files by their path in it; bytes.
    fetch: gives the bytes of a file (no name for the only one) from a position up to another one.
    """
    limits = limits or ArchiveLimits()
    if not isinstance(files, int):
        return _RemoteFolder(label, files, fetch, limits)
    return lone_file(RangedSource(files, lambda start, end: fetch("", start, end)), Path(label), limits)


class _RemoteFolder(ScanArchive):
    """A folder whose files lie elsewhere."""

    def __init__(
        self, label: str, files: Mapping[str, int], fetch: Callable[[str, int, int], bytes], limits: ArchiveLimits
    ) -> None:
        self._fetch = fetch
        problems = Findings()
        sizes = {name: size for name, size in files.items() if not is_junk(name)}
        if len(sizes) > limits.entries:
            raise too_many_entries(label, limits)
        for name, size in sizes.items():
            check_size(check_name(name, problems), size, limits, problems)
        check_total(label, sizes, limits, problems)
        raise_errors(problems)
        super().__init__(Path(label), sizes)

    def close(self) -> None:
        """Nothing is held open."""

    def _stamp(self, name: str) -> int:
        return checksum(self._stream(name))

    def _stream(self, name: str) -> io.RawIOBase:
        size = self.size(name.removeprefix(self._prefix))
        return SourceStream(RangedSource(size, lambda start, end: self._fetch(name, start, end)))

    def _range(self, name: str, offset: int, length: int) -> bytes:
        data = self._fetch(name, offset, offset + length) if length else b""
        if len(data) != length:
            raise changed(name)
        return data


class RangedSource:
    """A file of `size` bytes that lies elsewhere. fetch: gives the bytes from a position up to another one.

    Blocks that were read are kept for a while. Reads that pass over the file in order, as those of a zip of many small
    members do, fetch megabytes at once; single ones fetch one block. Not thread-safe.
    """

    def __init__(self, size: int, fetch: Callable[[int, int], bytes]) -> None:
        self.size = size
        self._fetch = fetch
        self._blocks: OrderedDict[int, bytes] = OrderedDict()

    def read(self, length: int, offset: int) -> bytes:
        """`length` bytes from `offset`, fewer only at the end of the file."""
        end = min(offset + length, self.size)
        if offset >= end:
            return b""
        first, last = offset // BLOCK, (end - 1) // BLOCK
        data = b"".join(self._block(number, last) for number in range(first, last + 1))
        return data[offset - first * BLOCK : end - first * BLOCK]

    def close(self) -> None:
        """Nothing is held open."""

    def _block(self, number: int, wanted: int) -> bytes:
        """Block `number`, fetched with those up to `wanted` if need be."""
        if number not in self._blocks:
            forward = any(number - back in self._blocks for back in range(1, NEAR + 1))
            count = AHEAD if forward else min(wanted - number + 1, AHEAD)
            start = number * BLOCK
            data = self._fetch(start, min(start + count * BLOCK, self.size))
            for at in range(0, len(data), BLOCK):
                self._blocks[number + at // BLOCK] = data[at : at + BLOCK]
            while len(self._blocks) > KEPT:
                self._blocks.popitem(last=False)
        if number not in self._blocks:  # the file has become shorter
            return b""
        self._blocks.move_to_end(number)
        return self._blocks[number]

"""Random access into a zip member, stored or deflated, without unpacking it.

For a deflated member `RangeReader` keeps copies of the decompressor's state: one every `CHECKPOINT_BYTES` of output for
good, and the last few where a read of a large member ended. Reading ranges in order therefore inflates each byte once,
and a jump into a region that was passed before inflates at most one checkpoint's distance. A state takes about 50 kB:
10 GB of output keep about 30 MB. Kept states are only copied, never advanced, so threads need no lock to inflate.
"""

from __future__ import annotations

import bisect
import io
import threading
import zlib
from collections import OrderedDict, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from advtex_scan._source import ByteSource
from advtex_scan.errors import ArchiveError, Finding

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer

CHECKPOINT_BYTES = 16 << 20
RECENT_STATES = 16  # one per decoding thread, and some
INPUT_CHUNK = 16 << 10
OUTPUT_CHUNK = 256 << 10


@dataclass(frozen=True, slots=True)
class Extent:
    """Where a member's bytes lie: `stored` of them from `start` of the file, `size` once inflated."""

    name: str
    start: int
    stored: int
    size: int
    crc: int
    deflated: bool


class _State:
    """A decompressor with the positions of its next input and output byte."""

    __slots__ = ("consumed", "inflater", "position")

    def __init__(self) -> None:
        self.inflater = zlib.decompressobj(-zlib.MAX_WBITS)
        self.consumed = 0
        self.position = 0

    def copy(self) -> _State:
        twin = _State.__new__(_State)
        twin.inflater, twin.consumed, twin.position = self.inflater.copy(), self.consumed, self.position
        return twin


def damaged(name: str, what: str) -> ArchiveError:
    """Return the error for a member that does not decode."""
    return ArchiveError(Finding("error", "damaged_member", name, what, "make the zip again and upload all of it"))


class RangeReader:
    """Reads ranges of the members of one file. Safe to use from several threads at once."""

    def __init__(self, source: ByteSource) -> None:
        self._source = source
        self._lock = threading.Lock()
        self._checkpoints: defaultdict[str, list[_State]] = defaultdict(list)
        self._recent: OrderedDict[tuple[str, int], _State] = OrderedDict()

    def read(self, extent: Extent, offset: int, length: int) -> bytes:
        """Return `length` bytes from `offset`; the caller has checked them against the member's size."""
        if not extent.deflated:
            return _stored(self._source, extent, offset, length)
        state = self._nearest(extent.name, offset)
        for _ in _inflate(self._source, extent, state, offset - state.position):
            self._keep_checkpoint(extent.name, state)
        pieces = []
        for piece in _inflate(self._source, extent, state, length):
            pieces.append(piece)
            self._keep_checkpoint(extent.name, state)
        if extent.size > CHECKPOINT_BYTES:
            self._keep_recent(extent.name, state)
        return b"".join(pieces)

    def _nearest(self, name: str, offset: int) -> _State:
        with self._lock:
            checkpoints = self._checkpoints.get(name, [])
            index = bisect.bisect_right(checkpoints, offset, key=lambda state: state.position)
            before = [state for (member, at), state in self._recent.items() if member == name and at <= offset]
            before += checkpoints[max(index - 1, 0) : index]
            return max(before, key=lambda state: state.position).copy() if before else _State()

    def _keep_checkpoint(self, name: str, state: _State) -> None:
        with self._lock:
            checkpoints = self._checkpoints.get(name)
            last = checkpoints[-1].position if checkpoints else 0
            if state.position >= last + CHECKPOINT_BYTES:
                self._checkpoints[name].append(state.copy())

    def _keep_recent(self, name: str, state: _State) -> None:
        with self._lock:
            self._recent[name, state.position] = state
            self._recent.move_to_end((name, state.position))
            if len(self._recent) > RECENT_STATES:
                self._recent.popitem(last=False)


class MemberStream(io.RawIOBase):
    """One pass over a member from its first byte; its length and CRC are checked when the end is reached."""

    def __init__(self, source: ByteSource, extent: Extent) -> None:
        super().__init__()
        self._source = source
        self._extent = extent
        self._state = _State()
        self._crc = 0

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: WriteableBuffer, /) -> int:
        view = memoryview(buffer).cast("B")
        position, extent = self._state.position, self._extent
        length = min(len(view), extent.size - position, OUTPUT_CHUNK)
        if extent.deflated:
            piece = b"".join(_inflate(self._source, extent, self._state, length))
        else:
            piece = _stored(self._source, extent, position, length)
            self._state.position += length
        self._crc = zlib.crc32(piece, self._crc)
        view[:length] = piece
        if length == 0 and len(view) > 0:
            self._check_end()
        return length

    def _check_end(self) -> None:
        if self._extent.deflated and _holds_more(self._source, self._extent, self._state):
            raise damaged(self._extent.name, f"inflates to more than the {self._extent.size} bytes it claims")
        if self._crc != self._extent.crc:
            raise damaged(self._extent.name, "its checksum is wrong")


def _stored(source: ByteSource, extent: Extent, offset: int, length: int) -> bytes:
    data = source.read(length, extent.start + offset)
    if len(data) != length:
        raise damaged(extent.name, "the file ends before this member does")
    return data


def _next_input(source: ByteSource, extent: Extent, state: _State) -> bytes:
    """Return what the inflater left over, else the next stored bytes; empty at the member's end."""
    if state.inflater.unconsumed_tail:
        return state.inflater.unconsumed_tail
    piece = _stored(source, extent, state.consumed, min(INPUT_CHUNK, extent.stored - state.consumed))
    state.consumed += len(piece)
    return piece


def _inflate(source: ByteSource, extent: Extent, state: _State, length: int) -> Iterator[bytes]:
    """Advance `state` by `length` bytes of output, in pieces of at most OUTPUT_CHUNK."""
    while length > 0:
        data = _next_input(source, extent, state)
        try:
            piece = state.inflater.decompress(data, min(length, OUTPUT_CHUNK))
        except zlib.error as error:
            raise damaged(extent.name, f"does not inflate ({error})") from error
        state.position += len(piece)
        length -= len(piece)
        if piece:
            yield piece
        elif state.inflater.eof or not data:
            raise damaged(extent.name, f"inflates to {state.position} bytes, not to the {extent.size} it claims")


def _holds_more(source: ByteSource, extent: Extent, state: _State) -> bool:
    try:
        while not state.inflater.eof:
            data = _next_input(source, extent, state)
            if state.inflater.decompress(data, 1):
                return True
            if not data:
                return False
    except zlib.error as error:
        raise damaged(extent.name, f"does not inflate ({error})") from error
    return False

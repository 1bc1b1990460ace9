"""What an MP4 or QuickTime file says of its picture track: size, number of pictures, codec. Nothing is decoded.

A file is a sequence of boxes, each with a 32-bit length, four letters and a body, which may be boxes again (ISO/IEC
14496-12). The track's description is in `moov`, which recorders write last: a recording that was broken off has none.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass

from advtex_scan.archive import ScanArchive
from advtex_scan.errors import ArchiveError, Finding

MOST_DESCRIPTION = 64 << 20  # bytes of `moov`; an hour at 60 pictures a second takes 5 MB
MOST_BOXES = 10_000
FOLDERS = (b"moov", b"trak", b"mdia", b"minf", b"stbl")
REMEDY = "copy the video again in full; a recording that was broken off cannot be used"


@dataclass(frozen=True, slots=True)
class VideoHeader:
    """The first picture track: size of its stored pictures, how many there are, and the codec's four letters."""

    width: int
    height: int
    frames: int
    codec: str


@dataclass(slots=True)
class _Track:
    is_picture: bool = False
    width: int = 0
    height: int = 0
    codec: str = ""
    frames: int = 0


def read_video_header(archive: ScanArchive, name: str) -> VideoHeader:
    """Read the header of a video. Raises ArchiveError if it is none, cut off, or without pictures."""
    tracks: list[_Track] = []
    for kind, body in _boxes(_description(archive, name)):
        if kind == b"trak":
            tracks.append(_Track())
        elif tracks:
            _read_box(tracks[-1], kind, body)
    for track in tracks:
        if track.is_picture and track.width and track.height and track.frames:
            return VideoHeader(track.width, track.height, track.frames, track.codec)
    raise _broken(name, "holds no pictures")


def _description(archive: ScanArchive, name: str) -> bytes:
    """Return the body of `moov`."""
    offset, size = 0, archive.size(name)
    for _ in range(MOST_BOXES):
        if offset + 16 > size:
            break
        length, kind, long_length = struct.unpack(">I4sQ", archive.read_range(name, offset, 16))
        head = 16 if length == 1 else 8
        length = long_length if length == 1 else length or size - offset
        if not kind.isalnum() or length < head:
            break
        if kind == b"moov":
            if length > min(size - offset, MOST_DESCRIPTION):
                raise _broken(name, "is cut off or damaged: its description is not whole")
            return archive.read_range(name, offset + head, length - head)
        offset += length
    raise _broken(name, "is no whole MP4 or QuickTime video: its description is missing")


def _boxes(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Yield all boxes below `data`, each before those inside it; this ends silently at one that makes no sense."""
    stack = [(0, len(data))]
    for _ in range(MOST_BOXES):
        while stack and stack[-1][0] + 8 > stack[-1][1]:
            stack.pop()
        if not stack:
            return
        start, end = stack.pop()
        length, kind = struct.unpack_from(">I4s", data, start)
        if not 8 <= length <= end - start:
            continue
        stack.append((start + length, end))
        if kind in FOLDERS:
            stack.append((start + 8, start + length))
        yield kind, data[start + 8 : start + min(length, 128)]


def _read_box(track: _Track, kind: bytes, body: bytes) -> None:
    if kind == b"hdlr" and len(body) >= 12:
        track.is_picture = body[8:12] == b"vide"
    elif kind == b"stsd" and len(body) >= 44:
        # Version and flags, count; then the first entry: length, codec, 24 bytes, width, height.
        track.codec = body[12:16].decode("latin-1")
        track.width, track.height = struct.unpack_from(">2H", body, 40)
    elif kind == b"stsz" and len(body) >= 12:
        track.frames = struct.unpack_from(">I", body, 8)[0]


def _broken(name: str, what: str) -> ArchiveError:
    return ArchiveError(Finding("error", "bad_video", name, what, REMEDY))

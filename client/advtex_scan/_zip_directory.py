"""The central directory of a zip (APPNOTE 6.3), read by hand so that a hostile one costs nothing.

The number of entries is checked before and while they are read; nothing is trusted: names, sizes, positions and
overlaps of all members are checked here, and `Extent`s with verified bounds are all that leaves this module.
"""

from __future__ import annotations

import stat
import struct
from collections.abc import Iterator
from dataclasses import dataclass

from advtex_scan._inflate import Extent, damaged
from advtex_scan._names import is_junk, is_nested_archive, unsafe_reason
from advtex_scan._source import ByteSource
from advtex_scan.errors import ArchiveError, Finding, Findings, LimitError, ScanFormatError, UnsafeArchiveError

END = struct.Struct("<4s4H2LH")  # end of central directory
END64_LOCATOR = struct.Struct("<4sLQL")
END64 = struct.Struct("<4sQ2H2L4Q")
ENTRY = struct.Struct("<4s6H3L5H2L")
LOCAL = struct.Struct("<4s5H3L2H")
STORED, DEFLATED = 0, 8
UTF8_FLAG, ENCRYPTED_FLAGS = 0x800, 0x2041  # encrypted, strongly encrypted, masked headers
U16, U32 = 0xFFFF, 0xFFFFFFFF
DIRECTORY_BYTES_PER_ENTRY = 400  # on average: the fixed part, a name and extra fields
RATIO_FLOOR = 1 << 20  # below this size a member may compress as well as it likes


@dataclass(frozen=True, slots=True)
class ArchiveLimits:
    """What an archive may hold at most; sizes are those of the unpacked members.

    A member is never read past the size that the directory states, and one that goes on is refused, so bounding the
    stated sizes bounds the bytes that are read.
    """

    entries: int = 100_000
    member_bytes: int = 64 << 30
    total_bytes: int = 128 << 30
    ratio: float = 200.0


@dataclass(frozen=True, slots=True)
class _Entry:
    name: str
    flags: int
    method: int
    crc: int
    stored: int
    size: int
    header: int
    mode: int
    is_folder: bool


def read_directory(source: ByteSource, label: str, limits: ArchiveLimits) -> dict[str, Extent]:
    """Return all files of the zip by name, without folders and operating systems' junk.

    Raises ArchiveError with every problem that was found in the directory.
    """
    start, size, count = _find_directory(source, label)
    if count > limits.entries:
        raise too_many_entries(label, limits)
    if size > DIRECTORY_BYTES_PER_ENTRY * limits.entries:
        raise too_many_entries(label, limits)
    problems = Findings()
    entries: list[_Entry] = []
    for entry in _entries(source, label, start, size):
        entries.append(entry)
        if len(entries) > limits.entries:
            raise too_many_entries(label, limits)
    _check_entries(entries, limits, problems)
    extents = _locate(source, start, entries, problems)
    raise_errors(problems)
    return extents


def too_many_entries(label: str, limits: ArchiveLimits) -> LimitError:
    """Return the error for an archive with more entries than allowed."""
    message = f"holds more than {limits.entries} entries"
    return LimitError(Finding("error", "too_many_entries", label, message, "leave out what is no part of the scan"))


def raise_errors(problems: Findings) -> None:
    """Raise what was collected as one error, of the kind of the first finding."""
    findings = problems.result()
    if findings:
        kind: type[ScanFormatError] = UnsafeArchiveError
        if findings[0].code in {"member_too_large", "archive_too_large", "compression_ratio"}:
            kind = LimitError
        elif findings[0].code == "damaged_member":
            kind = ArchiveError
        raise kind(*findings)


def _not_a_zip(label: str, what: str) -> ArchiveError:
    return ArchiveError(
        Finding("error", "not_a_zip", label, what, "make the zip again, or check that all of it was uploaded")
    )


def _exactly(source: ByteSource, label: str, length: int, offset: int) -> bytes:
    data = source.read(length, offset) if offset >= 0 else b""
    if len(data) != length:
        raise _not_a_zip(label, "is truncated or no zip: its directory points outside the file")
    return data


def _find_directory(source: ByteSource, label: str) -> tuple[int, int, int]:
    """Return the start, size in bytes and stated number of entries of the central directory."""
    end = source.size
    tail_start = max(0, end - END.size - U16)
    tail = source.read(end - tail_start, tail_start)
    at = tail.rfind(b"PK\x05\x06")
    if at < 0 or at + END.size > len(tail):
        head = source.read(4, 0)
        what = "is truncated: its end is missing" if head == b"PK\x03\x04" else "is not a zip"
        raise _not_a_zip(label, what)
    _, disk, _, _, count, size, start, comment = END.unpack_from(tail, at)
    if disk not in (0, U16) or at + END.size + comment > len(tail):
        raise _not_a_zip(label, "is truncated or split over several files")
    position = tail_start + at
    if U16 in (disk, count) or U32 in (size, start):
        locator = source.read(END64_LOCATOR.size, max(0, position - END64_LOCATOR.size))
        if locator[:4] == b"PK\x06\x07" and len(locator) == END64_LOCATOR.size:
            position = END64_LOCATOR.unpack(locator)[2]
            record = END64.unpack(_exactly(source, label, END64.size, min(position, end)))
            if record[0] != b"PK\x06\x06":
                raise _not_a_zip(label, "is damaged: its zip64 directory is missing")
            count, size, start = record[7], record[8], record[9]
    if start + size != position:
        raise _not_a_zip(label, "is truncated or damaged: its directory is not where its end says")
    return start, size, count


def _entries(source: ByteSource, label: str, start: int, size: int) -> Iterator[_Entry]:
    data = _exactly(source, label, size, start)
    at = 0
    while at < size:
        if at + ENTRY.size > size or data[at : at + 4] != b"PK\x01\x02":
            raise _not_a_zip(label, "is damaged: its directory holds something that is no entry")
        fields = ENTRY.unpack_from(data, at)
        flags, method, crc, stored, full = fields[3], fields[4], fields[7], fields[8], fields[9]
        name_length, extra_length, comment_length = fields[10], fields[11], fields[12]
        attributes, header = fields[15], fields[16]
        extra_at = at + ENTRY.size + name_length
        raw_name = data[at + ENTRY.size : extra_at]
        extra = data[extra_at : extra_at + extra_length]
        at = extra_at + extra_length + comment_length
        if at > size:
            raise _not_a_zip(label, "is damaged: its directory ends within an entry")
        name = _decode(raw_name, flags)
        if U32 in (full, stored, header):
            full, stored, header = _zip64(extra, full, stored, header, name)
        mode = attributes >> 16
        is_folder = name.endswith("/") or stat.S_IFMT(mode) == stat.S_IFDIR
        yield _Entry(name, flags, method, crc, stored, full, header, mode, is_folder)


def _decode(raw: bytes, flags: int) -> str:
    """Decode as UTF-8 where flagged; some tools write it without the flag, so it is tried before code page 437."""
    try:
        return raw.decode("utf-8")
    except UnicodeDecodeError:
        return raw.decode("utf-8", "backslashreplace") if flags & UTF8_FLAG else raw.decode("cp437")


def _zip64(extra: bytes, full: int, stored: int, header: int, name: str) -> tuple[int, int, int]:
    values = [full, stored, header]
    at = 0
    while at + 4 <= len(extra):
        kind, length = struct.unpack_from("<2H", extra, at)
        wanted = [index for index, value in enumerate(values) if value == U32]
        if kind == 1:
            if length < 8 * len(wanted) or at + 4 + length > len(extra):
                raise damaged(name, "its zip64 sizes are missing")
            for index, value in zip(wanted, struct.unpack_from(f"<{len(wanted)}Q", extra, at + 4), strict=True):
                values[index] = value
            break
        at += 4 + length
    return values[0], values[1], values[2]


def _check_entries(entries: list[_Entry], limits: ArchiveLimits, problems: Findings) -> None:
    seen: set[str] = set()
    total = 0
    for entry in entries:
        name, shown = entry.name, repr(entry.name)[1:-1][:200]
        reason = unsafe_reason(name)
        if reason:
            problems.error("unsafe_name", shown, reason, "use plain relative names")
        if stat.S_IFMT(entry.mode) not in (0, stat.S_IFREG, stat.S_IFDIR):
            problems.error("link_or_device", shown, "is a symbolic link or special file", "replace it by a plain file")
        if name in seen:
            problems.error("duplicate_name", shown, "the name occurs twice", "keep one of the two")
        seen.add(name)
        if entry.flags & ENCRYPTED_FLAGS:
            problems.error("encrypted", shown, "is encrypted", "make the zip without a password")
        if entry.method not in (STORED, DEFLATED):
            remedy = "make the zip with deflate or without compression"
            problems.error("compression_method", shown, f"uses compression method {entry.method}", remedy)
        if is_nested_archive(name) and not is_junk(name):
            problems.error("nested_archive", shown, "is an archive inside the archive", "unpack it, or leave it out")
        total += entry.size
        if entry.size > limits.member_bytes:
            message = f"unpacks to {entry.size} bytes; at most {limits.member_bytes} are accepted"
            problems.error("member_too_large", shown, message, "leave it out or split the scan")
        if entry.size > max(RATIO_FLOOR, limits.ratio * entry.stored):
            message = f"unpacks to more than {limits.ratio:g} times its stored size"
            problems.error("compression_ratio", shown, message, "store it without compression")
    if total > limits.total_bytes:
        message = f"unpacks to {total} bytes; at most {limits.total_bytes} are accepted"
        problems.error("archive_too_large", "", message, "split the scan")


def _locate(source: ByteSource, directory: int, entries: list[_Entry], problems: Findings) -> dict[str, Extent]:
    """Follow each entry to its bytes; they must lie between its own header and the next one."""
    extents: dict[str, Extent] = {}
    ordered = sorted(entries, key=lambda entry: entry.header)
    bounds = [*(entry.header for entry in ordered), directory][1:]
    for entry, bound in zip(ordered, bounds, strict=True):
        shown = repr(entry.name)[1:-1][:200]
        local = source.read(LOCAL.size, min(entry.header, directory))
        if len(local) != LOCAL.size or local[:4] != b"PK\x03\x04":
            problems.error("damaged_member", shown, "its local header is missing", "make the zip again")
            continue
        name_length, extra_length = LOCAL.unpack(local)[9:11]
        start = entry.header + LOCAL.size + name_length + extra_length
        if start + entry.stored > bound:
            problems.error("overlap", shown, "overlaps the next member", "make the zip again with a common tool")
        if entry.method == STORED and entry.stored != entry.size:
            problems.error("damaged_member", shown, "is stored, but its two sizes differ", "make the zip again")
        if not entry.is_folder and not is_junk(entry.name):
            extents[entry.name] = Extent(
                entry.name, start, entry.stored, entry.size, entry.crc, entry.method == DEFLATED
            )
    return extents

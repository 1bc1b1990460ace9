"""A scan's files, from a folder, a zip or a lone `.sens`, read as streams; nothing is ever unpacked to disk.

What lies elsewhere and can be read by ranges is opened by `open_remote` (`remote.py`).

    with open_scan("scan.zip") as archive:
        archive.names()                       # "color/0.jpg", ...: sorted, below the one top folder if there is one
        archive.read("color/0.jpg", 1 << 20)  # bytes, at most so many
        archive.read_range("scan.sens", 4096, 100)

Reading is safe from several threads at once: each read uses its own position. Open streams belong to one thread each.
"""

from __future__ import annotations

import io
import os
import stat
import zlib
from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, BinaryIO, Self, cast

from advtex_scan._inflate import Extent, MemberStream, RangeReader
from advtex_scan._names import MAX_NAME, common_folder, is_junk, is_nested_archive, unsafe_reason
from advtex_scan._source import ByteSource, FileSource
from advtex_scan._zip_directory import ArchiveLimits, raise_errors, read_directory, too_many_entries
from advtex_scan.errors import ArchiveError, Finding, Findings, LimitError
from advtex_scan.manifest import ByteRange, FileRef

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer

READ_LIMIT = 256 << 20  # bytes that `read` returns at most unless told otherwise
STREAM_MAGIC = b"\x04\0\0\0"  # ScanNet's `.sens`, version 4: told by its content, for servers rename what they store
STREAM_NAME = "scan.sens"


class ScanArchive(ABC):
    """Access to the files of one scan. A context manager; see the module for its use.

    All methods raise ArchiveError (or LimitError) when a file is missing, damaged or larger than asked for.
    """

    def __init__(self, path: Path, sizes: dict[str, int]) -> None:
        self.path = path
        self._prefix = common_folder(list(sizes))
        self._sizes = {name.removeprefix(self._prefix): sizes[name] for name in sorted(sizes)}

    def names(self) -> tuple[str, ...]:
        """Return the relative paths of all files, sorted, with `/` as separator."""
        return tuple(self._sizes)

    def __contains__(self, name: object) -> bool:
        return name in self._sizes

    def size(self, name: str) -> int:
        """Return the size of a file in bytes."""
        if name not in self._sizes:
            message = "is not in the scan" if name else "a file name is empty"
            raise ArchiveError(Finding("error", "missing_file", name, message, "add the file or correct the name"))
        return self._sizes[name]

    def stamps(self) -> list[tuple[str, int, int]]:
        """Return name, size and stamp of all files, sorted; a file that is changed later has another size or stamp.

        A stamp is the checksum of a zip's member or of a lone file, and the time of the last change, in nanoseconds, of
        a file in a folder.
        """
        return [(name, size, self._stamp(self._prefix + name)) for name, size in self._sizes.items()]

    def open(self, name: str) -> BinaryIO:
        """Return a buffered stream over a file from its first byte; the caller closes it."""
        self.size(name)
        return cast(BinaryIO, io.BufferedReader(self._stream(self._prefix + name), 1 << 16))

    def read(self, ref: FileRef, limit: int = READ_LIMIT) -> bytes:
        """Return a whole file or byte range. Raises LimitError if it is longer than `limit` bytes."""
        length = ref.length if isinstance(ref, ByteRange) else self.size(ref)
        name = ref.path if isinstance(ref, ByteRange) else ref
        if length > limit:
            message = f"is {length} bytes long; at most {limit} are accepted for a file of this kind"
            raise LimitError(Finding("error", "file_too_large", name, message, "make the file smaller"))
        if isinstance(ref, ByteRange):
            return self.read_range(name, ref.offset, length)
        with self.open(name) as stream:
            data = stream.read(length)
            if len(data) != length or stream.read(1):  # a zip member checks its sum at its end
                raise changed(name)
        return data

    def head(self, ref: FileRef, length: int) -> bytes:
        """Return the first `length` bytes of a file or byte range, fewer if it is shorter."""
        if isinstance(ref, ByteRange):
            return self.read_range(ref.path, ref.offset, min(length, ref.length))
        return self.read_range(ref, 0, min(length, self.size(ref)))

    def tail(self, ref: FileRef, length: int) -> bytes:
        """Return the last `length` bytes of a file or byte range, fewer if it is shorter."""
        if isinstance(ref, ByteRange):
            length = min(length, ref.length)
            return self.read_range(ref.path, ref.offset + ref.length - length, length)
        length = min(length, self.size(ref))
        return self.read_range(ref, self.size(ref) - length, length)

    def read_range(self, name: str, offset: int, length: int) -> bytes:
        """Return `length` bytes from `offset` of a file; reading ranges in rising order passes over the file once."""
        size = self.size(name)
        if offset < 0 or length < 0 or offset + length > size:
            message = f"is {size} bytes long, but bytes {offset} to {offset + length} are needed"
            raise ArchiveError(Finding("error", "truncated_file", name, message, "copy the file again in full"))
        return self._range(self._prefix + name, offset, length)

    @abstractmethod
    def close(self) -> None:
        """Release the files; reading from a zip afterwards raises ValueError."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @abstractmethod
    def _stamp(self, name: str) -> int: ...

    @abstractmethod
    def _stream(self, name: str) -> io.RawIOBase: ...

    @abstractmethod
    def _range(self, name: str, offset: int, length: int) -> bytes: ...


def open_scan(path: str | os.PathLike[str], limits: ArchiveLimits | None = None) -> ScanArchive:
    """Open a folder, a zip or a `.sens` file. Raises ArchiveError with every reason why it is refused."""
    location = Path(path)
    limits = limits or ArchiveLimits()
    if location.is_dir():
        return _FolderArchive(location, limits)
    if location.is_file():
        return lone_file(FileSource(location), location, limits)
    raise ArchiveError(
        Finding("error", "not_found", location.name, "is neither a folder nor a file", "give the path of a scan")
    )


def lone_file(source: ByteSource, path: Path, limits: ArchiveLimits) -> ScanArchive:
    """A scan that is one file, a zip or a `.sens`. path: names it in findings."""
    try:
        is_stream = source.read(len(STREAM_MAGIC), 0) == STREAM_MAGIC
        return _StreamArchive(source, path, limits) if is_stream else _ZipArchive(source, path, limits)
    except BaseException:
        source.close()
        raise


class _ZipArchive(ScanArchive):
    def __init__(self, source: ByteSource, path: Path, limits: ArchiveLimits) -> None:
        self._source = source
        self._extents: dict[str, Extent] = read_directory(source, path.name, limits)
        self._reader = RangeReader(self._source)
        super().__init__(path, {name: extent.size for name, extent in self._extents.items()})

    def close(self) -> None:
        self._source.close()

    def _stamp(self, name: str) -> int:
        return self._extents[name].crc

    def _stream(self, name: str) -> io.RawIOBase:
        return MemberStream(self._source, self._extents[name])

    def _range(self, name: str, offset: int, length: int) -> bytes:
        return self._reader.read(self._extents[name], offset, length)


class _StreamArchive(ScanArchive):
    """A scan that is one file, under STREAM_NAME."""

    def __init__(self, source: ByteSource, path: Path, limits: ArchiveLimits) -> None:
        self._source = source
        if source.size > limits.member_bytes:
            message = f"is larger than {limits.member_bytes} bytes"
            raise ArchiveError(Finding("error", "member_too_large", path.name, message, "split the scan"))
        super().__init__(path, {STREAM_NAME: source.size})

    def close(self) -> None:
        self._source.close()

    def _stamp(self, name: str) -> int:
        return checksum(self._stream(name))

    def _stream(self, name: str) -> io.RawIOBase:
        assert name == STREAM_NAME
        return SourceStream(self._source)

    def _range(self, name: str, offset: int, length: int) -> bytes:
        data = self._source.read(length, offset)
        if len(data) != length:
            raise changed(name)
        return data


class SourceStream(io.RawIOBase):
    """One pass over a file from its first byte."""

    def __init__(self, source: ByteSource) -> None:
        super().__init__()
        self._source = source
        self._position = 0

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: WriteableBuffer, /) -> int:
        view = memoryview(buffer).cast("B")
        data = self._source.read(len(view), self._position)
        view[: len(data)] = data
        self._position += len(data)
        return len(data)


class _FolderArchive(ScanArchive):
    def __init__(self, path: Path, limits: ArchiveLimits) -> None:
        self._root = path.resolve()
        problems = Findings()
        sizes: dict[str, int] = {}
        for name, size in _walk(self._root, path.name, limits, problems):
            sizes[name] = size
        check_total(path.name, sizes, limits, problems)
        raise_errors(problems)
        super().__init__(path, sizes)

    def close(self) -> None:
        """Do nothing: a folder holds nothing open."""

    def _stamp(self, name: str) -> int:
        try:
            return (self._root / name).stat().st_mtime_ns
        except OSError as error:
            raise _unreadable(name, error) from error

    def _stream(self, name: str) -> io.RawIOBase:
        return self._open(name)

    def _range(self, name: str, offset: int, length: int) -> bytes:
        with self._open(name) as stream:
            stream.seek(offset)
            data = stream.read(length)
        if len(data) != length:
            raise changed(name)
        return data

    def _open(self, name: str) -> io.FileIO:
        path = self._root / name
        try:
            if not path.resolve(strict=True).is_relative_to(self._root):
                raise ArchiveError(_leaves(name))
            return io.FileIO(path, "rb")
        except OSError as error:
            raise _unreadable(name, error) from error


def _unreadable(name: str, error: OSError) -> ArchiveError:
    message = f"cannot be read ({error.strerror})"
    return ArchiveError(Finding("error", "unreadable_file", name, message, "check its permissions"))


def changed(name: str) -> ArchiveError:
    """The error for a file that is no longer as long as it was."""
    message = "changed its length while it was read"
    return ArchiveError(Finding("error", "truncated_file", name, message, "wait until the scan is written"))


def _leaves(name: str) -> Finding:
    return Finding("error", "link_or_device", name, "is a link that leaves the scan", "copy the file into the folder")


def _walk(root: Path, label: str, limits: ArchiveLimits, problems: Findings) -> list[tuple[str, int]]:
    """Return names and sizes of all plain files below `root`; links are followed only to files inside it."""
    found: list[tuple[str, int]] = []
    for folder, subfolders, files in os.walk(root, onerror=_unreadable_folder):
        base = Path(folder)
        if len(base.relative_to(root).as_posix()) > MAX_NAME:
            shown = repr(base.relative_to(root).as_posix())[1:61] + "..."
            problems.error("unsafe_name", shown, "is nested too deeply", "use plain relative names")
            subfolders.clear()
            continue
        for entry in [*files, *(name for name in subfolders if (base / name).is_symlink())]:
            path = base / entry
            name = path.relative_to(root).as_posix()
            if is_junk(name):
                continue
            if len(found) >= limits.entries:
                raise too_many_entries(label, limits)
            found.append((name, _checked_size(root, path, name, limits, problems)))
    return found


def _unreadable_folder(error: OSError) -> None:
    finding = Finding(
        "error", "unreadable_file", Path(str(error.filename)).name, "cannot be listed", "check permissions"
    )
    raise ArchiveError(finding) from error


def _checked_size(root: Path, path: Path, name: str, limits: ArchiveLimits, problems: Findings) -> int:
    shown = check_name(name, problems)
    try:
        if path.is_symlink() and not path.resolve(strict=True).is_relative_to(root):
            problems.add(_leaves(shown))
            return 0
        status = path.stat()
    except (OSError, RuntimeError):
        problems.error("unreadable_file", shown, "is a broken link or cannot be read", "replace it by a plain file")
        return 0
    if not stat.S_ISREG(status.st_mode):
        problems.error("link_or_device", shown, "is a linked folder or special file", "replace it by plain files")
    check_size(shown, status.st_size, limits, problems)
    return status.st_size


def check_name(name: str, problems: Findings) -> str:
    """Of a folder's file. -> the name as findings show it"""
    shown = repr(name)[1:-1][:200]
    reason = unsafe_reason(name)
    if reason:
        problems.error("unsafe_name", shown, reason, "use plain relative names")
    if is_nested_archive(name):
        problems.error("nested_archive", shown, "is an archive inside the scan", "unpack it, or leave it out")
    return shown


def check_size(shown: str, size: int, limits: ArchiveLimits, problems: Findings) -> None:
    """Of a folder's file."""
    if size > limits.member_bytes:
        message = f"is larger than {limits.member_bytes} bytes"
        problems.error("member_too_large", shown, message, "leave it out or split the scan")


def check_total(label: str, sizes: Mapping[str, int], limits: ArchiveLimits, problems: Findings) -> None:
    """Of all files of a folder."""
    if sum(sizes.values()) > limits.total_bytes:
        problems.error("archive_too_large", label, f"holds more than {limits.total_bytes} bytes", "split the scan")


def checksum(stream: io.RawIOBase) -> int:
    """Of all bytes of a stream, which is closed."""
    total = 0
    with stream:
        while data := stream.read(1 << 20):
            total = zlib.crc32(data, total)
    return total

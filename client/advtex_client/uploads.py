"""A scan on its way to the server: packed, hashed and streamed, never held in memory."""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
import tempfile
import zipfile
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import anyio.to_thread
import httpx

from advtex_client.errors import ClientError

CHUNK = 1 << 20
PIECE = 64 << 20  # bytes per request: after it, the server has confirmed them, and no proxy has to hold more
_EPOCH = (1980, 1, 1, 0, 0, 0)  # the earliest date that a zip can hold

OnBytes = Callable[[int, int], None]
"""Called with the bytes done and their total."""


@dataclass(frozen=True)
class PackedScan:
    """A scan as one file: `path` holds `size` bytes whose digest is `sha256` (hex); `filename` is shown to users."""

    path: Path
    filename: str
    size: int
    sha256: str


@contextmanager
def packed(scan: Path) -> Iterator[PackedScan]:
    """Yield the file itself, or a folder packed into a temporary zip that is gone afterwards.

    Equal folders give equal bytes: members are sorted, stored, and carry no dates or permissions. Names that begin
    with a dot are left out. Raises ClientError when the scan cannot be read or the temporary disk is full.
    """
    with ExitStack() as stack:
        try:
            if scan.is_dir():
                folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="advtex-"))
                archive = Path(folder) / "scan.zip"
                _pack(scan, archive)
                result = _hashed(archive, f"{scan.resolve().name}.zip")
            else:
                result = _hashed(scan, scan.name)
        except OSError as error:
            raise ClientError(_unreadable(scan, error)) from error
        yield result


def _unreadable(scan: Path, error: OSError) -> str:
    problem = f"{error.filename or scan}: {error.strerror or error}"
    if error.errno == errno.ENOSPC:
        return (
            f"{problem}; {scan} is packed below {tempfile.gettempdir()}, which needs as much free space as the scan; "
            "set TMPDIR to a larger disk or give a zip"
        )
    return f"{problem}; give a scan's folder or file that can be read"


def scan_members(folder: Path) -> list[tuple[str, Path]]:
    """Return (name in the zip, file) for every file that belongs to the scan, sorted by name."""
    found = []
    for parent, folders, files in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".")]
        found += [Path(parent, name) for name in files if not name.startswith(".")]
    return sorted((path.relative_to(folder).as_posix(), path) for path in found)


def _pack(folder: Path, archive: Path) -> None:
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_STORED) as bundle:
        for name, path in scan_members(folder):
            entry = zipfile.ZipInfo(name, date_time=_EPOCH)
            entry.create_system = 3
            entry.external_attr = 0o100644 << 16
            entry.file_size = path.stat().st_size  # beyond 2 GiB the header needs to know
            with path.open("rb") as source, bundle.open(entry, "w") as target:
                shutil.copyfileobj(source, target, CHUNK)


def _hashed(path: Path, filename: str) -> PackedScan:
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        return PackedScan(path, filename, file.tell(), digest)


class FileStream(httpx.SyncByteStream, httpx.AsyncByteStream):
    """Bytes `start` up to, not including, `stop` of a file as a request body for both clients; it can be read again."""

    def __init__(self, scan: PackedScan, start: int = 0, on_bytes: OnBytes | None = None) -> None:
        self.start = start
        self.stop = min(scan.size, start + PIECE)
        self._scan = scan
        self._on_bytes = on_bytes

    def __iter__(self) -> Iterator[bytes]:
        done = self.start
        with self._scan.path.open("rb") as file:
            file.seek(done)
            while done < self.stop:
                chunk = file.read(min(CHUNK, self.stop - done))
                done += len(chunk)
                if not chunk or (done == self._scan.size and file.read(1)):
                    raise ClientError(
                        f"{self._scan.path} changed while it was being sent; submit it again when it is complete"
                    )
                yield chunk
                if self._on_bytes:
                    self._on_bytes(done, self._scan.size)

    async def __aiter__(self) -> AsyncIterator[bytes]:
        chunks = iter(self)
        while (chunk := await anyio.to_thread.run_sync(next, chunks, b"")) != b"":
            yield chunk

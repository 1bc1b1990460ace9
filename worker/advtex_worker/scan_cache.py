"""Scans that were downloaded, kept for later attempts on them. All workers of a machine may share the folder.

    {name}          a whole scan, which nobody changes; under a shared lock of everyone who uses it
    {name}.part     one on its way, under a lock of who downloads it; the others wait for that

Locks are the kernel's: a process that dies lets go, and what it had begun is begun anew. A name may change hands while
somebody waits for its lock, so everyone who gets one looks whether the name still means the same file.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

PART = ".part"
POLL_SECONDS = 0.1  # between looks whether another process has done the download
KEPT_SECONDS = 86400.0  # of no use; users delete their scans, and copies should not outlast that for long


def cache_name(upload_id: str) -> str:
    """What an upload's scan is called there."""
    return f"{upload_id}.zip"


class ScanCache:
    """limit_bytes: of what nobody uses; the scans in use come on top where they are more."""

    def __init__(self, folder: Path, limit_bytes: int) -> None:
        self._folder = folder
        self.limit_bytes = limit_bytes

    @contextmanager
    def held(self, name: str, fill: Callable[[IO[bytes]], None], check: Callable[[], None]) -> Iterator[Path]:
        """The scan's file, kept for as long as the block lasts.

        fill: writes the bytes, once on this machine; what it raises leaves nothing behind. check: called while another
        process does that, may raise to end the wait.
        """
        self._folder.mkdir(parents=True, exist_ok=True)
        path = self._folder / name
        while (file := _opened(path) or self._filled(path, fill)) is None:
            check()
            time.sleep(POLL_SECONDS)
        try:
            self.shrink(self.limit_bytes)
            yield path
        finally:
            file.close()
            self.shrink(self.limit_bytes)

    def has(self, name: str) -> bool:
        """Whether the scan is there now."""
        return (self._folder / name).exists()

    def free_bytes(self) -> int:
        """Room on its disk."""
        self._folder.mkdir(parents=True, exist_ok=True)
        return shutil.disk_usage(self._folder).free

    def shrink(self, limit_bytes: int) -> None:
        """Remove what was not used for the longest time and is not used now, until no more than the limit is left, and
        all that was not used for a day."""
        found = []
        for path in self._folder.glob("*"):
            with suppress(FileNotFoundError):
                stat = path.stat()
                found.append((stat.st_mtime, stat.st_size, path))
        total = sum(size for _, size, _ in found)
        for used, size, path in sorted(found):
            if total <= limit_bytes and used > time.time() - KEPT_SECONDS:
                return
            if _removed(path):
                total -= size

    def _filled(self, path: Path, fill: Callable[[IO[bytes]], None]) -> IO[bytes] | None:
        """The new scan; None while another process downloads it, or has just done so."""
        part = path.with_name(path.name + PART)
        file = part.open("ab")
        try:
            if not _locked(file, fcntl.LOCK_EX) or not _is_at(file, part):
                file.close()
                return None
            try:
                file.truncate(0)
                if not path.exists():
                    fill(file)
                    file.flush()
                    os.fsync(file.fileno())
                    part.rename(path)
                    path.chmod(0o444)
            finally:
                part.unlink(missing_ok=True)
            if _locked(file, fcntl.LOCK_SH) and _is_at(file, path):
                return file
        except BaseException:
            file.close()
            raise
        file.close()
        return None


def _opened(path: Path) -> IO[bytes] | None:
    """The scan under a shared lock, used just now; None if it is not there."""
    try:
        file = path.open("rb")
    except FileNotFoundError:
        return None
    if _locked(file, fcntl.LOCK_SH) and _is_at(file, path):
        os.utime(file.fileno())
        return file
    file.close()
    return None


def _removed(path: Path) -> bool:
    """Whether the file was removed, as nobody uses it."""
    try:
        with path.open("rb") as file:
            if not _locked(file, fcntl.LOCK_EX) or not _is_at(file, path):
                return False
            path.unlink()
    except FileNotFoundError:  # another process was faster
        return False
    return True


def _locked(file: IO[bytes], kind: int) -> bool:
    """Whether the lock could be had at once."""
    try:
        fcntl.flock(file, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _is_at(file: IO[bytes], path: Path) -> bool:
    """Whether the path still leads to the open file."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return False

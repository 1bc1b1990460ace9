"""Locks of devices, the same for every worker of this user on this machine. Nothing here imports torch."""

from __future__ import annotations

import fcntl
import os
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import IO


def lock_path(name: str) -> Path:
    """The lock file of a device."""
    return Path(tempfile.gettempdir()) / f"advtex-{os.getuid()}-{name}.lock"


def lock_paths(name: str, jobs: int) -> list[Path]:
    """Those of a device on which so many may run at a time."""
    return [lock_path(name if number == 0 else f"{name}-{number}") for number in range(jobs)]


def try_lock(path: Path) -> IO[bytes] | None:
    """The open lock file, None if another process holds it. Held until it is closed or the process ends."""
    file = path.open("ab")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.close()
        return None
    return file


def first_lock(paths: Iterable[Path]) -> IO[bytes] | None:
    """The first of the locks that is free, None if none is."""
    return next((lock for path in paths if (lock := try_lock(path)) is not None), None)

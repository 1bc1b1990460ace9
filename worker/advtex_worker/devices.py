"""The device of one attempt: a GPU belongs to one runner at a time."""

from __future__ import annotations

import fcntl
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO

import torch

POLL_SECONDS = 0.5


def lock_path(name: str) -> Path:
    """The lock file of a device, the same for every worker of this user on this machine."""
    return Path(tempfile.gettempdir()) / f"advtex-{os.getuid()}-{name}.lock"


def try_lock(path: Path) -> IO[bytes] | None:
    """The open lock file, None if another process holds it. Held until it is closed or the process ends."""
    file = path.open("ab")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.close()
        return None
    return file


def acquire(device: str, stop_requested: Callable[[], bool]) -> tuple[str, IO[bytes] | None] | None:
    """(device for torch, its lock) once one is free; None if a stop was requested first.

    `auto` is any free GPU, or the CPU where there is none. GPUs are told apart by UUID, since every process may see
    them under other numbers. The CPU is not locked, nor is a GPU that is not there: the engine says so.
    """
    if device == "cpu" or not torch.cuda.is_available():
        return "cpu" if device == "auto" else device, None
    wanted = range(torch.cuda.device_count()) if device == "auto" else [int(device.partition(":")[2] or 0)]
    paths = {f"cuda:{i}": lock_path(f"gpu-{torch.cuda.get_device_properties(i).uuid}") for i in wanted}
    while not stop_requested():
        for name, path in paths.items():
            lock = try_lock(path)
            if lock is not None:
                return name, lock
        time.sleep(POLL_SECONDS)
    return None

"""The device of one attempt: on a GPU there are never more runners than it may have."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import IO

import torch

from advtex_worker.locks import lock_paths, try_lock

POLL_SECONDS = 0.5


def acquire(device: str, stop_requested: Callable[[], bool], jobs: int = 1) -> tuple[str, IO[bytes] | None] | None:
    """(device for torch, its lock) once one is free; None if a stop was requested first.

    `auto` is any free GPU, or the CPU where there is none. jobs: how many may run on a GPU at a time; a GPU that has
    none comes before one that has. GPUs are told apart by UUID, since every process may see them under other numbers.
    The CPU is not locked, nor is a GPU that is not there: the engine says so.
    """
    if device == "cpu" or not torch.cuda.is_available():
        return "cpu" if device == "auto" else device, None
    wanted = range(torch.cuda.device_count()) if device == "auto" else [int(device.partition(":")[2] or 0)]
    of_gpu = {f"cuda:{i}": lock_paths(f"gpu-{torch.cuda.get_device_properties(i).uuid}", jobs) for i in wanted}
    while not stop_requested():
        for number in range(jobs):
            for name, paths in of_gpu.items():
                lock = try_lock(paths[number])
                if lock is not None:
                    return name, lock
        time.sleep(POLL_SECONDS)
    return None

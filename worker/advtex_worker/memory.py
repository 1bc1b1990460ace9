"""How much memory jobs may use on this worker, found without torch."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

CGROUP_LIMITS = (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"))
QUERY = ["nvidia-smi", "--query-gpu=memory.total", "--format=csv,noheader,nounits"]


def usable_memory(device: str) -> int:
    """Bytes: of the smallest GPU, since a job may run on any of them, or of the machine (or container) without one."""
    gpus = [] if device == "cpu" else _gpu_memory()
    return min(gpus) if gpus else _machine_memory()


def _gpu_memory() -> list[int]:
    try:
        told = subprocess.run(QUERY, capture_output=True, text=True, timeout=30, check=True).stdout
    except (OSError, subprocess.SubprocessError):  # no driver, so no GPU
        return []
    return [int(mebibytes) << 20 for mebibytes in told.split() if mebibytes.isdigit()]


def _machine_memory() -> int:
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    for path in CGROUP_LIMITS:
        try:
            memory = min(memory, int(path.read_text()))
        except (OSError, ValueError):  # there is no such limit, or it is "max"
            continue
    return memory

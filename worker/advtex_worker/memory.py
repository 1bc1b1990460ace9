"""Which GPUs and how many cores this worker may use, and how much memory jobs may use on it, found without torch."""

from __future__ import annotations

import os
import subprocess
from dataclasses import dataclass
from pathlib import Path

CGROUP_LIMITS = (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"))
CPU_SHARE = Path("/sys/fs/cgroup/cpu.max")
CPU_SHARE_V1 = (Path("/sys/fs/cgroup/cpu/cpu.cfs_quota_us"), Path("/sys/fs/cgroup/cpu/cpu.cfs_period_us"))
QUERY = ["nvidia-smi", "--query-gpu=uuid,memory.total", "--format=csv,noheader,nounits"]
VISIBLE = "CUDA_VISIBLE_DEVICES"


@dataclass(frozen=True)
class Gpu:
    """uuid: as nvidia-smi names it and CUDA_VISIBLE_DEVICES takes it."""

    uuid: str
    memory_bytes: int


def list_gpus() -> list[Gpu]:
    """The GPUs that this process may see, in the order of CUDA_VISIBLE_DEVICES or else of nvidia-smi.

    Numbers in that variable are taken for nvidia-smi's. Parts of a GPU (MIG) are not found.
    """
    try:
        told = subprocess.run(QUERY, capture_output=True, text=True, timeout=30, check=True).stdout
    except (OSError, subprocess.SubprocessError):  # no driver, so no GPU
        return []
    rows = [line.split(",") for line in told.splitlines()]
    there = [Gpu(row[0].strip(), int(row[1]) << 20) for row in rows if len(row) == 2 and row[1].strip().isdigit()]
    visible = os.environ.get(VISIBLE)
    if visible is None:
        return there
    found = []
    for name in filter(None, map(str.strip, visible.split(","))):
        matching = there[int(name) : int(name) + 1] if name.isdigit() else [g for g in there if g.uuid.startswith(name)]
        if not matching:  # CUDA takes those before the first that it does not know
            break
        found += matching[:1]
    return found


def usable_memory(device: str) -> int:
    """Bytes: of the smallest GPU, since a job may run on any of them, or of the machine (or container) without one."""
    gpus = [] if device == "cpu" else list_gpus()
    return min(gpu.memory_bytes for gpu in gpus) if gpus else _machine_memory()


def usable_cores() -> int:
    """Cores of this process, or fewer where its container may use a share of their time only.

    With a thread on each of 64 cores a container of four would stand still for most of every tenth of a second.
    """
    cores = len(os.sched_getaffinity(0))
    for files in ((CPU_SHARE,), CPU_SHARE_V1):
        try:
            quota, period = map(int, " ".join(file.read_text() for file in files).split())
        except (OSError, ValueError):  # there is no such limit, or it is "max"
            continue
        if quota > 0:  # -1 is none
            cores = min(cores, max(1, round(quota / period)))
    return cores


def _machine_memory() -> int:
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    for path in CGROUP_LIMITS:
        try:
            memory = min(memory, int(path.read_text()))
        except (OSError, ValueError):  # there is no such limit, or it is "max"
            continue
    return memory

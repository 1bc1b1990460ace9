"""What a device has left of its memory, and how much of it this process may take."""

from __future__ import annotations

import ctypes
import os
import sys
from contextlib import suppress
from pathlib import Path

import torch

CONTEXT = 500 << 20  # of CUDA and its libraries; no tensor, so not among those that torch's allocator counts


def resident_memory() -> int | None:
    """Bytes of this process's resident set; None where the system does not tell."""
    if sys.platform != "linux":
        return None
    return _field(Path("/proc/self/status").read_text(), "VmRSS:") * 1024


def give_back_unused() -> None:
    """Gives the host what the C library keeps although it was freed: it would count as this process's.

    Only glibc has a call for it; elsewhere nothing is done.
    """
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


def available_memory(device: torch.device, allowed: int | None = None) -> int:
    """Bytes that are still free for tensors on the device.

    allowed: what this process may take altogether of a GPU that others use too. Of a CPU it is what the machine can
    give without swapping, and no more than the container's limit leaves.
    """
    if device.type != "cuda":
        return _available_on_host()
    free, _ = torch.cuda.mem_get_info(device)
    taken = torch.cuda.memory_allocated(device)
    unused = torch.cuda.memory_reserved(device) - taken
    return free + unused if allowed is None else max(0, min(free + unused, allowed - CONTEXT - taken))


def limit_process(device: torch.device, allowed: int | None) -> None:
    """Lets torch refuse what goes beyond `allowed` bytes of a GPU: a job's shortage is its own and no neighbor's."""
    if device.type == "cuda" and allowed is not None:
        total = torch.cuda.get_device_properties(device).total_memory
        torch.cuda.set_per_process_memory_fraction(min(1.0, max(0, allowed - CONTEXT) / total), device)


def _available_on_host() -> int:
    found = [_meminfo("MemAvailable")]
    for limit, usage, statistics in _CGROUPS:
        try:
            reclaimable = _field(statistics.read_text(), "inactive_file ")
            found.append(int(limit.read_text()) - int(usage.read_text()) + reclaimable)
        except (OSError, ValueError):  # there is no such limit, or it is "max"
            continue
    return max(0, min(found))


_V2, _V1 = Path("/sys/fs/cgroup"), Path("/sys/fs/cgroup/memory")
_CGROUPS = (
    (_V2 / "memory.max", _V2 / "memory.current", _V2 / "memory.stat"),
    (_V1 / "memory.limit_in_bytes", _V1 / "memory.usage_in_bytes", _V1 / "memory.stat"),
)


def _meminfo(name: str) -> int:
    if sys.platform != "linux":
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2
    return _field(Path("/proc/meminfo").read_text(), f"{name}:") * 1024


def _field(text: str, name: str) -> int:
    return int(text.partition(name)[2].split()[0])

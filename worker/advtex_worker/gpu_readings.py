"""How much of a GPU is in use: by NVML where nvidia-ml-py is installed, else by nvidia-smi."""

from __future__ import annotations

import importlib
import subprocess
import threading
import time
from typing import Any

import structlog

from advtex_store.fleet import GpuReading

SECONDS = 10.0  # between readings; nvidia-smi may take seconds on a host with many GPUs
QUERY = "--query-gpu=memory.used,memory.total,utilization.gpu"

log = structlog.get_logger()


class GpuWatch:
    """Reads one GPU on a thread of its own, so that no announcement waits for a driver. `newest`: None before the first
    reading, and while the GPU cannot be read. uuid: as nvidia-smi names it; None for no GPU, which is not read."""

    def __init__(self, uuid: str | None) -> None:
        self.newest: GpuReading | None = None
        if uuid is not None:
            threading.Thread(target=self._work, args=(uuid,), name="gpu readings", daemon=True).start()

    def _work(self, uuid: str) -> None:
        told = False
        while True:
            self.newest = read_gpu(uuid)
            if self.newest is None and not told:
                log.warning("the GPU's memory and utilization cannot be read", gpu=uuid)
                told = True
            time.sleep(SECONDS)


def read_gpu(uuid: str) -> GpuReading | None:
    """What is in use now; None if neither way tells."""
    return _by_nvml(uuid) or _by_nvidia_smi(uuid)


def _by_nvml(uuid: str) -> GpuReading | None:
    try:
        nvml: Any = importlib.import_module("pynvml")
    except ImportError:
        return None
    try:
        nvml.nvmlInit()  # counts how often; it costs nothing again
        handle = nvml.nvmlDeviceGetHandleByUUID(uuid)
        memory = nvml.nvmlDeviceGetMemoryInfo(handle)
        used, total = int(memory.used), int(memory.total)
    except nvml.NVMLError:
        return None
    try:
        utilization = nvml.nvmlDeviceGetUtilizationRates(handle).gpu / 100
    except nvml.NVMLError:  # parts of a GPU have none
        utilization = None
    return GpuReading(uuid=uuid, memory_used_bytes=used, memory_bytes=total, utilization=utilization)


def _by_nvidia_smi(uuid: str) -> GpuReading | None:
    command = ["nvidia-smi", f"--id={uuid}", QUERY, "--format=csv,noheader,nounits"]
    try:
        told = subprocess.run(command, capture_output=True, text=True, timeout=30, check=True).stdout
        used, total, utilization = (word.strip() for word in told.strip().split(","))
        return GpuReading(
            uuid=uuid,
            memory_used_bytes=int(used) << 20,
            memory_bytes=int(total) << 20,
            utilization=int(utilization) / 100 if utilization.isdigit() else None,
        )
    except (OSError, subprocess.SubprocessError, ValueError):
        return None

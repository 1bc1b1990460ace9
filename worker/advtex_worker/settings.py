"""What a worker needs to know beyond the store's settings; also read from `ADVTEX_*` variables."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field

from advtex_store.settings import StoreSettings
from advtex_worker.memory import usable_cores

CACHE_BYTES = 20 << 30


class WorkerSettings(StoreSettings):
    """Settings of one worker.

    work_dir: scratch space of running attempts, `<data_dir>/work` by default.
    cache_dir: of downloaded scans, `<data_dir>/scans` by default; workers of one machine may share it.
    gpu: set for the processes that a worker starts for each of its GPUs; set by hand, this process takes one job at a
    time, on that GPU. GPUs in `device` have nvidia-smi's numbers.
    """

    device: str = Field(default="auto", pattern=r"^(auto|cpu|cuda(:\d+)?)$", description="where the engine computes")
    gpu: str | None = Field(default=None, description="UUID, as nvidia-smi names it, of the only GPU to use")
    jobs_per_gpu: int = Field(default=1, ge=1, le=64, description="at a time; they share its memory evenly")
    memory_bytes: int | None = Field(default=None, gt=0, description="what a job may use; the device's by default")
    work_dir: Path | None = None
    cache_dir: Path | None = None
    cache_bytes: int | None = Field(
        default=None, ge=0, description="of scans that are kept; by default 20 GiB, and none where blobs are a folder"
    )
    threads: int = Field(default_factory=usable_cores, ge=1, description="of the engine, at most")
    grace_seconds: float = Field(default=30.0, gt=0, description="a runner that was asked to stop is killed after this")
    refused_seconds: float = Field(
        default=600.0, ge=0, description="a job ends after the storage has refused it for so long: no right, no bucket"
    )
    heartbeat_seconds: float = Field(
        default=0.5, gt=0, description="between looks at the job's row, and news for those who watch"
    )
    log_level: str = Field(default="INFO", pattern=r"^(DEBUG|INFO|WARNING|ERROR)$")

    @property
    def workspaces(self) -> Path:
        """The folder that holds one folder per running attempt."""
        return self.work_dir or self.data_dir / "work"

    @property
    def scan_cache(self) -> Path:
        """The folder of scans that were downloaded."""
        return self.cache_dir or self.data_dir / "scans"

    @property
    def cached_bytes(self) -> int:
        """How much of them is kept. A folder is near enough."""
        if self.cache_bytes is not None:
            return self.cache_bytes
        return 0 if self.blobs.startswith("file:") else CACHE_BYTES

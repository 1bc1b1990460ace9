"""What is read of a GPU, by NVML or by nvidia-smi."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from live_service import wait_until

from advtex_store.fleet import GpuReading
from advtex_worker.gpu_readings import GpuWatch, read_gpu

MIB = 1 << 20


@pytest.fixture
def nvidia_smi(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A tool of the test's own, the first in the PATH; there is no NVML."""
    tool = tmp_path / "nvidia-smi"
    tool.write_text(
        '#!/bin/sh\ncase "$1" in --id=GPU-a) echo "812, 24576, 37";; --id=GPU-b) echo "5, 10, [N/A]";; esac\n'
    )
    tool.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    monkeypatch.setitem(sys.modules, "pynvml", None)
    return tool


def test_nvidia_smi_tells(nvidia_smi: Path) -> None:
    assert read_gpu("GPU-a") == GpuReading(
        uuid="GPU-a", memory_used_bytes=812 * MIB, memory_bytes=24576 * MIB, utilization=0.37
    )
    part = read_gpu("GPU-b")
    assert part is not None
    assert (part.memory_bytes, part.utilization) == (10 * MIB, None)
    assert read_gpu("GPU-gone") is None
    nvidia_smi.write_text("#!/bin/sh\nexit 9\n")
    assert read_gpu("GPU-a") is None


class NvmlStub:
    """NVML's own library is on machines with a driver only."""

    class NVMLError(Exception):
        pass

    def __init__(self, *, utilization: bool = True) -> None:
        self.nvmlInit = lambda: None
        self.utilization = utilization

    def nvmlDeviceGetHandleByUUID(self, uuid: str) -> str:
        if uuid != "GPU-n":
            raise self.NVMLError("not found")
        return uuid

    def nvmlDeviceGetMemoryInfo(self, handle: str) -> Any:
        return SimpleNamespace(used=3 * MIB, total=4 * MIB)

    def nvmlDeviceGetUtilizationRates(self, handle: str) -> Any:
        if not self.utilization:
            raise self.NVMLError("not supported")
        return SimpleNamespace(gpu=50)


def test_nvml_comes_first(nvidia_smi: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pynvml", NvmlStub())
    assert read_gpu("GPU-n") == GpuReading(
        uuid="GPU-n", memory_used_bytes=3 * MIB, memory_bytes=4 * MIB, utilization=0.5
    )
    assert read_gpu("GPU-a") is not None, "what NVML cannot tell, nvidia-smi may"
    monkeypatch.setitem(sys.modules, "pynvml", NvmlStub(utilization=False))
    found = read_gpu("GPU-n")
    assert found is not None
    assert found.utilization is None


def test_a_watch_reads_by_itself_and_follows(nvidia_smi: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("advtex_worker.gpu_readings.SECONDS", 0.01)
    assert GpuWatch(None).newest is None
    watch = GpuWatch("GPU-a")
    wait_until(lambda: watch.newest is not None)
    nvidia_smi.write_text("#!/bin/sh\nexit 9\n")
    wait_until(lambda: watch.newest is None)
    monkeypatch.setattr("advtex_worker.gpu_readings.SECONDS", 1e6)

"""How long each stage of a run took, and how much memory."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import torch

from advtex_engine.core.errors import Stopped
from advtex_engine.core.monitor import WarningKeeper
from advtex_engine.runtime.checkpoint import WorkFolder
from advtex_engine.runtime.threads import fit_threads

RESET_PEAK = "5"  # written to clear_refs, it sets VmHWM back to the present resident set: proc(5)


def reset_peak_memory(device: torch.device) -> None:
    """Lets both peaks begin anew; where the system forbids it (/proc is not writable), the host's goes on."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text(RESET_PEAK)
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)


def peak_memory_bytes() -> int:
    """The process's largest resident set since the last reset; since its start where there is no reset."""
    if sys.platform == "linux":
        status = Path("/proc/self/status").read_text()
        return int(status.partition("VmHWM:")[2].split()[0]) * 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def peak_device_memory_bytes(device: torch.device) -> int | None:
    """The most that tensors took on a GPU since the last reset; None on a CPU."""
    return torch.cuda.max_memory_allocated(device) if device.type == "cuda" else None


class Stages:
    """Times the stages and tells the monitor; `records` go into the report.

    A resumed run keeps the records and warnings of the stages whose result it takes over. A record's seconds are of all
    attempts together, as far as their results were kept; its peaks are of the last one, as is what the monitor hears.
    """

    def __init__(self, monitor: WarningKeeper, folder: WorkFolder, device: torch.device) -> None:
        self.monitor, self.folder, self.device = monitor, folder, device
        self.records: list[dict[str, Any]] = []
        saved = folder.load("stages", ("records", "warnings"))
        self._saved = {record["stage"]: record for record in saved["records"]} if saved else {}
        self._saved_warnings = saved["warnings"] if saved else []

    @contextmanager
    def run(self, stage: str) -> Iterator[None]:
        """Raises Stopped before the stage when a stop was asked for: what earlier stages made is in the work folder."""
        if self.monitor.stop_requested():
            raise Stopped(f"stopped before {stage}; resume goes on from there")
        fit_threads()
        self.monitor.stage_started(stage)
        reset_peak_memory(self.device)
        started = time.monotonic()
        yield
        seconds = time.monotonic() - started
        peak, on_device = peak_memory_bytes(), peak_device_memory_bytes(self.device)
        self.records.append(
            {
                "stage": stage,
                "seconds": round(self._earlier_seconds(stage) + seconds, 3),
                "peak_memory_bytes": peak,
                "peak_device_memory_bytes": on_device,
                "resumed": False,
            }
        )
        self.monitor.stage_finished(stage, seconds, peak, on_device)

    def _earlier_seconds(self, stage: str) -> float:
        """What earlier attempts spent on the stage; of the optimization, the checkpoint tells it."""
        if stage == "optimization":
            return self.folder.earlier_seconds
        return float(self._saved.get(stage, {}).get("seconds", 0.0))

    def restore(self, *stages: str) -> None:
        """Takes over the records of stages whose result was found in the work folder."""
        self.records += [{**self._saved[stage], "resumed": True} for stage in stages if stage in self._saved]
        told = self.monitor.warnings  # where a run begins again after it ran out of memory, some are
        told += [warning for warning in self._saved_warnings if warning["stage"] in stages and warning not in told]

    def save(self) -> None:
        self.folder.save("stages", {"records": self.records, "warnings": self.monitor.warnings})

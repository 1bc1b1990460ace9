"""What a run says about itself: stage times, held-out scores, report.json; and the scene's cache form."""

from __future__ import annotations

import importlib.metadata
import platform
import resource
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from advtex_engine.checkpoint import WorkFolder
from advtex_engine.errors import Problem, Stopped
from advtex_engine.evaluate import configured_lpips, score_views
from advtex_engine.files import json_text, write_atomically
from advtex_engine.monitor import Glimpse, Monitor
from advtex_engine.scene import Atlas, Camera, Mesh, Scene, View

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


class WarningKeeper(Monitor):
    """Passes everything on to the host's monitor and keeps the warnings, each with its stage."""

    def __init__(self, inner: Monitor) -> None:
        self.inner = inner
        self.warnings: list[dict[str, str]] = []
        self.stage = ""

    def stage_started(self, stage: str) -> None:
        self.stage = stage
        self.inner.stage_started(stage)

    def stage_finished(
        self, stage: str, seconds: float, peak_memory_bytes: int, peak_device_memory_bytes: int | None
    ) -> None:
        self.inner.stage_finished(stage, seconds, peak_memory_bytes, peak_device_memory_bytes)

    def progress(self, step: int, steps: int, losses: Mapping[str, float]) -> None:
        self.inner.progress(step, steps, losses)

    def glimpsed(self, glimpse: Glimpse) -> None:
        self.inner.glimpsed(glimpse)

    def warning(self, problem: Problem) -> None:
        self.warnings.append({"stage": self.stage, **asdict(problem)})
        self.inner.warning(problem)

    def note(self, message: str) -> None:
        self.inner.note(message)

    def checkpointed(self, files: tuple[Path, ...]) -> None:
        self.inner.checkpointed(files)

    def stop_requested(self) -> bool:
        return self.inner.stop_requested()


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


def versions() -> dict[str, str]:
    """Versions of what decides the result."""
    names = ("advtex", "torch", "numpy", "opencv-python-headless", "xatlas", "fast-simplification")
    found = {"python": platform.python_version()}
    for name in names:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


def describe_scene(scene: Scene) -> dict[str, Any]:
    """Counts and names of what was used."""
    camera = scene.views[0].camera
    return {
        "views": len(scene.views),
        "heldout": [view.name for view in scene.heldout],
        "width": camera.width,
        "height": camera.height,
        "depth": scene.views[0].depth is not None,
        "faces": scene.mesh.t_pos_idx.shape[0],
        "vertices": scene.mesh.v_pos.shape[0],
        "kind": scene.kind,
        "up_axis": scene.up_axis,
        "notes": list(scene.notes),
    }


def heldout_scores(scene: Scene, atlas: Atlas, texture: Tensor, mean: Tensor) -> dict[str, Any] | None:
    """Scores of the held-out views for the texture and for the projected mean; None when no view was held out.

    Those of `evaluate.score_views`; `missing` says why a metric has none.
    """
    if not scene.heldout:
        return None
    lpips, missing = configured_lpips()
    return {
        name: score_views(atlas, candidate, scene.heldout, lpips) | {"missing": missing}
        for name, candidate in (("texture", texture), ("mean", mean))
    }


def write_report(out: Path, report: Mapping[str, Any]) -> Path:
    path = out / "report.json"
    write_atomically(path, json_text(report, indent=1).encode() + b"\n")
    return path


def scene_to_dict(scene: Scene) -> dict[str, Any]:
    """The scene as tensors and plain values; `scene_from_dict` is its inverse."""
    return {
        "mesh": {key: value for key, value in vars(scene.mesh).items() if value is not None},
        "views": [_view_to_dict(view) for view in scene.views],
        "heldout": [_view_to_dict(view) for view in scene.heldout],
        "kind": scene.kind,
        "up_axis": scene.up_axis,
        "notes": list(scene.notes),
    }


def scene_from_dict(saved: Mapping[str, Any]) -> Scene:
    """Inverse of `scene_to_dict`."""
    return Scene(
        Mesh(**saved["mesh"]),
        tuple(_view_from_dict(view) for view in saved["views"]),
        tuple(_view_from_dict(view) for view in saved["heldout"]),
        saved["kind"],
        saved["up_axis"],
        tuple(saved["notes"]),
    )


def _view_to_dict(view: View) -> dict[str, Any]:
    camera = asdict(view.camera)
    return {"name": view.name, "camera": camera, "color": view.color, "depth": view.depth, "mask": view.mask}


def _view_from_dict(saved: Mapping[str, Any]) -> View:
    return View(saved["name"], Camera(**saved["camera"]), saved["color"], saved["depth"], saved["mask"])

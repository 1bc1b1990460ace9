"""What a run tells its host, and how the host stops it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from advtex_engine.core.errors import Problem

STAGES = (
    "ingest",
    "conventions",
    "fusion",
    "geometry",
    "refinement",
    "atlas",
    "view_maps",
    "initial_texture",
    "optimization",
    "dilation",
    "export",
    "previews",
)


@dataclass(frozen=True)
class Glimpse:
    """The texture as it is after `step`: small JPEGs of the model by file name, and the curves so far.

    titles: the view's name for each of the pictures. curves: as `previews/curves.py` gives them.
    """

    step: int
    pictures: Mapping[str, bytes]
    titles: Mapping[str, str]
    curves: Mapping[str, Any]


class Monitor:
    """Callbacks of a run, all on the run's thread; this base ignores everything and never stops.

    checkpointed: the files (stage caches, checkpoint) just written durably below the work folder; a copy of all
    files reported so far is enough to resume elsewhere.
    stop_requested: asked between steps and between stages; after True the run writes a checkpoint and raises Stopped.
    """

    def stage_started(self, stage: str) -> None:
        """`stage` is one of STAGES, in their order; fusion and refinement only come where they are needed."""

    def stage_finished(
        self, stage: str, seconds: float, peak_memory_bytes: int, peak_device_memory_bytes: int | None
    ) -> None:
        """Peaks of the stage: the process's resident set, and what tensors took on a GPU (None on a CPU)."""

    def progress(self, step: int, steps: int, losses: Mapping[str, float]) -> None:
        """Optimiser iterations done, their total, and the newest losses; a few times per second at most."""

    def glimpsed(self, glimpse: Glimpse) -> None:
        """The texture so far, every few seconds of the optimization."""

    def warning(self, problem: Problem) -> None:
        """Something a user should know that does not end the run."""

    def note(self, message: str) -> None:
        """Something that a user may like to know, and that nothing is wrong with."""

    def checkpointed(self, files: tuple[Path, ...]) -> None:
        """Files written since the last call."""

    def stop_requested(self) -> bool:
        return False


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

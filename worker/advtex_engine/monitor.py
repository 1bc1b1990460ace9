"""What a run tells its host, and how the host stops it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from advtex_engine.errors import Problem

STAGES = (
    "ingest",
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


class Monitor:
    """Callbacks of a run, all on the run's thread; this base ignores everything and never stops.

    checkpointed: the files (stage caches, checkpoint) just written durably below the work folder; a copy of all
    files reported so far is enough to resume elsewhere.
    stop_requested: asked between steps and between stages; after True the run writes a checkpoint and raises Stopped.
    """

    def stage_started(self, stage: str) -> None:
        """`stage` is one of STAGES."""

    def stage_finished(self, stage: str, seconds: float, peak_memory_bytes: int) -> None:
        """Host memory (peak resident set of the process so far)."""

    def progress(self, step: int, steps: int, losses: Mapping[str, float]) -> None:
        """Optimiser iterations done, their total, and the newest losses; a few times per second at most."""

    def warning(self, problem: Problem) -> None:
        """Something a user should know that does not end the run."""

    def checkpointed(self, files: tuple[Path, ...]) -> None:
        """Files written since the last call."""

    def stop_requested(self) -> bool:
        return False

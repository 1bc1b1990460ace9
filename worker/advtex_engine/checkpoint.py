"""Stage caches and checkpoints of one run, in its work folder.

Every file is written to a temporary name, fsynced and renamed: after a kill a file is whole or absent. Each carries the
run's fingerprint (scan and options); a file of another run is ignored.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO, cast

import torch

from advtex_engine.files import atomic_file
from advtex_engine.monitor import Monitor

CHECKPOINT = "checkpoint"
MAX_SHARE = 0.01  # of the run time goes into checkpoints; the promise is 2 %


class WorkFolder:
    """Named dictionaries of tensors and plain values below `path`, tied to `fingerprint`.

    save: atomic and durable, then reported to the monitor; OSError when the disk is full. load: None when absent,
    unreadable or of another run.
    seconds: spent in `save` so far.
    """

    def __init__(self, path: Path, fingerprint: str, monitor: Monitor) -> None:
        self.path, self.fingerprint, self.monitor = path, fingerprint, monitor
        self.seconds = 0.0
        path.mkdir(parents=True, exist_ok=True)

    def save(self, name: str, content: Mapping[str, Any]) -> None:
        started = time.monotonic()
        target = self.path / f"{name}.pt"
        with atomic_file(target) as file:
            watched = _Watched(file)
            try:
                torch.save({"fingerprint": self.fingerprint, **content}, cast(BinaryIO, watched))
            except RuntimeError as error:
                raise watched.error or error from None
        self.monitor.checkpointed((target,))
        self.seconds += time.monotonic() - started

    def load(self, name: str) -> dict[str, Any] | None:
        target = self.path / f"{name}.pt"
        if not target.exists():
            return None
        try:
            content: dict[str, Any] = torch.load(target, map_location="cpu", weights_only=True)
        except (OSError, RuntimeError, EOFError, ValueError):
            return None
        return content if content.get("fingerprint") == self.fingerprint else None

    def clear(self) -> None:
        """Removes what an earlier run left."""
        for file in self.path.glob("*.pt"):
            file.unlink()


class _Watched:
    """A file that keeps the error of a failed write: torch raises a RuntimeError of its own, which does not tell it."""

    def __init__(self, file: BinaryIO) -> None:
        self.file = file
        self.error: OSError | None = None

    def write(self, data: bytes) -> int:
        try:
            return self.file.write(data)
        except OSError as error:
            self.error = error
            raise

    def flush(self) -> None:
        self.file.flush()


class CheckpointTimer:
    """When the next checkpoint is due: every `seconds`, rarer when writing takes more than MAX_SHARE of the time."""

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self._due = time.monotonic() + seconds

    def due(self) -> bool:
        return time.monotonic() >= self._due

    def wrote(self, started: float) -> None:
        """Call after a write that began at `started` (time.monotonic)."""
        now = time.monotonic()
        self._due = now + max(self.seconds, (now - started) / MAX_SHARE)

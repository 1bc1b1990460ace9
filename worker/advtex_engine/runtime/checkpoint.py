"""Stage caches and checkpoints of one run, in its work folder.

Every file is written to a temporary name, fsynced and renamed: after a kill a file is whole or absent. Each carries the
run's fingerprint (scan, options, numbers of the presets and FORMAT); a file of another run or of another version of the
engine is ignored, as is one that is broken or of which a single byte is not what was written.
"""

from __future__ import annotations

import time
import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, BinaryIO, cast

import torch
from torch import Tensor

from advtex_engine.core.monitor import Monitor
from advtex_engine.runtime.files import atomic_file
from advtex_engine.runtime.shortage import memory_problem

FORMAT = 9
"""The version of what files hold, raised with every change (`tests/engine/stages/test_work_format.py` compares)."""
CHECKPOINT = "checkpoint"
MAX_SHARE = 0.01
"""A checkpoint is due while saving took less than this of the run's time. It costs about as much as all that was saved
before it at most, so that afterwards the share is within twice this: the promise of 2 %."""


class WorkFolder:
    """Named dictionaries of tensors and plain values below `path`, tied to `fingerprint`.

    save: atomic and durable, then reported to the monitor; OSError when the disk is full. load: None when absent, and,
    with a note to the monitor, when unreadable, of another run or without one of the names that are `needed`; tensors
    that are `mapped` lie in the file and take memory only while they are read.
    seconds: spent in `save` so far. earlier_seconds: what attempts before this one spent on the optimization, as far
    as the checkpoint that was loaded goes.
    """

    def __init__(self, path: Path, fingerprint: str, monitor: Monitor) -> None:
        self.path, self.fingerprint, self.monitor = path, fingerprint, monitor
        self.seconds = self.earlier_seconds = 0.0
        self._told = False
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

    def load(self, name: str, needed: Iterable[str] = (), *, mapped: bool = False) -> dict[str, Any] | None:
        target = self.path / f"{name}.pt"
        if not target.exists():
            return None
        try:
            if (record := damaged_record(target)) is not None:
                self._note(name, f"is damaged (its record {record})")
                return None
            content = torch.load(target, map_location="cpu", weights_only=True, mmap=mapped)
        except Exception as error:  # of nearly any kind, by what is broken
            if memory_problem(error) is not None:
                raise
            self._note(name, "cannot be read")
            return None
        if not isinstance(content, dict) or content.get("fingerprint") != self.fingerprint:
            self._note(name, "was made of another scan, with other options or by another version")
            return None
        if missing := set(needed) - set(content):
            self._note(name, f"lacks {', '.join(sorted(missing))}")
            return None
        return content

    def _note(self, name: str, reason: str) -> None:
        """One line for a run: what else it finds goes without saying."""
        if not self._told:
            self.monitor.note(f"{name}.pt in the work folder {reason}: what it held is made anew")
        self._told = True

    def clear(self) -> None:
        """Removes what an earlier run left."""
        for file in self.path.glob("*.pt"):
            file.unlink()


def damaged_record(path: Path) -> str | None:
    """The first record of a file of torch's whose bytes do not have the CRC-32 beside them; None if all are whole.

    torch writes it with each record, and does not look at it when it reads: a number of a tensor could be any other.
    Reads the file once, 0.6 to 0.9 GB/s on one core. BadZipFile where the file's structure is broken.
    """
    with zipfile.ZipFile(path) as records:
        return records.testzip()


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


def restore_generator(generator: torch.Generator, state: Tensor, step: int) -> None:
    """Goes on from a saved state. That of another kind of device, which has another size, says nothing here: the draws
    after `step` begin with a seed of their own."""
    if state.shape == generator.get_state().shape:
        generator.set_state(state)
    else:
        generator.manual_seed(generator.initial_seed() + step)


class Checkpoints:
    """The checkpoint of a run's optimization (or start): made when it begins, loaded, and then saved from time to time.

    The next one is due every `seconds`, and later while checkpoints have taken more than MAX_SHARE of the time.
    steps: of the whole run. A checkpoint of a run with another number is of no use to this one; that happens where the
    preset "auto" is decided anew, on another kind of device. name: of its file in the work folder.
    """

    def __init__(self, work: WorkFolder, seconds: float, steps: int, name: str = CHECKPOINT) -> None:
        self.work, self.seconds, self.steps, self.name = work, seconds, steps, name
        self._started = self._last = time.monotonic()
        self._saving = 0.0

    def load(self, *needed: str) -> dict[str, Any] | None:
        """What `save` was given, with these names at least, of the work folder's checkpoint; None without one."""
        saved = self.work.load(self.name, ("seconds", *needed))
        if saved is None or saved.get("steps", self.steps) != self.steps:
            return None
        self.work.earlier_seconds = saved["seconds"]
        return saved

    def due(self) -> bool:
        now = time.monotonic()
        in_share = self._saving <= MAX_SHARE * (now - self._started)
        return in_share and now >= self._last + self.seconds

    def save(self, content: Mapping[str, Any]) -> None:
        """Replaces the checkpoint; beside `content` it holds what all attempts have spent on the optimization."""
        before = time.monotonic()
        seconds = self.work.earlier_seconds + before - self._started
        self.work.save(self.name, {"seconds": seconds, "steps": self.steps, **content})
        self._last = time.monotonic()
        self._saving += self._last - before

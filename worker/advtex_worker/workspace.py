"""The folders of one attempt, and how what killed attempts left of theirs is removed."""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

PREFIX = "attempt-"  # of the names of workspaces; other folders beside them are nobody's business here


@dataclass(frozen=True)
class Workspace:
    """The folders of one attempt. `snapshots` lies beside `work`, so that hard links reach it."""

    root: Path

    @property
    def scan(self) -> Path:
        return self.root / "scan.zip"

    @property
    def work(self) -> Path:
        return self.root / "work"

    @property
    def snapshots(self) -> Path:
        return self.root / "snapshots"

    @property
    def out(self) -> Path:
        return self.root / "out"

    @property
    def log(self) -> Path:
        return self.root / "engine.log"

    @contextmanager
    def made(self) -> Iterator[None]:
        """Empty folders, gone at the end. OSError when `sweep` came in between: try again."""
        self.root.mkdir(parents=True, exist_ok=True)
        with self.held():
            try:
                for folder in (self.work, self.snapshots, self.out):
                    folder.mkdir()
                yield
            finally:
                shutil.rmtree(self.root, ignore_errors=True)

    @contextmanager
    def held(self) -> Iterator[None]:
        """Keep `sweep` away, until this process ends at the latest."""
        handle = os.open(self.root, os.O_RDONLY | os.O_DIRECTORY)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            yield
        finally:
            os.close(handle)

    def results(self) -> dict[str, Path]:
        """Everything in the out folder, by its name there."""
        files = (path for path in sorted(self.out.rglob("*")) if path.is_file())
        return {path.relative_to(self.out).as_posix(): path for path in files}


def workspace_of(workspaces: Path, job_id: str, attempt: int) -> Workspace:
    """Its place; nothing is made."""
    return Workspace(workspaces / f"{PREFIX}{job_id}-{attempt}")


def sweep(workspaces: Path) -> None:
    """Remove what killed attempts left behind."""
    for root in workspaces.glob(f"{PREFIX}*/"):
        with suppress(OSError), Workspace(root).held():  # BlockingIOError: it is in use
            shutil.rmtree(root, ignore_errors=True)

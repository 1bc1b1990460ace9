"""The work folder's files are whole, of this run, or ignored; checkpoints keep to their share of the time."""

from __future__ import annotations

import resource
import time
from pathlib import Path

import pytest
import torch

from advtex_engine.checkpoint import MAX_SHARE, CheckpointTimer, WorkFolder
from advtex_engine.monitor import Monitor


class Files(Monitor):
    def __init__(self) -> None:
        self.names: list[str] = []

    def checkpointed(self, files: tuple[Path, ...]) -> None:
        self.names += [file.name for file in files]


def test_what_is_saved_is_loaded_and_reported(tmp_path: Path) -> None:
    monitor = Files()
    folder = WorkFolder(tmp_path, "run", monitor)
    folder.save("stage", {"tensor": torch.arange(3), "name": "x", "list": [1, 2.5, None]})
    loaded = folder.load("stage")
    assert loaded is not None
    assert torch.equal(loaded["tensor"], torch.arange(3))
    assert (loaded["name"], loaded["list"]) == ("x", [1, 2.5, None])
    assert monitor.names == ["stage.pt"]
    assert folder.seconds > 0


def test_files_of_another_run_and_broken_files_are_ignored(tmp_path: Path) -> None:
    WorkFolder(tmp_path, "other", Monitor()).save("stage", {"a": 1})
    folder = WorkFolder(tmp_path, "run", Monitor())
    assert folder.load("stage") is None
    assert folder.load("absent") is None
    folder.save("stage", {"tensor": torch.zeros(1000)})
    whole = (tmp_path / "stage.pt").read_bytes()
    (tmp_path / "stage.pt").write_bytes(whole[: len(whole) // 2])
    assert folder.load("stage") is None
    (tmp_path / "stage.pt").write_bytes(b"")
    assert folder.load("stage") is None


def test_a_write_that_fails_leaves_the_file_before_it(tmp_path: Path) -> None:
    folder = WorkFolder(tmp_path, "run", Monitor())
    folder.save("stage", {"a": 1})
    with pytest.raises(AttributeError):
        folder.save("stage", {"a": lambda: None})
    loaded = folder.load("stage")
    assert loaded is not None
    assert loaded["a"] == 1
    assert [path.name for path in tmp_path.iterdir()] == ["stage.pt"]


@pytest.mark.parametrize("parts", [1, 3, 200])
def test_a_file_that_cannot_grow_is_an_os_error(tmp_path: Path, parts: int) -> None:
    """Who waits for room on a full disk must be able to tell it from a fault."""
    folder = WorkFolder(tmp_path, "run", Monitor())
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (500_000, limits[1]))
    try:
        with pytest.raises(OSError, match="too large"):
            folder.save("stage", {str(part): torch.zeros(300_000 // parts) for part in range(parts)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert list(tmp_path.iterdir()) == []


def test_clear_removes_what_an_earlier_run_left(tmp_path: Path) -> None:
    folder = WorkFolder(tmp_path, "run", Monitor())
    folder.save("stage", {})
    folder.clear()
    assert list(tmp_path.iterdir()) == []


def test_checkpoints_come_every_so_many_seconds_and_rarer_when_writing_is_slow(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 1000.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    timer = CheckpointTimer(30.0)
    assert not timer.due()
    now = 1030.0
    assert timer.due()
    now = 1030.1  # a tenth of a second to write: the interval stays
    timer.wrote(1030.0)
    now = 1060.0
    assert not timer.due()
    now = 1060.2
    assert timer.due()
    now = 1065.2  # five seconds to write
    timer.wrote(1060.2)
    now = 1065.2 + 5 / MAX_SHARE - 1
    assert not timer.due()
    now += 2
    assert timer.due()

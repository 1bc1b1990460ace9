"""The work folder's files are whole, of this run, or ignored; checkpoints keep to their share of the time."""

from __future__ import annotations

import resource
import tempfile
import time
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from advtex_engine.core.monitor import Monitor
from advtex_engine.runtime.checkpoint import MAX_SHARE, Checkpoints, WorkFolder, restore_generator

STEPS = 100


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


@pytest.mark.parametrize("mapped", [False, True])
def test_no_byte_of_a_file_changes_unnoticed(tmp_path: Path, mapped: bool) -> None:
    """Wherever it flips: what is loaded is what was saved, or nothing."""
    folder, numbers = WorkFolder(tmp_path, "run", Monitor()), torch.arange(256, dtype=torch.float32)
    folder.save("stage", {"tensor": numbers, "step": 7})
    path = tmp_path / "stage.pt"
    whole = path.read_bytes()
    first = whole.index(numbers.numpy().tobytes())
    places = [*range(first, first + 1024, 64), *range(0, len(whole), 23)]
    lost = 0
    for place in places:
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        loaded = folder.load("stage", mapped=mapped)
        if loaded is None:
            lost += 1
        else:
            assert torch.equal(loaded["tensor"], numbers), place
            assert loaded["step"] == 7, place
    assert lost >= 16, "the numbers' own"


def test_a_damaged_file_is_told_of(tmp_path: Path) -> None:
    class Notes(Monitor):
        told = ""

        def note(self, message: str) -> None:
            self.told = message

    folder = WorkFolder(tmp_path, "run", notes := Notes())
    folder.save("checkpoint", {"tensor": torch.ones(64)})
    path = tmp_path / "checkpoint.pt"
    path.write_bytes(path.read_bytes().replace(torch.ones(64).numpy().tobytes(), torch.zeros(64).numpy().tobytes()))
    assert folder.load("checkpoint") is None
    assert notes.told.startswith("checkpoint.pt in the work folder is damaged (its record ")


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


class Clock(Monitor):
    """Stands in for time.monotonic; whatever is saved takes `cost` seconds."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now, self.cost = 1000.0, 0.0
        monkeypatch.setattr(time, "monotonic", lambda: self.now)

    def checkpointed(self, files: tuple[Path, ...]) -> None:
        self.now += self.cost


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    return Clock(monkeypatch)


@pytest.fixture
def folder(clock: Clock, tmp_path: Path) -> WorkFolder:
    return WorkFolder(tmp_path, "run", clock)


def test_checkpoints_come_every_so_many_seconds(clock: Clock, folder: WorkFolder) -> None:
    checkpoints = Checkpoints(folder, 30.0, STEPS)
    clock.cost = 0.1
    for _ in range(3):
        clock.now += 29.9
        assert not checkpoints.due()
        clock.now += 0.1
        assert checkpoints.due()
        checkpoints.save({})


def test_checkpoints_that_take_long_come_rarer(clock: Clock, folder: WorkFolder) -> None:
    begun, checkpoints = clock.now, Checkpoints(folder, 30.0, STEPS)
    clock.now += 30
    assert checkpoints.due()
    clock.cost = 5.0
    checkpoints.save({})
    clock.now = begun + 5 / MAX_SHARE - 1
    assert not checkpoints.due()
    clock.now += 1
    assert checkpoints.due()
    checkpoints.save({})
    clock.now = begun + 10 / MAX_SHARE - 1
    assert not checkpoints.due()
    clock.now += 1
    assert checkpoints.due()


@settings(max_examples=60)
@given(st.floats(0.01, 30), st.floats(0.01, 3))
def test_all_checkpoints_but_the_last_keep_to_their_share(cost: float, step: float) -> None:
    with pytest.MonkeyPatch.context() as patch, tempfile.TemporaryDirectory() as path:
        clock = Clock(patch)
        folder = WorkFolder(Path(path), "run", clock)
        clock.cost = cost
        begun, checkpoints = clock.now, Checkpoints(folder, 1.0, STEPS)
        for number in range(4):
            clock.now = max(clock.now, begun + number * cost / MAX_SHARE - step)
            while not checkpoints.due():
                clock.now += step
            assert number * cost <= MAX_SHARE * (clock.now - begun) * (1 + 1e-9)
            checkpoints.save({})


def test_a_checkpoint_knows_what_all_attempts_have_spent(clock: Clock, folder: WorkFolder) -> None:
    checkpoints = Checkpoints(folder, 30.0, STEPS)
    clock.now += 40
    checkpoints.save({"step": 1})
    clock.now += 1000
    again = WorkFolder(folder.path, "run", clock)
    resumed = Checkpoints(again, 30.0, STEPS)
    loaded = resumed.load()
    assert loaded is not None
    assert loaded["step"] == 1
    assert again.earlier_seconds == 40
    clock.now += 2
    resumed.save({"step": 2})
    last = WorkFolder(folder.path, "run", clock)
    Checkpoints(last, 30.0, STEPS).load()
    assert last.earlier_seconds == 42


def test_a_checkpoint_of_a_run_of_other_length_is_ignored(folder: WorkFolder) -> None:
    Checkpoints(folder, 30.0, STEPS).save({"step": 1})
    assert Checkpoints(folder, 30.0, STEPS).load() is not None
    assert Checkpoints(folder, 30.0, STEPS + 1).load() is None


def test_draws_go_on_from_a_checkpoint_of_another_kind_of_device() -> None:
    """A GPU's generator has a state of 16 bytes, a CPU's of some thousand."""

    def draws(step: int) -> torch.Tensor:
        generator = torch.Generator().manual_seed(7)
        restore_generator(generator, torch.zeros(16, dtype=torch.uint8), step)
        return torch.rand(4, generator=generator)

    fresh = torch.rand(4, generator=torch.Generator().manual_seed(7))
    assert torch.equal(draws(30), draws(30))
    assert not torch.equal(draws(30), draws(31))
    assert not torch.equal(draws(30), fresh)

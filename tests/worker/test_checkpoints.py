"""Checkpoints in both blob storages: only whole ones are ever used."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from advtex_store import keys
from advtex_store.blobs import Blobs, Written
from advtex_store.errors import NoSpace
from advtex_worker.checkpoints import EMPTY, INDEX, CheckpointIndex, CheckpointUploader, restore

JOB = "0" * 28


@dataclass
class Uploads:
    """What becomes of them: they fail while `full`; `begins` is called before each."""

    full: bool = False
    begins: Callable[[str], None] = lambda _key: None


@pytest.fixture
def uploads(blobs: Blobs, monkeypatch: pytest.MonkeyPatch) -> Uploads:
    fate, upload = Uploads(), blobs.upload

    def flaky(path: Path, key: str) -> Written:
        fate.begins(key)
        if fate.full:
            raise NoSpace("the disk is full")
        return upload(path, key)

    monkeypatch.setattr(blobs, "upload", flaky)
    return fate


def snapshot(tmp_path: Path, text: str) -> Path:
    folder = tmp_path / "snapshots"
    folder.mkdir(exist_ok=True)
    path = folder / str(len(list(folder.iterdir())) + 1000 * hash(text))
    path.write_text(text)
    return path


def uploader(blobs: Blobs, attempt: int, base: CheckpointIndex = EMPTY, held: bool = True) -> CheckpointUploader:
    return CheckpointUploader(blobs, JOB, attempt, base, lambda: held)


def restored(blobs: Blobs, before: int, work: Path) -> dict[str, str]:
    index = restore(blobs, JOB, before, work)
    return {name: (work / name).read_text() for name in index.files}


def test_the_newest_version_of_every_file_comes_back(blobs: Blobs, tmp_path: Path) -> None:
    up = uploader(blobs, 1)
    up.add({"atlas.npz": snapshot(tmp_path, "atlas"), "deep/er/state.pt": snapshot(tmp_path, "step 1")})
    up.add({"deep/er/state.pt": snapshot(tmp_path, "step 2")})
    up.finish()
    assert restored(blobs, 2, tmp_path / "work") == {"atlas.npz": "atlas", "deep/er/state.pt": "step 2"}
    assert list((tmp_path / "snapshots").iterdir()) == [], "snapshots were left behind"


def test_bytes_of_checkpoints_are_told(blobs: Blobs, tmp_path: Path) -> None:
    sent = list[int]()
    up = CheckpointUploader(blobs, JOB, 1, EMPTY, lambda: True, moved=sent.append)
    up.add({"a": snapshot(tmp_path, "four"), "b": snapshot(tmp_path, "seven77")})
    up.finish()
    assert sorted(sent) == [4, 7]


def test_what_is_no_longer_part_of_the_checkpoint_is_removed(blobs: Blobs, tmp_path: Path) -> None:
    base = EMPTY
    for attempt, text in ((1, "one"), (1, "two"), (1, "three")):
        up = uploader(blobs, attempt, base)
        up.add({"state": snapshot(tmp_path, text)})
        up.finish()
        base = restore(blobs, JOB, 2, tmp_path / "work")
    assert len(list(blobs.list(keys.checkpoints_prefix(JOB)))) == 2  # the file and the index


def test_a_later_attempt_carries_unchanged_files_over(blobs: Blobs, tmp_path: Path) -> None:
    up = uploader(blobs, 1)
    up.add({"atlas": snapshot(tmp_path, "atlas"), "state": snapshot(tmp_path, "old")})
    up.finish()
    base = restore(blobs, JOB, 2, tmp_path / "work")
    up = uploader(blobs, 2, base)
    up.add({"state": snapshot(tmp_path, "new")})
    up.finish()
    assert restored(blobs, 3, tmp_path / "work") == {"atlas": "atlas", "state": "new"}
    assert restored(blobs, 2, tmp_path / "work") == {"atlas": "atlas", "state": "old"}


def test_a_checkpoint_without_its_index_is_not_there(blobs: Blobs, tmp_path: Path) -> None:
    up = uploader(blobs, 1)
    up.add({"state": snapshot(tmp_path, "whole")})
    up.finish()
    blobs.put(keys.checkpoint_prefix(JOB, 2) + "2/0", b"half")
    assert restored(blobs, 3, tmp_path / "work") == {"state": "whole"}


@pytest.mark.parametrize("harm", ["missing", "damaged", "index", "name"])
def test_a_broken_checkpoint_is_passed_over_for_an_older_one(blobs: Blobs, tmp_path: Path, harm: str) -> None:
    for attempt, text in ((1, "old"), (2, "new")):
        up = uploader(blobs, attempt)
        up.add({"state": snapshot(tmp_path, text), f"only in {attempt}": snapshot(tmp_path, "x")})
        up.finish()
    victim = next(file for file in restore(blobs, JOB, 3, tmp_path / "w").files.values() if file.size == 3)
    if harm == "missing":
        blobs.delete(victim.key)
    elif harm in ("index", "name"):
        place = keys.checkpoint_prefix(JOB, 2) + INDEX
        wrong = b"}" if harm == "index" else blobs.get(place).replace(b'"jobs/', b'"j//s/')
        blobs.put(place, wrong)
    else:
        blobs.put(victim.key, b"odd")
    assert restored(blobs, 3, tmp_path / "work") == {"state": "old", "only in 1": "x"}
    assert sorted(path.name for path in (tmp_path / "work").iterdir()) == ["only in 1", "state"]


def test_a_stale_attempt_leaves_the_index_alone(blobs: Blobs, tmp_path: Path) -> None:
    up = uploader(blobs, 1)
    up.add({"state": snapshot(tmp_path, "mine")})
    up.finish()
    stale = uploader(blobs, 1, restore(blobs, JOB, 2, tmp_path / "work"), held=False)
    stale.add({"state": snapshot(tmp_path, "too late")})
    stale.finish()
    assert restored(blobs, 2, tmp_path / "work") == {"state": "mine"}


def test_abandoning_in_the_middle_of_an_upload_commits_nothing(blobs: Blobs, uploads: Uploads, tmp_path: Path) -> None:
    uploading, go_on = threading.Event(), threading.Event()

    def pause(key: str) -> None:
        uploading.set()
        go_on.wait(5.0)

    uploads.begins = pause
    up = uploader(blobs, 1)
    up.add({"state": snapshot(tmp_path, "x")})
    assert uploading.wait(5.0)
    abandoning = threading.Thread(target=up.abandon)
    abandoning.start()
    while not up._abandoned:
        pass
    go_on.set()
    abandoning.join()
    assert restore(blobs, JOB, 2, tmp_path / "work") == EMPTY


def test_a_full_disk_delays_the_checkpoint_and_loses_nothing(
    blobs: Blobs, uploads: Uploads, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("advtex_worker.checkpoints.RETRY_SECONDS", 0.01)
    tried = threading.Event()
    uploads.begins = lambda _key: tried.set()
    uploads.full = True
    up = uploader(blobs, 1)
    up.add({"state": snapshot(tmp_path, "kept")})
    assert tried.wait(5.0)
    uploads.full = False
    up.finish()
    assert restored(blobs, 2, tmp_path / "work") == {"state": "kept"}

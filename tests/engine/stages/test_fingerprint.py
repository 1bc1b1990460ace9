"""When work that was kept may be used again: for the same scan, wherever it lies, and the same options."""

from __future__ import annotations

import os
import shutil
import zipfile
from dataclasses import replace
from pathlib import Path

import pytest

from advtex_engine.core.config import TextureConfig
from advtex_engine.core.errors import ScanError
from advtex_engine.stages import fingerprint

CONFIG = TextureConfig()
FILES = {"scan.json": b"{}", "color/0.png": b"abcd", "color/1.png": b"efgh"}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, data in FILES.items():
        path = tmp_path / "scan" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    return tmp_path / "scan"


def write_zip(path: Path, **changed: bytes) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in (FILES | changed).items():
            archive.writestr(name, data)
    return path


def test_what_is_kept_serves_other_files_of_the_same_texture(folder: Path) -> None:
    assert fingerprint(folder, replace(CONFIG, lossless=True)) == fingerprint(folder, CONFIG)
    assert fingerprint(folder, replace(CONFIG, unseen="remove")) == fingerprint(folder, CONFIG)
    for other in ({"box": "0,0,0,1,1,1"}, {"close_holes": 0.5}):
        assert fingerprint(folder, replace(CONFIG, **other)) != fingerprint(folder, CONFIG)
    assert fingerprint(folder, replace(CONFIG, seed=1)) != fingerprint(folder, CONFIG)


def test_an_edit_that_keeps_a_files_size_is_another_scan(folder: Path, tmp_path: Path) -> None:
    before = fingerprint(folder, CONFIG)
    assert fingerprint(folder, CONFIG) == before
    path = folder / "color/1.png"
    changed = path.stat().st_mtime_ns + 1000
    path.write_bytes(b"EFGH")
    os.utime(path, ns=(changed, changed))
    assert fingerprint(folder, CONFIG) != before
    one, other = write_zip(tmp_path / "one.zip"), write_zip(tmp_path / "other.zip", **{"color/1.png": b"EFGH"})
    assert one.stat().st_size == other.stat().st_size
    assert fingerprint(one, CONFIG) != fingerprint(other, CONFIG)


def test_files_that_change_places_are_another_scan(folder: Path) -> None:
    before = fingerprint(folder, CONFIG)
    (folder / "depth").mkdir()
    (folder / "color/1.png").rename(folder / "depth/1.png")
    assert fingerprint(folder, CONFIG) != before


def test_a_copy_is_the_same_scan(folder: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(folder, tmp_path / "elsewhere"))  # with the files' times
    assert fingerprint(copy, CONFIG) == fingerprint(folder, CONFIG)
    packed = write_zip(tmp_path / "one.zip")
    again = shutil.copyfile(packed, tmp_path / "scan.zip")
    os.utime(again, ns=(0, 0))
    assert fingerprint(again, CONFIG) == fingerprint(packed, CONFIG)


def test_options_count_if_they_change_the_result(folder: Path) -> None:
    before = fingerprint(folder, CONFIG)
    assert fingerprint(folder, replace(CONFIG, seed=CONFIG.seed + 1)) != before
    assert fingerprint(folder, replace(CONFIG, device="cpu", checkpoint_seconds=1.0)) == before


def test_what_cannot_be_opened_is_a_scan_error(tmp_path: Path) -> None:
    (tmp_path / "scan.zip").write_bytes(b"no zip")
    with pytest.raises(ScanError, match="not a zip"):
        fingerprint(tmp_path / "scan.zip", CONFIG)

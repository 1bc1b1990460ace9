"""Scans that are read by ranges: the same report as of the same scan here, and little of it fetched."""

from __future__ import annotations

import os
import random
import zipfile
from pathlib import Path

import pytest

from advtex_scan import ScanFormatError, check_scan, open_remote, open_scan

FORMATS = Path(os.environ.get("ADVTEX_DATA", Path(__file__).parents[2] / ".." / "shared" / "data")) / "formats"


class Elsewhere:
    """A scan of this machine as another one would see it, and what was fetched of it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.fetched: list[int] = []

    def files(self):
        if self.path.is_file():
            return self.path.stat().st_size
        found = (path for path in self.path.rglob("*") if path.is_file())
        return {path.relative_to(self.path).as_posix(): path.stat().st_size for path in found}

    def fetch(self, name: str, start: int, end: int) -> bytes:
        with (self.path / name if name else self.path).open("rb") as file:
            file.seek(start)
            data = file.read(end - start)
        self.fetched.append(len(data))
        return data

    def open(self):
        return open_remote(self.path.name, self.files(), self.fetch)


def same_report(path: Path) -> None:
    with Elsewhere(path).open() as archive:
        assert check_scan(archive).to_dict() == check_scan(path).to_dict()


@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_the_report_is_the_same(maker, method):
    maker.native()
    same_report(maker.folder())
    same_report(maker.zip(prefix="my scan/", method=method))


@pytest.mark.data
@pytest.mark.parametrize("name", ["scannet_export", "scannet_sens", "record3d", "tum_rgbd", "polycam_raw"])
def test_the_report_of_an_export_is_the_same(name):
    if not (FORMATS / name).is_dir():
        pytest.skip(f"the samples are not at {FORMATS}")
    same_report(FORMATS / name)
    for path in FORMATS.glob(f"{name}/*"):
        if path.suffix in (".zip", ".sens", ".r3d"):
            same_report(path)


def test_files_and_stamps_are_the_same(maker):
    maker.native()
    for path in (maker.zip(), maker.folder()):
        with Elsewhere(path).open() as there, open_scan(path) as here:
            assert there.names() == here.names()
            for name in here.names():
                assert there.read(name) == here.read(name)
                assert there.tail(name, 5) == here.tail(name, 5)
            sizes = [(name, size) for name, size, _ in here.stamps()]
            assert [(name, size) for name, size, _ in there.stamps()] == sizes


def test_the_same_is_refused(maker, tmp_path):
    (tmp_path / "bad.zip").write_bytes(b"PK\3\4 and no end")
    (tmp_path / "nested").mkdir()
    (tmp_path / "nested" / "more.zip").write_bytes(b"")
    for path in (tmp_path / "bad.zip", tmp_path / "nested"):
        findings = []
        for opened in (lambda path=path: open_scan(path), Elsewhere(path).open):
            with pytest.raises(ScanFormatError) as caught:
                opened()
            findings.append(caught.value.findings)
        assert findings[0] == findings[1]


def test_of_large_members_only_the_heads_are_fetched(tmp_path):
    members = 40
    with zipfile.ZipFile(tmp_path / "large.zip", "w", zipfile.ZIP_STORED) as archive:
        for number in range(members):
            archive.writestr(f"{number}.bin", random.Random(number).randbytes(2 << 20))
    there = Elsewhere(tmp_path / "large.zip")
    with there.open() as archive:
        for name in archive.names():
            archive.head(name, 1000)
    assert sum(there.fetched) < 0.2 * (tmp_path / "large.zip").stat().st_size
    assert len(there.fetched) < 2 * members


def test_many_small_members_are_fetched_together_and_once(tmp_path):
    members = 4000
    with zipfile.ZipFile(tmp_path / "small.zip", "w", zipfile.ZIP_STORED) as archive:
        for number in range(members):
            archive.writestr(f"{number:05}.bin", random.Random(number).randbytes(5000))
    there = Elsewhere(tmp_path / "small.zip")
    with there.open() as archive:
        for name in archive.names():
            assert archive.read(name) == random.Random(int(name[:5])).randbytes(5000)
    assert sum(there.fetched) < 1.2 * (tmp_path / "small.zip").stat().st_size
    assert len(there.fetched) < members / 100


def test_a_file_that_becomes_shorter_meanwhile_is_an_error(maker):
    maker.native()
    path = maker.zip()
    there = Elsewhere(path)
    with pytest.raises(ScanFormatError):
        open_remote(path.name, path.stat().st_size + 1_000_000, there.fetch)

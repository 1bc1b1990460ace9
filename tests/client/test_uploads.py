"""Scans on their way out: equal folders give equal bytes, and nothing is held in memory."""

from __future__ import annotations

import errno
import hashlib
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from tiny_scan import write_scan

from advtex_client import ClientError
from advtex_client.uploads import CHUNK, FileStream, packed
from advtex_scan.check import check_scan


def test_equal_folders_give_equal_archives_wherever_and_whenever(tmp_path: Path) -> None:
    one, two = write_scan(tmp_path / "one"), write_scan(tmp_path / "two")
    os.utime(two / "scan.json", (10**9, 10**9))
    (two / "mesh.ply").chmod(0o600)
    with packed(one) as first, packed(two) as second:
        assert first.sha256 == second.sha256
        assert first.filename == "one.zip"
    (two / "scan.json").write_text((two / "scan.json").read_text() + " ")
    with packed(two) as changed:
        assert changed.sha256 != first.sha256


def test_the_archive_holds_the_folder_stored_and_passes_the_check(scan: Path) -> None:
    (scan / ".git").mkdir()
    (scan / ".git" / "config").write_text("secret")
    (scan / ".DS_Store").write_text("x")
    with packed(scan) as archive:
        assert archive.size == archive.path.stat().st_size
        assert archive.sha256 == hashlib.sha256(archive.path.read_bytes()).hexdigest()
        with zipfile.ZipFile(archive.path) as bundle:
            names = bundle.namelist()
            assert names == sorted(names) == ["color/0.png", "color/1.png", "color/2.png", "mesh.ply", "scan.json"]
            assert {info.compress_type for info in bundle.infolist()} == {zipfile.ZIP_STORED}
            assert bundle.read("mesh.ply") == (scan / "mesh.ply").read_bytes()
        assert check_scan(archive.path).ok
    assert not archive.path.exists()


def test_a_file_that_changes_while_it_is_sent_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "scan.zip"
    path.write_bytes(b"a" * (2 * CHUNK))
    with packed(path) as archive:
        stream = iter(FileStream(archive))
        next(stream)
        path.write_bytes(b"a" * (CHUNK + 10))
        with pytest.raises(ClientError, match="changed while it was being sent"):
            list(stream)
        path.write_bytes(b"a" * (2 * CHUNK + 1))
        with pytest.raises(ClientError, match="changed while it was being sent"):
            list(FileStream(archive))


def test_a_stream_can_be_sent_again(scan: Path) -> None:
    with packed(scan) as archive:
        stream = FileStream(archive)
        assert b"".join(stream) == b"".join(stream) == archive.path.read_bytes()


def test_what_cannot_be_read_is_named(tmp_path: Path) -> None:
    with (
        pytest.raises(ClientError, match=r"nowhere\.zip: No such file.*give a scan's folder or file"),
        packed(tmp_path / "nowhere.zip"),
    ):
        pass


def test_a_full_temporary_disk_is_named_with_its_remedy(scan: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_arguments: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("advtex_client.uploads.shutil.copyfileobj", full)
    with pytest.raises(ClientError, match="set TMPDIR to a larger disk or give a zip"), packed(scan):
        pass


@pytest.mark.slow
def test_a_large_scan_is_packed_and_streamed_in_little_memory(tmp_path: Path) -> None:
    folder = tmp_path / "scan"
    folder.mkdir()
    with (folder / "large.bin").open("wb") as file:
        file.truncate(512 << 20)
    code = (
        "import sys; from pathlib import Path; from advtex_client.uploads import PIECE, FileStream, packed\n"
        "with packed(Path(sys.argv[1])) as scan:\n"
        "    pieces = (FileStream(scan, start) for start in range(0, scan.size, PIECE))\n"
        "    print(sum(len(chunk) for piece in pieces for chunk in piece))\n"
        # ru_maxrss would start at what this process held when it forked.
        "status = Path('/proc/self/status').read_text()\n"
        "print(status.split('VmHWM:')[1].split()[0])"
    )
    ran = subprocess.run([sys.executable, "-c", code, str(folder)], capture_output=True, text=True, check=True)
    sent, peak_kib = map(int, ran.stdout.split())
    assert sent > 512 << 20
    assert peak_kib < 150 << 10

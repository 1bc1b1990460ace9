"""Folders and zips: what is read, and what is refused."""

from __future__ import annotations

import io
import os
import random
import stat
import struct
import time
import zipfile
import zlib
from concurrent.futures import ThreadPoolExecutor

import pytest

from advtex_scan import (
    ArchiveError,
    ArchiveLimits,
    ByteRange,
    LimitError,
    ScanFormatError,
    UnsafeArchiveError,
    open_scan,
)
from advtex_scan._source import FileSource


def codes(error: ScanFormatError) -> set[str]:
    return {finding.code for finding in error.findings}


def write_zip(path, members, method=zipfile.ZIP_DEFLATED):
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, content in members:
            archive.writestr(name, content)
    return path


def refused(path, limits=None) -> ScanFormatError:
    with pytest.raises(ScanFormatError) as caught:
        open_scan(path, limits)
    assert all(finding.message and finding.remedy for finding in caught.value.findings)
    return caught.value


@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
@pytest.mark.parametrize("prefix", ["", "my scan/", "a/b/"])
def test_zip_and_folder_give_the_same_files(maker, method, prefix):
    maker.native()
    with open_scan(maker.folder()) as folder, open_scan(maker.zip(prefix=prefix, method=method)) as archive:
        assert folder.names() == archive.names() == tuple(sorted(maker.all_files()))
        for name, content in maker.all_files().items():
            assert folder.read(name) == archive.read(name) == content
            assert folder.size(name) == archive.size(name) == len(content)
            with archive.open(name) as stream:
                assert stream.read(7) + stream.read() == content


def test_junk_of_operating_systems_is_left_out(tmp_path):
    members = [("scan/a.txt", "1"), ("__MACOSX/scan/._a.txt", "x"), ("scan/.DS_Store", "x"), ("scan/b/", "")]
    with open_scan(write_zip(tmp_path / "s.zip", members)) as archive:
        assert archive.names() == ("a.txt",)


def test_reads_say_what_is_missing_or_too_long(maker):
    with open_scan(maker.native().zip()) as archive:
        for action in (lambda: archive.read("none"), lambda: archive.open("none"), lambda: archive.size("none")):
            with pytest.raises(ArchiveError, match="not in the scan"):
                action()
        with pytest.raises(LimitError, match="at most 10"):
            archive.read("mesh.ply", 10)
        with pytest.raises(ArchiveError, match="bytes long, but"):
            archive.read_range("mesh.ply", 10, 1 << 40)
    with pytest.raises(ValueError, match="closed"):
        archive.read("mesh.ply")


@pytest.mark.parametrize(
    "name",
    ["../up.txt", "a/../../up", "/etc/passwd", "C:/x", "a\\b", "a/./b", "a//b", "bell\x07", "tab\tbed", "x" * 1025],
)
def test_unsafe_names_are_refused(tmp_path, name):
    error = refused(write_zip(tmp_path / "s.zip", [("ok.txt", "1"), (name, "2")]))
    assert isinstance(error, UnsafeArchiveError)
    assert codes(error) == {"unsafe_name"}
    assert not any(not c.isprintable() for finding in error.findings for c in finding.where)


def test_nul_in_a_name_is_refused(tmp_path):
    path = write_zip(tmp_path / "s.zip", [("aXb.txt", "1")])
    path.write_bytes(path.read_bytes().replace(b"aXb.txt", b"a\0b.txt"))
    assert codes(refused(path)) == {"unsafe_name"}


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_every_problem_is_listed_at_once(tmp_path):
    link = zipfile.ZipInfo("link")
    link.create_system, link.external_attr = 3, (stat.S_IFLNK | 0o777) << 16
    members = [("a", "1"), ("a", "2"), ("../b", "3"), (link, "/etc/passwd"), ("in.zip", "4")]
    error = refused(write_zip(tmp_path / "s.zip", members))
    assert codes(error) == {"duplicate_name", "unsafe_name", "link_or_device", "nested_archive"}


def test_encrypted_and_unknown_compression_are_refused(tmp_path):
    path = write_zip(tmp_path / "lzma.zip", [("a", "1" * 100)], zipfile.ZIP_LZMA)
    assert codes(refused(path)) == {"compression_method"}
    path = write_zip(tmp_path / "s.zip", [("a", "1")])
    data = bytearray(path.read_bytes())
    data[data.index(b"PK\x01\x02") + 8] |= 1
    path.write_bytes(data)
    assert codes(refused(path)) == {"encrypted"}


def test_overlapping_members_are_refused(tmp_path):
    """Two directory entries that share one member's bytes: the core of a bomb without recursion."""
    path = write_zip(tmp_path / "s.zip", [("a", os.urandom(100)), ("b", os.urandom(100))])
    data = bytearray(path.read_bytes())
    second = data.index(b"PK\x01\x02", data.index(b"PK\x01\x02") + 1)
    data[second + 42 : second + 46] = struct.pack("<L", 0)
    path.write_bytes(data)
    assert "overlap" in codes(refused(path))


def test_ratio_bomb_is_refused_before_it_is_inflated(tmp_path):
    path = write_zip(tmp_path / "s.zip", [("zeros", bytes(50 << 20))])
    error = refused(path)
    assert isinstance(error, LimitError)
    assert codes(error) == {"compression_ratio"}


def lie_about_size(path, true_size, claimed):
    """Patch the size in the directory and the local header."""
    data = path.read_bytes().replace(struct.pack("<L", true_size), struct.pack("<L", claimed))
    path.write_bytes(data)


@pytest.mark.parametrize("claimed", [1000, 7_777_777])
def test_a_member_that_lies_about_its_size_is_caught_while_reading(tmp_path, claimed):
    size = 1_234_567
    path = write_zip(tmp_path / "s.zip", [("a.bin", random.Random(0).randbytes(size))])
    lie_about_size(path, size, claimed)
    with open_scan(path) as archive:
        with pytest.raises(ArchiveError, match="claims"):
            archive.read("a.bin")
        if claimed > size:
            with pytest.raises(ArchiveError, match="claims"):
                archive.read_range("a.bin", claimed - 10, 10)


def test_damaged_bytes_are_caught(tmp_path):
    content = random.Random(1).randbytes(5000)
    for method in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        path = write_zip(tmp_path / "s.zip", [("a", content)], method)
        data = bytearray(path.read_bytes())
        data[2000] ^= 0xFF
        path.write_bytes(data)
        with open_scan(path) as archive, pytest.raises(ArchiveError, match=r"checksum|inflate"):
            archive.read("a")


def test_limits(tmp_path):
    path = write_zip(tmp_path / "s.zip", [(f"{i}", os.urandom(1000)) for i in range(20)])
    assert codes(refused(path, ArchiveLimits(entries=19))) == {"too_many_entries"}
    assert codes(refused(path, ArchiveLimits(member_bytes=999))) == {"member_too_large"}
    assert codes(refused(path, ArchiveLimits(total_bytes=19_999))) == {"archive_too_large"}
    open_scan(path, ArchiveLimits(entries=20, member_bytes=1000, total_bytes=20_000)).close()
    folder = tmp_path / "folder"
    folder.mkdir()
    for i in range(20):
        (folder / f"{i}").write_bytes(bytes(1000))
    assert codes(refused(folder, ArchiveLimits(entries=19))) == {"too_many_entries"}
    assert codes(refused(folder, ArchiveLimits(total_bytes=19_999))) == {"archive_too_large"}


def million_entries(stated: int) -> bytes:
    entry = struct.pack("<4s6H3L5H2L", b"PK\x01\x02", 20, 20, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0) + b"a"
    directory = entry * 1_000_000
    start = struct.pack("<4sQ2H2L4Q", b"PK\x06\x06", 44, 45, 45, 0, 0, stated, stated, len(directory), 0)
    locator = struct.pack("<4sLQL", b"PK\x06\x07", 0, len(directory), 1)
    end = struct.pack("<4s4H2LH", b"PK\x05\x06", 0, 0, 0xFFFF, 0xFFFF, 0xFFFFFFFF, 0xFFFFFFFF, 0)
    return directory + start + locator + end


@pytest.mark.parametrize("stated", [1_000_000, 1])
def test_a_million_entries_are_refused_fast(tmp_path, stated):
    """Also when the end of the directory claims a single entry."""
    path = tmp_path / "s.zip"
    path.write_bytes(million_entries(stated))
    start = time.process_time()
    assert codes(refused(path)) == {"too_many_entries"}
    assert time.process_time() - start < 2


def test_what_is_no_zip_says_so(tmp_path):
    path = tmp_path / "s.zip"
    for content, message in [(b"", "not a zip"), (b"hello" * 1000, "not a zip")]:
        path.write_bytes(content)
        assert message in str(refused(path))
    assert "neither a folder nor a file" in str(refused(tmp_path / "absent.zip"))


def test_a_truncated_zip_says_so(tmp_path):
    whole = write_zip(tmp_path / "s.zip", [(f"{i}", os.urandom(500)) for i in range(5)]).read_bytes()
    for length in (100, 1000, len(whole) - 30, len(whole) - 1):
        path = tmp_path / "cut.zip"
        path.write_bytes(whole[:length])
        assert "truncated" in str(refused(path))


def test_folders_refuse_links_that_leave_them(tmp_path):
    folder = tmp_path / "scan"
    folder.mkdir()
    (folder / "a.txt").write_text("1")
    (folder / "inside.txt").symlink_to(folder / "a.txt")
    with open_scan(folder) as archive:
        assert archive.read("inside.txt") == b"1"
    (tmp_path / "secret").write_text("2")
    (folder / "out.txt").symlink_to(tmp_path / "secret")
    assert codes(refused(folder)) == {"link_or_device"}
    (folder / "out.txt").unlink()
    (folder / "loop").symlink_to(folder)
    assert codes(refused(folder)) == {"link_or_device"}
    (folder / "loop").unlink()
    os.mkfifo(folder / "pipe")
    assert codes(refused(folder)) == {"link_or_device"}


def test_folders_nested_without_end_are_refused(tmp_path):
    """Names that long are refused before the walk gets deep enough to exhaust the stack."""
    tmp_path.joinpath("scan", *["d" * 100] * 12).mkdir(parents=True)
    assert codes(refused(tmp_path / "scan")) == {"unsafe_name"}


@pytest.mark.parametrize("length", [3, 300])
def test_a_file_that_changes_its_length_is_an_error(tmp_path, length):
    (tmp_path / "a.txt").write_bytes(bytes(100))
    with open_scan(tmp_path) as archive:
        (tmp_path / "a.txt").write_bytes(bytes(length))
        with pytest.raises(ArchiveError, match="changed its length"):
            archive.read("a.txt")
    with open_scan(tmp_path) as archive:
        assert archive.read("a.txt") == bytes(length)


def test_a_file_replaced_by_a_link_after_opening_is_not_followed(tmp_path):
    folder = tmp_path / "scan"
    folder.mkdir()
    (folder / "a.txt").write_text("1")
    (tmp_path / "secret").write_text("2")
    with open_scan(folder) as archive:
        (folder / "a.txt").unlink()
        (folder / "a.txt").symlink_to(tmp_path / "secret")
        with pytest.raises(ArchiveError, match="leaves the scan"):
            archive.read("a.txt")


@pytest.fixture(scope="module")
def long_member(tmp_path_factory):
    """40 MB that deflate can shorten a little, stored and deflated."""
    base = random.Random(2).randbytes(1 << 20)
    content = b"".join(base[i:] + base[:i] for i in range(40))
    folder = tmp_path_factory.mktemp("long")
    paths = {}
    for label, method in (("stored", zipfile.ZIP_STORED), ("deflated", zipfile.ZIP_DEFLATED)):
        with zipfile.ZipFile(folder / f"{label}.zip", "w", method, compresslevel=1) as archive:
            archive.writestr("long.bin", content)
        paths[label] = folder / f"{label}.zip"
    return content, paths


def counted_reads(monkeypatch) -> list[int]:
    """Lengths of all reads from files from now on."""
    lengths = []
    read = FileSource.read

    def counted(self, length, offset):
        lengths.append(length)
        return read(self, length, offset)

    monkeypatch.setattr(FileSource, "read", counted)
    return lengths


@pytest.mark.parametrize("label", ["stored", "deflated"])
def test_ranges_in_order_pass_over_the_member_once(long_member, label, monkeypatch):
    content, paths = long_member
    with open_scan(paths[label]) as archive:
        read = counted_reads(monkeypatch)
        step = 100_000
        for offset in range(0, len(content) - step, step):
            ref = ByteRange("long.bin", offset + 10, step // 2, "jpeg")
            assert archive.read(ref) == content[offset + 10 : offset + 10 + step // 2]
    assert sum(read) < 1.1 * len(content)


@pytest.mark.parametrize("label", ["stored", "deflated"])
def test_a_jump_back_inflates_one_checkpoint_at_most(long_member, label, monkeypatch):
    content, paths = long_member
    with open_scan(paths[label]) as archive:
        archive.read_range("long.bin", len(content) - 10, 10)
        read = counted_reads(monkeypatch)
        assert archive.read_range("long.bin", 39 << 20, 5) == content[39 << 20 : (39 << 20) + 5]
        assert sum(read) < 17 << 20


@pytest.mark.parametrize("label", ["stored", "deflated"])
def test_threads_read_the_same_bytes(long_member, label):
    content, paths = long_member
    rng = random.Random(3)
    offsets = [rng.randrange(0, len(content) - 1000) for _ in range(24)]
    with open_scan(paths[label]) as archive, ThreadPoolExecutor(8) as pool:
        pieces = pool.map(lambda at: archive.read_range("long.bin", at, 1000), offsets)
        assert all(piece == content[at : at + 1000] for at, piece in zip(offsets, pieces, strict=True))


def test_zip64_members_are_read(tmp_path):
    path = tmp_path / "s.zip"
    with zipfile.ZipFile(path, "w") as archive, archive.open("a.bin", "w", force_zip64=True) as member:
        member.write(b"hello")
    with open_scan(path) as archive:
        assert archive.read("a.bin") == b"hello"


def test_zips_written_as_streams_are_read(tmp_path):
    """Sizes then stand behind the data, and only the directory knows them."""

    class Pipe(io.BytesIO):
        def seekable(self):
            return False

        def tell(self):
            raise OSError

        def seek(self, *_):
            raise OSError

    pipe = Pipe()
    with zipfile.ZipFile(pipe, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.txt", "hello" * 10)
    (tmp_path / "s.zip").write_bytes(pipe.getvalue())
    with open_scan(tmp_path / "s.zip") as archive:
        assert archive.read("a.txt") == b"hello" * 10


def test_a_stream_that_goes_on_past_its_claim_gives_no_more_bytes(tmp_path):
    """The counted bytes, not the claimed ones, decide: nothing beyond the claim is ever inflated."""
    path = write_zip(tmp_path / "s.zip", [("a.bin", bytes(100_000))])
    lie_about_size(path, 100_000, 50)
    data = path.read_bytes().replace(
        struct.pack("<L", zlib.crc32(bytes(100_000))), struct.pack("<L", zlib.crc32(bytes(50)))
    )
    path.write_bytes(data)
    with open_scan(path) as archive:
        stream = archive.open("a.bin")
        assert stream.read(50) == bytes(50)
        with pytest.raises(ArchiveError, match="more than the 50 bytes"):
            stream.read(1)
        stream.close()

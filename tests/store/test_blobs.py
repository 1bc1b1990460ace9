"""Both storages: a local folder, and an S3 server that runs in the test's process."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from advtex_store.blobs import CHUNK, Blobs, FolderBlobs, check_key
from advtex_store.bucket import Bucket
from advtex_store.errors import BlobNotFound, BlobsRefused, BlobsUnavailable, NoSpace
from advtex_store.partials import Unpublished
from advtex_store.places import open_blobs

BIG = os.urandom(1 << 20) * 20  # more than one part of a multipart upload


def test_put_and_get(blobs: Blobs) -> None:
    written = blobs.put("scans/a/scan.zip", b"abc")
    assert (written.size, written.sha256) == (3, hashlib.sha256(b"abc").hexdigest())
    assert blobs.get("scans/a/scan.zip") == b"abc"
    info = blobs.head("scans/a/scan.zip")
    assert (info.key, info.size) == ("scans/a/scan.zip", 3)
    blobs.put("scans/a/scan.zip", b"defg")
    assert blobs.get("scans/a/scan.zip") == b"defg"
    assert blobs.head("scans/a/scan.zip").etag != info.etag
    assert list(blobs.spool_dir.iterdir()) == []


def test_large_blobs_pass_in_pieces(blobs: Blobs, tmp_path: Path) -> None:
    source = tmp_path / "source"
    source.write_bytes(BIG)
    written = blobs.upload(source, "jobs/a/big")
    assert (written.size, written.sha256) == (len(BIG), hashlib.sha256(BIG).hexdigest())
    chunks = list(blobs.stream("jobs/a/big"))
    assert b"".join(chunks) == BIG
    assert max(map(len, chunks)) <= 8 * CHUNK
    target = tmp_path / "deep" / "target"
    assert blobs.fetch("jobs/a/big", target) == written
    assert target.read_bytes() == BIG
    assert [path.name for path in target.parent.iterdir()] == ["target"]


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(start=st.integers(0, 120), length=st.none() | st.integers(0, 120))
def test_ranges_are_slices(blobs: Blobs, start: int, length: int | None) -> None:
    data = bytes(range(100))
    if not blobs.exists("a/ranges"):
        blobs.put("a/ranges", data)
    end = None if length is None else start + length
    assert b"".join(blobs.stream("a/ranges", start, end)) == data[start:end]


def test_missing_blobs(blobs: Blobs, tmp_path: Path) -> None:
    blobs.put("a/b/c", b"x")
    for key in ("a/none", "a/b", "a/b/c/d"):
        assert not blobs.exists(key)
        for read in (blobs.get, blobs.head, blobs.stream):
            with pytest.raises(BlobNotFound):
                read(key)
        with pytest.raises(BlobNotFound):
            blobs.fetch(key, tmp_path / "target")
        blobs.delete(key)
    assert not list(tmp_path.glob("target*"))
    assert blobs.exists("a/b/c")


def test_list_and_delete_prefix(blobs: Blobs) -> None:
    for key in ("jobs/a/checkpoints/10/x", "jobs/a/checkpoints/2/x", "jobs/a/result.json", "jobs/ab/x"):
        blobs.put(key, key.encode())
    assert [info.key for info in blobs.list("jobs/a/")] == [
        "jobs/a/checkpoints/10/x",
        "jobs/a/checkpoints/2/x",
        "jobs/a/result.json",
    ]
    assert [info.size for info in blobs.list("jobs/ab/")] == [len("jobs/ab/x")]
    assert list(blobs.list("none/")) == []
    blobs.delete_prefix("jobs/a/")
    blobs.delete_prefix("jobs/a/")
    assert list(blobs.list("jobs/a/")) == []
    assert blobs.get("jobs/ab/x") == b"jobs/ab/x"
    with pytest.raises(ValueError, match="ends in"):
        list(blobs.list("jobs/a"))


def test_only_one_of_many_creates(blobs: Blobs) -> None:
    barrier = threading.Barrier(6)
    won: list[bytes] = []

    def create(data: bytes) -> None:
        barrier.wait()
        if blobs.put_if_absent("jobs/a/result.json", data):
            won.append(data)

    threads = [threading.Thread(target=create, args=(bytes([n]) * 10,)) for n in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(won) == 1
    assert blobs.get("jobs/a/result.json") == won[0]
    assert not blobs.put_if_absent("jobs/a/result.json", b"later")
    assert list(blobs.spool_dir.glob("*")) == []


def test_a_small_blob_that_is_being_replaced_is_read_whole(blobs: Blobs) -> None:
    versions = [b"a" * 10, b"b" * 1000]
    blobs.put("jobs/a/index.json", versions[0])
    done = threading.Event()

    def replace() -> None:
        for number in range(60):
            blobs.put("jobs/a/index.json", versions[number % 2])
        done.set()

    writer = threading.Thread(target=replace)
    writer.start()
    read = []
    while not done.is_set():
        read.append(blobs.get("jobs/a/index.json"))
    writer.join()
    assert set(read) == set(versions)


def test_nothing_appears_without_commit(blobs: Blobs) -> None:
    with blobs.create("a/half") as writer:
        writer.write(b"x" * (3 * CHUNK))

    def broken_source() -> Iterator[bytes]:
        yield b"x" * CHUNK
        raise RuntimeError

    with pytest.raises(RuntimeError):
        blobs.put("a/half", broken_source())
    assert not blobs.exists("a/half")
    assert list(blobs.spool_dir.iterdir()) == []


@pytest.mark.parametrize(
    "key", ["", "/a", "a/", "a//b", "../a", "a/../b", "a/.hidden", ".spool/x", "a b", "ä", "a\0", "a\n", "a" * 901]
)
def test_no_key_leaves_the_storage(blobs: Blobs, key: str) -> None:
    with pytest.raises(ValueError, match="no blob key"):
        check_key(key)
    for use in (blobs.create, blobs.get, blobs.head, blobs.delete):
        with pytest.raises(ValueError, match="no blob key"):
            use(key)


def test_a_multipart_upload_that_is_not_under_way_is_aborted_again(blobs: Blobs, s3_url: str) -> None:
    blobs.abort(Unpublished("scans/a/scan.zip", "none", superseded=True))
    bucket = Bucket(s3_url.split("/")[2], os.urandom(6).hex())
    upload_id = bucket.begin("scans/a/scan.zip")
    for _ in range(2):  # two servers sweep, or an upload's piece has been dropped before
        bucket.abort("scans/a/scan.zip", upload_id)
    assert list(bucket.begun("scans")) == []


def test_check(blobs: Blobs) -> None:
    blobs.check()
    assert blobs.free_bytes() > 0


def test_an_unreachable_storage_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, s3_url: str) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(BlobsUnavailable, match="cannot be written"):
        FolderBlobs(tmp_path / "file").check()
    with pytest.raises(BlobsUnavailable, match="no bucket"):
        open_blobs("s3://no-such-bucket/x", tmp_path / "spool").put("a", b"x")
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:1")
    with pytest.raises(BlobsUnavailable, match="does not answer"):
        open_blobs("s3://bucket/x", tmp_path / "spool").check()


def test_an_answer_that_breaks_off_is_asked_for_again(s3_url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    from botocore.exceptions import ReadTimeoutError
    from botocore.response import StreamingBody

    bucket = Bucket(*s3_url.removeprefix("s3://").split("/", 1))
    bucket.put("a", b"0123456789")
    read, breaks = StreamingBody.read, 2

    def broken(self: StreamingBody) -> bytes:
        nonlocal breaks
        breaks -= 1
        if breaks >= 0:
            raise ReadTimeoutError(endpoint_url="")
        return bytes(read(self))

    monkeypatch.setattr(StreamingBody, "read", broken)
    assert bucket.get("a", 2, 5) == b"234"
    breaks = 100
    with pytest.raises(BlobsUnavailable, match="broke off"):
        bucket.get("a")


def test_what_an_object_storage_refuses_is_told_apart(s3_url: str) -> None:
    bucket = Bucket(*s3_url.removeprefix("s3://").split("/", 1))
    bucket.put("a/folder/", b"")
    bucket.put("a/b", b"x")
    assert [found.name for found in bucket.objects("a")] == ["a/b"], "tools make empty objects for folders"
    missing = Bucket("no-such-bucket", "x")
    for refused in (lambda: missing.put("a", b""), lambda: missing.get("a"), lambda: missing.objects("a")):
        with pytest.raises(BlobsRefused, match="no bucket"):
            refused()
    for gone in (lambda: bucket.get("c"), lambda: bucket.head("c"), lambda: bucket.parts("a/b", "no-such-id")):
        with pytest.raises(BlobNotFound):
            gone()
    upload_id = bucket.begin("d")
    etag = bucket.put_part("d", upload_id, 1, b"one")
    bucket.put_part("d", upload_id, 1, b"two")
    with pytest.raises(BlobsUnavailable, match="InvalidPart"):
        bucket.complete("d", upload_id, [etag])


def test_leftovers_are_cleared_by_age(blobs: Blobs) -> None:
    writer = blobs.create("a/b")
    writer.write(b"x")
    blobs.clear_spool(time.time() - 60)
    assert len(list(blobs.spool_dir.iterdir())) == 1
    blobs.clear_spool(time.time() + 60)
    assert list(blobs.spool_dir.iterdir()) == []
    writer.abort()


def test_bytes_are_synced_before_they_get_their_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The order of system calls is what durability is made of: file, rename, then every folder that changed."""
    calls: list[str] = []
    sync, replace = os.fsync, Path.replace
    monkeypatch.setattr(
        os,
        "fsync",
        lambda handle: (calls.append(f"sync {Path(f'/proc/self/fd/{handle}').readlink()}"), sync(handle))[1],
    )
    monkeypatch.setattr(Path, "replace", lambda a, b: (calls.append(f"rename to {b}"), replace(a, b))[1])
    blobs = FolderBlobs(tmp_path / "root")
    blobs.put("a/b/c", b"x")
    root = tmp_path / "root"
    assert calls[0].startswith(f"sync {root}/.spool/")
    renamed = calls.index(f"rename to {root}/a/b/c")
    assert calls[renamed + 1] == f"sync {root}/a/b"
    assert {f"sync {root}", f"sync {root}/a"} <= set(calls[:renamed])


def test_writing_and_deleting_in_one_folder(tmp_path: Path) -> None:
    """Who deletes removes empty folders; who writes at that moment must not notice."""
    blobs = FolderBlobs(tmp_path / "root")
    errors: list[Exception] = []

    def work(number: int) -> None:
        try:
            for _ in range(150):
                blobs.put(f"a/b/{number}", b"x")
                blobs.delete(f"a/b/{number}")
        except Exception as error:
            errors.append(error)

    threads = [threading.Thread(target=work, args=(n,)) for n in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []


def test_a_folder_that_comes_and_goes_while_it_is_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another writer makes the folder after the first look, and whoever deletes takes it away before the second."""
    blobs = FolderBlobs(tmp_path / "root")
    mkdir, raced = os.mkdir, []

    def race(path: str | Path, mode: int = 0o777) -> None:
        if Path(path).name == "b" and not raced:
            raced.append(path)
            raise FileExistsError(path)
        mkdir(path, mode)

    monkeypatch.setattr(os, "mkdir", race)
    assert blobs.put_if_absent("a/b/c", b"x")
    assert raced
    assert blobs.get("a/b/c") == b"x"


FILL = """
import resource, signal, sys
from pathlib import Path
from advtex_store.blobs import FolderBlobs
from advtex_store.errors import NoSpace
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (3_000_000, 3_000_000))
blobs = FolderBlobs(Path(sys.argv[1]))
try:
    blobs.put("a/big", (b"x" * 1_000_000 for _ in range(10)))
except NoSpace as error:
    print("no space:", error)
print(list(blobs.spool_dir.iterdir()), blobs.exists("a/big"), blobs.put("a/small", b"x" * 1000).size)
"""


def test_a_full_disk_keeps_nothing_and_does_not_hurt(tmp_path: Path) -> None:
    """A limit on file sizes stands in for a full disk: the write system call fails in the middle."""
    result = subprocess.run([sys.executable, "-c", FILL, str(tmp_path)], capture_output=True, text=True, check=True)
    assert result.stdout.startswith("no space: the disk is full")
    assert result.stdout.splitlines()[1] == "[] False 1000"


@pytest.mark.skipif(os.geteuid() != 0, reason="mounting a small file system needs root")
def test_a_really_full_disk(tmp_path: Path) -> None:
    mount = tmp_path / "small"
    mount.mkdir()
    done = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", str(mount)], capture_output=True, text=True
    )
    if done.returncode != 0:
        pytest.skip(f"mounting is not allowed here: {done.stderr}")
    try:
        blobs = FolderBlobs(mount / "blobs")
        with pytest.raises(NoSpace):
            blobs.put("a/big", (b"x" * 1_000_000 for _ in range(10)))
        assert list(blobs.spool_dir.iterdir()) == []
        assert blobs.free_bytes() > 1_500_000
        assert blobs.put("a/small", b"x" * 1000).size == 1000
    finally:
        subprocess.run(["umount", str(mount)], check=True)


def test_other_urls_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="ADVTEX_BLOB_URL"):
        open_blobs("http://host/x", tmp_path)

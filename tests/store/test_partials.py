"""Blobs that arrive in pieces: whatever happens between two pieces, the blob is what was sent."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from advtex_store import keys
from advtex_store.blobs import Blobs, FolderBlobs
from advtex_store.bucket import Bucket
from advtex_store.errors import BlobNotFound, BlobsUnavailable, NoSpace, Superseded
from advtex_store.partials import Hold, Partial
from advtex_store.places import open_blobs
from advtex_store.s3 import S3Blobs

PART = 1000
KEY = "scans/a/scan.zip"


@pytest.fixture(autouse=True)
def _small_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    import moto.s3.models

    monkeypatch.setattr("advtex_store.s3_partial.PART", PART)
    monkeypatch.setattr(moto.s3.models, "S3_UPLOAD_PART_MIN_SIZE", PART)


class Row:
    """What the database says of the upload, and the requests that hold it one after the other."""

    def __init__(self, blobs: Blobs, size: int) -> None:
        self.blobs, self.size = blobs, size
        self.offset = 0
        self.holder = 0
        self.kept_by: str | None = None

    def resume(self) -> Partial:
        self.holder += 1
        holder = str(self.holder)

        def check() -> None:
            if holder != str(self.holder):
                raise Superseded

        return self.blobs.resume(KEY, self.size, self.offset, Hold(holder, self.kept_by, check))

    def keep(self, partial: Partial) -> None:
        """What came to the newest holder is durable, and the row is told."""
        if partial.offset != self.offset:
            partial.flush()
            self.offset, self.kept_by = partial.offset, str(self.holder)
            partial.settle()


def everything(blobs: Blobs) -> list[str]:
    return [info.key for info in blobs.list("scans/")]


actions = st.lists(
    st.tuples(st.integers(1, 2500), st.sampled_from(["go on", "flush", "crash", "wrong bytes, crash"])), max_size=12
)


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.binary(min_size=1, max_size=64), size=st.integers(1, 4 * PART), plan=actions)
def test_what_was_flushed_survives_and_the_blob_is_what_was_sent(
    blobs: Blobs, data: bytes, size: int, plan: list[tuple[int, str]]
) -> None:
    blobs.drop_partial(KEY)
    blobs.delete(KEY)
    content = (data * (size // len(data) + 1))[:size]
    row = Row(blobs, size)
    partial = row.resume()
    for length, action in plan:
        piece = content[partial.offset : partial.offset + length]
        if action == "wrong bytes, crash":
            piece = bytes(255 - b for b in piece)
        partial.write(piece)
        if action == "flush":
            row.keep(partial)
        elif action.endswith("crash"):
            partial.close()
            partial = row.resume()
    partial.write(content[partial.offset :])
    row.keep(partial)
    partial.publish()
    partial.close()
    assert blobs.get(KEY) == content
    assert everything(blobs) == [KEY]
    for offset in (size, 0):  # as after a crash just before the row knew the digest; 0: of an earlier version
        row.offset = offset
        with row.resume() as again:
            assert again.offset == size
            again.publish()
    assert blobs.get(KEY) == content


def test_a_holder_that_was_overtaken_spoils_nothing(blobs: Blobs) -> None:
    """Its line went dead in another server process, which gives it up and keeps what it has much later."""
    content, other = os.urandom(3 * PART + 10), os.urandom(3 * PART + 10)
    row = Row(blobs, len(content))
    overtaken = row.resume()
    overtaken.write(content[:1300])
    row.keep(overtaken)
    newest = row.resume()
    assert newest.offset == 1300
    with pytest.raises(Superseded):
        overtaken.write(other[1300:2300])  # more than a part
    newest.write(content[1300:2500])
    row.keep(newest)
    with pytest.raises(Superseded):
        overtaken.write(other[2300:])
    newest.write(content[2500:])
    row.keep(newest)
    newest.publish()
    newest.close()
    overtaken.close()
    assert blobs.get(KEY) == content
    assert everything(blobs) == [KEY]


def test_whoever_comes_publishes_what_is_decided(blobs: Blobs) -> None:
    content = os.urandom(2 * PART + 10)
    row = Row(blobs, len(content))
    one = row.resume()
    one.write(content)
    row.keep(one)
    two, three = row.resume(), row.resume()
    assert (two.offset, three.offset) == (len(content),) * 2
    for partial in (three, one, two):
        partial.publish()
        partial.close()
    assert blobs.get(KEY) == content
    assert everything(blobs) == [KEY]


def test_pieces_that_are_not_held_any_more_are_noticed(blobs: Blobs) -> None:
    row = Row(blobs, 5000)
    row.offset = 10
    with pytest.raises(BlobNotFound):
        row.resume()
    row.offset = 0
    with row.resume() as partial:
        partial.write(b"x" * 1500)
        row.keep(partial)
    blobs.drop_partial(KEY)
    assert everything(blobs) == []
    with pytest.raises(BlobNotFound):
        row.resume()


def test_full_parts_go_to_s3_at_once_and_old_tails_are_removed(s3_url: str, tmp_path: Path) -> None:
    blobs = open_blobs(s3_url, tmp_path)
    row = Row(blobs, 10 * PART)
    for _ in range(3):
        with row.resume() as partial:
            for _ in range(3):
                partial.write(b"x" * (PART - 100))
                row.keep(partial)
                tail = f"{KEY}.tail-{partial.offset}-{row.holder}"
                assert [key for key in everything(blobs) if ".tail-" in key] == [tail]
    assert list(tmp_path.glob("*.part")) == [], "nothing passes through the local disk"


def test_a_file_that_lost_its_end_is_noticed(tmp_path: Path) -> None:
    blobs = FolderBlobs(tmp_path)
    row = Row(blobs, 5000)
    with row.resume() as partial:
        partial.write(b"x" * 1500)
        row.keep(partial)
    os.truncate(tmp_path / (KEY + ".partial"), 1499)
    with pytest.raises(BlobNotFound, match="not held any more"):
        row.resume()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_says_so(tmp_path: Path) -> None:
    blobs = FolderBlobs(tmp_path)
    (tmp_path / "scans" / "a").mkdir(parents=True)
    (tmp_path / (KEY + ".partial")).symlink_to("/dev/full")
    with Row(blobs, 5000).resume() as partial, pytest.raises(NoSpace):
        partial.write(b"x" * 1500)


def test_the_names_lie_where_a_purge_finds_them(blobs: Blobs) -> None:
    key = keys.scan_key("0a")
    with blobs.resume(key, 5000, 0, Hold("h", None, lambda: None)) as partial:
        partial.write(b"x" * 1500)
        partial.flush()
    assert everything(blobs)
    assert all(name.startswith(keys.scan_prefix("0a")) for name in everything(blobs))


# A folder: locked around every write


def test_a_write_that_has_begun_is_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The older holder has looked at the row, and has not written yet, when the newer one comes."""
    row = Row(FolderBlobs(tmp_path), 10)
    older = row.resume()
    pwrite, writing, go_on, newest = os.pwrite, threading.Event(), threading.Event(), []

    def slow(file: int, data: bytes, offset: int) -> int:
        if threading.current_thread() is thread:
            writing.set()
            go_on.wait()
        return pwrite(file, data, offset)

    monkeypatch.setattr(os, "pwrite", slow)
    thread = threading.Thread(target=older.write, args=(b"older",))
    thread.start()
    writing.wait()
    taker = threading.Thread(target=lambda: newest.append(row.resume()))
    taker.start()
    taker.join(0.2)
    assert taker.is_alive(), "it waits for the write"
    go_on.set()
    thread.join()
    taker.join()
    newest[0].write(b"newest")
    assert (tmp_path / (KEY + ".partial")).read_bytes() == b"newest"
    older.close()
    newest[0].close()


FROZEN_WRITER = """
import os, signal, sys
from pathlib import Path
from advtex_store.blobs import FolderBlobs
from advtex_store.partials import Hold
def freeze():
    if len(sys.argv) > 3:
        print("frozen", flush=True)
        os.kill(os.getpid(), signal.SIGSTOP)
partial = FolderBlobs(Path(sys.argv[1])).resume(sys.argv[2], 10, 0, Hold("older", None, lambda: None))
sys.argv.append("now")
object.__setattr__(partial._hold, "check", freeze)
partial.write(b"older")
"""


def test_a_frozen_holder_is_told_of_and_a_killed_one_is_in_nobodys_way(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("advtex_store.partials.LOCK_SECONDS", 0.3)
    command = [sys.executable, "-c", FROZEN_WRITER, str(tmp_path), KEY]
    row = Row(FolderBlobs(tmp_path), 10)
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "frozen\n"
        with pytest.raises(BlobsUnavailable, match="frozen"):
            row.resume()
        process.send_signal(signal.SIGKILL)
        process.wait()
    began = time.monotonic()
    with row.resume() as partial:
        partial.write(b"newest")
    assert time.monotonic() - began < 0.3
    assert (tmp_path / (KEY + ".partial")).read_bytes() == b"newest"


# S3: what cannot be prevented is noticed


def test_a_part_that_was_replaced_is_noticed_and_sent_again(s3_url: str, tmp_path: Path) -> None:
    blobs = open_blobs(s3_url, tmp_path)
    assert isinstance(blobs, S3Blobs)
    content = os.urandom(3 * PART + 10)
    row = Row(blobs, len(content))
    newest = row.resume()
    newest.write(content[:2500])
    row.keep(newest)
    replace(blobs.bucket, 2)  # by a request that had looked at the row before it was seized
    newest.write(content[2500:])
    row.keep(newest)
    with pytest.raises(BlobsUnavailable, match="InvalidPart"):
        newest.publish()
    newest.close()
    with row.resume() as again:
        assert again.offset == PART, "the first part is what it was"
        row.keep(again)
    with row.resume() as again:
        again.write(content[again.offset :])
        row.keep(again)
        again.publish()
    assert blobs.get(KEY) == content
    assert everything(blobs) == [KEY]


def replace(bucket: Bucket, number: int) -> None:
    bucket.put_part(KEY, bucket.get(KEY + ".multipart").decode(), number, b"x" * PART)


@pytest.mark.parametrize("offset", [0, 1300, 2000])
def test_an_upload_that_an_earlier_version_began_is_gone_on_with(offset: int, s3_url: str, tmp_path: Path) -> None:
    """Its tails are named by their offset alone, hold bytes alone, and are missing where a part is full."""
    blobs = open_blobs(s3_url, tmp_path)
    assert isinstance(blobs, S3Blobs)
    content = os.urandom(3 * PART)
    upload_id = blobs.bucket.begin(KEY)
    blobs.put(KEY + ".multipart", upload_id.encode())
    for number in range(offset // PART):
        blobs.bucket.put_part(KEY, upload_id, number + 1, content[number * PART : (number + 1) * PART])
    if rest := offset % PART:
        blobs.put(f"{KEY}.tail-{offset}", content[offset - rest : offset])
    row = Row(blobs, len(content))
    row.offset = offset
    with row.resume() as partial:
        partial.write(content[offset:])
        row.keep(partial)
        partial.publish()
    assert blobs.get(KEY) == content
    assert everything(blobs) == [KEY]

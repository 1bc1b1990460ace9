"""Blobs that arrive in pieces: whatever happens between two pieces, the blob is what was sent."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from advtex_store import keys
from advtex_store.blobs import Blobs, FolderBlobs, open_blobs
from advtex_store.errors import BlobNotFound, NoSpace

PART = 1000
KEY = "scans/a/scan.zip"


@pytest.fixture(autouse=True)
def _small_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    import moto.s3.models

    monkeypatch.setattr("advtex_store.s3_partial.PART", PART)
    monkeypatch.setattr(moto.s3.models, "S3_UPLOAD_PART_MIN_SIZE", PART)


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
    acknowledged = 0
    partial = blobs.resume(KEY, size, 0)
    for length, action in plan:
        piece = content[partial.offset : partial.offset + length]
        if action == "wrong bytes, crash":
            piece = bytes(255 - b for b in piece)
        partial.write(piece)
        if action == "flush":
            partial.flush()
            partial.settle()
            acknowledged = partial.offset
        elif action.endswith("crash"):
            partial.close()
            partial = blobs.resume(KEY, size, acknowledged)
    partial.write(content[partial.offset :])
    partial.publish()
    partial.close()
    assert blobs.get(KEY) == content
    assert everything(blobs) == [KEY]
    again = blobs.resume(KEY, size, acknowledged)  # as after a crash just before the row was told
    again.write(content[acknowledged:])
    again.flush()
    again.publish()
    again.close()
    assert blobs.get(KEY) == content


def test_two_writers_of_the_same_bytes_do_no_harm(blobs: Blobs) -> None:
    content = os.urandom(3 * PART + 10)
    one, two = blobs.resume(KEY, len(content), 0), blobs.resume(KEY, len(content), 0)
    one.write(content[:1500])
    one.flush()
    two.write(content[:2500])
    two.flush()
    one.write(content[1500:])
    two.write(content[2500:])
    one.publish()
    two.publish()
    assert blobs.get(KEY) == content
    assert everything(blobs) == [KEY]


def test_a_writer_that_was_overtaken_spoils_nothing(blobs: Blobs) -> None:
    """Its line went dead in another server process, which gives it up and keeps what it has much later."""
    content = os.urandom(PART - 10)
    with blobs.resume(KEY, len(content), 0) as overtaken:
        overtaken.write(content[:300])
        overtaken.flush()
        overtaken.settle()
        overtaken.write(content[300:500])
        with blobs.resume(KEY, len(content), 300) as newest:
            newest.write(content[300:700])
            newest.flush()
            overtaken.flush()  # the row refuses to be told, so that nothing is settled
            overtaken.flush()
            newest.settle()
    with blobs.resume(KEY, len(content), 700) as last:
        last.write(content[700:])
        last.publish()
    assert blobs.get(KEY) == content
    assert everything(blobs) == [KEY]


def test_pieces_that_are_not_held_any_more_are_noticed(blobs: Blobs) -> None:
    with pytest.raises(BlobNotFound):
        blobs.resume(KEY, 5000, 10)
    with blobs.resume(KEY, 5000, 0) as partial:
        partial.write(b"x" * 1500)
        partial.flush()
    blobs.drop_partial(KEY)
    assert everything(blobs) == []
    with pytest.raises(BlobNotFound):
        blobs.resume(KEY, 5000, 1500)


def test_full_parts_go_to_s3_at_once_and_old_tails_are_removed(s3_url: str, tmp_path: Path) -> None:
    blobs = open_blobs(s3_url, tmp_path)
    with blobs.resume(KEY, 10 * PART, 0) as partial:
        for _ in range(9):
            partial.write(b"x" * (PART - 100))
            partial.flush()
            assert 1 <= len([key for key in everything(blobs) if ".tail-" in key]) <= 2
            partial.settle()
            assert f"{KEY}.tail-{partial.offset}" in everything(blobs)
            assert len([key for key in everything(blobs) if ".tail-" in key]) == 1
    assert list(tmp_path.glob("*.part")) == [], "nothing passes through the local disk"


def test_a_file_that_lost_its_end_is_noticed(tmp_path: Path) -> None:
    blobs = FolderBlobs(tmp_path)
    with blobs.resume(KEY, 5000, 0) as partial:
        partial.write(b"x" * 1500)
        partial.flush()
    os.truncate(tmp_path / (KEY + ".partial"), 1499)
    with pytest.raises(BlobNotFound, match="not held any more"):
        blobs.resume(KEY, 5000, 1500)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_says_so(tmp_path: Path) -> None:
    blobs = FolderBlobs(tmp_path)
    (tmp_path / "scans" / "a").mkdir(parents=True)
    (tmp_path / (KEY + ".partial")).symlink_to("/dev/full")
    with blobs.resume(KEY, 5000, 0) as partial, pytest.raises(NoSpace):
        partial.write(b"x" * 1500)


def test_the_names_lie_where_a_purge_finds_them(blobs: Blobs) -> None:
    key = keys.scan_key("0a")
    with blobs.resume(key, 5000, 0) as partial:
        partial.write(b"x" * 1500)
        partial.flush()
    assert everything(blobs)
    assert all(name.startswith(keys.scan_prefix("0a")) for name in everything(blobs))

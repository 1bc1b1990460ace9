"""Uploads over real sockets."""

from __future__ import annotations

import base64
import hashlib
import os
import socket
import subprocess
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import psutil
import pytest
from sqlalchemy.exc import OperationalError

from advtex_store import keys

DATA = os.urandom(3_000_000)
SHA256 = hashlib.sha256(DATA).hexdigest()
DIGEST = f"sha-256=:{base64.b64encode(hashlib.sha256(DATA).digest()).decode()}:"


def nothing_is_kept(live: Any) -> bool:
    """No row, no blob, no leftover."""
    blobs = live.store.blobs
    spooled = list(blobs.spool_dir.glob("*")) if blobs.spool_dir.exists() else []
    return not spooled and not list(blobs.list("scans/")) and rows(live) == 0 and expected_bytes(live) == 0


def rows(live: Any) -> int:
    from sqlalchemy import text

    with live.store.database.read() as session:
        return int(session.execute(text("select count(*) from uploads")).scalar_one())


def expected_bytes(live: Any) -> int:
    return int(live.store.uploads.expected_bytes())


@pytest.mark.parametrize(
    "headers", [{}, {"X-Content-SHA256": SHA256.upper()}, {"Content-Digest": f"md5=:AA==:, {DIGEST}"}]
)
def test_an_upload(live: Any, headers: dict[str, str]) -> None:
    response = live.http.post("/v1/uploads", content=DATA, headers={"X-Filename": "chair%20%C3%A4.zip%0A", **headers})
    assert response.status_code == 201
    view = response.json()
    assert (view["size"], view["offset"], view["complete"], view["sha256"]) == (len(DATA), len(DATA), True, SHA256)
    assert view["filename"] == "chair ä.zip"
    assert live.http.get(f"/v1/uploads/{view['id']}").json() == view
    assert live.store.blobs.get(keys.scan_key(view["id"])) == DATA
    assert live.http.delete(f"/v1/uploads/{view['id']}").status_code == 204
    assert live.http.get(f"/v1/uploads/{view['id']}").status_code == 404


@pytest.mark.parametrize(
    "headers",
    [
        {"X-Content-SHA256": "0" * 64},
        {"Content-Digest": "sha-256=:" + base64.b64encode(bytes(32)).decode() + ":"},
    ],
)
def test_wrong_bytes_are_refused(live: Any, is_error: Any, headers: dict[str, str]) -> None:
    is_error(live.http.post("/v1/uploads", content=DATA, headers=headers), 422, "checksum_mismatch")
    assert nothing_is_kept(live)


@pytest.mark.one_machine("pure validation")
@pytest.mark.parametrize(
    "headers", [{"X-Content-SHA256": "12"}, {"Content-Digest": "sha-256=:AAAA:"}, {"Content-Digest": "sha-256=AAAA"}]
)
def test_malformed_checksums_are_refused(live: Any, is_error: Any, headers: dict[str, str]) -> None:
    is_error(live.http.post("/v1/uploads", content=DATA, headers=headers), 400, "bad_request")


@pytest.mark.one_machine("pure validation")
def test_a_length_is_needed(live: Any, is_error: Any) -> None:
    def chunks() -> Iterator[bytes]:
        yield b"x"

    message = is_error(live.http.post("/v1/uploads", content=chunks()), 411, "bad_request")
    assert "Content-Length" in message
    is_error(live.http.post("/v1/uploads", content=b""), 400, "bad_request")


@pytest.mark.one_machine("pure validation")
def test_too_large(make_live: Callable[..., Any], is_error: Any) -> None:
    live = make_live(max_upload_bytes=1000)
    is_error(live.http.post("/v1/uploads", content=b"x" * 1001), 413, "too_large")
    assert live.upload(b"x" * 1000)
    assert live.http.get("/v1/storage").json()["max_upload_bytes"] == 1000


def raw_request(live: Any, key: str | None, length: int) -> socket.socket:
    connection = socket.create_connection(live.url.removeprefix("http://").split(":"), timeout=20)
    auth = "" if key is None else f"Authorization: Bearer {key}\r\n"
    head = f"POST /v1/uploads HTTP/1.1\r\nHost: x\r\n{auth}Content-Length: {length}\r\n\r\n"
    connection.sendall(head.encode())
    return connection


def wait_until(condition: Callable[[], object]) -> None:
    done = threading.Event()
    for _ in range(500):
        if condition():
            return
        done.wait(0.02)
    pytest.fail("not in time")


def test_a_line_that_breaks_leaves_nothing(live: Any) -> None:
    connection = raw_request(live, live.key, 10_000_000)
    connection.sendall(b"x" * 4_000_000)
    wait_until(lambda: list(live.store.blobs.list("scans/")))
    assert expected_bytes(live) == 10_000_000
    connection.close()
    wait_until(lambda: nothing_is_kept(live))
    assert live.upload()


def test_a_half_open_line_is_ended(make_live: Callable[..., Any]) -> None:
    live = make_live(idle_seconds=0.3)
    connection = raw_request(live, live.key, 10_000_000)
    connection.sendall(b"x" * 4_000_000)
    assert connection.recv(4096).startswith(b"HTTP/1.1 408")
    connection.close()
    wait_until(lambda: nothing_is_kept(live))


def test_a_database_that_breaks_at_the_end_keeps_nothing(
    live: Any, is_error: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> None:
        raise OperationalError("", {}, Exception("away"))

    monkeypatch.setattr(live.store.uploads, "finish", broken)
    is_error(live.http.post("/v1/uploads", content=DATA), 503, "unavailable")
    assert nothing_is_kept(live)


def test_a_server_that_stops_in_the_middle_leaves_nothing(live: Any) -> None:
    connection = raw_request(live, live.key, 10_000_000)
    connection.sendall(b"x" * 4_000_000)
    wait_until(lambda: list(live.store.blobs.list("scans/")))
    live._server.should_exit = True
    live._thread.join(15)
    assert not live._thread.is_alive()
    connection.close()
    assert nothing_is_kept(live)


@pytest.mark.one_machine("pure validation")
def test_a_stranger_is_refused_before_the_body(live: Any) -> None:
    """The answer comes although not one byte of the body was sent."""
    for key in (None, "adv_000000000000_" + "a" * 40):
        connection = raw_request(live, key, 10_000_000)
        assert connection.recv(4096).startswith(b"HTTP/1.1 401")
        connection.close()
    assert nothing_is_kept(live)


@pytest.mark.one_machine("bytes for S3 do not stay on this disk")
def test_room_is_checked_and_held(make_live: Callable[..., Any], is_error: Any) -> None:
    live = make_live()
    leave(live, 50_000_000)
    connection = raw_request(live, live.key, 40_000_000)
    wait_until(lambda: expected_bytes(live))
    response = live.http.post("/v1/uploads", content=b"x" * 20_000_000)
    is_error(response, 507, "insufficient_storage")
    assert response.headers["retry-after"]
    connection.close()
    wait_until(lambda: nothing_is_kept(live))
    assert live.upload(b"x" * 20_000_000)


@pytest.mark.one_machine("bytes for S3 do not stay on this disk")
def test_room_is_promised_once(live: Any, is_error: Any) -> None:
    leave(live, 100_000_000)
    begun = announce(live, 80_000_000)
    refused = announce(live, 40_000_000)
    is_error(refused, 507, "insufficient_storage")
    assert refused.headers["Retry-After"]
    live.http.delete(begun.headers["Location"], headers={"Tus-Resumable": "1.0.0"})
    assert announce(live, 40_000_000).status_code == 201


@pytest.mark.one_machine("has an S3 of its own")
def test_bytes_for_an_object_storage_are_not_promised_here(make_live: Callable[..., Any], s3_url: str) -> None:
    live = make_live(blob_url=s3_url)
    leave(live, 100_000_000)
    for size in (80_000_000, 40_000_000):
        assert announce(live, size).status_code == 201


def leave(live: Any, room: int) -> None:
    """So many bytes of the disk for uploads, whatever others write to it meanwhile."""
    free = live.store.blobs.free_bytes()
    live.store.blobs.free_bytes = lambda: free
    reserve = free - room
    live.app.state.intake.settings = live.settings.model_copy(update={"disk_reserve_bytes": reserve})


def announce(live: Any, size: int) -> httpx.Response:
    """A resumable upload without its bytes."""
    headers = {"Tus-Resumable": "1.0.0", "Upload-Length": str(size)}
    response: httpx.Response = live.http.post("/v1/uploads", headers=headers)
    return response


@pytest.mark.one_machine("bytes for S3 do not stay on this disk")
@pytest.mark.skipif(os.geteuid() != 0, reason="mounting a small file system needs root")
def test_a_disk_that_fills_up_in_mid_upload(make_live: Callable[..., Any], is_error: Any, tmp_path: Path) -> None:
    """The check at the start cannot know what others write meanwhile."""
    mount = tmp_path / "small"
    mount.mkdir()
    done = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=8m", "tmpfs", str(mount)], capture_output=True)
    if done.returncode != 0:
        pytest.skip(f"mounting is not allowed here: {done.stderr!r}")
    try:
        live = make_live(blob_url=(mount / "blobs").as_uri())

        def body() -> Iterator[bytes]:
            yield b"x" * 2_000_000
            (mount / "somebody-else").write_bytes(b"x" * 5_000_000)
            for _ in range(3):
                yield b"x" * 1_000_000

        response = live.http.post("/v1/uploads", content=body(), headers={"Content-Length": "5000000"})
        is_error(response, 507, "insufficient_storage")
        assert nothing_is_kept(live)
        assert live.upload(b"x" * 100_000)
        (mount / "somebody-else").unlink()
        assert live.upload(b"x" * 5_000_000)
    finally:
        subprocess.run(["umount", "-l", str(mount)], check=True)


@pytest.mark.one_machine("the S3 of the tests keeps its bytes in the memory that is measured")
def test_memory_stays_small(live: Any) -> None:
    """200 MB pass through; the process may grow by a few buffers only."""
    piece = b"x" * (1 << 20)
    live.http.post("/v1/uploads", content=piece)
    before = psutil.Process().memory_info().rss
    peak = before

    def body() -> Iterator[bytes]:
        nonlocal peak
        for _ in range(200):
            peak = max(peak, psutil.Process().memory_info().rss)
            yield piece

    response = live.http.post("/v1/uploads", content=body(), headers={"Content-Length": str(200 << 20)})
    assert response.status_code == 201
    assert peak - before < 40 << 20


@pytest.mark.one_machine("tests/store has the same on both databases")
def test_uploads_belong_to_their_owner(live: Any, is_error: Any) -> None:
    upload = live.upload()
    with live.client(live.store.accounts.create_key("other")) as other:
        is_error(other.get(f"/v1/uploads/{upload}"), 404, "not_found")
        is_error(other.delete(f"/v1/uploads/{upload}"), 404, "not_found")
        is_error(other.post("/v1/jobs", json={"upload_id": upload}), 404, "not_found")
    with live.client(live.store.accounts.create_key(owner="me", scopes=["read"])) as reader:
        assert reader.get(f"/v1/uploads/{upload}").status_code == 200
        is_error(reader.post("/v1/uploads", content=b"x"), 403, "forbidden")

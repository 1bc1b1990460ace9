"""Resumable uploads (tus 1.0.0): by the letter of the protocol, and by its own clients."""

from __future__ import annotations

import base64
import hashlib
import os
import socket
import threading
import time
from collections.abc import Callable
from email.utils import parsedate_to_datetime
from typing import Any

import httpx
import pytest

from advtex_store import keys
from advtex_store.errors import BlobsUnavailable
from advtex_store.partials import FolderPartial
from advtex_store.s3_partial import S3Partial

DATA = os.urandom(20_000_000)
SHA256 = hashlib.sha256(DATA).hexdigest()
TUS = {"Tus-Resumable": "1.0.0"}
STREAM = {"Content-Type": "application/offset+octet-stream"}


def metadata(**values: str) -> dict[str, str]:
    pairs = (f"{name} {base64.b64encode(value.encode()).decode()}" for name, value in values.items())
    return {"Upload-Metadata": ",".join(pairs)}


def create(live: Any, size: int = len(DATA), **headers: str) -> str:
    response = live.http.post("/v1/uploads", headers=TUS | {"Upload-Length": str(size)} | headers)
    assert response.status_code == 201, response.text
    return str(response.headers["Location"])


def patch(live: Any, url: str, offset: int, data: Any, **headers: str) -> httpx.Response:
    response: httpx.Response = live.http.patch(
        url, content=data, headers=TUS | STREAM | {"Upload-Offset": str(offset)} | headers
    )
    return response


def offset_of(live: Any, url: str) -> int:
    response = live.http.head(url, headers=TUS)
    assert response.status_code == 200
    assert response.headers["Cache-Control"] == "no-store"
    return int(response.headers["Upload-Offset"])


def stored(live: Any, url: str) -> bytes:
    return bytes(live.store.blobs.get(keys.scan_key(url.rpartition("/")[2])))


def sha1(data: bytes) -> dict[str, str]:
    return {"Upload-Checksum": "sha1 " + base64.b64encode(hashlib.sha1(data).digest()).decode()}


# The protocol


@pytest.mark.one_machine("pure validation")
def test_the_server_says_what_it_speaks(make_live: Callable[..., Any]) -> None:
    response = make_live(max_upload_bytes=5000).http.options("/v1/uploads")
    assert response.status_code == 204
    assert response.headers["Tus-Version"] == "1.0.0"
    assert set(response.headers["Tus-Extension"].split(",")) == {
        *("creation", "creation-with-upload", "checksum", "termination", "expiration")
    }
    assert "sha1" in response.headers["Tus-Checksum-Algorithm"].split(",")
    assert response.headers["Tus-Max-Size"] == "5000"


def test_an_upload_in_three_pieces(live: Any) -> None:
    given = metadata(filename="chair ä.zip", sha256=SHA256)
    url = create(live, **given)
    for start, end in ((0, 1), (1, 9_000_001), (9_000_001, len(DATA))):
        assert offset_of(live, url) == start
        response = patch(live, url, start, DATA[start:end])
        assert (response.status_code, response.headers["Upload-Offset"]) == (204, str(end))
        assert response.headers["Tus-Resumable"] == "1.0.0"
        assert ("Upload-Expires" in response.headers) == (end < len(DATA))
        if end < len(DATA):
            left = parsedate_to_datetime(response.headers["Upload-Expires"]).timestamp() - time.time()
            assert 86000 < left < 86401
    head = live.http.head(url, headers=TUS).headers
    assert (head["Upload-Length"], head["Upload-Metadata"]) == (str(len(DATA)), given["Upload-Metadata"])
    view = live.http.get(url).json()
    assert (view["complete"], view["sha256"], view["filename"]) == (True, SHA256, "chair ä.zip")
    assert stored(live, url) == DATA
    assert patch(live, url, len(DATA), b"").status_code == 204, "finalizing again changes nothing"
    assert patch(live, url, 0, b"x").status_code == 409


def test_creation_with_all_or_part_of_the_bytes(live: Any) -> None:
    for part in (DATA, DATA[:7_000_000], b""):
        response = live.http.post(
            "/v1/uploads", content=part, headers=TUS | STREAM | {"Upload-Length": str(len(DATA))} | sha1(part)
        )
        assert (response.status_code, response.headers["Upload-Offset"]) == (201, str(len(part)))
        url = response.headers["Location"]
        assert offset_of(live, url) == len(part)
        patch(live, url, len(part), DATA[len(part) :])
        assert live.http.get(url).json()["sha256"] == SHA256


def test_checksums_are_checked_before_a_byte_counts(live: Any, is_error: Any) -> None:
    url = create(live)
    assert patch(live, url, 0, DATA[:10_000_000], **sha1(DATA[:10_000_000])).status_code == 204
    wrong = b"x" * 9_000_000
    is_error(patch(live, url, 10_000_000, wrong, **sha1(wrong + b"!")), 460, "checksum_mismatch")
    assert offset_of(live, url) == 10_000_000
    sum256 = base64.b64encode(hashlib.sha256(DATA[10_000_000:]).digest()).decode()
    assert patch(live, url, 10_000_000, DATA[10_000_000:], **{"Upload-Checksum": f"sha256 {sum256}"}).status_code == 204
    assert stored(live, url) == DATA
    assert live.http.get(url).json()["sha256"] == SHA256
    for header in ("sha1 !!!", "sha1 AAAA", "crc32 AAAA", ""):
        is_error(patch(live, url, 0, b"", **{"Upload-Checksum": header}), 400, "bad_request")


def test_bytes_that_are_not_the_announced_ones_are_refused_and_forgotten(live: Any, is_error: Any) -> None:
    url = create(live, **metadata(sha256="0" * 64))
    is_error(patch(live, url, 0, DATA), 422, "checksum_mismatch")
    assert live.http.get(url).status_code == 404
    assert list(live.store.blobs.list("scans/")) == []


def test_termination(live: Any) -> None:
    url = create(live)
    patch(live, url, 0, DATA[:100])
    assert live.http.delete(url, headers=TUS).status_code == 204
    for response in (live.http.head(url, headers=TUS), patch(live, url, 100, b"x"), live.http.delete(url, headers=TUS)):
        assert response.status_code == 404
    wait_until(lambda: not list(live.store.blobs.list("scans/")))


def test_unfinished_uploads_expire(live: Any) -> None:
    url = create(live)
    patch(live, url, 0, DATA[:100])
    with live.store.database.write() as session:
        session.connection().exec_driver_sql("update uploads set expires_at = 1")
    wait_until(lambda: live.http.head(url, headers=TUS).status_code == 404)
    wait_until(lambda: not list(live.store.blobs.list("scans/")))


@pytest.mark.one_machine("pure validation")
@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({}, 400),
        ({"Upload-Length": "-1"}, 400),
        ({"Upload-Length": "many"}, 400),
        ({"Upload-Length": "0"}, 400),
        ({"Upload-Length": "9" * 18}, 413),
        ({"Upload-Defer-Length": "1"}, 400),
        ({"Upload-Length": "5", "Upload-Metadata": "name !"}, 400),
        ({"Upload-Length": "5", "Upload-Metadata": "a YQ==,a YQ=="}, 400),
        ({"Upload-Length": "5", "Upload-Metadata": "a " + "YQ==" * 2000}, 400),
        ({"Upload-Length": "5", **metadata(sha256="12")}, 400),
        ({"Upload-Length": "5", "Tus-Resumable": "0.2.2"}, 412),
    ],
    ids=str,
)
def test_a_creation_that_cannot_be(live: Any, headers: dict[str, str], status: int) -> None:
    response = live.http.post("/v1/uploads", headers=TUS | headers)
    assert response.status_code == status, response.text
    assert response.headers["Tus-Resumable"] == "1.0.0"
    assert ("Tus-Version" in response.headers) == (status == 412)
    assert live.store.uploads.expected_bytes() == 0


def test_a_patch_that_cannot_be(live: Any, is_error: Any) -> None:
    url = create(live, 1000)
    is_error(patch(live, url, 1, b"x"), 409, "conflict")
    is_error(patch(live, url, 0, b"x" * 1001), 413, "too_large")
    is_error(patch(live, url, 0, iter([b"x" * 1001])), 413, "too_large")
    is_error(live.http.patch(url, content=b"x", headers=TUS | {"Upload-Offset": "0"}), 415, "bad_request")
    is_error(live.http.patch(url, content=b"x", headers=STREAM | {"Upload-Offset": "0"}), 412, "precondition_failed")
    is_error(live.http.patch(url, content=b"x", headers=TUS | STREAM), 400, "bad_request")
    is_error(patch(live, "/v1/uploads/none", 0, b"x"), 404, "not_found")
    assert live.http.head(url).status_code == 412
    assert offset_of(live, url) == 0


@pytest.mark.one_machine("pure validation")
def test_methods_that_a_proxy_does_not_pass(live: Any) -> None:
    url = create(live, 10)
    headers = TUS | STREAM | {"Upload-Offset": "0", "X-HTTP-Method-Override": "PATCH"}
    assert live.http.post(url, content=b"0123456789", headers=headers).status_code == 204
    assert stored(live, url) == b"0123456789"


@pytest.mark.one_machine("tests/store has the same on both databases")
def test_uploads_belong_to_their_owner(live: Any, is_error: Any) -> None:
    url = create(live, **metadata(sha256=SHA256))
    with live.client(live.store.accounts.create_key("other")) as other:
        assert other.head(url, headers=TUS).status_code == 404
        is_error(other.patch(url, content=b"x", headers=TUS | STREAM | {"Upload-Offset": "0"}), 404, "not_found")
        is_error(other.delete(url, headers=TUS), 404, "not_found")
        assert other.get("/v1/uploads", params={"sha256": SHA256}).json() == {"uploads": []}
    with live.client(live.store.accounts.create_key(owner="me", scopes=["read"])) as reader:
        is_error(reader.patch(url, content=b"x", headers=TUS | STREAM | {"Upload-Offset": "0"}), 403, "forbidden")
        assert reader.get(url).status_code == 200


@pytest.mark.one_machine("tests/store has the same on both databases")
def test_what_is_held_is_found_by_its_sha256(live: Any) -> None:
    far, near = create(live, **metadata(sha256=SHA256)), create(live, **metadata(sha256=SHA256))
    patch(live, far, 0, DATA[:5000])

    def found() -> list[str]:
        uploads = live.http.get("/v1/uploads", params={"sha256": SHA256}).json()["uploads"]
        return [f"/v1/uploads/{upload['id']}" for upload in uploads]

    assert found() == [far, near]
    plain = f"/v1/uploads/{live.upload(DATA)}"
    assert found() == [plain, far, near]
    assert live.http.get("/v1/uploads", params={"sha256": "x"}).status_code == 422


# Room


@pytest.mark.one_machine("tests/store has the same on both databases")
def test_the_quota_of_a_key_counts_when_an_upload_is_created(live: Any, is_error: Any) -> None:
    with live.client(live.store.accounts.create_key(owner="small", max_bytes=1000)) as small:
        first = small.post("/v1/uploads", headers=TUS | {"Upload-Length": "600"})
        assert first.status_code == 201
        for refused in (
            small.post("/v1/uploads", headers=TUS | {"Upload-Length": "401"}),
            small.post("/v1/uploads", content=b"x" * 401),
        ):
            assert "delete jobs and uploads" in is_error(refused, 413, "quota_exceeded")
        assert small.post("/v1/uploads", headers=TUS | {"Upload-Length": "400"}).status_code == 201
        small.delete(first.headers["Location"], headers=TUS)
        assert small.post("/v1/uploads", content=b"x" * 600).status_code == 201


# Lines that break


def raw_patch(live: Any, url: str, offset: int, length: int, key: str | None = None) -> socket.socket:
    host, _, port = live.url.removeprefix("http://").partition(":")
    connection = socket.create_connection((host, int(port)), timeout=20)
    head = f"PATCH {url} HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {live.key if key is None else key}\r\n"
    head += f"Tus-Resumable: 1.0.0\r\nContent-Type: {STREAM['Content-Type']}\r\nUpload-Offset: {offset}\r\n"
    connection.sendall(f"{head}Content-Length: {length}\r\n\r\n".encode())
    return connection


def wait_until(condition: Callable[[], object]) -> None:
    done = threading.Event()
    for _ in range(500):
        if condition():
            return
        done.wait(0.02)
    pytest.fail("not in time")


def test_what_came_before_a_line_broke_is_kept(live: Any) -> None:
    url = create(live)
    connection = raw_patch(live, url, 0, len(DATA))
    connection.sendall(DATA[:3_333_333])
    connection.close()
    wait_until(lambda: live.http.get(url).json()["offset"] == 3_333_333)
    patch(live, url, 3_333_333, DATA[3_333_333:])
    assert stored(live, url) == DATA


def test_a_half_open_line_delays_nobody(live: Any) -> None:
    """The client's machine is gone without a word; the server still waits for its bytes."""
    url = create(live)
    lost = raw_patch(live, url, 0, len(DATA))
    lost.sendall(DATA[:5_000_000])
    wait_until(lambda: live.app.state.bodies._open)
    asked = time.monotonic()
    offset = offset_of(live, url)
    assert time.monotonic() - asked < 0.5
    assert 0 <= offset <= 5_000_000
    assert patch(live, url, offset, DATA[offset:]).status_code == 204
    assert stored(live, url) == DATA
    assert lost.recv(100).startswith(b"HTTP/1.1 409")
    lost.close()


def test_the_newest_patch_wins(live: Any) -> None:
    url = create(live)
    old = raw_patch(live, url, 0, len(DATA))
    old.sendall(DATA[:3_000_000])
    wait_until(lambda: live.app.state.bodies._open)
    response = patch(live, url, 0, DATA[:6_000_000])
    if response.status_code == 409:  # the older one had brought something first; it is over now
        start = offset_of(live, url)
        assert 0 < start <= 3_000_000
        response = patch(live, url, start, DATA[start:6_000_000])
    assert response.status_code == 204
    assert old.recv(100).startswith(b"HTTP/1.1 409")
    old.close()
    patch(live, url, 6_000_000, DATA[6_000_000:])
    assert stored(live, url) == DATA


def test_the_newest_patch_wins_on_another_server_of_the_same_fleet(make_live: Callable[..., Any]) -> None:
    one, two = make_live(), make_live()
    url = create(one)
    old = raw_patch(one, url, 0, len(DATA))
    old.sendall(DATA[:3_000_000])
    wait_until(lambda: one.app.state.bodies._open)
    offset = offset_of(two, url)
    assert patch(two, url, offset, DATA[offset:]).status_code == 204
    old.sendall(DATA[3_000_000:])
    # 503: the S3 of the tests fails on parts of an upload that is complete, where others answer 404
    assert old.recv(100).startswith((b"HTTP/1.1 409", b"HTTP/1.1 404", b"HTTP/1.1 503"))
    old.close()
    assert stored(two, url) == DATA
    assert one.http.get(url).json()["sha256"] == SHA256


def test_a_silent_line_is_ended_and_its_bytes_are_kept(make_live: Callable[..., Any]) -> None:
    live = make_live(idle_seconds=0.3)
    url = create(live)
    connection = raw_patch(live, url, 0, len(DATA))
    connection.sendall(DATA[:1234])
    assert connection.recv(100).startswith(b"HTTP/1.1 408")
    connection.close()
    assert offset_of(live, url) == 1234


@pytest.mark.one_machine("pure validation")
def test_strangers_write_nothing(live: Any) -> None:
    url = create(live)
    for key in ("", "adv_000000000000_" + "a" * 40):
        connection = raw_patch(live, url, 0, len(DATA), key)
        assert connection.recv(100).startswith(b"HTTP/1.1 401")
        connection.close()
    assert list(live.store.blobs.list("scans/")) == []


def test_a_server_that_stops_in_mid_patch_keeps_what_came(make_live: Callable[..., Any]) -> None:
    live = make_live()
    url = create(live)
    connection = raw_patch(live, url, 0, len(DATA))
    connection.sendall(DATA[:9_000_000])
    wait_until(lambda: live.http.get(url).json()["offset"] > 0)
    live.stop()
    connection.close()
    again = make_live()
    offset = offset_of(again, url)
    assert 8_000_000 < offset <= 9_000_000
    patch(again, url, offset, DATA[offset:])
    assert again.http.get(url).json()["sha256"] == SHA256, "digested anew: the other process knew the first part"


def test_a_crash_between_the_blob_and_its_row_is_mended_when_the_client_asks(
    live: Any, is_error: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    from sqlalchemy.exc import OperationalError

    def broken(*_: object) -> None:
        raise OperationalError("", {}, Exception("away"))

    url = create(live)
    patch(live, url, 0, DATA[:-10])
    with monkeypatch.context() as patched:
        patched.setattr(live.store.uploads, "finish", broken)
        is_error(patch(live, url, len(DATA) - 10, DATA[-10:]), 503, "unavailable")
    assert not live.http.get(url).json()["complete"]
    is_error(patch(live, url, len(DATA) - 10, DATA[-10:]), 409, "conflict")
    assert offset_of(live, url) == len(DATA)
    assert live.http.get(url).json()["sha256"] == SHA256, "a client that sees all of its bytes stops here"
    assert stored(live, url) == DATA


def test_a_storage_that_fails_at_the_very_end_costs_nothing(
    live: Any, is_error: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> None:
        raise BlobsUnavailable("no answer")

    whole = DATA[: 16 << 20]  # full parts of S3 only: no rest is left that the last one could be made of
    url = create(live, len(whole))
    patch(live, url, 0, whole[: 8 << 20])
    with monkeypatch.context() as patched:
        for kind in (FolderPartial, S3Partial):
            patched.setattr(kind, "publish", broken)
        is_error(patch(live, url, 8 << 20, whole[8 << 20 :]), 503, "unavailable")
        assert live.http.head(url, headers=TUS).status_code == 503, "a client that sees all of its bytes would stop"
    assert patch(live, url, len(whole), b"").status_code == 204
    assert stored(live, url) == whole
    assert [info.key for info in live.store.blobs.list("scans/")] == [keys.scan_key(url.rpartition("/")[2])]

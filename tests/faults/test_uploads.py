"""Uploads over bad lines, past dead processes, and by strangers: real processes, real sockets."""

from __future__ import annotations

import hashlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import psutil
import pytest
from cutting_proxy import BUFFER, CuttingProxy
from live_fleet import Place, fleet
from live_service import LiveService, wait_until

from advtex_client import Client
from advtex_client.uploads import CHUNK
from advtex_store import keys

MB = 1_000_000
TUS = {"Tus-Resumable": "1.0.0"}
ON_THE_LINE = 2 * MB  # what a cut takes with it at most: the buffers on the way
MOST_RESENT = 0.05


def sparse(path: Path, size: int) -> Path:
    """A file of zeros that takes no room, with some bytes here and there by which places are told apart."""
    with path.open("wb") as file:
        for place in range(0, size, 10 * MB):
            file.seek(place)
            file.write(hashlib.sha256(str(place).encode()).digest())
        file.truncate(size)
    return path


def digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


class Sent:
    """Counts what the client hands to the line, whether it arrives or not; a short last chunk counts as a whole one."""

    def __init__(self, watch: Callable[[], None] = lambda: None) -> None:
        self.bytes = 0
        self._watch = watch

    def __call__(self, done: int, total: int) -> None:
        self.bytes += CHUNK
        self._watch()


def over_a_line_that_is_cut(service: LiveService, tmp_path: Path, size: int, least: int, most: int) -> None:
    """Every byte arrives, few are sent twice, and the server holds few of them in memory."""
    archive = sparse(tmp_path / "scan.zip", size)
    server = psutil.Process(service.server.pid)
    with service.client() as client:
        client.upload(sparse(tmp_path / "small.zip", 20 * MB))  # the first one loads what every one needs
    before = peak = server.memory_info().rss

    def look(_done: int, _total: int) -> None:
        nonlocal peak
        peak = max(peak, server.memory_info().rss)

    # Between two processes of one machine Linux grows the sender's buffer to megabytes, all lost with a cut; few real
    # lines hold so much. With the proxy's own size, what is sent again is what client and server are to blame for.
    line = httpx.HTTPTransport(socket_options=[(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER)])
    with CuttingProxy(service.url, 1, least, most) as proxy, Client(proxy.url, service.key, transport=line) as client:
        began = time.monotonic()
        upload = client.upload(archive, on_bytes=look)
        seconds = time.monotonic() - began
    stored = service.store.blobs.path(keys.scan_key(upload.id))  # type: ignore[attr-defined]
    resent = proxy.received / size - 1
    print(
        f"{size / MB:.0f} MB in {seconds:.1f} s over {proxy.cuts} cuts: {100 * resent:.2f} % sent again, "
        f"server grew by {(peak - before) / MB:.1f} MB"
    )
    assert upload.sha256 == digest(archive)
    assert digest(stored) == upload.sha256
    assert proxy.cuts >= 3
    assert 0 <= resent * size <= min(proxy.cuts * ON_THE_LINE, size * MOST_RESENT)
    assert peak - before < 64 * MB


def test_a_line_that_is_cut_again_and_again(service: LiveService, tmp_path: Path) -> None:
    over_a_line_that_is_cut(service, tmp_path, 200 * MB, 40 * MB, 60 * MB)


@pytest.mark.slow
def test_two_gigabytes_over_a_line_that_is_cut(service: LiveService, tmp_path: Path) -> None:
    if shutil.disk_usage(tmp_path).free < 5000 * MB:
        pytest.skip(f"there is no room for 2 GB twice below {tmp_path}")
    over_a_line_that_is_cut(service, tmp_path, 2000 * MB, 20 * MB, 400 * MB)


def begun(service: LiveService, size: int) -> str:
    headers = {"Authorization": f"Bearer {service.key}", **TUS, "Upload-Length": str(size)}
    return str(httpx.post(f"{service.url}/v1/uploads", headers=headers).headers["Location"])


def raw_patch(url: str, location: str, length: int, key: str, offset: int = 0) -> socket.socket:
    parts = urlsplit(url)
    connection = socket.create_connection((parts.hostname, parts.port), timeout=20)
    head = f"PATCH {location} HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {key}\r\nTus-Resumable: 1.0.0\r\n"
    head += (
        f"Content-Type: application/offset+octet-stream\r\nUpload-Offset: {offset}\r\nContent-Length: {length}\r\n\r\n"
    )
    connection.sendall(head.encode())
    return connection


def bytes_on_the_way(connection: socket.socket) -> int:
    """What the kernel still holds of a connection on this machine, at both ends."""
    port = f":{connection.getsockname()[1]:04X}"
    rows = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    queues = [row[4].split(":") for row in rows if row[1].endswith(port) or row[2].endswith(port)]
    return sum(int(queue, 16) for pair in queues for queue in pair)


def test_a_half_open_line_does_not_keep_the_next_one_waiting(service: LiveService) -> None:
    location = begun(service, 100 * MB)
    connection = raw_patch(service.url, location, 100 * MB, service.key)
    connection.sendall(b"x" * (30 * MB))  # and then nothing more, not even its end
    headers = {"Authorization": f"Bearer {service.key}", **TUS}
    with httpx.Client(base_url=service.url, headers=headers) as http:
        wait_until(lambda: http.get(location).json()["offset"] > 20 * MB)
        wait_until(lambda: bytes_on_the_way(connection) == 0)
        asked = time.monotonic()
        offset = int(http.head(location).headers["Upload-Offset"])
        seconds = time.monotonic() - asked
        print(f"HEAD beside a half-open PATCH: {seconds * 1000:.0f} ms")
        assert seconds < 0.5
        assert offset == 30 * MB
        stream = {"Content-Type": "application/offset+octet-stream", "Upload-Offset": str(offset)}
        assert http.patch(location, content=b"x" * (70 * MB), headers=stream).status_code == 204
        assert http.get(location).json()["complete"]
    connection.close()


def test_two_clients_of_two_servers_send_differing_bytes(tmp_path: Path, place: dict[str, str]) -> None:
    """The first one is slow, and does not know that it has lost the upload when the rest of its bytes come."""
    s3 = {name: value for name, value in os.environ.items() if name.startswith("AWS_")} if place else None
    where = Place(tmp_path / "data", **place, s3=s3)
    with fleet(tmp_path, where, servers=2, workers=0, engine="journaled") as running:
        key = running.store.accounts.create_key("tests", owner="tests")
        headers = {"Authorization": f"Bearer {key}", **TUS}
        begun = httpx.post(f"{running.urls[0]}/v1/uploads", headers={**headers, "Upload-Length": str(60 * MB)})
        location = str(begun.headers["Location"])
        upload_id = location.rpartition("/")[2]
        older = raw_patch(running.urls[0], location, 60 * MB, key)
        older.sendall(b"A" * (30 * MB))
        wait_until(lambda: running.store.uploads.upload(upload_id).offset > 20 * MB)
        wait_until(lambda: bytes_on_the_way(older) == 0)
        offset = int(httpx.head(running.urls[1] + location, headers=headers).headers["Upload-Offset"])
        assert 20 * MB < offset <= 30 * MB
        newer = raw_patch(running.urls[1], location, 60 * MB - offset, key, offset)
        newer.sendall(b"B" * (25 * MB))
        wait_until(lambda: running.store.uploads.upload(upload_id).offset > offset + 16 * MB)
        with suppress(OSError):  # it may be answered, and its line closed, before all has come
            older.sendall(b"A" * (30 * MB))
        answered = older.recv(100)
        newer.sendall(b"B" * (35 * MB - offset))
        assert newer.recv(100).startswith(b"HTTP/1.1 204")
        assert answered.startswith(b"HTTP/1.1 409")
        view = httpx.get(running.urls[0] + location, headers=headers).json()
        stored = b"".join(running.store.blobs.stream(keys.scan_key(upload_id)))
        assert stored == b"A" * offset + b"B" * (60 * MB - offset)
        assert view["sha256"] == hashlib.sha256(stored).hexdigest()
        older.close()
        newer.close()


def test_not_a_byte_of_a_stranger_is_written(service: LiveService) -> None:
    location = begun(service, 100 * MB)
    server = psutil.Process(service.server.pid)
    before = server.io_counters().write_bytes
    for key in ("adv_000000000000_" + "a" * 40, "", service.key[:-1] + ("a" if service.key[-1] != "a" else "b")):
        connection = raw_patch(service.url, location, 100 * MB, key)
        try:
            for _ in range(50):
                connection.sendall(b"x" * MB)
        except OSError:  # the server has answered and gone
            pass
        connection.close()
    headers = {"Authorization": f"Bearer {service.key}", **TUS}
    assert int(httpx.head(f"{service.url}{location}", headers=headers).headers["Upload-Offset"]) == 0
    assert list(service.store.blobs.list("scans/")) == []
    assert server.io_counters().write_bytes - before < MB


def test_a_server_that_is_killed_in_mid_upload(service: LiveService, tmp_path: Path) -> None:
    archive = sparse(tmp_path / "scan.zip", 150 * MB)

    def kill() -> None:
        if sent.bytes > 75 * MB and service.server.poll() is None:
            service.server.send_signal(signal.SIGKILL)
            service.server.wait()

    sent = Sent(kill)
    with Client(service.url, service.key, retries=1) as client, pytest.raises(Exception, match="no answer"):
        client.upload(archive, on_bytes=sent)
    service.restart_server()
    again = Sent()
    with service.client() as client:
        upload = client.upload(archive, on_bytes=again)
    assert upload.sha256 == digest(archive)
    assert sent.bytes + again.bytes < (150 + 30) * MB, "only what had not been made durable is sent again"


def test_a_client_that_is_killed_in_mid_upload_goes_on(service: LiveService, tmp_path: Path, scan: Path) -> None:
    sparse(scan / "large.bin", 200 * MB)
    command = [sys.executable, "-m", "advtex_client.cli", "submit", str(scan)]
    environment = os.environ | {"ADVTEX_URL": service.url, "ADVTEX_API_KEY": service.key}

    def partly() -> bool:
        return service.store.uploads.expected_bytes() in range(1, 150 * MB)

    with subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL) as process:
        wait_until(partly, seconds=30)
        process.send_signal(signal.SIGKILL)
        process.wait()
    with service.client() as client:
        sent = Sent()
        job = client.submit(scan, on_bytes=sent)
        assert sent.bytes < 160 * MB
        assert client.get_upload(job.upload_id).complete
        assert service.store.uploads.expected_bytes() == 0, "it went on with the upload of the first run"

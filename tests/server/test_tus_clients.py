"""Resumable uploads by the clients that tus itself gives out: tuspy and tus-js-client."""

from __future__ import annotations

import io
import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import httpx
import pytest
from tusclient.client import TusClient
from tusclient.exceptions import TusCommunicationError

from advtex_store import keys

DATA = os.urandom(20_000_000)
TUS = {"Tus-Resumable": "1.0.0"}
STREAM = {"Content-Type": "application/offset+octet-stream"}


def create(live: Any, size: int = len(DATA), **headers: str) -> str:
    response = live.http.post("/v1/uploads", headers=TUS | {"Upload-Length": str(size)} | headers)
    assert response.status_code == 201, response.text
    return str(response.headers["Location"])


def patch(live: Any, url: str, offset: int, data: Any, **headers: str) -> httpx.Response:
    response: httpx.Response = live.http.patch(
        url, content=data, headers=TUS | STREAM | {"Upload-Offset": str(offset)} | headers
    )
    return response


def stored(live: Any, url: str) -> bytes:
    return bytes(live.store.blobs.get(keys.scan_key(url.rpartition("/")[2])))


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    path = tmp_path / "scan.zip"
    path.write_bytes(DATA)
    return path


def test_tuspy(live: Any) -> None:
    client = TusClient(f"{live.url}/v1/uploads", headers={"Authorization": f"Bearer {live.key}"})
    settings: dict[str, Any] = {"chunk_size": 6_000_000, "metadata": {"filename": "scan.zip"}, "upload_checksum": True}
    first = client.uploader(file_stream=io.BytesIO(DATA), **settings)
    first.upload_chunk()
    first.upload_chunk()
    again = client.uploader(file_stream=io.BytesIO(DATA), url=first.url, **settings)
    assert again.offset == 12_000_000
    again.upload()
    assert stored(live, first.url) == DATA
    stranger = TusClient(f"{live.url}/v1/uploads", headers={"Authorization": "Bearer wrong"})
    with pytest.raises(TusCommunicationError):
        stranger.uploader(file_stream=io.BytesIO(DATA)).upload()


@pytest.fixture(scope="module")
def tus_js(request: pytest.FixtureRequest) -> Path:
    """A folder in pytest's cache with tus-js-client installed."""
    npm = shutil.which("npm")
    if npm is None:
        pytest.skip("npm is not installed: it provides tus-js-client")
    assert request.config.cache is not None
    folder = Path(request.config.cache.mkdir("tus_js"))
    for name in ("package.json", "upload.cjs"):
        shutil.copy(Path(__file__).parent / "tus_js" / name, folder)
    if not (folder / "node_modules" / "tus-js-client").is_dir():
        command = [npm, "install", "--no-save", "--no-audit", "--no-fund", "--ignore-scripts"]
        subprocess.run(command, cwd=folder, check=True, capture_output=True, timeout=240)
    return folder


@pytest.mark.slow
def test_tus_js_client(live: Any, archive: Path, tus_js: Path) -> None:
    def run(*arguments: str) -> dict[str, Any]:
        command = ["node", "upload.cjs", f"{live.url}/v1/uploads", live.key, str(archive), *arguments]
        done = subprocess.run(command, cwd=tus_js, capture_output=True, text=True, timeout=60)
        assert done.returncode == 0, done.stderr
        return dict(json.loads(done.stdout))

    whole = run("6000000")
    assert whole["accepted"] == [6_000_000, 12_000_000, 18_000_000, 20_000_000]
    assert stored(live, whole["url"]) == DATA
    assert live.http.get(whole["url"]).json()["filename"] == "scän.zip"
    begun = create(live)
    patch(live, begun, 0, DATA[:11_000_000])
    resumed = run("6000000", f"{live.url}{begun}")
    assert resumed["accepted"] == [17_000_000, 20_000_000]
    assert stored(live, begun) == DATA

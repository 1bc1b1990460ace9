"""The examples of `client/examples`, as processes of their own, at a real service over a line that breaks."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from cutting_proxy import CuttingProxy
from live_service import LiveService, live_service, wait_until
from tiny_scan import write_scan, write_zip

from advtex_server.embedded import free_port

EXAMPLES = Path(__file__).parents[2] / "client" / "examples"
BEYOND = 40 << 20  # more than two of the pieces in which the examples send

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveService]:
    webhooks = {"ADVTEX_WEBHOOK_ALLOW_HTTP": "true", "ADVTEX_WEBHOOK_NETWORKS": '["127.0.0.0/8"]'}
    with live_service(tmp_path_factory.mktemp("examples"), settings=webhooks) as running:
        running.start_worker("quick")
        yield running


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scan")
    path = write_zip(folder / "kitchen.zip", write_scan(folder / "scan"))
    with zipfile.ZipFile(path, "a") as bundle:
        bundle.writestr("notes.bin", os.urandom(BEYOND))
    return path


def run(name: str, url: str, key: str, *arguments: Path) -> subprocess.CompletedProcess[str]:
    program = sys.executable if name.endswith(".py") else shutil.which("node")
    if program is None:
        pytest.skip("node is not installed")
    command = [program, str(EXAMPLES / name), *map(str, arguments)]
    environment = {**os.environ, "ADVTEX_URL": url, "ADVTEX_API_KEY": key}
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, check=False)


@pytest.mark.parametrize("name", ["upload.py", "upload.mjs"])
def test_a_scan_is_sent_over_a_line_that_breaks_and_its_model_comes_back(
    service: LiveService, archive: Path, tmp_path: Path, name: str
) -> None:
    with CuttingProxy(service.url, seed=1, least=10 << 20, most=25 << 20) as line:
        done = run(name, line.url, service.key, archive, tmp_path / "model.glb")
    assert done.returncode == 0, done.stderr
    assert line.cuts > 0
    with service.client() as client:
        job = next(job for job in client.list_jobs() if job.label.startswith("kitchen"))
        (glb,) = client.download_results(job, tmp_path / "again", names=["model.glb"])
    assert (tmp_path / "model.glb").read_bytes() == glb.read_bytes()


@pytest.mark.parametrize("name", ["upload.py", "upload.mjs"])
def test_what_is_refused_is_said_with_the_place_that_explains_it(
    service: LiveService, archive: Path, tmp_path: Path, name: str
) -> None:
    done = run(name, service.url, "adv_wrong", archive, tmp_path / "model.glb")
    assert done.returncode != 0
    assert f"{service.url}/errors#unauthorized" in done.stderr


def test_a_webhook_is_believed_only_with_its_signature(service: LiveService, scan: Path) -> None:
    port = free_port()
    address = f"http://127.0.0.1:{port}/"
    with service.client() as client:
        headers = {"Authorization": f"Bearer {service.key}"}
        made = httpx.post(f"{service.url}/v1/webhooks", json={"url": address}, headers=headers).json()
        environment = {**os.environ, "ADVTEX_WEBHOOK_SECRET": made["secret"]}
        command = [sys.executable, str(EXAMPLES / "webhook.py"), str(port)]
        with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as receiver:
            try:
                wait_until(lambda: _status(address) == 401, 30)
                job = client.submit(scan, label="signed")
                assert receiver.stdout is not None
                assert receiver.stdout.readline() == f"job.succeeded {job.id} signed\n"
            finally:
                receiver.kill()


def _status(address: str) -> int | None:
    try:
        return httpx.post(address, json={"type": "job.succeeded", "data": {"id": "forged", "label": ""}}).status_code
    except httpx.TransportError:
        return None

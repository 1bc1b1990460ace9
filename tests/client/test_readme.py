"""client/README.md: its programs run, and what it lists is what there is."""

from __future__ import annotations

import base64
import json
import re
import threading
from collections.abc import Iterator
from datetime import UTC, datetime
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import httpx
import pytest
from fake_server import FakeServer, error, ok
from standardwebhooks import Webhook, WebhookVerificationError
from tiny_scan import write_scan

from advtex_client._cli import EXIT_CODES, INTERRUPTED, USAGE
from advtex_contract.errors import ErrorCode
from advtex_contract.jobs import TERMINAL, JobPage

ROOT = Path(__file__).parents[2]
README = (ROOT / "client" / "README.md").read_text(encoding="utf-8")
SYNC, ASYNC, RECEIVER = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
RESULTS = {"model.glb": b"glb", "previews/0.jpg": b"jpeg"}


class Finishing(FakeServer):
    """Jobs have succeeded when they are asked for the second time, and are listed by label."""

    def answer(self, request: httpx.Request) -> httpx.Response:
        if request.headers["Authorization"] != "Bearer adv_key":
            return error(401, ErrorCode.unauthorized)
        if request.method == "GET" and request.url.path == "/v1/jobs":
            label = request.url.params["label"]
            return ok(JobPage(jobs=[job for job in self.jobs.values() if job.label == label]))
        answer = super().answer(request)
        name = request.url.path.removeprefix("/v1/jobs/")
        if request.method == "GET" and name in self.jobs and self.jobs[name].state not in TERMINAL:
            self.finish(name, RESULTS)
        return answer


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[Finishing]:
    """The fake server behind a socket, named by the environment as the page says."""
    fake, lock = Finishing(), threading.Lock()

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def handle_any(self) -> None:
            body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
            url = f"http://{self.headers['Host']}{self.path}"
            with lock:
                answer = fake.handle(httpx.Request(self.command, url, headers=self.headers.items(), content=body))
            self.send_response_only(answer.status_code)
            for name, value in answer.headers.items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(answer.content)

        do_GET = do_POST = do_PATCH = handle_any  # noqa: N815  http.server looks them up by these names

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as socket:
        thread = threading.Thread(target=socket.serve_forever, args=(0.01,))
        thread.start()
        monkeypatch.setenv("ADVTEX_URL", f"http://127.0.0.1:{socket.server_port}")
        monkeypatch.setenv("ADVTEX_API_KEY", "adv_key")
        monkeypatch.setattr("advtex_client._events.POLL_SECONDS", 0.01)
        yield fake
        socket.shutdown()
        thread.join()


@pytest.fixture(autouse=True)
def in_its_own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def run(program: str, **names: object) -> None:
    exec(compile(program, "client/README.md", "exec"), {"__name__": "__main__"} | names)


def test_the_sync_program_textures_a_scan(server: Finishing, scan: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run(SYNC)
    (job,) = server.jobs.values()
    assert (job.label, job.options.preset, job.options.width) == ("kitchen", "standard", 640)
    assert {name: Path("result", name).read_bytes() for name in RESULTS} == RESULTS
    said = capsys.readouterr().out.splitlines()
    assert said[0].split() == ["queued", "0"]
    assert said[-2:] == [str(Path("result", name)) for name in RESULTS]


def test_the_sync_program_says_what_is_wrong_with_a_scan(
    server: Finishing, scan: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (scan / "scan.json").write_text("{")
    run(SYNC)
    assert capsys.readouterr().out.startswith("scan.json: ")
    assert server.requests == []


def test_the_async_program_textures_many_scans(server: Finishing, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("kitchen", "hall"):
        (write_scan(Path("scans", name)) / "note.txt").write_text(name)
    run(ASYNC)
    assert sorted(job.label for job in server.jobs.values()) == ["hall", "kitchen"]
    for name in ("kitchen", "hall"):
        assert Path("results", name, "model.glb").read_bytes() == b"glb"
        assert not Path("results", name, "previews").exists()
    (kitchen,) = (job.id for job in server.jobs.values() if job.label == "kitchen")
    assert capsys.readouterr().out.endswith(f"\n{kitchen} succeeded\n")


def test_the_receiver_of_webhooks_takes_what_is_signed(capsys: pytest.CaptureFixture[str]) -> None:
    secret, now = "whsec_" + base64.b64encode(bytes(24)).decode(), datetime.now(UTC)
    body = json.dumps({"type": "job.succeeded", "timestamp": now.isoformat(), "data": {"id": "j0"}})
    headers = {"webhook-id": "1", "webhook-timestamp": str(int(now.timestamp()))}
    headers["webhook-signature"] = Webhook(secret).sign("1", now, body)
    run(RECEIVER, secret=secret, body=body, headers=headers)
    assert capsys.readouterr().out == "job.succeeded j0\n"
    with pytest.raises(WebhookVerificationError):
        run(RECEIVER, secret=secret, body=body.replace("j0", "j1"), headers=headers)


def test_every_call_of_curl_is_one_of_the_api() -> None:
    paths = json.loads((ROOT / "tests/server/openapi.json").read_text())["paths"]
    known = {(method, re.sub(r"\{\w+\}", "<>", path)) for path, methods in paths.items() for method in methods}
    lines = [line for line in README.replace("\\\n", "").splitlines() if line.startswith("    ") and "curl " in line]
    assert len(lines) > 20
    for line in lines:
        method = re.search(r"-X (\w+)", line)
        default = "head" if " -I " in line else "post" if "--json" in line else "get"
        (path,) = re.findall(r'"\$url(/[^"?]*)', line)
        path = re.sub(r"<\w+>|(?<=batches/)night|(?<=results/)[\w.]+", "<>", path)
        assert (method[1].lower() if method else default, path) in known, line


def test_the_exit_codes_are_those_of_the_command() -> None:
    listed = {int(code) for code in re.findall(r"^\| (\d+) \|", README, re.MULTILINE)}
    assert listed == {0, USAGE, INTERRUPTED, *EXIT_CODES.values()}


def test_the_variables_are_those_that_the_client_reads() -> None:
    sources = "".join(path.read_text() for path in (ROOT / "client/advtex_client").glob("*.py"))
    read = set(re.findall(r'environ\.get\("(ADVTEX_\w+)"', sources))
    assert set(re.findall(r"^\| `(ADVTEX_\w+)`", README, re.MULTILINE)) == read

"""Webhooks from the API to a receiver on a real socket, and where they may not go."""

from __future__ import annotations

import datetime
import json
import socket
import ssl
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from ipaddress import ip_network
from pathlib import Path
from typing import Any

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from standardwebhooks import Webhook

from advtex_contract.jobs import JobError
from advtex_server.targets import TargetRefused, TargetRules
from advtex_store import webhooks as outbox
from advtex_store.models import WebhookRow

LOOPBACK = [ip_network("127.0.0.0/8")]
pytestmark = pytest.mark.one_machine("the outbox runs on both databases in tests/store")


class Receiver:
    """Answers with `answers` in turn, the last one for ever; keeps what it got."""

    def __init__(self, *answers: int, tls: ssl.SSLContext | None = None) -> None:
        self.got: list[tuple[dict[str, str], bytes]] = []
        self._answers = list(answers) or [204]
        self._news = threading.Condition()
        receiver = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"]))
                receiver._take(dict(self.headers), body)
                self.send_response(receiver._answers[0])
                if len(receiver._answers) > 1:
                    receiver._answers.pop(0)
                self.send_header("Location", "/elsewhere")
                self.send_header("Content-Length", "0")
                self.end_headers()

            def log_message(self, *_: object) -> None:
                """Quiet."""

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        if tls is not None:
            self._server.socket = tls.wrap_socket(self._server.socket, server_side=True)
        self.port = int(self._server.server_address[1])
        self._thread = threading.Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.05})
        self._thread.start()

    def wait(self, count: int) -> list[tuple[dict[str, str], bytes]]:
        with self._news:
            assert self._news.wait_for(lambda: len(self.got) >= count, timeout=20), f"{len(self.got)} came"
        return self.got

    def stop(self) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def _take(self, headers: dict[str, str], body: bytes) -> None:
        with self._news:
            self.got.append((headers, body))
            self._news.notify_all()


@contextmanager
def receiver(*answers: int, tls: ssl.SSLContext | None = None) -> Iterator[Receiver]:
    running = Receiver(*answers, tls=tls)
    try:
        yield running
    finally:
        running.stop()


@pytest.fixture(autouse=True)
def _fast(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outbox, "PAUSES", (0.05,) * len(outbox.PAUSES))
    monkeypatch.setattr("advtex_server.deliveries.LOOK_SECONDS", 0.02)


@pytest.fixture
def local(make_live: Callable[..., Any]) -> Any:
    """A server whose webhooks may go to this machine."""
    return make_live(webhook_allow_http=True, webhook_networks=("127.0.0.0/8",))


def hook(live: Any, url: str, **spec: object) -> dict[str, Any]:
    response = live.http.post("/v1/webhooks", json={"url": url, **spec})
    assert response.status_code == 201, response.text
    return dict(response.json())


def fail_a_job(live: Any, scan: Path, message: str = "it broke") -> str:
    job = str(live.job(live.upload(scan.read_bytes()))["id"])
    live.store.records.claim(job, 1, "w")
    live.store.records.fail(job, 1, JobError(code="engine_error", message=message))
    return job


def until(live: Any, webhook: str, condition: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
    pause = threading.Event()
    for _ in range(500):
        view = dict(live.http.get(f"/v1/webhooks/{webhook}").json())
        if condition(view):
            return view
        pause.wait(0.02)
    pytest.fail(f"not in time: {view}")


def test_news_arrive_signed(local: Any, scan_zip: Path) -> None:
    with receiver() as there:
        made = hook(local, f"http://127.0.0.1:{there.port}/path?q=1")
        job = fail_a_job(local, scan_zip)
        ((headers, body),) = there.wait(1)
        told = Webhook(made["secret"]).verify(body, headers)
        assert (told["type"], told["data"]["id"], told["data"]["state"]) == ("job.failed", job, "failed")
        assert headers["Host"] == f"127.0.0.1:{there.port}"
        with pytest.raises(Exception, match="No matching signature"):
            Webhook(made["secret"]).verify(body.replace(b"failed", b"better"), headers)
        assert "secret" not in {k for k, v in local.http.get(f"/v1/webhooks/{made['id']}").json().items() if v}


def test_the_states_that_were_chosen_and_no_others(local: Any, scan_zip: Path) -> None:
    with receiver() as there:
        hook(local, f"http://127.0.0.1:{there.port}/", events=["queued", "failed"])
        fail_a_job(local, scan_zip)
        assert [json.loads(body)["type"] for _, body in there.wait(2)] == ["job.queued", "job.failed"]
    assert local.http.post("/v1/webhooks", json={"url": "https://x", "events": ["uploading"]}).status_code == 422
    assert local.http.post("/v1/webhooks", json={"url": "https://x", "events": []}).status_code == 422


def test_tries_are_repeated_with_the_same_id(local: Any, scan_zip: Path) -> None:
    with receiver(500, 503, 200) as there:
        made = hook(local, f"http://127.0.0.1:{there.port}/")
        fail_a_job(local, scan_zip)
        got = there.wait(3)
        assert len({headers["webhook-id"] for headers, _ in got}) == 1
        assert len({body for _, body in got}) == 1
        until(local, made["id"], lambda view: view["failures"] == 0)


def test_a_dead_receiver_is_disabled_and_holds_up_nobody(local: Any, scan_zip: Path) -> None:
    with socket.socket() as unheard, receiver() as there:
        unheard.bind(("127.0.0.1", 0))  # refuses connections
        dead = hook(local, f"http://127.0.0.1:{unheard.getsockname()[1]}/")
        hook(local, f"http://127.0.0.1:{there.port}/")
        fail_a_job(local, scan_zip)
        there.wait(1)
        view = until(local, dead["id"], lambda view: view["disabled_at"] is not None)
        assert view["failures"] == outbox.MOST_FAILURES
        assert "ConnectError" in view["last_error"]
        again = local.http.post(f"/v1/webhooks/{dead['id']}/enable").json()
        assert (again["disabled_at"], again["failures"]) == (None, 0)


def test_what_cannot_be_sent_counts_as_failed_and_holds_up_nobody(local: Any, scan_zip: Path) -> None:
    """Else it would be tried for ever, and nobody would be told."""
    with receiver() as there:
        bad, good = (hook(local, f"http://127.0.0.1:{there.port}/{name}")["id"] for name in ("bad", "good"))
        with local.store.database.write() as session:
            session.get(WebhookRow, bad).secret = "whsec_a"
        fail_a_job(local, scan_zip)
        view = until(local, bad, lambda view: view["disabled_at"] is not None)
        assert view["last_error"].startswith("it cannot be sent: the server failed (")
        there.wait(1)
        assert until(local, good, lambda view: view["failures"] == 0)["disabled_at"] is None


def test_redirects_are_not_followed(local: Any, scan_zip: Path) -> None:
    with receiver(302) as there:
        made = hook(local, f"http://127.0.0.1:{there.port}/")
        fail_a_job(local, scan_zip)
        view = until(local, made["id"], lambda view: view["failures"] > 0)
        assert view["last_error"] == "it answered 302; redirects are not followed"


def test_a_receiver_that_says_gone_is_left_alone(local: Any, scan_zip: Path) -> None:
    with receiver(410) as there:
        made = hook(local, f"http://127.0.0.1:{there.port}/")
        fail_a_job(local, scan_zip)
        until(local, made["id"], lambda view: view["disabled_at"] is not None)
        assert len(there.got) == 1


def test_others_do_not_see_them(local: Any, is_error: Any) -> None:
    made = hook(local, "http://127.0.0.1:9/")
    assert [view["id"] for view in local.http.get("/v1/webhooks").json()["webhooks"]] == [made["id"]]
    with local.client(local.store.accounts.create_key("other")) as other:
        assert other.get("/v1/webhooks").json() == {"webhooks": []}
        for call in (other.get, other.delete):
            is_error(call(f"/v1/webhooks/{made['id']}"), 404, "not_found")
        is_error(other.post(f"/v1/webhooks/{made['id']}/enable"), 404, "not_found")
    assert local.http.delete(f"/v1/webhooks/{made['id']}").status_code == 204
    is_error(local.http.get(f"/v1/webhooks/{made['id']}"), 404, "not_found")


def test_tls_checks_the_name_although_the_address_is_pinned(
    make_live: Callable[..., Any], scan_zip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    certificate = write_certificate(tmp_path, "receiver.example")
    monkeypatch.setenv("SSL_CERT_FILE", str(certificate))
    real = socket.getaddrinfo
    names = {"receiver.example": "127.0.0.1", "impostor.example": "127.0.0.1"}
    monkeypatch.setattr(socket, "getaddrinfo", lambda host, *a, **k: real(names.get(host, host), *a, **k))
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate, tmp_path / "key.pem")
    live = make_live(webhook_networks=("127.0.0.0/8",))
    with receiver(tls=context) as there:
        wrong = hook(live, f"https://impostor.example:{there.port}/")
        fail_a_job(live, scan_zip)
        view = until(live, wrong["id"], lambda view: view["failures"] > 0)
        assert "CERTIFICATE_VERIFY_FAILED" in view["last_error"]
        assert there.got == []
        hook(live, f"https://receiver.example:{there.port}/")
        fail_a_job(live, scan_zip)
        ((headers, _),) = there.wait(1)
        assert headers["Host"] == f"receiver.example:{there.port}"


def write_certificate(folder: Path, name: str) -> Path:
    """Self-signed, with its key beside it."""
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, name)])
    now = datetime.datetime.now(datetime.UTC)
    certificate = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(subject)
        .public_key(key.public_key())
        .serial_number(1)
        .not_valid_before(now - datetime.timedelta(days=1))
        .not_valid_after(now + datetime.timedelta(days=1))
        .add_extension(x509.SubjectAlternativeName([x509.DNSName(name)]), critical=False)
        .add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
        .sign(key, hashes.SHA256())
    )
    plain = serialization.NoEncryption()
    pem = serialization.Encoding.PEM
    (folder / "key.pem").write_bytes(key.private_bytes(pem, serialization.PrivateFormat.PKCS8, plain))
    path = folder / "certificate.pem"
    path.write_bytes(certificate.public_bytes(pem))
    return path


TARGETS = {
    "loopback": "127.0.0.1",
    "loopback as a number": "2130706433",
    "loopback in hexadecimal": "0x7f000001",
    "loopback in short": "127.1",
    "loopback by name": "localhost",
    "this host": "0.0.0.0",
    "loopback, IPv6": "[::1]",
    "unspecified, IPv6": "[::]",
    "loopback, mapped": "[::ffff:127.0.0.1]",
    "loopback, NAT64": "[64:ff9b::7f00:1]",
    "loopback, NAT64 of its own network": "[64:ff9b:1::7f00:1]",
    "loopback, 6to4": "[2002:7f00:1::]",
    "loopback, Teredo": "[2001:0:101:101::80ff:fffe]",
    "Teredo of a public host": "[2001:0:101:101::fefe:fefe]",
    "loopback, IPv4-compatible": "[::127.0.0.1]",
    "loopback, translated": "[::ffff:0:7f00:1]",
    "cloud metadata": "169.254.169.254",
    "cloud metadata, mapped": "[::ffff:169.254.169.254]",
    "cloud metadata, IPv6": "[fd00:ec2::254]",
    "private 10/8": "10.0.0.1",
    "private 172.16/12": "172.16.0.1",
    "private 192.168/16": "192.168.1.1",
    "carrier-grade NAT": "100.64.0.1",
    "link-local, IPv6": "[fe80::1]",
    "site-local, IPv6": "[fec0::1]",
    "not given out, IPv6": "[4000::1]",
    "multicast": "224.0.0.1",
    "broadcast": "255.255.255.255",
    "documentation": "192.0.2.1",
}


@pytest.mark.parametrize("host", TARGETS.values(), ids=TARGETS.keys())
def test_addresses_that_are_not_public_are_refused(host: str) -> None:
    with pytest.raises(TargetRefused, match="not a public one"):
        TargetRules().resolve(f"https://{host}/")


def test_the_api_refuses_them_too(live: Any, is_error: Any) -> None:
    for host in TARGETS.values():
        response = live.http.post("/v1/webhooks", json={"url": f"https://{host}/"})
        assert "not a public one" in is_error(response, 422, "bad_request")
    assert live.http.get("/v1/webhooks").json() == {"webhooks": []}


@pytest.mark.parametrize(
    "url",
    [
        "http://1.1.1.1/",
        "file:///etc/passwd",
        "gopher://1.1.1.1/",
        "https://",
        "https:///path",
        "https://user:password@1.1.1.1/",
        "https://1.1.1.1:0/",
        "https://1.1.1.1:99999/",
        "https://1.1.1.1/\r\nHost: other",
        "https://1.1.1.1\\@127.0.0.1/",
        "https://exämple.org/",
        "not a url",
    ],
)
def test_urls_that_are_none_for_webhooks(url: str) -> None:
    with pytest.raises(TargetRefused):
        TargetRules().resolve(url)


def test_how_long_they_are_tried_is_described(live: Any) -> None:
    text = live.http.get("/openapi.json").json()["paths"]["/v1/webhooks"]["post"]["description"]
    assert f"after {outbox.MOST_FAILURES} tries" in text
    assert f"within {outbox.KEPT_SECONDS / 86400:g} days" in text


def test_a_name_is_resolved_once_and_its_address_is_pinned(monkeypatch: pytest.MonkeyPatch) -> None:
    """DNS rebinding: a public address for the check, and loopback a moment later."""
    answers = [["1.1.1.1"], ["127.0.0.1"]]

    def resolve(_host: str, port: int, **_: object) -> list[Any]:
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, "", (address, port)) for address in answers.pop(0)]

    monkeypatch.setattr(socket, "getaddrinfo", resolve)
    target = TargetRules().resolve("https://rebinding.example/path?a=b")
    assert (target.url, target.host) == ("https://1.1.1.1:443/path?a=b", "rebinding.example")
    assert len(answers) == 1
    answers[:] = [["1.1.1.1", "10.0.0.1"]]
    with pytest.raises(TargetRefused, match=r"10\.0\.0\.1"):
        TargetRules().resolve("https://one-of-two.example/")


@pytest.mark.parametrize("host", ["1.1.1.1", "[2606:4700:4700::1111]", "[64:ff9b::101:101]", "[2002:101:101::1]"])
def test_public_addresses_are_allowed(host: str) -> None:
    assert host in TargetRules().resolve(f"https://{host}/").url


def test_what_the_operator_allows_is_allowed() -> None:
    rules = TargetRules(allow_http=True, networks=LOOPBACK)
    assert rules.resolve("http://127.0.0.1:8080/x").url == "http://127.0.0.1:8080/x"
    with pytest.raises(TargetRefused):
        rules.resolve("http://10.0.0.1/")
    local = TargetRules(networks=[ip_network("fd00::/8")])
    assert local.resolve("https://[fd00::1]/").url == "https://[fd00::1]:443/"

"""`advtex-client doctor`: what is looked at, what is said, and the exit codes."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path

import httpx
import pytest
from fake_server import FakeServer, Fault, answers, breaks, refuses
from typer.testing import CliRunner, Result

from advtex_client import cli
from advtex_client.client import Client
from advtex_client.config import embedded_file
from advtex_contract.errors import ErrorCode
from advtex_contract.health import KeyView, PartView, Readiness


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> FakeServer:
    made = FakeServer()

    def connect(url: str | None, api_key: str | None) -> Client:
        return Client(url, api_key, transport=made.transport)

    monkeypatch.setattr(cli, "Client", connect)
    monkeypatch.setenv("ADVTEX_URL", "http://server.test")
    monkeypatch.setenv("ADVTEX_API_KEY", "k")
    return made


def doctor(*arguments: str) -> Result:
    return CliRunner().invoke(cli.app, ["doctor", *arguments])


def failing(ran: Result) -> list[str]:
    return [line.split()[1].rstrip(":") for line in ran.stdout.splitlines() if line.startswith("FAIL")]


def test_all_is_well(server: FakeServer, tmp_path: Path) -> None:
    ran = doctor()
    assert ran.exit_code == 0, ran.output
    assert failing(ran) == []
    assert "http://server.test from the environment, key from the environment" in ran.stdout
    assert "0123 may read, write" in ran.stdout
    assert str(tmp_path / "state" / "advtex") in ran.stdout
    assert list((tmp_path / "state" / "advtex").iterdir()) == []


def test_where_address_and_key_come_from(server: FakeServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("ADVTEX_URL")
    embedded_file().parent.mkdir(parents=True)
    embedded_file().write_text(json.dumps({"url": "http://local.test", "api_key": "other"}))
    assert f"http://local.test from {embedded_file()}, key from the environment" in doctor().stdout
    assert "http://flag.test from the call, key from the environment" in doctor("--url", "http://flag.test").stdout
    monkeypatch.delenv("ADVTEX_API_KEY")
    assert "http://flag.test from the call, no key" in doctor("--url", "http://flag.test").stdout


def test_without_any_configuration_it_says_where_one_could_be(monkeypatch: pytest.MonkeyPatch) -> None:
    ran = doctor()
    assert ran.exit_code == 2
    assert "ADVTEX_URL" in ran.stderr


@pytest.mark.parametrize("fault", [refuses, breaks, answers(502)])
def test_a_server_that_does_not_answer_is_6(server: FakeServer, fault: Fault) -> None:
    server.faults = [fault]
    ran = doctor()
    assert (ran.exit_code, failing(ran)) == (6, ["server"])
    assert "memory" in ran.stdout, "the rest is looked at all the same"


def test_another_server_s_page_is_told_apart(server: FakeServer) -> None:
    server.faults = [lambda _: httpx.Response(200, text="<html>welcome</html>")]
    ran = doctor()
    assert (ran.exit_code, failing(ran)) == (2, ["server"])
    assert "not an advtex server's" in ran.stdout


@pytest.mark.parametrize(("essential", "exit_code"), [(True, 6), (False, 0)])
def test_what_does_not_work_in_the_server_is_said(server: FakeServer, essential: bool, exit_code: int) -> None:
    part = PartView(ok=False, essential=essential, message="no room: delete something")
    well = PartView(ok=True, essential=True)
    server.readiness = Readiness(ready=not essential, checks={"disk": part, "database": well})
    ran = doctor()
    assert ran.exit_code == exit_code
    assert "FAIL disk: no room: delete something" in ran.stdout
    assert "database" not in ran.stdout
    report = json.loads(doctor("--json").stdout)
    assert report["ok"] is not essential
    assert {"name": "disk", "ok": False, "message": part.message} in report["checks"]


def test_a_proxy_s_503_is_no_readiness(server: FakeServer) -> None:
    def proxy(_request: httpx.Request) -> httpx.Response:
        return httpx.Response(503, text="upstream is away")

    server.faults = [server.answer, proxy]
    ran = doctor()
    assert (ran.exit_code, failing(ran)) == (6, ["readiness"])
    assert "upstream is away" in ran.stdout


@pytest.mark.parametrize("fault", [answers(401, ErrorCode.unauthorized), answers(403, ErrorCode.forbidden)])
def test_a_key_that_is_refused_is_3(server: FakeServer, fault: Fault) -> None:
    server.faults = [server.answer, server.answer, fault]
    ran = doctor()
    assert (ran.exit_code, failing(ran)) == (3, ["key"])


def test_limits_and_the_end_of_a_key_are_told(server: FakeServer) -> None:
    end = datetime(2030, 1, 2, tzinfo=UTC)
    server.key = KeyView(
        id="0", scopes=["read"], expires_at=end, active_jobs=2, max_active_jobs=9, bytes=5, max_bytes=10
    )
    assert "0 may read; 2 of 9 active jobs; 5 of 10 bytes; until 2030-01-02 00:00 UTC" in doctor().stdout


def test_a_folder_that_cannot_be_written_is_2(
    server: FakeServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "file"))
    ran = doctor()
    assert (ran.exit_code, failing(ran)) == (2, ["memory"])
    assert "XDG_STATE_HOME" in ran.stdout

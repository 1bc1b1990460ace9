"""Streams end with the right to follow them."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from sqlalchemy.exc import OperationalError

from advtex_server import authentication, browsers, streams
from advtex_store.accounts import Caller

pytestmark = pytest.mark.one_machine("who may follow is asked as for every other call")


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every message is asked about, and nobody is known from before."""
    monkeypatch.setattr(streams, "ASK_SECONDS", 0.0)
    for module in (authentication, browsers):
        monkeypatch.setattr(module, "KNOWN_SECONDS", 0.0)


def messages(response: httpx.Response) -> list[str]:
    return [line for line in response.iter_lines() if line.startswith("event: ")]


@pytest.mark.usefixtures("impatient")
def test_a_revoked_key_sees_nothing_more(live: Any, scan_zip: Path) -> None:
    job = live.job(live.upload(scan_zip.read_bytes()))["id"]
    with live.client(live.store.accounts.create_key("second", owner="me")) as other:
        with live.http.stream("GET", f"/v1/jobs/{job}/events") as stream:
            lines = stream.iter_lines()
            for _ in ("checking", "queued"):
                assert next(line for line in lines if line.startswith("event: ")) == "event: state"
            assert next(line for line in lines if line.startswith("event: ")) == "event: job"
            live.store.accounts.revoke_key(live.key.split("_")[1])
            assert other.post(f"/v1/jobs/{job}/cancel").status_code == 200
            assert [line for line in lines if line.startswith("event: ")] == []
        with other.stream("GET", f"/v1/jobs/{job}/events") as stream:
            assert messages(stream)[-1] == "event: job"


@pytest.mark.usefixtures("impatient")
def test_a_page_that_is_signed_out_sees_nothing_more(live: Any) -> None:
    upload = live.upload()
    with live.client(None) as browser:
        browser.post("/sign-in", data={"key": live.key}, headers={"Origin": live.url})
        first = live.job(upload)["id"]
        with browser.stream("GET", "/changes") as stream:
            lines = stream.iter_lines()
            assert first in next(line for line in lines if line.startswith("data: "))
            assert browser.post("/sign-out", headers={"Origin": live.url}).status_code == 303
            live.job(upload)
            assert [line for line in lines if line.startswith("event: ")] == []


@pytest.mark.usefixtures("impatient")
def test_a_database_that_is_away_ends_no_stream() -> None:
    caller = Caller("id", "me", frozenset({"read"}))
    answers: list[Caller | Exception | None] = [OperationalError("select", {}, OSError("away")), caller, None, caller]

    async def ask() -> Caller | None:
        answer = answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer

    async def events() -> AsyncIterator[str]:
        for event in "abcd":
            yield event

    async def seen() -> list[str]:
        return [event async for event in streams.while_welcome(events(), ask)]

    assert asyncio.run(seen()) == ["a", "b"]

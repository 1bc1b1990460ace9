"""What goes on in the background goes on, whatever fails in it, and health and metrics tell of it."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from redis import ConnectionError as RedisAway

from advtex_server.dispatch import Dispatcher
from advtex_server.loops import Loop
from advtex_store.checks import Checks
from advtex_store.webhooks import Webhooks

pytestmark = pytest.mark.one_machine("the loops are the same on both")
KINDS = {"check-0", "check-1", "dispatch", "housekeeping", "webhooks"}


def until(true: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 20
    while not true():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_a_turn_that_fails_is_told_until_one_goes_well() -> None:
    loop = Loop("webhooks")
    for error in (RedisAway("away"), ZeroDivisionError("a flaw")):
        with loop.turn():
            raise error
        assert loop.failing_seconds > 0
    assert loop.trouble.startswith("webhooks has failed since 2")
    assert loop.trouble.endswith("ZeroDivisionError: a flaw")
    with loop.turn():
        pass
    assert (loop.failing_seconds, loop.trouble) == (0.0, "")


def test_a_loop_that_is_to_end_ends() -> None:
    async def run() -> None:
        with Loop("webhooks").turn():
            raise asyncio.CancelledError

    with pytest.raises(asyncio.CancelledError):
        asyncio.run(run())


@pytest.mark.parametrize(
    ("owner", "method", "loop"), [(Webhooks, "take_due", "webhooks"), (Checks, "claim", "check-0")]
)
def test_a_flaw_ends_no_loop_and_health_tells_of_it(
    make_live: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, owner: type, method: str, loop: str, redis_url: str
) -> None:
    mended = threading.Event()
    whole = getattr(owner, method)

    def flawed(self: Any, *arguments: Any) -> Any:
        if not mended.is_set():
            raise ZeroDivisionError("a flaw")
        return whole(self, *arguments)

    monkeypatch.setattr("advtex_server.deliveries.LOOK_SECONDS", 0.02)
    monkeypatch.setattr(owner, method, flawed)
    live = make_live(redis_url=redis_url)

    def background() -> dict[str, Any]:
        return dict(live.http.get("/readyz").json()["checks"]["background"])

    until(lambda: loop in background()["message"])
    told = background()
    assert not told["ok"]
    assert not told["essential"]
    assert "ZeroDivisionError: a flaw" in told["message"]
    lines = [
        line.split() for line in live.http.get("/metrics").text.splitlines() if line.startswith("advtex_background")
    ]
    assert {name.split('"')[1] for name, _ in lines} == KINDS
    assert {name.split('"')[1] for name, seconds in lines if float(seconds) > 0} >= {loop}
    mended.set()
    until(lambda: bool(background()["ok"]))


def test_a_server_without_background_tells_of_none(tmp_path: Path) -> None:
    from advtex_server.app import create_app
    from advtex_server.settings import ServerSettings

    assert create_app(ServerSettings(data_dir=tmp_path), dispatch=False).state.service.loops == ()


def test_a_flaw_in_one_step_of_housekeeping_keeps_no_other(live: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    dispatcher, done = Dispatcher(live.store, live.settings), list[str]()

    def flawed() -> None:
        raise ZeroDivisionError("a flaw")

    monkeypatch.setattr(dispatcher.retention, "expire", flawed)
    monkeypatch.setattr(live.store.blobs, "clear_spool", lambda _age: done.append("spool"))
    with pytest.raises(ZeroDivisionError):
        dispatcher.reconcile()
    assert "spool" in done

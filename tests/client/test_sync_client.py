"""The sync client is made of the async one, and offers the same."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import pytest

import make_sync_client
from advtex_client import AsyncClient, Client

METHODS = sorted(name for name in vars(AsyncClient) if not name.startswith("_"))


def test_the_sync_client_is_what_the_async_one_gives() -> None:
    committed = make_sync_client.TARGET.read_text(encoding="utf-8")
    same = committed == make_sync_client.sync_client()
    assert same, (
        "client/advtex_client/client.py is not what client/advtex_client/async_client.py gives: "
        "edit async_client.py alone, then run `.venv/bin/python client/make_sync_client.py` and commit both files"
    )


def test_both_clients_have_the_same_methods() -> None:
    assert sorted(name for name in vars(Client) if not name.startswith("_")) == METHODS
    assert {"__enter__", "__exit__"} <= vars(Client).keys()
    assert {"__aenter__", "__aexit__"} <= vars(AsyncClient).keys()


@pytest.mark.parametrize("name", METHODS)
def test_a_method_is_the_same_in_both_clients_but_for_the_waiting(name: str) -> None:
    waits, plain = getattr(AsyncClient, name), getattr(Client, name)
    assert _parameters(waits) == _parameters(plain)
    assert (
        inspect.signature(waits).return_annotation.removeprefix("Async") == inspect.signature(plain).return_annotation
    )
    assert inspect.getdoc(waits) == inspect.getdoc(plain)
    assert inspect.iscoroutinefunction(waits) or inspect.isasyncgenfunction(waits)
    assert not (inspect.iscoroutinefunction(plain) or inspect.isasyncgenfunction(plain))
    assert inspect.isasyncgenfunction(waits) == inspect.isgeneratorfunction(plain)


def test_both_clients_are_made_with_the_same_parameters() -> None:
    waits, plain = _parameters(AsyncClient.__init__), _parameters(Client.__init__)
    assert waits[-1].annotation == "httpx.AsyncBaseTransport | None"
    assert [*waits[:-1], waits[-1].replace(annotation="httpx.BaseTransport | None")] == plain


def _parameters(method: Callable[..., Any]) -> list[inspect.Parameter]:
    return list(inspect.signature(method).parameters.values())

"""Browser sessions: they end at their time, by signing out and with their key; links work once."""

from __future__ import annotations

from typing import Any

import pytest
from sqlalchemy import select

from advtex_store.models import SessionRow
from advtex_store.sessions import LINK_SECONDS, Sessions


@pytest.fixture
def sessions(bench: Any) -> Sessions:
    return Sessions(bench.database)


@pytest.fixture
def key_id(bench: Any) -> str:
    return str(bench.accounts.create_key("ada", owner="ada", scopes=["read"])).split("_")[1]


def test_a_session_speaks_for_its_key_until_its_time(sessions: Sessions, key_id: str, bench: Any) -> None:
    token = sessions.begin(key_id, 100)
    caller = sessions.caller(token)
    assert caller is not None
    assert (caller.owner, caller.scopes) == ("ada", {"read"})
    assert sessions.caller(token + "x") is None
    bench.clock.now += 100
    assert sessions.caller(token) is None


def test_signing_out_ends_one_session(sessions: Sessions, key_id: str) -> None:
    first, second = sessions.begin(key_id, 100), sessions.begin(key_id, 100)
    sessions.end(first)
    assert sessions.caller(first) is None
    assert sessions.caller(second) is not None


def test_a_session_ends_with_its_key(sessions: Sessions, key_id: str, bench: Any) -> None:
    token, link = sessions.begin(key_id, 100), sessions.offer(key_id)
    bench.accounts.revoke_key(key_id)
    assert sessions.caller(token) is None
    assert sessions.follow(link, 100) is None


def test_a_link_works_once_within_a_day_and_is_no_session(sessions: Sessions, key_id: str, bench: Any) -> None:
    link = sessions.offer(key_id)
    assert sessions.caller(link) is None
    token = sessions.follow(link, 100)
    assert token is not None
    assert sessions.caller(token) is not None
    assert sessions.follow(link, 100) is None
    assert sessions.follow(token, 100) is None, "a session is no link"
    late = sessions.offer(key_id)
    bench.clock.now += LINK_SECONDS
    assert sessions.follow(late, 100) is None


def test_only_digests_are_kept_and_old_rows_go(sessions: Sessions, key_id: str, bench: Any) -> None:
    token = sessions.begin(key_id, 100)
    with bench.database.read() as session:
        assert token not in session.scalars(select(SessionRow.token_sha256)).all()
    bench.clock.now += 101
    sessions.begin(key_id, 100)
    with bench.database.read() as session:
        assert len(session.scalars(select(SessionRow)).all()) == 1

"""Links to one file of a result: nothing but what was said when they were made."""

from __future__ import annotations

from typing import Any

import pytest

from advtex_store.links import SECONDS, Links

JOB, NAME = "0123abc", "model_mobile.glb"


@pytest.fixture
def links(bench: Any) -> Links:
    return Links(bench.database)


def key_of(bench: Any, owner: str, scopes: tuple[str, ...] = ("read",)) -> str:
    return str(bench.accounts.create_key(owner, owner=owner, scopes=scopes)).split("_")[1]


def test_a_link_is_good_for_its_file_until_its_time(links: Links, bench: Any) -> None:
    token = links.make(key_of(bench, "ada"), JOB, NAME)
    assert links.owner(token, JOB, NAME) == "ada"
    assert links.owner(token, "0123abd", NAME) is None
    assert links.owner(token, JOB, "model.glb") is None
    assert links.owner(token, JOB, NAME + "\n") is None
    bench.clock.now += SECONDS
    assert links.owner(token, JOB, NAME) is None


def test_no_part_of_a_link_can_be_changed(links: Links, bench: Any) -> None:
    key, other = key_of(bench, "ada"), key_of(bench, "bob")
    key_id, expires, mac = links.make(key, JOB, NAME).split(".")
    assert key_id == key
    for forged in (
        f"{other}.{expires}.{mac}",
        f"{key}.{int(expires) + 1}.{mac}",
        f"{key}.0{expires}.{mac[:-1]}{'0' if mac[-1] != '0' else '1'}",
        f"{key}.{expires}.{mac[:-2]}",
        f"{key}.{expires}.{'0' * 64}",
        f"{key}.{expires}",
        "",
        "x" * 9999,
    ):
        assert links.owner(forged, JOB, NAME) is None, forged


def test_a_link_ends_with_its_key(links: Links, bench: Any) -> None:
    key = key_of(bench, "ada")
    token = links.make(key, JOB, NAME)
    bench.accounts.revoke_key(key)
    assert links.owner(token, JOB, NAME) is None
    writes = key_of(bench, "ada", ("write",))
    assert links.owner(links.make(writes, JOB, NAME), JOB, NAME) is None, "a key that may not read gives no such right"

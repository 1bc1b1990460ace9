"""Keys: scopes, expiry, quotas, rotation, and what happens to those who guess."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from advtex_contract.health import KeyView
from advtex_server.authentication import KNOWN_SECONDS, Authenticator
from advtex_server.refusal import ApiError
from advtex_store.accounts import Caller

GOOD = "Bearer adv_good"


class FakeAccounts:
    """Knows one key, and counts how often it was asked."""

    def __init__(self) -> None:
        self.asked = 0
        self.revoked = False

    def authenticate(self, key: str) -> Caller | None:
        self.asked += 1
        return Caller("id", "me", frozenset({"read"})) if key == "adv_good" and not self.revoked else None


class Door:
    """An authenticator with a clock that is set by hand."""

    def __init__(self, limit: int = 5) -> None:
        self.now = 0.0
        self.accounts = FakeAccounts()
        self._keeper = Authenticator(self.accounts, limit, lambda: self.now)  # type: ignore[arg-type]

    def knock(self, authorization: str, address: str = "1.1.1.1") -> int:
        """-> the status that the request would get."""
        try:
            asyncio.run(self._keeper.caller(authorization, address))
        except ApiError as error:
            return error.status
        return 200


def test_wrong_keys_are_refused_without_a_look_after_some() -> None:
    door = Door(limit=5)
    assert [door.knock(f"Bearer adv_{n}") for n in range(7)] == [401] * 5 + [429] * 2
    assert door.accounts.asked == 5
    assert door.knock("Bearer adv_x", "2.2.2.2") == 401, "others are not affected"
    door.now += 12.1
    assert [door.knock("Bearer adv_x") for _ in range(2)] == [401, 429], "one is forgotten every 12 s"
    door.now += 3600
    assert door.knock(GOOD) == 200


def test_a_known_key_works_from_an_address_that_guesses() -> None:
    door = Door(limit=2)
    assert door.knock(GOOD) == 200
    assert [door.knock("Bearer adv_wrong") for _ in range(3)] == [401, 401, 429]
    door.now += KNOWN_SECONDS + 1
    assert door.knock(GOOD) == 200


def test_a_key_is_not_looked_up_for_every_request_and_a_revoked_one_ends_soon() -> None:
    door = Door()
    assert [door.knock(GOOD) for _ in range(100)] == [200] * 100
    assert door.accounts.asked == 1
    door.accounts.revoked = True
    door.now += KNOWN_SECONDS + 0.1
    assert door.knock(GOOD) == 401
    assert door.knock(GOOD) == 401


def test_no_key_is_no_guess() -> None:
    door = Door(limit=2)
    assert [door.knock(header) for header in ("", "Basic x", "Bearer", "Bearer ") * 3] == [401] * 12
    assert door.accounts.asked == 0


@pytest.mark.one_machine("pure validation")
def test_guessing_over_http(make_live: Callable[..., Any], is_error: Any) -> None:
    live = make_live(auth_failures_per_minute=3)
    with live.client("adv_000000000000_" + "a" * 40) as stranger:
        for _ in range(3):
            is_error(stranger.get("/v1/jobs"), 401, "unauthorized")
        refused = stranger.get("/v1/jobs")
        is_error(refused, 429, "rate_limited")
        assert int(refused.headers["retry-after"]) > 0


@pytest.mark.one_machine("pure validation")
def test_behind_a_trusted_proxy_callers_have_addresses_of_their_own(make_live: Callable[..., Any]) -> None:
    """uvicorn trusts this machine by default; FORWARDED_ALLOW_IPS names others."""
    live = make_live(auth_failures_per_minute=1)
    with live.client("adv_000000000000_" + "a" * 40) as stranger:
        came_from = ("1.1.1.1", "1.1.1.1", "2.2.2.2")
        statuses = [stranger.get("/v1/jobs", headers={"X-Forwarded-For": ip}).status_code for ip in came_from]
    assert statuses == [401, 429, 401]


@pytest.mark.one_machine("pure validation")
def test_a_proxy_that_is_not_named_speaks_for_nobody(
    make_live: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FORWARDED_ALLOW_IPS", "10.9.8.7")
    live = make_live(auth_failures_per_minute=1)
    with live.client("adv_000000000000_" + "a" * 40) as stranger:
        statuses = [stranger.get("/v1/jobs", headers={"X-Forwarded-For": f"1.1.1.{n}"}).status_code for n in range(2)]
    assert statuses == [401, 429]


@pytest.mark.one_machine("tests/store has the same on both databases")
def test_scopes_and_expiry(live: Any, is_error: Any) -> None:
    accounts = live.store.accounts
    with live.client(accounts.create_key("r", owner="me", scopes=["read"])) as reader:
        assert reader.get("/v1/jobs").status_code == 200
        is_error(reader.post("/v1/jobs", json={"upload_id": "x"}), 403, "forbidden")
        is_error(reader.post("/v1/webhooks", json={"url": "https://1.1.1.1/"}), 403, "forbidden")
    with live.client(accounts.create_key("w", owner="me", scopes=["write"])) as writer:
        is_error(writer.get("/v1/jobs"), 403, "forbidden")
    with live.client(accounts.create_key("old", owner="me", expires_at=time.time() - 1)) as expired:
        is_error(expired.get("/v1/jobs"), 401, "unauthorized")


@pytest.mark.one_machine("tests/store has the same on both databases")
def test_a_key_can_be_asked_what_it_may_do(live: Any, is_error: Any, scan_zip: Path) -> None:
    end = int(time.time()) + 600
    key = live.store.accounts.create_key("w", owner="me", scopes=["write"], expires_at=end, max_active_jobs=3)
    with live.client(key) as writer:
        upload = writer.post("/v1/uploads", content=scan_zip.read_bytes()).json()
        writer.post("/v1/jobs", json={"upload_id": upload["id"]})
        found = KeyView.model_validate(writer.get("/v1/key").json())
    assert (found.id, found.scopes, found.max_active_jobs, found.max_bytes) == (key.split("_")[1], ["write"], 3, None)
    assert (found.active_jobs, found.bytes) == (1, upload["size"])
    assert found.expires_at is not None
    assert found.expires_at.timestamp() == end
    with live.client("adv_000000000000_" + "a" * 40) as stranger:
        is_error(stranger.get("/v1/key"), 401, "unauthorized")


@pytest.mark.one_machine("tests/store has the same on both databases")
def test_a_rotated_key_sees_the_same_jobs(live: Any, is_error: Any, scan_zip: Path) -> None:
    accounts = live.store.accounts
    old = accounts.create_key("mine", scopes=["read", "write"], max_active_jobs=1)
    with live.client(old) as http:
        upload = http.post("/v1/uploads", content=scan_zip.read_bytes()).json()["id"]
        job = http.post("/v1/jobs", json={"upload_id": upload}).json()["id"]
    new = accounts.rotate_key(old.split("_")[1])
    with live.client(new) as http:
        assert http.get(f"/v1/jobs/{job}").json()["id"] == job
        is_error(http.post("/v1/jobs", json={"upload_id": upload}), 429, "quota_exceeded")
    assert accounts.authenticate(old) is None
    kept = accounts.rotate_key(new.split("_")[1], keep_seconds=3600)
    assert accounts.authenticate(new) is not None
    assert accounts.authenticate(kept) is not None


def test_the_quota_of_active_jobs(live: Any, is_error: Any, scan_zip: Path) -> None:
    key = live.store.accounts.create_key("small", owner="small", max_active_jobs=2)
    with live.client(key) as http:
        upload = http.post("/v1/uploads", content=scan_zip.read_bytes()).json()["id"]
        jobs = [http.post("/v1/jobs", json={"upload_id": upload}).json()["id"] for _ in range(2)]
        message = is_error(http.post("/v1/jobs", json={"upload_id": upload}), 429, "quota_exceeded")
        assert "2 jobs have not ended" in message
        http.post(f"/v1/jobs/{jobs[0]}/cancel")
        assert http.post("/v1/jobs", json={"upload_id": upload}).status_code == 201
        is_error(http.post(f"/v1/jobs/{jobs[0]}/retry"), 429, "quota_exceeded")


@pytest.mark.parametrize("most", [1, 3])
def test_requests_at_once_do_not_exceed_the_quota(live: Any, scan_zip: Path, most: int) -> None:
    key = live.store.accounts.create_key("many", owner=f"many{most}", max_active_jobs=most)
    statuses: list[int] = []
    with live.client(key) as http:
        upload = http.post("/v1/uploads", content=scan_zip.read_bytes()).json()["id"]
        work = lambda: statuses.append(http.post("/v1/jobs", json={"upload_id": upload}).status_code)  # noqa: E731
        threads = [threading.Thread(target=work) for _ in range(6)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert sorted(statuses) == [201] * most + [429] * (6 - most)


def test_how_long_a_job_is_kept_is_announced(live: Any, is_error: Any, scan_zip: Path) -> None:
    upload = live.upload(scan_zip.read_bytes())
    assert live.job(upload)["retention_seconds"] == live.settings.retention_seconds
    job = live.job(upload, retention_seconds=3600)
    assert (job["retention_seconds"], job["expires_at"]) == (3600, None)
    ended = live.http.post(f"/v1/jobs/{job['id']}/cancel").json()
    assert ended["expires_at"] is not None
    too_long = {"upload_id": upload, "retention_seconds": live.settings.max_retention_seconds + 1}
    assert "at most" in is_error(live.http.post("/v1/jobs", json=too_long), 422, "bad_request")

"""Upload rows and API keys."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
from sqlalchemy import text

from advtex_contract.jobs import JobSpec
from advtex_store.errors import IllegalTransition, QuotaExceeded, RecordNotFound, Superseded


def test_an_upload_from_beginning_to_end(bench: Any) -> None:
    row = bench.uploads.create("me", 10, "scan.zip")
    holder = bench.uploads.seize(row.id, "me").holder
    bench.clock.now += 100
    assert bench.uploads.expected_bytes() == 10
    assert bench.uploads.advance(row.id, holder, 4) == bench.clock.now + 86400, "it expires a day after its last bytes"
    half = bench.uploads.upload(row.id, "me")
    assert (half.offset, half.sha256, half.expires_at) == (4, None, bench.clock.now + 86400)
    assert bench.uploads.expected_bytes() == 6
    bench.clock.now += 5
    bench.uploads.advance(row.id, holder, 10)
    whole = bench.uploads.finish(row.id, "ab" * 32, holder)
    assert (whole.offset, whole.sha256, whole.expires_at) == (10, "ab" * 32, bench.clock.now + 1000)
    assert bench.uploads.finish(row.id, "ab" * 32).id == row.id
    with pytest.raises(IllegalTransition):
        bench.uploads.finish(row.id, "cd" * 32)
    with pytest.raises(RecordNotFound):
        bench.uploads.upload(row.id, "somebody else")


def test_only_the_newest_holder_moves_the_offset(bench: Any) -> None:
    row = bench.uploads.create("me", 10)
    old, new = (bench.uploads.seize(row.id, "me").holder for _ in range(2))
    with pytest.raises(Superseded):
        bench.uploads.advance(row.id, old, 4)
    bench.uploads.advance(row.id, new, 5)
    with pytest.raises(RecordNotFound):
        bench.uploads.seize(row.id, "somebody else")
    with pytest.raises(Superseded):
        bench.uploads.check_held(row.id, old)
    bench.uploads.check_held(row.id, new)
    with pytest.raises(Superseded):
        bench.uploads.finish(row.id, "cd" * 32, old)
    bench.uploads.finish(row.id, "ab" * 32, new)
    with pytest.raises(Superseded):
        bench.uploads.advance(row.id, new, 6)
    with pytest.raises(Superseded, match="complete"):
        bench.uploads.seize(row.id, "me")
    with pytest.raises(RecordNotFound):
        bench.uploads.seize(row.id, "somebody else")


def test_the_quota_counts_what_is_kept_and_what_is_on_its_way(bench: Any) -> None:
    bench.accounts.create_key(owner="me")
    row = bench.uploads.create("me", 60, max_bytes=100)
    bench.uploads.finish(row.id, "ab" * 32)
    bench.uploads.create("me", 40, max_bytes=100)
    bench.uploads.create("other", 40, max_bytes=100)
    with pytest.raises(QuotaExceeded):
        bench.uploads.create("me", 1, max_bytes=100)
    bench.uploads.delete(row.id)
    bench.uploads.create("me", 60, max_bytes=100)


def at_once(action: Callable[[], object], callers: int) -> int:
    """-> how many of them were not refused by the quota"""

    def attempt(_: int) -> bool:
        try:
            action()
        except QuotaExceeded:
            return False
        return True

    with ThreadPoolExecutor(callers) as pool:
        return sum(pool.map(attempt, range(callers)))


def test_uploads_at_once_do_not_exceed_the_quota(bench: Any) -> None:
    bench.accounts.create_key("k", owner="me")
    assert at_once(lambda: bench.uploads.create("me", 40, max_bytes=100), 8) == 2


def test_jobs_at_once_do_not_exceed_the_quota(bench: Any) -> None:
    bench.accounts.create_key("k", owner="me")
    spec = JobSpec(upload_id=bench.finished_upload("me"))
    assert at_once(lambda: bench.submissions.create_job("me", spec, max_active_jobs=3), 8) == 3


def test_an_upload_that_is_not_admitted_leaves_no_row(bench: Any) -> None:
    def refuse(expected: int) -> None:
        raise IllegalTransition(f"{expected} bytes are promised")

    bench.uploads.create("me", 60)
    with pytest.raises(IllegalTransition, match="60 bytes are promised"):
        bench.uploads.create("other", 10, admit=refuse)
    assert bench.uploads.expected_bytes() == 60


def test_uploads_are_found_by_their_bytes(bench: Any) -> None:
    waiting = bench.uploads.create("me", 10, announced_sha256="ab" * 32)
    whole = bench.uploads.create("me", 10)
    bench.uploads.finish(whole.id, "ab" * 32)
    bench.uploads.create("other", 10, announced_sha256="ab" * 32)
    assert [row.id for row in bench.uploads.find("me", "ab" * 32)] == [whole.id, waiting.id]
    bench.clock.now += 86401
    assert [row.id for row in bench.uploads.find("me", "ab" * 32)] == [], "an expired one is about to go"


def test_a_discarded_upload_is_gone(bench: Any) -> None:
    row = bench.uploads.create("me", 10)
    assert bench.uploads.discard(row.id, None)
    assert not bench.uploads.discard(row.id, None)
    with pytest.raises(RecordNotFound):
        bench.uploads.finish(row.id, "ab" * 32)


def test_only_the_holder_discards_and_only_what_is_not_complete(bench: Any) -> None:
    row = bench.uploads.create("me", 10)
    old, new = (bench.uploads.seize(row.id, "me").holder for _ in range(2))
    assert not bench.uploads.discard(row.id, old)
    assert not bench.uploads.discard(row.id, None)
    bench.uploads.advance(row.id, new, 10)
    bench.uploads.finish(row.id, "ab" * 32, new)
    assert not bench.uploads.discard(row.id, new)
    assert bench.uploads.upload(row.id).sha256 == "ab" * 32


def test_an_upload_with_a_job_stays(bench: Any) -> None:
    job = bench.job()
    upload = bench.records.job(job).upload_id
    with pytest.raises(IllegalTransition, match="delete the job"):
        bench.uploads.delete(upload, bench.owner)
    bench.records.cancel(job)
    bench.records.delete(job)
    with pytest.raises(RecordNotFound):
        bench.uploads.delete(upload, "somebody else")
    bench.uploads.delete(upload, bench.owner)
    with pytest.raises(RecordNotFound):
        bench.uploads.upload(upload)


def test_keys(bench: Any) -> None:
    key = bench.accounts.create_key("laptop", scopes=["read"])
    caller = bench.accounts.authenticate(key)
    assert key.startswith(f"adv_{caller.key_id}_")
    assert (caller.owner, caller.scopes) == (caller.key_id, frozenset({"read"}))
    for wrong in ("", "adv_", key[:-1], key + "x", key[:-1] + ("a" if key[-1] != "a" else "b"), key.upper()):
        assert bench.accounts.authenticate(wrong) is None
    bench.accounts.revoke_key(caller.key_id)
    assert bench.accounts.authenticate(key) is None
    with pytest.raises(RecordNotFound):
        bench.accounts.revoke_key("none")
    with pytest.raises(ValueError, match="the scopes are"):
        bench.accounts.create_key(scopes=["fly"])
    for names in ({"name": "x" * 256}, {"owner": "x" * 256}):
        with pytest.raises(ValueError, match="255 characters at most"):
            bench.accounts.create_key(**names)
    assert bench.accounts.create_key("x" * 255, owner="y" * 255)


def test_keys_expire_and_share_an_owner(bench: Any) -> None:
    old = bench.accounts.create_key(owner="team", expires_at=bench.clock.now + 10)
    new = bench.accounts.create_key(owner="team")
    assert bench.accounts.authenticate(old).owner == "team"
    bench.clock.now += 10
    assert bench.accounts.authenticate(old) is None
    assert bench.accounts.authenticate(new).owner == "team"


def test_no_secret_is_stored(bench: Any) -> None:
    key = bench.accounts.create_key()
    secret = key.rpartition("_")[2]
    with bench.database.read() as session:
        stored = str(session.execute(text("select * from api_keys")).all())
    assert secret not in stored

"""Requests that meet in PostgreSQL, where transactions run side by side; SQLite has one writer at a time."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import pytest
from sqlalchemy import event

from advtex_contract.jobs import TERMINAL, JobSpec, JobState
from advtex_store.errors import IdempotencyInFlight, QuotaExceeded
from advtex_store.models import DeliveryRow
from advtex_store.submissions import Reservation
from advtex_store.webhooks import MOST_FAILURES, MOST_PER_OWNER, Webhooks

URL = "https://receiver.example/hook"
SPEC = JobSpec(upload_id="scan")


@pytest.fixture(autouse=True)
def database_url(postgres_url: str) -> str:
    """In place of both."""
    return postgres_url.replace("postgresql:", "postgresql+psycopg:")


@pytest.fixture
def meanwhile(bench: Any) -> Callable[[str, Callable[[], object]], Callable[[], None]]:
    """`ended = meanwhile(start, action)`: right after the next statement that begins so, another connection does
    `action`. It has half a second for it; what is locked out goes on when the statement's transaction has ended.
    `ended()` waits for it."""

    def when(start: str, action: Callable[[], object]) -> Callable[[], None]:
        thread = threading.Thread(target=action)

        def act(_connection: Any, _cursor: Any, statement: str, *_: Any) -> None:
            if thread.ident is None and statement.lower().startswith(start):
                thread.start()
                thread.join(0.5)

        event.listen(bench.database.engine, "after_cursor_execute", act)
        return thread.join

    return when


def test_a_key_that_is_released_while_it_is_asked_for(bench: Any, meanwhile: Any) -> None:
    held = bench.submissions.reserve(bench.owner, "key", SPEC)
    ended = meanwhile("insert into idempotency", lambda: bench.submissions.release(held))
    with pytest.raises(IdempotencyInFlight):
        bench.submissions.reserve(bench.owner, "key", SPEC)
    ended()
    assert isinstance(bench.submissions.reserve(bench.owner, "key", SPEC), Reservation)


def test_a_webhook_that_is_deleted_while_a_job_ends(bench: Any, meanwhile: Any) -> None:
    webhooks = Webhooks(bench.database)
    hook = webhooks.create(bench.owner, URL, TERMINAL).id
    job = bench.job()
    bench.records.claim(job, 1, "w")
    ended = meanwhile("select webhooks", lambda: webhooks.delete(hook, bench.owner))
    bench.records.succeed(job, 1, [])
    ended()
    assert bench.records.job(job).state == JobState.succeeded
    assert webhooks.webhooks(bench.owner) == []


def test_two_servers_report_on_one_webhook_at_once(bench: Any, meanwhile: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("advtex_store.webhooks.PAUSES", (300.0,) * MOST_FAILURES)  # a pause moves all deliveries
    webhooks = Webhooks(bench.database)
    hook = webhooks.create(bench.owner, URL, [JobState.queued]).id
    for _ in range(2):
        bench.job()
    one, two = (webhooks.take_due(1)[0] for _ in range(2))
    ended = meanwhile("delete from deliveries", lambda: webhooks.failed(two, "it broke"))
    webhooks.delivered(one)
    ended()
    assert webhooks.webhook(hook, bench.owner).failures == 1
    with bench.database.read() as session:
        assert [row.id for row in session.query(DeliveryRow)] == [two.id]


def test_the_last_place_for_a_webhook_is_given_once(bench: Any, meanwhile: Any) -> None:
    webhooks = Webhooks(bench.database)
    bench.accounts.create_key(owner=bench.owner)
    for _ in range(MOST_PER_OWNER - 1):
        webhooks.create(bench.owner, URL, TERMINAL)

    def create() -> None:
        with suppress(QuotaExceeded):
            webhooks.create(bench.owner, URL, TERMINAL)

    ended = meanwhile("select count", create)
    create()
    ended()
    assert len(webhooks.webhooks(bench.owner)) == MOST_PER_OWNER

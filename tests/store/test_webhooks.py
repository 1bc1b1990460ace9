"""The outbox of webhooks on both databases."""

from __future__ import annotations

import json
from typing import Any

import pytest

from advtex_contract.jobs import TERMINAL, JobError, JobSpec, JobState
from advtex_store.errors import QuotaExceeded, RecordNotFound
from advtex_store.models import DeliveryRow
from advtex_store.webhooks import KEPT_SECONDS, MOST_FAILURES, MOST_PER_OWNER, PAUSES, TRY_SECONDS, Webhooks

URL = "https://receiver.example/hook"


@pytest.fixture
def webhooks(bench: Any) -> Webhooks:
    return Webhooks(bench.database)


def outbox(bench: Any) -> list[dict[str, Any]]:
    with bench.database.read() as session:
        return [json.loads(row.body) for row in session.query(DeliveryRow).order_by(DeliveryRow.id)]


def end(bench: Any, job: str) -> None:
    bench.clock.now += 0.002  # ids of one millisecond have no order
    bench.records.claim(job, 1, "w")
    bench.records.fail(job, 1, JobError(code="engine_error", message="it broke", log_tail="secret"))
    bench.clock.now += 0.002


def test_the_change_and_its_news_are_one(bench: Any, webhooks: Webhooks) -> None:
    webhooks.create(bench.owner, URL, TERMINAL)
    webhooks.create(bench.owner, URL, [JobState.queued])
    webhooks.create("somebody else", URL, TERMINAL)
    end(bench, bench.job(label="chair"))
    queued, failed = outbox(bench)
    assert (queued["type"], failed["type"]) == ("job.queued", "job.failed")
    assert failed["data"]["label"] == "chair"
    assert failed["data"]["error"] == {"code": "engine_error", "message": "it broke"}
    job = bench.job()
    with pytest.raises(ZeroDivisionError), bench.database.write() as session:  # noqa: PT012
        bench.records.move(session, job, JobState.canceled)
        raise ZeroDivisionError
    assert len(outbox(bench)) == 3, "a change that was rolled back was told"


def test_a_rejected_job_is_told(bench: Any, webhooks: Webhooks) -> None:
    webhooks.create(bench.owner, URL, TERMINAL | {JobState.checking})
    bench.submissions.create_job(bench.owner, JobSpec(upload_id=bench.finished_upload()))
    bench.checks.rejected(bench.checks.claim(), JobError(code="invalid_scan", message="no mesh"))
    assert sorted(told["type"] for told in outbox(bench)) == ["job.checking", "job.rejected"]


def test_one_try_at_a_time_per_webhook(bench: Any, webhooks: Webhooks) -> None:
    first, second = (webhooks.create(bench.owner, f"{URL}/{n}", TERMINAL) for n in range(2))
    jobs = [bench.job() for _ in range(3)]
    for job in jobs:
        end(bench, job)
    taken = webhooks.take_due(10)
    assert sorted(delivery.webhook_id for delivery in taken) == sorted([first.id, second.id])
    assert {json.loads(delivery.body)["data"]["id"] for delivery in taken} == {jobs[0]}, "the oldest comes first"
    assert webhooks.take_due(10, {first.id, second.id}) == []
    for delivery in taken:
        webhooks.delivered(delivery)
    assert len(outbox(bench)) == 4


def test_a_try_that_nobody_reports_on_is_made_again(bench: Any, webhooks: Webhooks) -> None:
    webhooks.create(bench.owner, URL, TERMINAL)
    end(bench, bench.job())
    (lost,) = webhooks.take_due(10)
    assert webhooks.take_due(10) == []
    bench.clock.now += TRY_SECONDS
    assert webhooks.take_due(10) == [lost], "the same id, so that the receiver can tell"


def test_pauses_grow_until_the_webhook_is_disabled(bench: Any, webhooks: Webhooks) -> None:
    hook = webhooks.create(bench.owner, URL, TERMINAL)
    end(bench, bench.job())
    for number in range(1, MOST_FAILURES + 1):
        (delivery,) = webhooks.take_due(10)
        end(bench, bench.job())  # news during a pause do not cut it short
        disabled = webhooks.failed(delivery, f"failure {number}")
        assert disabled == (number == MOST_FAILURES)
        pause = PAUSES[min(number, len(PAUSES)) - 1]
        bench.clock.now += pause - 0.01
        assert webhooks.take_due(10) == []
        bench.clock.now += 0.02
    assert webhooks.take_due(10) == []
    row = webhooks.webhook(hook.id, bench.owner)
    assert (row.failures, row.last_error, row.disabled_at is not None) == (MOST_FAILURES, "failure 8", True)
    webhooks.enable(hook.id, bench.owner)
    (delivery,) = webhooks.take_due(10)
    webhooks.delivered(delivery)
    assert webhooks.webhook(hook.id, bench.owner).disabled_at is None
    assert len(outbox(bench)) == MOST_FAILURES


def test_news_that_one_receiver_cannot_take_do_not_hold_up_the_others(bench: Any, webhooks: Webhooks) -> None:
    """It answers 500 to one of them only: the rest gets through, and the webhook is not disabled."""
    hook = webhooks.create(bench.owner, URL, TERMINAL)
    for _ in range(3):
        end(bench, bench.job())
    (poison,) = webhooks.take_due(1)
    webhooks.failed(poison, "it answered 500")
    bench.clock.now += PAUSES[0] + 1
    for _ in range(2):
        (delivery,) = webhooks.take_due(1)
        assert delivery.id != poison.id
        webhooks.delivered(delivery)
    assert webhooks.webhook(hook.id, bench.owner).failures == 0


def test_a_receiver_that_is_gone_is_disabled_at_once(bench: Any, webhooks: Webhooks) -> None:
    webhooks.create(bench.owner, URL, TERMINAL)
    end(bench, bench.job())
    (delivery,) = webhooks.take_due(1)
    assert webhooks.failed(delivery, "it answered 410", gone=True)


def test_owners_do_not_see_each_other_and_may_have_some(bench: Any, webhooks: Webhooks) -> None:
    hook = webhooks.create(bench.owner, URL, TERMINAL)
    assert hook.secret.startswith("whsec_")
    for act in (webhooks.webhook, webhooks.enable, webhooks.delete):
        with pytest.raises(RecordNotFound):
            act(hook.id, "somebody else")
    for _ in range(MOST_PER_OWNER - 1):
        webhooks.create(bench.owner, URL, TERMINAL)
    with pytest.raises(QuotaExceeded):
        webhooks.create(bench.owner, URL, TERMINAL)
    assert len({row.secret for row in webhooks.webhooks(bench.owner)}) == MOST_PER_OWNER


def test_what_is_not_wanted_any_more_goes(bench: Any, webhooks: Webhooks) -> None:
    hook = webhooks.create(bench.owner, URL, TERMINAL)
    end(bench, bench.job())
    webhooks.delete(hook.id, bench.owner)
    assert outbox(bench) == []
    webhooks.create(bench.owner, URL, TERMINAL)
    end(bench, bench.job())
    end(bench, bench.job())
    assert webhooks.drop_old() == 0
    assert len(outbox(bench)) == 2
    bench.clock.now += KEPT_SECONDS
    assert webhooks.drop_old() == 2
    assert outbox(bench) == []

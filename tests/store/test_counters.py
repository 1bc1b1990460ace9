"""What those who watch are told of the rows."""

from __future__ import annotations

from typing import Any

from sqlalchemy import update

from advtex_contract.jobs import JobError, JobState, Progress
from advtex_store.counters import ACCURACY, ACCURACY_BUCKETS, STAGE_BUCKETS, Counters, Line, RunningJob
from advtex_store.models import JobRow
from advtex_store.webhooks import Webhooks


def test_lines_are_of_an_owner_and_a_class(bench: Any) -> None:
    first = bench.job("ada")
    bench.clock.now += 10
    others = [bench.job("ada"), bench.job("bob"), bench.job("ada")]
    with bench.database.write() as session:
        session.execute(update(JobRow).where(JobRow.id == others[0]).values(memory_bytes=1 << 31))
    bench.records.claim(others[2], 1, "w")
    bench.clock.now += 5
    counters = Counters(bench.database)
    gib = bench.records.job(first).memory_gib
    assert sorted(counters.lines(), key=lambda line: (line.owner, line.jobs, line.oldest_seconds)) == [
        Line("ada", 2, 1, 5.0),
        Line("ada", gib, 1, 15.0),
        Line("bob", gib, 1, 5.0),
    ]
    bench.records.heartbeat(others[2], 1, Progress(stage="atlas", steps_per_second=2.5))
    load = counters.load()
    assert load.running == [RunningJob(others[2], 1, gib, 2.5)]
    assert (load.oldest_seconds, load.steps_per_second) == (15.0, 2.5)


def test_what_webhooks_wait_for_is_overdue_while_they_are_enabled(bench: Any) -> None:
    webhooks, counters = Webhooks(bench.database), Counters(bench.database)
    webhooks.create("ada", "https://example.invalid", [JobState.queued])
    bench.job("ada")
    bench.clock.now += 60
    assert (counters.load().deliveries, counters.load().overdue_seconds) == (1, 60.0)
    (taken,) = webhooks.take_due(1)
    assert counters.load().overdue_seconds == 0, "a server has it"
    bench.clock.now += 100
    assert counters.load().overdue_seconds == 40
    webhooks.failed(taken, "gone", gone=True)
    bench.clock.now += 7200
    assert (counters.load().deliveries, counters.load().overdue_seconds) == (1, 0.0)


def test_times_in_stages_are_counted_by_the_bound_that_they_stay_below(bench: Any) -> None:
    for seconds in (1.0, 1.1, 1e6):
        job = bench.job()
        bench.records.claim(job, 1, "w")
        bench.records.heartbeat(job, 1, Progress(stage="atlas", stage_seconds={"atlas": seconds}))
        bench.records.fail(job, 1, JobError(code="engine_error", message="no"))
    rows = [row for row in Counters(bench.database).counts() if row.name == STAGE_BUCKETS]
    assert {row.label: row.count for row in rows} == {"atlas 1": 1, "atlas 3": 1}


def test_what_discriminators_told_apart_at_the_end_is_counted_by_preset(bench: Any) -> None:
    for accuracy, ends in ((0.5, True), (0.56, True), (0.97, False), (None, True)):
        job = bench.job()
        bench.records.claim(job, 1, "w")
        losses = {"l1": 0.1} | ({} if accuracy is None else {"accuracy": accuracy})
        bench.records.heartbeat(job, 1, Progress(stage="previews", losses=losses))
        if ends:
            bench.records.succeed(job, 1, [])
        else:
            bench.records.fail(job, 1, JobError(code="engine_error", message="no"))
    counts = Counters(bench.database).counts()
    preset = bench.records.job(job).options["preset"]
    assert {row.label: row.count for row in counts if row.name == ACCURACY_BUCKETS} == {
        f"{preset} 0.55": 1,
        f"{preset} 0.6": 1,
    }
    (row,) = [row for row in counts if row.name == ACCURACY]
    assert (row.label, row.count, round(row.total, 6)) == (preset, 2, 1.06)

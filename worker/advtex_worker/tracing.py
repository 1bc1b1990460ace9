"""What an attempt adds to the trace of its job."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

from sqlalchemy.exc import SQLAlchemyError

from advtex_contract.jobs import JobState
from advtex_options.methods import chosen_method
from advtex_store.errors import RecordNotFound
from advtex_store.records import Claim
from advtex_store.store import Store
from advtex_store.tracing import OFF, Span, open_traces
from advtex_worker.events import StageEvent


class AttemptTrace:
    """The span of an attempt, and below it those of its stages: each until its end, or the attempt's."""

    def __init__(self, span: Span) -> None:
        self._span = span
        self._stage: Span | None = None

    def stage(self, event: StageEvent) -> None:
        """A stage began or ended."""
        if self._stage is not None:
            self._stage.end(peak_bytes=event.peak_bytes)
        self._stage = self._span.child(f"stage {event.stage}") if event.seconds is None else None

    def end(self, state: str = "", error: str = "") -> None:
        if self._stage is not None:
            self._stage.end()
        self._span.end(error, state=state)


NOT_TRACED = AttemptTrace(OFF.span("attempt", None))


@contextmanager
def traced(store: Store, claim: Claim) -> Iterator[AttemptTrace]:
    """The span of the attempt, after the one of its time in the queue. What it adds is sent when it ends."""
    traces = open_traces("advtex-worker")
    facts: dict[str, Any] = {"job": claim.job_id, "attempt": claim.attempt, "owner": claim.owner}
    traces.span("queue", claim.traceparent, start=claim.waiting_since, **facts).end()
    facts |= {"method": chosen_method(claim.options.method, claim.options.preset), "preset": claim.options.preset.value}
    trace = AttemptTrace(traces.span("attempt", claim.traceparent, **facts))
    try:
        yield trace
    finally:
        if traces.on:
            trace.end(**_ending(store, claim))
            traces.close()


def _ending(store: Store, claim: Claim) -> dict[str, str]:
    """The state that the attempt has left its job in, and why it failed."""
    with suppress(SQLAlchemyError, RecordNotFound):
        row = store.records.job(claim.job_id)
        failed = row.error["message"] if row.state == JobState.failed and row.error else ""
        return {"state": row.state, "error": failed}
    return {}

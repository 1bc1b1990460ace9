"""What the page's list of jobs shows, and the stream of what changes in it."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Sequence
from datetime import UTC, datetime

from pydantic import BaseModel
from sqlalchemy.exc import SQLAlchemyError
from starlette.concurrency import run_in_threadpool

from advtex_options import Options
from advtex_options.methods import chosen_method
from advtex_server.events import PING_SECONDS
from advtex_server.waiting import tell_why, waiting_reason
from advtex_store.models import JobRow
from advtex_store.store import Store

POLL_SECONDS = 1.0
LIFETIME_SECONDS = 300.0  # of a stream; the browser comes back, and has to be signed in still
OVERLAP_SECONDS = 5.0  # a change may become visible this long after the time that it carries


class JobSummary(BaseModel):
    """One line of the list. problem: why it failed or was rejected, in a sentence."""

    id: str
    state: str
    label: str
    batch: str | None
    preset: str
    method: str
    stage: str
    step: int
    steps: int
    eta_seconds: float | None
    waiting_reason: str
    problem: str
    created_at: datetime
    finished_at: datetime | None
    deleted: bool


def job_summary(row: JobRow) -> JobSummary:
    """The row as the list shows it."""
    progress = row.progress
    return JobSummary(
        id=row.id,
        state=row.state,
        label=row.label,
        batch=row.batch,
        preset=str(row.options.get("preset", Options.preset)),
        method=chosen_method(row.options.get("method"), row.options.get("preset", Options.preset)),
        stage=progress.get("stage", ""),
        step=progress.get("step", 0),
        steps=progress.get("steps", 0),
        eta_seconds=progress.get("eta_seconds"),
        waiting_reason=waiting_reason(row, {}),
        problem=(row.error or {}).get("message", ""),
        created_at=datetime.fromtimestamp(row.created_at, UTC),
        finished_at=None if row.finished_at is None else datetime.fromtimestamp(row.finished_at, UTC),
        deleted=row.deleted_at is not None,
    )


async def stream_changes(store: Store, owner: str, since: float, stopping: asyncio.Event) -> AsyncIterator[str]:
    """Server-sent `job` events, one per change of a job after `since`, for some minutes.

    Ids are times in milliseconds: a browser that comes back says the last one. What changed shortly before is sent
    again, as each message is the whole summary.
    """
    sent: dict[str, float] = {}
    newest, spoken = since, time.monotonic()
    end = spoken + LIFETIME_SECONDS
    while not stopping.is_set() and time.monotonic() < end:
        try:
            rows = await run_in_threadpool(changed, store, owner, newest - OVERLAP_SECONDS)
        except SQLAlchemyError:
            rows = []
        fresh = [row for row in rows if sent.get(row.id) != row.updated_at]
        if fresh:
            yield "".join(_message(row) for row in fresh)
            spoken = time.monotonic()
            newest = max(newest, fresh[-1].updated_at)
            sent = {row.id: row.updated_at for row in rows if row.updated_at > newest - OVERLAP_SECONDS}
        elif time.monotonic() - spoken > PING_SECONDS:
            yield ": ping\n\n"
            spoken = time.monotonic()
        try:
            await asyncio.wait_for(stopping.wait(), POLL_SECONDS)
        except TimeoutError:
            continue


def changed(store: Store, owner: str, since: float) -> Sequence[JobRow]:
    """Rows that changed after a time, in the order of their changes, each with why its job waits."""
    rows = store.overviews.changed(owner, since)
    tell_why(store, owner, rows)
    return rows


def _message(row: JobRow) -> str:
    return f"id: {int(row.updated_at * 1000)}\nevent: job\ndata: {job_summary(row).model_dump_json()}\n\n"

"""Server-sent events of one job, read from its row: any server can serve them, and a restart loses none."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator

from sqlalchemy.exc import DBAPIError
from starlette.concurrency import run_in_threadpool

from advtex_contract.jobs import TERMINAL, JobState
from advtex_server.service import Service, job_view
from advtex_store.errors import RecordNotFound
from advtex_store.models import EventRow, JobRow

POLL_SECONDS = 0.5
PING_SECONDS = 15.0


async def stream_events(
    service: Service, owner: str, job_id: str, after: int, stopping: asyncio.Event
) -> AsyncIterator[str]:
    """Changes after version `after`, then new ones until the job has ended, was deleted, or the server stops."""
    records = service.store.records
    seen, spoken = after, time.monotonic()
    first = True
    while not stopping.is_set():
        try:
            row = await run_in_threadpool(records.job, job_id, owner)
            recorded = await run_in_threadpool(records.events, job_id, seen) if row.version > seen else []
        except RecordNotFound:
            return
        except DBAPIError:
            await _pause(stopping)
            continue
        if first or row.version > seen:
            yield "".join(_message(e.data["kind"], e.version, json.dumps(e.data)) for e in _until(recorded, row))
            yield _message("job", row.version, job_view(row).model_dump_json())
            seen, spoken, first = max(seen, row.version), time.monotonic(), False
        if JobState(row.state) in TERMINAL:
            return
        if time.monotonic() - spoken > PING_SECONDS:
            yield ": ping\n\n"
            spoken = time.monotonic()
        await _pause(stopping)


def _until(recorded: list[EventRow], row: JobRow) -> list[EventRow]:
    """Without those that came after the row was read: their job follows with the next look."""
    return [event for event in recorded if event.version <= row.version]


def _message(name: str, version: int, data: str) -> str:
    return f"id: {version}\nevent: {name}\ndata: {data}\n\n"


async def _pause(stopping: asyncio.Event) -> None:
    try:
        await asyncio.wait_for(stopping.wait(), POLL_SECONDS)
    except TimeoutError:
        return

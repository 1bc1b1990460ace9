"""Server-sent events of one job, read from its row: any server can serve them, and a restart loses none.

Between two changes of the row its progress moves on, as the attempt tells it through Redis.
"""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator

from sqlalchemy.exc import SQLAlchemyError
from starlette.concurrency import run_in_threadpool

from advtex_contract.jobs import TERMINAL
from advtex_server.service import Service, job_view
from advtex_store.errors import RecordNotFound
from advtex_store.models import EventRow, JobRow

POLL_SECONDS = 0.5
FRESH_SECONDS = 0.3  # streams of one job share what was read so long ago at most
PING_SECONDS = 15.0


class _Look:
    """A job as it was read once: its row, the `job` message about it, and its events after some versions."""

    def __init__(self, service: Service, owner: str, job_id: str) -> None:
        self._service, self._owner, self._job_id = service, owner, job_id
        self._events: dict[int, asyncio.Future[list[EventRow]]] = {}
        self.at = time.monotonic()
        self.job = asyncio.ensure_future(run_in_threadpool(self._read))

    def _read(self) -> tuple[JobRow, str]:
        row = self._service.newest(self._owner, self._job_id)
        return row, _message("job", row.version, job_view(row).model_dump_json())

    def events(self, after: int) -> asyncio.Future[list[EventRow]]:
        """Recorded after this version."""
        if after not in self._events:
            read = run_in_threadpool(self._service.store.records.events, self._job_id, after)
            self._events[after] = asyncio.ensure_future(read)
        return self._events[after]


class Lookout:
    """The newest look at each job that streams follow: however many they are, the database is asked once."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self._looks: dict[tuple[str, str], _Look] = {}

    def look(self, owner: str, job_id: str) -> _Look:
        """A fresh look, which others may share: shield its futures from the end of one stream."""
        oldest = time.monotonic() - FRESH_SECONDS
        self._looks = {key: look for key, look in self._looks.items() if look.at > oldest}
        if (owner, job_id) not in self._looks:
            self._looks[owner, job_id] = _Look(self._service, owner, job_id)
        return self._looks[owner, job_id]


async def stream_events(
    lookout: Lookout, owner: str, job_id: str, after: int, stopping: asyncio.Event
) -> AsyncIterator[str]:
    """Changes after version `after`, then new ones until the job has ended, was deleted, or the server stops."""
    seen, spoken = after, time.monotonic()
    said = ""
    while not stopping.is_set():
        look = lookout.look(owner, job_id)
        try:
            row, message = await asyncio.shield(look.job)
            recorded = await asyncio.shield(look.events(seen)) if row.version > seen else []
        except RecordNotFound:
            return
        except SQLAlchemyError:  # also when all connections are in use
            await _pause(stopping)
            continue
        if message != said:
            yield "".join(_message(e.data["kind"], e.version, json.dumps(e.data)) for e in _until(recorded, row))
            yield message
            seen, said, spoken = max(seen, row.version), message, time.monotonic()
        if row.state in TERMINAL:
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

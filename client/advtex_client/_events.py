"""Following a job: server-sent events read line by line, and what a watcher knows between two of them."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import httpx
from pydantic import ValidationError

from advtex_client._calls import is_passing
from advtex_client.errors import ClientError, NetworkError, WaitTimeoutError
from advtex_contract.jobs import TERMINAL, JobView

POLL_SECONDS = 2.0
SILENCE_SECONDS = 45.0  # the server sends a comment every 15 s; a longer silence is a half-open connection
PATIENCE_SECONDS = 600.0  # without any answer, before a watcher gives up on the line

OnTrouble = Callable[[ClientError], None]
"""Called when the line to the server is in trouble; the watch goes on."""


@dataclass(frozen=True)
class Event:
    """One server-sent event (WHATWG HTML, section 9.2)."""

    name: str
    data: str
    id: str


class EventParser:
    """Puts events together: it takes lines without their line ends, and returns an event at the blank line after it."""

    def __init__(self) -> None:
        self.last_id = ""
        self._name = ""
        self._data: list[str] = []

    def feed(self, line: str) -> Event | None:
        if not line:
            event = Event(self._name or "message", "\n".join(self._data), self.last_id) if self._data else None
            self._name, self._data = "", []
            return event
        field, _, value = line.partition(":")
        value = value.removeprefix(" ")
        if field == "data":
            self._data.append(value)
        elif field == "event":
            self._name = value
        elif field == "id" and "\0" not in value:
            self.last_id = value
        return None


class Watch:
    """What is known of a job that is followed: its newest view, the deadline, and how long the line has been silent."""

    def __init__(self, job_id: str, timeout: float | None, on_trouble: OnTrouble | None) -> None:
        self.job_id = job_id
        self.job: JobView | None = None
        self._timeout = timeout
        self._on_trouble = on_trouble
        self._started = self._heard = time.monotonic()
        self._parser = EventParser()

    @property
    def done(self) -> bool:
        return self.job is not None and self.job.state in TERMINAL

    @property
    def expired(self) -> bool:
        return self._remaining() <= 0

    def is_news(self, job: JobView) -> bool:
        """Remember `job`; False for a view that is older than the newest or equal to it."""
        self._heard = time.monotonic()
        if self.job is not None and (job == self.job or job.updated_at < self.job.updated_at):
            return False
        self.job = job
        return True

    def view_from_line(self, line: str) -> JobView | None:
        """Return the job's view that a line of the stream completes, if it does and if it is news."""
        self._heard = time.monotonic()
        event = self._parser.feed(line)
        if event is None:
            return None
        try:
            job = JobView.model_validate_json(event.data)
        except ValidationError:
            return None  # an event of another kind
        return job if self.is_news(job) else None

    def stream_headers(self) -> dict[str, str]:
        headers = {"Accept": "text/event-stream", "Cache-Control": "no-store"}
        return headers | {"Last-Event-ID": self._parser.last_id} if self._parser.last_id else headers

    def stream_timeout(self) -> httpx.Timeout:
        return httpx.Timeout(10.0, read=max(0.05, min(SILENCE_SECONDS, self._remaining())))

    def pause(self) -> float:
        """Return the seconds until the next poll. Raises WaitTimeoutError when the deadline has passed."""
        remaining = self._remaining()
        if remaining <= 0:
            state = f"{self.job.state} at last sight" if self.job else "not seen yet"
            raise WaitTimeoutError(
                f"job {self.job_id} did not end within {self._timeout:g} s ({state}); it goes on, `watch` it again",
                self.job,
            )
        return min(POLL_SECONDS, remaining)

    def trouble(self, error: ClientError) -> None:
        """Say that the line is in trouble, which is never the job's failure, and go on. Raises what will not pass."""
        if not is_passing(error):
            raise error
        if time.monotonic() - self._heard > PATIENCE_SECONDS:
            raise NetworkError(
                f"no answer about job {self.job_id} for {PATIENCE_SECONDS / 60:.0f} minutes: {error}; the job may go on"
            ) from error
        if self._on_trouble:
            self._on_trouble(error)

    def _remaining(self) -> float:
        return float("inf") if self._timeout is None else self._timeout - (time.monotonic() - self._started)


def is_event_stream(response: httpx.Response) -> bool:
    return response.status_code == 200 and response.headers.get("Content-Type", "").startswith("text/event-stream")

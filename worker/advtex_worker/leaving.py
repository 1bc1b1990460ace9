"""When a worker goes without being told to, and how it says why to whoever started it.

Whatever the reason, it goes as on SIGTERM: it takes no more jobs, and one that runs is given back with a checkpoint.
"""

from __future__ import annotations

import argparse
import signal
import time
from dataclasses import dataclass
from datetime import datetime
from enum import Enum
from pathlib import Path
from types import FrameType

import httpx
import structlog
from rq.exceptions import StopRequested

AGAIN = 75  # EX_TEMPFAIL of <sysexits.h>: start it again
STOP_SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGUSR1)
NOTICE_SECONDS = 2.0  # between looks for a notice
NOTICE_TIMEOUT = 2.0
TOKEN_PATH = "/latest/api/token"  # noqa: S105  where EC2 hands out tokens for its metadata
TOKEN_LIFE = {"X-aws-ec2-metadata-token-ttl-seconds": "21600"}

log = structlog.get_logger()


class Reason(Enum):
    """Why a worker goes, and the exit code that says so."""

    asked = "it was asked to", 0
    idle = "it has been idle for long enough", 0
    jobs = "it has had its jobs", 0
    evicted = "SIGUSR1: its machine is wanted", AGAIN
    limit = "its time is up", AGAIN
    notice = "its machine was given notice", AGAIN

    def __init__(self, words: str, exit_code: int) -> None:
        self.words = words
        self.exit_code = exit_code


@dataclass(frozen=True)
class Stay:
    """How long a worker stays, unless it is asked to go.

    max_jobs: attempts that each of its slots takes. idle_seconds: of all its slots at once. until: seconds since 1970,
    by when it is gone. notice: a file that comes to be, or a URL, for both of which see `Notice`.
    """

    max_jobs: int | None = None
    idle_seconds: int | None = None
    until: float | None = None
    notice: str | None = None

    @property
    def is_watched(self) -> bool:
        """Whether something may end it in the middle of a job."""
        return self.until is not None or self.notice is not None

    @property
    def is_short(self) -> bool:
        """Whether a slot may end by itself."""
        return self.max_jobs is not None or self.idle_seconds is not None

    def slot_arguments(self) -> list[str]:
        """What a slot's process is told; the rest is its supervisor's business."""
        told = {"--max-jobs": self.max_jobs, "--exit-when-idle": self.idle_seconds}
        return [word for name, value in told.items() if value is not None for word in (name, str(value))]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Those of `read_stay`."""
    group = parser.add_argument_group("how long it stays", "A job that still runs is given back with a checkpoint.")
    group.add_argument("--max-jobs", type=_positive, metavar="N", help="attempts that each slot takes before it ends")
    group.add_argument(
        "--exit-when-idle", type=_positive, metavar="SECONDS", help="end when none of its slots had a job for so long"
    )
    group.add_argument(
        "--until", type=_time, metavar="TIME", help="be gone by then: seconds since 1970, or as 2026-01-31T18:00"
    )
    group.add_argument(
        "--notice", metavar="FILE_OR_URL", help="end when the file is there, or the URL answers that the machine goes"
    )


def read_stay(told: argparse.Namespace) -> Stay:
    """What the command line says."""
    return Stay(told.max_jobs, told.exit_when_idle, told.until, told.notice)


class Notice:
    """The cloud's notice that it takes the machine away: a file that comes to be, or a URL that answers 200 with
    anything but `FALSE`. Meant for the metadata of EC2 (`spot/instance-action`, which asks for a token) and of Google's
    Compute Engine (`instance/preempted`), and for anything that can make a file."""

    def __init__(self, place: str) -> None:
        self._place = place
        self._next = 0.0
        self._told = ""

    def is_given(self) -> bool:
        """Looked up every few seconds. What cannot be asked is no notice."""
        if time.monotonic() < self._next:
            return False
        self._next = time.monotonic() + NOTICE_SECONDS
        if not self._place.startswith(("http://", "https://")):
            return Path(self._place).exists()
        try:
            answer = self._ask()
        except httpx.HTTPError as error:
            reason = f"{type(error).__name__}: {error}"
            if reason != self._told:
                log.warning("cannot ask whether the machine goes", url=self._place, error=reason)
                self._told = reason
            return False
        return answer.status_code == 200 and answer.text.strip().upper() != "FALSE"

    def _ask(self) -> httpx.Response:
        with httpx.Client(trust_env=False, timeout=NOTICE_TIMEOUT, headers={"Metadata-Flavor": "Google"}) as client:
            answer = client.get(self._place)
            if answer.status_code != 401:
                return answer
            token = client.put(httpx.URL(self._place).join(TOKEN_PATH), headers=TOKEN_LIFE)
            return client.get(self._place, headers={"X-aws-ec2-metadata-token": token.text})


class Departure:
    """Whether this process goes, and why: the first reason counts.

    grace_seconds: a job that is given back takes up to twice as long, for its last step and for its checkpoint.
    """

    def __init__(self, stay: Stay, grace_seconds: float) -> None:
        self.stay = stay
        self.reason: Reason | None = None
        self._end = None if stay.until is None else stay.until - 2 * grace_seconds
        self._notice = None if stay.notice is None else Notice(stay.notice)
        self._jobs = 0

    @property
    def exit_code(self) -> int:
        """Of the process."""
        return 0 if self.reason is None else self.reason.exit_code

    def begin(self, reason: Reason) -> None:
        """Go. From a signal handler too."""
        if self.reason is None:
            self.reason = reason

    def begin_on_signal(self, signum: int) -> None:
        """The same for one of `STOP_SIGNALS`."""
        self.begin(Reason.evicted if signum == signal.SIGUSR1 else Reason.asked)

    def is_due(self) -> bool:
        """Whether it goes; time and notice are looked at."""
        if self._end is not None and time.time() >= self._end:
            self.begin(Reason.limit)
        elif self._notice is not None and self._notice.is_given():
            self.begin(Reason.notice)
        return self.reason is not None

    def count_job(self) -> None:
        """One more has ended here."""
        self._jobs += 1
        if self._jobs == self.stay.max_jobs:
            self.begin(Reason.jobs)

    def raise_on_signals(self) -> None:
        """From now on a signal raises StopRequested in the main thread, for as long as nothing is at stake."""

        def handle(signum: int, _frame: FrameType | None) -> None:
            self.begin_on_signal(signum)
            raise StopRequested

        for number in STOP_SIGNALS:
            signal.signal(number, handle)

    def wait(self, seconds: float) -> None:
        """Before something is tried again. StopRequested."""
        if self.is_due():
            raise StopRequested
        time.sleep(seconds)


def parent_of(pid: int) -> int | None:
    """The process that has started another one; None where nothing tells (it has ended, or this is no Linux)."""
    try:
        told = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return None
    return int(told.rpartition(")")[2].split()[1])


def _positive(text: str) -> int:
    if (number := int(text)) < 1:
        raise argparse.ArgumentTypeError(f"{text} is less than 1")
    return number


def _time(text: str) -> float:
    """Seconds since 1970 of a number of such, or of a date and time, which is local where it names no zone."""
    try:
        return float(text)
    except ValueError:
        pass
    try:
        return datetime.fromisoformat(text).timestamp()
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is neither seconds since 1970 nor a time") from None

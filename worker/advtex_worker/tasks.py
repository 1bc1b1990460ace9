"""What RQ calls, in its work-horse: one attempt of one job."""

from __future__ import annotations

import os
import signal
import socket
import traceback
from contextlib import suppress
from dataclasses import dataclass, field
from types import FrameType

import structlog

from advtex_store.errors import NotUnderstood, RecordNotFound, StaleAttempt
from advtex_store.store import open_store
from advtex_worker.attempt import Attempt
from advtex_worker.runner import ENGINE
from advtex_worker.settings import WorkerSettings
from advtex_worker.tracing import traced
from advtex_worker.workspace import sweep

log = structlog.get_logger()


class StopSignal:
    """SIGTERM, remembered from the moment the horse exists, and handed to the attempt as soon as there is one."""

    def __init__(self) -> None:
        self._received = False
        self._attempt: Attempt | None = None

    def install(self) -> None:
        signal.signal(signal.SIGTERM, self._on_signal)

    def watch(self, attempt: Attempt) -> None:
        self._attempt = attempt
        if self._received:
            attempt.stop()

    def _on_signal(self, _signum: int, _frame: FrameType | None) -> None:
        self._received = True
        if self._attempt is not None:
            self._attempt.stop()


@dataclass(frozen=True)
class Host:
    """What a worker gives to each attempt. `engine` is `module:function` (`events.Request`), `gib` its own class."""

    settings: WorkerSettings
    engine: str = ENGINE
    stop_signal: StopSignal = field(default_factory=StopSignal)
    gib: int | None = None


_host: Host | None = None


def serve_as(host: Host) -> None:
    """Run this process's attempts for `host`; without it, `run_job` reads the settings from the environment."""
    global _host
    _host = host


def run_job(job_id: str, attempt: int) -> None:
    """Claim the attempt and carry it to its end. Returns quietly when another one has the job, or should have it."""
    run_attempt(_host or Host(WorkerSettings()), job_id, attempt)


def run_attempt(host: Host, job_id: str, attempt: int) -> None:
    """The same for a given host."""
    sweep(host.settings.workspaces)
    store = open_store(host.settings)
    try:
        claim = store.records.claim(job_id, attempt, f"{socket.gethostname()}-{os.getpid()}")
    except (StaleAttempt, RecordNotFound) as reason:
        log.info("nothing to do", job=job_id, attempt=attempt, reason=str(reason))
    except NotUnderstood as reason:
        log.warning("declined a job that is not understood here", job=job_id, attempt=attempt, reason=str(reason))
        store.records.decline(job_id, attempt, str(reason))
        store.queue.decline(job_id, attempt)
    else:
        with traced(store, claim) as trace:
            carried = Attempt(store, host.settings, host.engine, claim, host.gib, trace)
            host.stop_signal.watch(carried)
            try:
                carried.carry()
            except Exception:  # a flaw of the worker or its surroundings: the next attempt may fare better
                log.exception("attempt broke", job=job_id, attempt=attempt)
                with suppress(StaleAttempt):
                    store.records.lost(job_id, attempt, log_tail=traceback.format_exc())
    finally:
        store.close()

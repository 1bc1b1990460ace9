"""Checks of scans, beside the requests: each in a process of its own (`check_process.py`), a few at a time.

The threads here live as long as the server: a check's process goes with the thread that started it.
"""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

import structlog
from sqlalchemy.exc import SQLAlchemyError

from advtex_contract.errors import ErrorCode, ErrorDetail
from advtex_contract.jobs import JobError
from advtex_server.check_process import LENGTH
from advtex_server.loops import Loop
from advtex_server.settings import ServerSettings
from advtex_store.blobs import FolderBlobs
from advtex_store.checks import CheckClaim
from advtex_store.errors import (
    BlobNotFound,
    BlobsRefused,
    ReferenceRefused,
    ReferenceUnreadable,
    StaleAttempt,
    StoreError,
)
from advtex_store.memory_estimate import needed_memory
from advtex_store.process_ends import how_it_ended
from advtex_store.references import RemoteScan
from advtex_store.secrecy import public_environment
from advtex_store.store import Store
from advtex_store.tracing import OFF, Traces

COMMAND = (sys.executable, "-m", "advtex_server.check_process")
PROCESSES = 2
CHECK_SECONDS = 1800.0  # what takes longer counts as a death
RENEWALS = 4  # of a claim, in the time that it lasts
LOOK_SECONDS = 0.2  # between looks whether the server stops
RETRY_SECONDS = 0.5  # before a database that is away is asked again
PAUSE_SECONDS = 15.0  # before a scan that could not be read is looked at again

log = structlog.get_logger("advtex.checks")


class CheckDied(Exception):
    """The process ended without a report, or had to be ended; the message says how."""


class Stopping(Exception):
    """The server is about to end."""


class Checker:
    """Checks what is to be checked. `wake` is called when a job has been queued."""

    def __init__(self, store: Store, settings: ServerSettings, wake: Callable[[], None], traces: Traces = OFF) -> None:
        self._store = store
        self._traces = traces
        self._poll_seconds = settings.dispatch_seconds
        self._wake = wake
        self._news = threading.Event()
        self._stopping = threading.Event()
        self.loops = tuple(Loop(f"check-{number}") for number in range(PROCESSES))
        self._threads = [
            threading.Thread(target=self._work, args=(loop,), name=loop.name, daemon=True) for loop in self.loops
        ]

    def start(self) -> None:
        for thread in self._threads:
            thread.start()

    def wake(self) -> None:
        """From any thread: look now."""
        self._news.set()

    def stop(self) -> None:
        """Let go of what is being checked, and end."""
        self._stopping.set()
        self._news.set()
        for thread in self._threads:
            thread.join()

    def _work(self, loop: Loop) -> None:
        """Until the server stops."""
        while not self._stopping.is_set():
            self._news.clear()
            more = False
            with loop.turn():
                claim = self._store.checks.claim()
                if claim is not None:
                    self._carry(claim)
                    more = True
            if not more and not self._stopping.is_set():
                self._news.wait(self._poll_seconds)

    def _carry(self, claim: CheckClaim) -> None:
        """One check, and its outcome, which does not count once the claim is lost."""
        span = self._traces.span("check", claim.traceparent, job=claim.job_id)
        try:
            outcome = self._outcome(claim)
            give_up = time.monotonic() + self._store.checks.lease_seconds
            while True:
                try:
                    outcome()
                    break
                except SQLAlchemyError:
                    if time.monotonic() > give_up:
                        raise
                    time.sleep(RETRY_SECONDS)
        except StaleAttempt as error:
            log.info("a check is stale", job=claim.job_id, reason=str(error))
            return
        finally:
            span.end()
        self._wake()

    def _outcome(self, claim: CheckClaim) -> Callable[[], object]:
        """Check the scan. -> what tells the rows how it came out"""
        checks, told = self._store.checks, log.bind(job=claim.job_id)
        try:
            return self._judged(claim, self._report(claim))
        except StaleAttempt:
            raise
        except Stopping:
            return lambda: checks.release(claim)
        except CheckDied as death:
            how = str(death)
            told.warning("a check died", reason=how)
            return lambda: checks.died(claim, how)
        except (BlobsRefused, ReferenceUnreadable) as error:
            refusal = JobError(code="storage_refused", message=f"the scan cannot be read: {error}")
            told.warning("a scan cannot be read", error=str(error))
            return lambda: checks.postpone(claim, refusal.message, PAUSE_SECONDS, refusal)
        except (BlobNotFound, ReferenceRefused) as error:
            message = str(error) if claim.source else "the scan is no longer stored; submit it again"
            missing = JobError(code="scan_missing", message=message)
            return lambda: checks.failed(claim, missing)
        except (StoreError, OSError) as error:
            reason = f"the scan cannot be read now: {error}"
            told.warning("a scan cannot be read now", error=str(error))
            return lambda: checks.postpone(claim, reason, PAUSE_SECONDS)
        except Exception as error:
            failure = f"the server failed: {type(error).__name__}"
            told.exception("a check failed")
            return lambda: checks.died(claim, failure)

    def _judged(self, claim: CheckClaim, report: Mapping[str, Any]) -> Callable[[], object]:
        checks = self._store.checks
        details = [ErrorDetail.model_validate(finding) for finding in report["findings"]]
        log.info("scan checked", job=claim.job_id, ok=report["ok"], findings=len(details))
        if not report["ok"]:
            return lambda: checks.rejected(claim, _rejection(details))
        size, fuses = report["view_size"], report["mesh"] is None
        memory = needed_memory(claim.options, report["frames_usable"], *size, fuses=fuses)
        return lambda: checks.passed(claim, details, memory)

    def _report(self, claim: CheckClaim) -> dict[str, Any]:
        """What the process finds (`CheckReport.to_dict`). CheckDied, Stopping, StaleAttempt, errors of the storage."""
        place = self._place(claim)
        where = {"path": str(place)} if isinstance(place, Path) else {"label": place.label, "files": place.files}
        process = subprocess.Popen(
            [*COMMAND, str(os.getpid())],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=public_environment(os.environ),
            start_new_session=True,  # a Ctrl-C in the server's terminal is not meant for it
        )
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            _write(process.stdin, json.dumps({"layout": claim.options.layout} | where).encode() + b"\n")
            for line in self._lines(process.stdout, claim):
                message = json.loads(line)
                if "report" in message:
                    return dict(message["report"])
                assert isinstance(place, RemoteScan)
                data = place.fetch(*message["fetch"])
                _write(process.stdin, LENGTH.pack(len(data)) + data)
            raise CheckDied(f"its process {how_it_ended(process.wait())}")
        finally:
            process.kill()
            process.wait()
            with suppress(BrokenPipeError):
                process.stdin.close()
            process.stdout.close()

    def _place(self, claim: CheckClaim) -> Path | RemoteScan:
        if claim.source is not None:
            return self._store.references.look(claim.source)
        blobs, key = self._store.blobs, claim.scan_key
        size = blobs.head(key).size
        if isinstance(blobs, FolderBlobs):
            return blobs.path(key)

        def fetch(_file: str, start: int, end: int) -> bytes:
            return b"".join(blobs.stream(key, start, end))

        return RemoteScan(key.rpartition("/")[2], size, fetch)

    def _lines(self, pipe: IO[bytes], claim: CheckClaim) -> Iterator[bytes]:
        """What the process says, until its end. The claim is renewed meanwhile."""
        begun = renewed = time.monotonic()
        poll = select.poll()
        poll.register(pipe, select.POLLIN)
        rest = bytearray()
        while True:
            if self._stopping.is_set():
                raise Stopping
            now = time.monotonic()
            if now - begun > CHECK_SECONDS:
                raise CheckDied(f"it had not ended after {CHECK_SECONDS:.0f} s")
            if now - renewed > self._store.checks.lease_seconds / RENEWALS:
                with suppress(SQLAlchemyError):  # a database that is away is no reason to stop
                    self._store.checks.renew(claim)
                renewed = now
            if poll.poll(LOOK_SECONDS * 1000):
                data = os.read(pipe.fileno(), 1 << 20)
                if not data:
                    return
                rest += data
                if data.endswith(b"\n"):  # it says one thing at a time
                    yield bytes(rest)
                    rest.clear()


def _write(pipe: IO[bytes], data: bytes) -> None:
    with suppress(BrokenPipeError):  # it is dead, which is noticed where it is heard
        pipe.write(data)
        pipe.flush()


def _rejection(details: list[ErrorDetail]) -> JobError:
    errors = [detail for detail in details if detail.severity == "error"]
    more = f" (and {len(errors) - 1} more problems)" if len(errors) > 1 else ""
    first = f"{errors[0].where} {errors[0].message}".lstrip()  # some are of the scan as a whole
    message = f"the scan cannot be textured: {first}{more}"
    return JobError(code=ErrorCode.invalid_scan, message=message, details=details)

"""The process that owns the device for one attempt: `python -m advtex_worker.runner PARENT_PID`.

It reads a `Request` and then control lines from stdin, and writes events to stdout (`events.py`). It dies with its
parent. Nothing here knows the queue, the rows or the blobs.
"""

from __future__ import annotations

import errno
import importlib
import math
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import IO, Any, Never

from pydantic import ValidationError

from advtex_contract.errors import ErrorDetail
from advtex_contract.live import LiveRecord
from advtex_engine.core.errors import EngineError, MemoryShortage, OptionError, Problem, ScanError, Stopped
from advtex_engine.core.monitor import Glimpse, Monitor
from advtex_store.process_ends import die_with_parent
from advtex_worker.adapt import texture_config
from advtex_worker.events import (
    CANCEL_LINE,
    CANCEL_SECONDS,
    STOP_LINE,
    CheckpointEvent,
    DiskFullEvent,
    Ending,
    Event,
    FailedEvent,
    FinishedEvent,
    LiveEvent,
    NoteEvent,
    ProgressEvent,
    Request,
    StageEvent,
    StoppedEvent,
    WarningEvent,
)

ENGINE = "advtex_engine.pipeline:texture_scan"
VIEW_NAME = 200  # characters of a frame's name that are shown
DISK_SECONDS = 2.0  # between two looks whether a full disk has room again


class Reporter(Monitor):
    """The engine's monitor: tells the parent, and asks nobody but itself whether to stop."""

    def __init__(self, request: Request, events: IO[str], stop: threading.Event) -> None:
        self._request = request
        self._events = events
        self._stop = stop
        self._snapshots = 0
        self._telling = threading.Lock()

    def tell(self, event: Event) -> None:
        with self._telling:
            self._events.write(event.line())
            self._events.flush()

    def end(self, ending: Ending) -> Never:
        """Tell it and exit at once, from any thread: no destructor of a native library may spoil a finished run."""
        self.tell(ending)
        with self._telling:  # no event of another thread is cut off
            sys.stderr.flush()
            os._exit(0)

    def stage_started(self, stage: str) -> None:
        self.tell(StageEvent(stage=stage))

    def stage_finished(
        self, stage: str, seconds: float, peak_memory_bytes: int, peak_device_memory_bytes: int | None
    ) -> None:
        peak, on_device = peak_memory_bytes, peak_device_memory_bytes
        self.tell(StageEvent(stage=stage, seconds=seconds, peak_bytes=peak, device_peak_bytes=on_device))

    def progress(self, step: int, steps: int, losses: Mapping[str, float]) -> None:
        finite = {name: value for name, value in losses.items() if math.isfinite(value)}  # JSON has no others
        self.tell(ProgressEvent(step=step, steps=steps, losses=finite))

    def warning(self, problem: Problem) -> None:
        self.tell(WarningEvent(problem=_detail(problem, "warning")))

    def note(self, message: str) -> None:
        self.tell(NoteEvent(message=message))

    def glimpsed(self, glimpse: Glimpse) -> None:
        """One that breaks the bounds of the contract is left out: a job does not fail for it."""
        pictures = [
            {"name": name, "view": glimpse.titles[name][:VIEW_NAME], "jpeg": jpeg}
            for name, jpeg in glimpse.pictures.items()
        ]
        record = {"step": glimpse.step, "curves": glimpse.curves, "pictures": pictures}
        with suppress(ValidationError):
            self.tell(LiveEvent(record=LiveRecord.model_validate(record)))

    def checkpointed(self, files: tuple[Path, ...]) -> None:
        """The engine replaces files and never changes them, so a hard link keeps this state at no cost."""
        self._snapshots += 1
        folder = self._request.snapshots / str(self._snapshots)
        folder.mkdir(parents=True)
        kept = {}
        for number, path in enumerate(files):
            link = folder / str(number)
            link.hardlink_to(path)
            kept[path.relative_to(self._request.work).as_posix()] = link
        self.tell(CheckpointEvent(files=kept))

    def stop_requested(self) -> bool:
        return self._stop.is_set()

    def wait_for_stop(self, seconds: float) -> bool:
        return self._stop.wait(seconds)


def run(request: Request, reporter: Reporter) -> Ending:
    """Run the engine and say how it ended. A full disk is no end: the engine goes on from its checkpoint later."""
    while (ending := _run_once(request, reporter)) is None:
        reporter.tell(DiskFullEvent())
        print(f"the disk is full: waiting {DISK_SECONDS:.0f} s", file=sys.stderr, flush=True)
        if reporter.wait_for_stop(DISK_SECONDS):
            return StoppedEvent()
        request = request.model_copy(update={"resume": True})
    return ending


def _run_once(request: Request, reporter: Reporter) -> Ending | None:
    """None for a full disk. What is not the engine's own error is logged with its traceback."""
    try:
        texture_scan = _resolved(request.engine)
        texture_config(request.options, "cpu")  # options are refused before a device is waited for
        device, _lock = _device(request, reporter)
        texture_scan(
            request.scan,
            request.out,
            texture_config(request.options, device, request.memory_bytes),
            work=request.work,
            resume=request.resume,
            monitor=reporter,
        )
    except Stopped:
        return StoppedEvent()
    except ScanError as error:
        problems = [_detail(problem, "error") for problem in error.problems]
        return FailedEvent(code="invalid_scan", message=str(error), details=problems)
    except OptionError as error:
        return FailedEvent(code="invalid_options", message=str(error))
    except MemoryShortage as error:
        traceback.print_exc()
        return FailedEvent(code="out_of_memory", message=str(error))
    except EngineError as error:
        traceback.print_exc()
        return FailedEvent(code="engine_error", message=str(error))
    except Exception as error:
        traceback.print_exc()
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            return None
        if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":  # torch's own class
            remedy = "choose a smaller --size or --max-texture-size, or a machine with more memory"
            return FailedEvent(code="out_of_memory", message=f"the engine ran out of memory: {error}; {remedy}")
        return FailedEvent(code="engine_error", message=f"the engine failed: {type(error).__name__}: {error}")
    return FinishedEvent()


def _resolved(engine: str) -> Any:
    module, _, function = engine.partition(":")
    return getattr(importlib.import_module(module), function)


def _device(request: Request, reporter: Reporter) -> tuple[str, object]:
    """The device and its lock, which must be kept while the engine runs."""
    if request.device == "cpu":
        return "cpu", None
    from advtex_worker import devices  # torch is imported by the process that needs it, and only then

    taken = devices.acquire(request.device, reporter.stop_requested, request.jobs_per_gpu)
    if taken is None:
        raise Stopped
    return taken


def _detail(problem: Problem, severity: Any) -> ErrorDetail:
    return ErrorDetail(
        severity=severity, code=problem.code, where=problem.where, message=problem.message, remedy=problem.remedy
    )


def _listen(control: IO[str], stop: threading.Event, reporter: Reporter) -> None:
    for line in control:
        if line in (STOP_LINE, CANCEL_LINE):
            stop.set()
        if line == CANCEL_LINE:
            time.sleep(CANCEL_SECONDS)  # the engine may come to a step, where it writes its checkpoint and ends
            reporter.end(StoppedEvent())  # files are replaced whole: an exit spoils none
    stop.set()  # the parent closed the line


def main() -> None:
    die_with_parent(int(sys.argv[1]), signal.SIGKILL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    events = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # stray prints belong in the log
    request = Request.model_validate_json(sys.stdin.readline())
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda _signum, _frame: stop.set())  # whoever stops all processes at once
    reporter = Reporter(request, events, stop)
    threading.Thread(target=_listen, args=(sys.stdin, stop, reporter), daemon=True).start()
    reporter.end(run(request, reporter))


if __name__ == "__main__":
    main()

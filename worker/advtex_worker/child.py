"""The runner as its parent sees it: started, listened to, asked to stop, and ended."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import IO, Self

from advtex_store.secrecy import public_environment
from advtex_worker.events import CANCEL_LINE, STOP_LINE, Event, Request, parse_event

LOG_TAIL_BYTES = 6000


class Child:
    """A running runner, and a context manager that outlasts it.

    Made on a thread that lives as long as the child is wanted (`die_with_parent`).
    gpu: UUID of the only one that it sees; None for all. returncode: of the process once the block has ended, negative
    for a signal.
    """

    def __init__(self, request: Request, log: Path, threads: int, gpu: str | None = None) -> None:
        self._log = log
        self._lock = threading.Lock()
        self.returncode = 0
        environment = public_environment(os.environ)
        for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
            environment[name] = str(threads)
        if gpu is not None:
            environment["CUDA_VISIBLE_DEVICES"] = gpu
        with log.open("ab") as sink:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "advtex_worker.runner", str(os.getpid())],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=sink,
                env=environment,
                start_new_session=True,  # a Ctrl-C in the worker's terminal is not meant for it
            )
        self._write(request.line())

    @property
    def pid(self) -> int:
        return self._process.pid

    def events(self) -> Iterator[Event]:
        """What the runner says, until its end of the line closes. A line cut off by its death is dropped."""
        pipe: IO[bytes] | None = self._process.stdout
        assert pipe is not None
        for line in pipe:
            if not line.endswith(b"\n"):
                return
            yield parse_event(line)

    def ask_to_stop(self) -> None:
        """With a checkpoint, however long that takes."""
        self._write(STOP_LINE)

    def cancel(self) -> None:
        """The same within `CANCEL_SECONDS`, if need be without the checkpoint."""
        self._write(CANCEL_LINE)

    def kill(self) -> None:
        """End it and whatever it started, at once."""
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """Wait for its end, which an exception hurries; whatever it has started ends too. Sets `returncode`."""
        if kind is not None:
            self.kill()
        self.returncode = self._process.wait()
        self.kill()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe:
                with self._lock, suppress(BrokenPipeError):
                    pipe.close()

    def log_tail(self) -> str:
        """The newest lines of what the runner and its libraries printed."""
        try:
            with self._log.open("rb") as file:
                size = file.seek(0, os.SEEK_END)
                file.seek(max(0, size - LOG_TAIL_BYTES))
                return file.read().decode("utf-8", errors="replace")
        except FileNotFoundError:  # the workspace is gone already
            return ""

    def _write(self, line: str) -> None:
        pipe = self._process.stdin
        assert pipe is not None
        with self._lock, suppress(BrokenPipeError, ValueError):  # it is dead; that is noticed where events are read
            pipe.write(line.encode())
            pipe.flush()

"""Work in child processes that a stop ends at once, whatever native code they are in.

A child is a fresh `python -m advtex_engine.runtime.children MODULE:FUNCTION`, which imports what the function needs and
nothing of the program that runs. It reads the function's arguments (arrays by name) from stdin and writes the arrays
that the function returns to stdout. It ends with its parent: its stdin is closed then.
"""

from __future__ import annotations

import fcntl
import importlib
import io
import os
import signal
import struct
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from advtex_engine.core.errors import EngineError, Stopped
from advtex_engine.core.monitor import Monitor

Arrays = dict[str, npt.NDArray[Any]]

STOP_SECONDS = 0.2  # between two looks whether a stop was asked for
TRIES = 2  # a child that was killed is repeated once: what took its memory may be gone
LENGTH = struct.Struct("<Q")


def run_in_children(
    function: str, requests: Sequence[Mapping[str, npt.NDArray[Any]]], processes: int, monitor: Monitor, remedy: str
) -> list[Arrays]:
    """The results of `function` ("module:name") for each request, in their order, `processes` at a time.

    Raises Stopped when the monitor asks for it, and EngineError with the remedy when a child died on the same request
    twice; no child is left then.
    """
    children = _Children(function, remedy)
    with ThreadPoolExecutor(processes) as pool:
        futures = [pool.submit(children.run, request) for request in requests]
        waiting = set(futures)
        try:
            while waiting:
                done, waiting = wait(waiting, STOP_SECONDS, FIRST_COMPLETED)
                for future in done:
                    future.result()
                if waiting and monitor.stop_requested():
                    raise Stopped("stopped between parts; resume begins the stage again")
        except BaseException:
            children.kill()
            raise
    return [future.result() for future in futures]


class _Children:
    """The children that run now, so that all can be ended."""

    def __init__(self, function: str, remedy: str) -> None:
        self._function, self._remedy = function, remedy
        self._lock = threading.Lock()
        self._running = set[subprocess.Popen[bytes]]()
        self._closed = False

    def run(self, request: Mapping[str, npt.NDArray[Any]]) -> Arrays:
        for _ in range(TRIES):
            with self._lock:
                if self._closed:
                    raise Stopped("stopped before a part")
                command = [sys.executable, "-m", "advtex_engine.runtime.children", self._function]
                child = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
                self._running.add(child)
            try:
                answer = _ask(child, request)
            finally:
                with self._lock:
                    self._running.discard(child)
            if answer is not None:
                return answer
        how = f"signal {-child.returncode}" if child.returncode < 0 else f"exit status {child.returncode}"
        raise EngineError(f"a child process of {self._function} died ({how}), twice on the same part; {self._remedy}")

    def kill(self) -> None:
        with self._lock:
            self._closed = True
            for child in self._running:
                child.kill()


def _ask(child: subprocess.Popen[bytes], request: Mapping[str, npt.NDArray[Any]]) -> Arrays | None:
    """The child's answer once it has ended; None if it died."""
    try:
        with child:
            assert child.stdin is not None
            assert child.stdout is not None
            _send(child.stdin, request)
            return _receive(child.stdout)
    except (BrokenPipeError, EOFError):
        return None


def _send(stream: IO[bytes], arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    packed = io.BytesIO()
    np.savez(packed, allow_pickle=False, **arrays)
    stream.write(LENGTH.pack(packed.getbuffer().nbytes))
    stream.write(packed.getbuffer())
    stream.flush()


def _receive(stream: IO[bytes]) -> Arrays:
    header = stream.read(LENGTH.size)
    if len(header) < LENGTH.size:
        raise EOFError
    (length,) = LENGTH.unpack(header)
    data = stream.read(length)
    if len(data) < length:
        raise EOFError
    with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
        return dict(arrays)


def _end_with_parent() -> None:
    """A closed stdin sends SIGIO, which ends a process that does not handle it."""
    fcntl.fcntl(0, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(0, fcntl.F_SETFL, fcntl.fcntl(0, fcntl.F_GETFL) | os.O_ASYNC)


def main() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to the whole group; the parent decides
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # stray prints belong in the log
    module, _, name = sys.argv[1].partition(":")
    request = _receive(sys.stdin.buffer)
    _end_with_parent()
    try:
        answer = getattr(importlib.import_module(module), name)(**request)
    finally:
        signal.signal(signal.SIGIO, signal.SIG_IGN)  # an error ends the process with its own exit status
    _send(answers, answer)


if __name__ == "__main__":
    main()

"""Child processes of server and worker: they die with their parent, and start again when they die first."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress

import structlog

from advtex_store.process_ends import die_with_parent, how_it_ended

RESTART_SECONDS = (1.0, 2.0, 5.0, 10.0, 30.0)  # pauses before further starts of a child that keeps dying
STEADY_SECONDS = 60.0  # a child that lived this long starts again at the shortest pause

log = structlog.get_logger("advtex.children")


class Supervised:
    """One process that is kept alive. All methods are called from the main thread (`die_with_parent`).

    stdin: what it is told at each start. stop_seconds: how long it may take to end; None for as long as it likes.
    """

    def __init__(
        self,
        name: str,
        command: Sequence[str],
        environment: Mapping[str, str],
        *,
        stdin: Callable[[], str] | None = None,
        stop_seconds: float | None = None,
    ) -> None:
        self.name = name
        self._command = list(command)
        self._environment = dict(environment)
        self._stdin = stdin
        self._stop_seconds = stop_seconds
        self._process: subprocess.Popen[bytes] | None = None
        self._started = 0.0
        self._failures = 0
        self._next_start = 0.0
        self._asked = False

    @property
    def pid(self) -> int | None:
        """Of the living process."""
        return self._process.pid if self._process is not None and self._process.poll() is None else None

    @property
    def exit_code(self) -> int | None:
        """Of the process that has ended; None while it lives, or before it was started."""
        return None if self._process is None else self._process.poll()

    def start(self) -> None:
        """Start it. Its output goes to this process's stderr, so that stdout stays for machine-readable lines."""
        self._asked = False
        parent = os.getpid()
        self._process = subprocess.Popen(
            self._command,
            env=self._environment,
            stdin=subprocess.DEVNULL if self._stdin is None else subprocess.PIPE,
            stdout=sys.stderr.fileno(),
            stderr=sys.stderr.fileno(),
            start_new_session=True,  # Ctrl-C reaches this process only, which stops its children in order
            preexec_fn=lambda: die_with_parent(parent, signal.SIGTERM),
        )
        if self._stdin is not None:
            assert self._process.stdin is not None
            with suppress(BrokenPipeError), self._process.stdin as pipe:  # it died; `watch` sees that
                pipe.write(self._stdin().encode())
        self._started = time.monotonic()
        log.info("started", child=self.name, pid=self._process.pid)

    def watch(self) -> None:
        """Start it again if it has died, after a pause that grows."""
        if self._process is None or self._process.poll() is None:
            return
        now = time.monotonic()
        if self._next_start == 0.0:
            self._failures = 1 if now - self._started > STEADY_SECONDS else self._failures + 1
            pause = RESTART_SECONDS[min(self._failures, len(RESTART_SECONDS)) - 1]
            self._next_start = now + pause
            log.warning("starts again", child=self.name, died=how_it_ended(self._process.returncode), pause=pause)
        if now >= self._next_start:
            self._next_start = 0.0
            self.start()

    def ask_to_stop(self) -> None:
        """SIGTERM, once: a second one would make a worker give up what it is just saving."""
        if not self._asked and self._process is not None and self._process.poll() is None:
            self._process.send_signal(signal.SIGTERM)
            self._asked = True

    def wait(self) -> None:
        """Until it is gone; killed, with its process group, when it takes too long."""
        if self._process is None:
            return
        try:
            self._process.wait(self._stop_seconds)
        except subprocess.TimeoutExpired:
            log.warning("does not stop, killed", child=self.name)
            os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()
        log.info("stopped", child=self.name, exit_code=self._process.returncode)

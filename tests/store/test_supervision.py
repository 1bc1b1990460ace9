"""Child processes that are kept alive: stopped in order, started again ever more slowly, gone with their parent."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import psutil
import pytest

from advtex_store.process_ends import how_it_ended
from advtex_store.supervision import Supervised

PARENT = """
import os, time
from advtex_store.logs import configure_logs
from advtex_store.supervision import Supervised
configure_logs()
child = Supervised("sleeper", ["sleep", "60"], os.environ)
child.start()
print(child.pid, flush=True)
time.sleep(60)
"""


def until(condition: Callable[[], Any], seconds: float = 20) -> Any:
    deadline = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < deadline, condition
        time.sleep(0.02)
    return found


def test_a_child_that_does_not_stop_is_killed_with_its_own_children() -> None:
    script = "trap '' TERM; sleep 60 & echo; wait; sleep 60"
    child = Supervised("stubborn", ["sh", "-c", script], os.environ, stop_seconds=0.3)
    child.start()
    assert child.pid is not None
    process = psutil.Process(child.pid)
    grandchildren = until(process.children)
    child.ask_to_stop()
    child.wait()
    assert child.pid is None
    until(lambda: not any(p.is_running() and p.status() != psutil.STATUS_ZOMBIE for p in grandchildren))


def test_a_child_that_keeps_dying_is_started_ever_more_slowly(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [1000.0]
    monkeypatch.setattr("advtex_store.supervision.time.monotonic", lambda: now[0])
    child = Supervised("dying", ["true"], os.environ, stop_seconds=1)
    child.start()
    pauses = []
    for lived in (0, 0, 0, 0, 0, 0, 100):
        assert child._process is not None
        child._process.wait()
        now[0] += lived
        dead, died = child._process, now[0]
        while child._process is dead:
            child.watch()
            now[0] += 0.5
        pauses.append(now[0] - died - 0.5)
    child.wait()
    assert pauses == [1.0, 2.0, 5.0, 10.0, 30.0, 30.0, 1.0]


def test_a_child_goes_with_its_killed_parent() -> None:
    with subprocess.Popen([sys.executable, "-c", PARENT], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        child = psutil.Process(int(parent.stdout.readline()))
        parent.send_signal(signal.SIGKILL)
    until(lambda: not child.is_running() or child.status() == psutil.STATUS_ZOMBIE)


@pytest.mark.parametrize(
    ("code", "words"),
    [(-9, "out of memory"), (-11, "SIGSEGV"), (-15, "SIGTERM"), (3, "exit code 3"), (-50, "signal 50"), (0, "without")],
)
def test_a_death_is_put_into_words(code: int, words: str) -> None:
    assert words in how_it_ended(code)

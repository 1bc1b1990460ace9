"""Threads that operations take: what other processes leave of the cores."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from advtex_engine.runtime import threads
from advtex_engine.runtime.threads import (
    fit_threads,
    fitting_threads,
    side_by_side,
    thread_limit,
    threads_each,
    threads_fitted,
)

CORES = len(os.sched_getaffinity(0))


@pytest.fixture
def limit() -> Iterator[int]:
    before = torch.get_num_threads()
    torch.set_num_threads(CORES)
    yield CORES
    torch.set_num_threads(before)


class Machine:
    """A /proc/stat and clocks that go on as they are told."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, stat: Path) -> None:
        self._stat, self._at, self._own, self._children, self._ticks = stat, 0.0, 0.0, 0.0, 1000
        monkeypatch.setattr(threads, "STAT", stat)
        monkeypatch.setattr(time, "monotonic", lambda: self._at)
        monkeypatch.setattr(time, "process_time", lambda: self._own)
        used = resource.struct_rusage
        monkeypatch.setattr(resource, "getrusage", lambda _: used((self._children, *[0] * (used.n_fields - 1))))
        self.go_on(0, own=0, others=0)

    def go_on(self, seconds: float, *, own: float, others: float, children: float = 0) -> None:
        """For so long, this process, the others, and children that end then use so many cores."""
        self._at += seconds
        self._own += seconds * own
        self._children += seconds * children
        self._ticks += round(seconds * (own + others + children) * os.sysconf("SC_CLK_TCK"))
        core = min(os.sched_getaffinity(0))
        self._stat.write_text(
            f"cpu  1 1 1 1\ncpu{core} {self._ticks} 0 0 {self._at} 0 0 0 0 0 0\ncpu9999 {self._at} 0 0 0 0 0 0 0 0 0\n"
        )


def test_calls_side_by_side_share_the_threads_of_operations() -> None:
    meeting = threading.Barrier(2, timeout=20)

    def call(number: int) -> tuple[int, int]:
        meeting.wait()
        return number, torch.get_num_threads()

    with threads_each(4), side_by_side(2) as mapped:
        for _ in range(2):
            assert mapped(call, [1, 2]) == [(1, 2), (2, 2)]
        assert torch.get_num_threads() == 4
        assert mapped(lambda _: torch.get_num_threads(), [1]) == [4], "one alone has them all"


def test_without_threads_for_it_calls_follow_one_another() -> None:
    with threads_each(1), side_by_side(2) as mapped:
        assert mapped(lambda number: (number, threading.get_ident()), [1, 2]) == [
            (1, threading.get_ident()),
            (2, threading.get_ident()),
        ]


def test_cores_that_others_use_are_left_to_them() -> None:
    assert [fitting_threads(2, 2, others) for others in (0, 0.2, 0.3, 1, 2, 5)] == [2, 2, 1, 1, 1, 1]
    assert [fitting_threads(16, 16, others) for others in (0.2, 4, 4.3, 15, 16)] == [16, 12, 11, 1, 1]
    assert fitting_threads(4, 16, 8) == 4


@given(st.integers(1, 256), st.integers(1, 256), st.floats(-1, 300))
def test_there_are_as_many_as_allowed_and_one_at_least(most: int, cores: int, others: float) -> None:
    fitting = fitting_threads(most, cores, others)
    assert 1 <= fitting <= most
    assert fitting <= fitting_threads(most, cores, others - 1) <= fitting + 1


@pytest.mark.skipif(CORES < 2, reason="needs two cores")
def test_what_others_use_is_left_to_them_until_they_stop(
    limit: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    machine = Machine(monkeypatch, tmp_path / "stat")
    with threads_fitted():
        for own, others, left in ((limit, 0, limit), (1, limit - 1, 1), (1, 0, limit), (0, 2 * limit, 1)):
            machine.go_on(10, own=own, others=others)
            fit_threads()
            assert torch.get_num_threads() == left
            assert thread_limit() == limit
        machine.go_on(10, own=1, others=0, children=limit - 1)
        fit_threads()
        assert torch.get_num_threads() == limit, "what ended children used is free again"
        machine.go_on(10, own=0, others=2 * limit)
        fit_threads()
        machine.go_on(0.5, own=1, others=0)  # too short to tell
        fit_threads()
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == limit


@pytest.mark.skipif(CORES < 2, reason="needs two cores")
def test_busy_processes_are_noticed(limit: int) -> None:
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(CORES)]
    try:
        with threads_fitted():
            time.sleep(1.5)
            fit_threads()
            assert torch.get_num_threads() < limit
    finally:
        for process in busy:
            process.kill()
            process.wait()


def test_outside_of_a_run_and_without_a_system_that_tells_nothing_changes(
    limit: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    fit_threads()
    assert torch.get_num_threads() == thread_limit() == limit
    monkeypatch.setattr(threads, "STAT", tmp_path / "none")
    with threads_fitted():
        fit_threads()
        assert torch.get_num_threads() == limit

"""Work on many items in a few threads, read ahead by no more than is worked on; how many threads operations take."""

from __future__ import annotations

import os
import resource
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import torch

WORKERS = 16  # an image of 12 megapixels takes 70 MB while it is decoded
BUSY_FIELDS = (1, 2, 3, 6, 7, 8)  # of a core in /proc/stat: user, nice, system, irq, softirq, steal
STAT = Path("/proc/stat")
WINDOW_SECONDS = 1.0  # over which load is measured, at least
# Of a core that others may use before it counts as taken. With one of two cores taken, a run of two threads takes 1.6
# times as long as one of a single thread: each operation waits for the thread whose turn it is not.
TOLERATED = 0.25
T = TypeVar("T")
R = TypeVar("R")


def in_threads(function: Callable[[T], R], items: Iterable[T], workers: int | None = None) -> Iterator[R]:
    """The results in order. The items are drawn on the calling thread; of them and of the results few are held.

    workers: threads, by default WORKERS or as many as there are cores; 1 does without any.
    """
    workers = workers or min(WORKERS, os.cpu_count() or 1)
    if workers == 1:
        yield from map(function, items)
        return
    pending = deque[Future[R]]()
    with ThreadPoolExecutor(workers, thread_name_prefix="advtex") as pool:
        for item in items:
            pending.append(pool.submit(function, item))
            if len(pending) > workers:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()


@contextmanager
def side_by_side(workers: int) -> Iterator[Callable[[Callable[[T], R], Sequence[T]], list[R]]]:
    """Within it a map whose calls go on in `workers` threads, which share those that PyTorch's operations take.

    One call after the other where these take only one.
    """
    with ThreadPoolExecutor(workers, thread_name_prefix="advtex") as pool:

        def mapped(function: Callable[[T], R], items: Sequence[T]) -> list[R]:
            threads = torch.get_num_threads()
            if min(workers, threads, len(items)) == 1:
                return [function(item) for item in items]
            with threads_each(max(1, threads // workers)):
                return list(pool.map(function, items))

        yield mapped


@contextmanager
def threads_each(count: int) -> Iterator[None]:
    """Within it PyTorch's operations on the CPU take so many threads, also those of threads that begin in it."""
    threads = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def one_thread_each() -> AbstractContextManager[None]:
    """Within it PyTorch's operations on the CPU take one thread: those on small pictures mostly wait for a second."""
    return threads_each(1)


@dataclass
class _Load:
    """What was measured last. limit: threads without any load. busy, own: seconds of all processes, of this one's."""

    limit: int
    at: float
    busy: float
    own: float


_load: _Load | None = None


@contextmanager
def threads_fitted() -> Iterator[None]:
    """Within it `fit_threads` decides how many threads PyTorch's operations take; afterwards they take what they took.

    Without effect where the system does not tell how busy its cores are.
    """
    global _load  # as PyTorch's own number of threads is
    limit, busy = torch.get_num_threads(), _busy_seconds()
    if busy is None:
        yield
        return
    _load = _Load(limit, time.monotonic(), busy, _own_seconds())
    try:
        yield
    finally:
        _load = None
        torch.set_num_threads(limit)


def fit_threads() -> None:
    """To be called between operations, however often: leaves cores that other processes use to these."""
    if _load is None or (passed := time.monotonic() - _load.at) < WINDOW_SECONDS or (busy := _busy_seconds()) is None:
        return
    own = _own_seconds()
    others = (busy - _load.busy - (own - _load.own)) / passed
    torch.set_num_threads(fitting_threads(_load.limit, len(_cores()), others))
    _load.at, _load.busy, _load.own = time.monotonic(), busy, own


def fitting_threads(limit: int, cores: int, others: float) -> int:
    """How many of at most `limit` threads run at once on `cores` of which other processes use `others`."""
    return max(1, min(limit, int(cores - others + TOLERATED)))


def thread_limit() -> int:
    """Threads that PyTorch's operations take where other processes leave all cores."""
    return torch.get_num_threads() if _load is None else _load.limit


def _own_seconds() -> float:
    """Of this process and of its children that have ended: what these used is free again."""
    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + ended.ru_utime + ended.ru_stime


def _busy_seconds() -> float | None:
    """Of the cores that this process may use, since the system's start; None where there is no /proc/stat."""
    names = {f"cpu{core}" for core in _cores()}
    try:
        lines = [line.split() for line in STAT.read_text().splitlines()]
    except OSError:
        return None
    ticks = sum(int(line[field]) for line in lines if line and line[0] in names for field in BUSY_FIELDS)
    return ticks / os.sysconf("SC_CLK_TCK")


def _cores() -> set[int]:
    return os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set(range(os.cpu_count() or 1))

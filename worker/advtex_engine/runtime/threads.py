"""Work on many items in a few threads, read ahead by no more than is worked on."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import torch

WORKERS = 16  # an image of 12 megapixels takes 70 MB while it is decoded
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
def one_thread_each() -> Iterator[None]:
    """Within it PyTorch's operations on the CPU take one thread: those on small pictures mostly wait for a second."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)

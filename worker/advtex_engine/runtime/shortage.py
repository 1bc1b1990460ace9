"""Errors that say that there is too little memory."""

from __future__ import annotations

import errno

import torch


def memory_problem(error: BaseException) -> str | None:
    """What an error says if it is one of too little memory, None for any other.

    torch's CPU allocator, cuBLAS and cuDNN, and mmap have no class of their own for it.
    """
    if isinstance(error, MemoryError | torch.OutOfMemoryError):
        return str(error) or type(error).__name__
    if isinstance(error, OSError) and error.errno == errno.ENOMEM:
        return str(error)
    said = str(error)
    return said if isinstance(error, RuntimeError) and any(words in said for words in _SHORTAGES) else None


_SHORTAGES = (
    "can't allocate memory",
    "not enough memory",
    "out of memory",
    "Cannot allocate memory",
    "ALLOC_FAILED",
    "std::bad_alloc",
    "unable to find an engine to execute this computation",  # what cuDNN says when no plan gets its workspace
)

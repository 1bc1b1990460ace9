"""Engine errors.

EngineError
├── ScanError       the scan cannot be textured; `findings` say what and how to mend it
├── OptionError     an option is out of bounds or unknown
├── MemoryShortage  the device has too little memory, also for the least that can be done
├── Diverged        the losses or the texture are no longer finite
└── Stopped         a stop was asked for; a checkpoint is on disk
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


class EngineError(Exception):
    """Base of all errors that the engine raises on purpose. The message names the input and the remedy."""


@dataclass(frozen=True)
class Problem:
    """One thing that is wrong with a scan."""

    code: str
    where: str
    message: str
    remedy: str


def few_of(names: Sequence[str]) -> str:
    """The first three, and how many more there are."""
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


class ScanError(EngineError):
    """The scan cannot be textured. The message tells of problems that differ in their places alone once."""

    def __init__(self, *problems: Problem) -> None:
        places = dict[tuple[str, str], list[str]]()
        for problem in problems:
            places.setdefault((problem.message, problem.remedy), []).append(problem.where)
        super().__init__("; ".join(f"{few_of(names)}: {what} ({remedy})" for (what, remedy), names in places.items()))
        self.problems = problems


class OptionError(EngineError):
    """An option is out of bounds or unknown."""


class MemoryShortage(EngineError):
    """The device has too little memory, and nothing is left to be made smaller."""


class Diverged(EngineError):
    """The losses or the texture are no longer finite, also with half the learning rates."""


class Stopped(EngineError):
    """The run was asked to stop and has written its checkpoint."""

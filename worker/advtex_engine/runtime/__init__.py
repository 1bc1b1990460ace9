"""What runs need of the machine: devices, memory, threads, child processes, files, checkpoints.

The room's names come when they are asked for: child processes start from here (`children`), without torch.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from advtex_engine.runtime.checkpoint import WorkFolder
    from advtex_engine.runtime.devices import choose_device
    from advtex_engine.runtime.stage_records import Stages
    from advtex_engine.runtime.threads import threads_fitted

__all__ = ["Stages", "WorkFolder", "choose_device", "threads_fitted"]

_MODULES = {
    "Stages": "stage_records",
    "WorkFolder": "checkpoint",
    "choose_device": "devices",
    "threads_fitted": "threads",
}


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)

"""What runs need of the machine: devices, memory, threads, child processes, files, checkpoints."""

from advtex_engine.runtime.checkpoint import WorkFolder
from advtex_engine.runtime.devices import choose_device
from advtex_engine.runtime.stage_records import Stages

__all__ = ["Stages", "WorkFolder", "choose_device"]

"""Slots: a place for one job at a time on a GPU. A worker has as many as its GPUs can have jobs.

Each slot has a process with an RQ worker of its own, which is told by `ADVTEX_GPU` which GPU its jobs see. It holds a
lock for as long as it lives, so that of all workers of a machine no more take jobs than its GPUs can have; the others
wait without a job, and step in when one goes.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import FrameType
from typing import IO

import structlog

from advtex_store.supervision import Supervised
from advtex_worker.leaving import STOP_SIGNALS, Departure
from advtex_worker.locks import first_lock, lock_paths
from advtex_worker.memory import list_gpus, usable_memory
from advtex_worker.settings import WorkerSettings

POLL_SECONDS = 0.2

log = structlog.get_logger()


@dataclass(frozen=True)
class Slot:
    """gpu: UUID, None where the runner finds its device itself. memory_bytes: what a job may use."""

    gpu: str | None
    memory_bytes: int


def find_slots(settings: WorkerSettings) -> list[Slot]:
    """All slots that the settings give this machine, or the one of a process that was started for it; at least one.

    A GPU's memory is shared out evenly among its slots.
    """
    gpus = [] if settings.device == "cpu" else list_gpus()
    if settings.gpu is not None:
        gpus = [gpu for gpu in gpus if gpu.uuid == settings.gpu]
    elif ":" in settings.device:
        number = int(settings.device.partition(":")[2])
        gpus = gpus[number : number + 1]
    elif settings.device == "cuda":
        gpus = gpus[:1]
    if not gpus:
        return [Slot(settings.gpu, settings.memory_bytes or usable_memory(settings.device))]
    jobs = settings.jobs_per_gpu
    slots = [Slot(gpu.uuid, settings.memory_bytes or gpu.memory_bytes // jobs) for gpu in gpus]
    return slots if settings.gpu is not None else [slot for _ in range(jobs) for slot in slots]


def settings_of(slot: Slot, settings: WorkerSettings, slots: int) -> WorkerSettings:
    """For the one slot of a process: its GPU, its share of memory, and of the threads if nobody has set them."""
    changed: dict[str, object] = {"gpu": slot.gpu}
    if settings.jobs_per_gpu > 1 and slot.gpu is not None:
        changed["memory_bytes"] = slot.memory_bytes
    if "threads" not in settings.model_fields_set:
        changed["threads"] = max(1, settings.threads // slots)
    return settings.model_copy(update=changed)


def hold(slot: Slot, jobs: int, wait: Callable[[float], object]) -> IO[bytes] | None:
    """The lock of a slot on its GPU, waited for; None for one that has no GPU of its own."""
    if slot.gpu is None:
        return None
    told = False
    while (lock := first_lock(lock_paths(f"slot-{slot.gpu}", jobs))) is None:
        if not told:
            log.info("all slots of the GPU are taken by other workers; waiting", gpu=slot.gpu)
            told = True
        wait(POLL_SECONDS)
    return lock


def supervise(command: Sequence[str], slots: Sequence[Slot], settings: WorkerSettings, departure: Departure) -> None:
    """One process per slot, started again when it dies, until a signal comes or the stay is over; each then gives its
    job back. Where slots may end by themselves, those that have are not started again."""
    environments = [_environment(settings_of(slot, settings, len(slots))) for slot in slots]
    children = [Supervised(f"slot {number}", command, told) for number, told in enumerate(environments)]

    def stop(signum: int, _frame: FrameType | None) -> None:
        departure.begin_on_signal(signum)

    for number in STOP_SIGNALS:
        signal.signal(number, stop)
    if departure.is_due():
        return
    for child in children:
        child.start()
    staying = children
    while staying and not departure.is_due():
        for child in staying:
            child.watch()
        time.sleep(POLL_SECONDS)
        if departure.stay.is_short:
            staying = [child for child in staying if child.exit_code != 0]
    for child in children:
        child.ask_to_stop()
    for child in children:
        child.wait()


def _environment(settings: WorkerSettings) -> dict[str, str]:
    told = os.environ | {"ADVTEX_THREADS": str(settings.threads)}
    if settings.gpu is not None:
        told["ADVTEX_GPU"] = settings.gpu
    if settings.memory_bytes is not None:
        told["ADVTEX_MEMORY_BYTES"] = str(settings.memory_bytes)
    return told

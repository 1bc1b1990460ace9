"""What the device itself can do, measured: the two numbers that every floor is made of."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import torch

from advtex_engine.runtime.devices import wait_for

FIRST_SIDE, LAST_SIDE = 1024, 8192  # of the matrices that are multiplied
LONG_ENOUGH = 0.05  # seconds of a repetition
REPETITIONS = 5
COPIED_BYTES = {"cpu": 128 << 20, "cuda": 1 << 30}  # far more than caches hold


@dataclass(frozen=True)
class Limits:
    """flops: of a large matrix product, per second. bytes: read and written by a large copy on the device, per second.

    upload: bytes per second from page-locked memory of the host to the device; on a CPU, half of `bytes`.
    """

    flops: float
    bytes: float
    upload: float

    def floor(self, flops: float, moved: float, uploaded: float = 0.0) -> float:
        """Seconds below which no program does so many operations and reads and writes so many bytes.

        The three are added: what overlaps in practice is not taken for granted.
        """
        return flops / self.flops + moved / self.bytes + uploaded / self.upload


def measure_limits(device: torch.device, dtype: torch.dtype) -> Limits:
    """dtype: of the matrices, that of the step's convolutions. Takes about a second."""
    return Limits(_product(device, dtype), _copy(device), _upload(device))


def least_seconds(work: Callable[[], object], device: torch.device, repetitions: int = REPETITIONS) -> float:
    """The median of the repetitions, after one that does not count."""
    times = []
    for _ in range(repetitions + 1):
        wait_for(device)
        started = time.perf_counter()
        work()
        wait_for(device)
        times.append(time.perf_counter() - started)
    return min(times[1:])


def _product(device: torch.device, dtype: torch.dtype) -> float:
    """Operations per second of the largest product that is worth its time."""
    side = FIRST_SIDE
    while True:
        a, b = (torch.rand((side, side), device=device).to(dtype) for _ in range(2))
        out = torch.empty_like(a)
        seconds = least_seconds(lambda a=a, b=b, out=out: torch.mm(a, b, out=out), device)  # type: ignore[misc]
        if seconds >= LONG_ENOUGH or side >= LAST_SIDE:
            return 2 * side**3 / seconds
        side *= 2


def _copy(device: torch.device) -> float:
    source = torch.ones(COPIED_BYTES[device.type] // 4, device=device)
    target = torch.empty_like(source)
    return 2 * source.nbytes / least_seconds(lambda: target.copy_(source), device)


def _upload(device: torch.device) -> float:
    if device.type == "cpu":
        return _copy(device) / 2
    source = torch.empty(COPIED_BYTES["cpu"], dtype=torch.uint8, pin_memory=True)
    target = torch.empty_like(source, device=device)
    return source.nbytes / least_seconds(lambda: target.copy_(source, non_blocking=True), device)

"""Which operations a step's time goes to, by torch's profiler: what stands between a part and its floor."""

from __future__ import annotations

from typing import Any

from torch.profiler import ProfilerActivity, profile

from advtex_engine.adversarial.cuda_graph import Stepper
from advtex_engine.runtime.devices import wait_for

SHOWN = 12
LONGEST_NAME = 100  # of a kernel, whose template arguments may fill pages
MANY = 1_000_000


def profile_steps(stepper: Stepper, steps: int) -> dict[str, Any]:
    """Profiles steps as a run takes them: busy_ms per step, and the operations that take most of it.

    On a GPU the operations are kernels, and what busy_ms lacks of a step's time is spent between them; on a CPU they
    are torch's, each without those that it calls. A GPU whose counters may not be read says nothing: no operations.
    """
    device, taken = stepper.optimizer.device, 0
    on_gpu = device.type == "cuda"
    with profile(activities=[ProfilerActivity.CUDA if on_gpu else ProfilerActivity.CPU]) as profiler:
        while taken < steps:
            taken += stepper.take(MANY)
        wait_for(device)
    kind = "CUDA" if on_gpu else "CPU"
    found = [
        (event.self_device_time_total if on_gpu else event.self_cpu_time_total, event.count, event.key)
        for event in profiler.key_averages()
        if event.device_type.name == kind
    ]
    busy = sum(microseconds for microseconds, _, _ in found)
    return {
        "busy_ms": float(f"{busy / taken / 1e3:.4g}"),
        "operations": [
            {
                "name": name[:LONGEST_NAME],
                "calls": round(calls / taken, 2),
                "ms": float(f"{microseconds / taken / 1e3:.4g}"),
                "share": round(microseconds / busy, 3),
            }
            for microseconds, calls, name in sorted(found, reverse=True)[:SHOWN]
        ],
    }

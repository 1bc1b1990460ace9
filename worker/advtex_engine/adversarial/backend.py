"""Which form of a step's operations a device gets: Triton's on a GPU that can have them, else torch's."""

from __future__ import annotations

import importlib.util
import shutil

import torch

from advtex_engine.adversarial.operations import Operations, plain_operations


def choose_operations(device: torch.device) -> Operations:
    """Triton's on a GPU that can have them, else the plain ones with the reason."""
    if device.type != "cuda":
        return plain_operations("the device is not an NVIDIA GPU")
    if importlib.util.find_spec("triton") is None:
        return plain_operations("the package triton is missing")
    if shutil.which("gcc") is None and shutil.which("clang") is None:
        return plain_operations("Triton needs a C compiler; install gcc")
    try:
        from advtex_engine.adversarial.triton_operations import triton_operations

        fused = triton_operations()
        # Whatever is amiss with compiler, driver or card shows in the first kernel, and had better do so here.
        mean, state = torch.zeros(1, device=device), torch.ones(1, device=device)
        fused.average(mean, state, torch.ones((), device=device))
        found = float(mean)
    except Exception as error:
        return plain_operations(f"Triton failed: {error}")
    return fused if found == 1.0 else plain_operations(f"Triton computes {found} where 1.0 is right")

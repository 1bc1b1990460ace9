"""The device that a run computes on, by its name."""

from __future__ import annotations

import torch

from advtex_engine.core.errors import OptionError


def choose_device(name: str) -> torch.device:
    """ "auto" is the GPU when there is one. Raises OptionError for a device that is not there.

    A GPU has its index: tensors name theirs, and cuda:0 is not equal to cuda.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
        if device.type == "cuda" and device.index is None:
            device = torch.device("cuda", torch.cuda.current_device())
        torch.empty(0, device=device)
        if device.type == "cuda":
            torch.cuda.set_device(device)  # where kernels that are not torch's are launched
    except (RuntimeError, AssertionError) as error:
        raise OptionError(f"device {name!r} is not available here ({error}); use auto, cpu or cuda") from error
    return device


def wait_for(device: torch.device) -> None:
    """Until the device has done all that it was given."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)

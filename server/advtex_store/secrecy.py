"""What a process that reads hostile files must not learn from those that start it: passwords and keys."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Mapping

PR_SET_DUMPABLE = 4  # <linux/prctl.h>
PASSED_ON = frozenset(
    (
        *("PATH", "HOME", "USER", "LOGNAME", "SHELL", "TMPDIR", "TZ", "LANG", "LANGUAGE", "VIRTUAL_ENV"),
        *("CC", "CXX"),  # Triton compiles launchers
        *("ADVTEX_LPIPS_WEIGHTS", "ADVTEX_VGG_WEIGHTS"),  # folders that the engine reads
    )
)
PASSED_ON_BEGINNINGS = (
    "ADVTEX_ENGINE_",  # what an operator has to tell an engine
    *("LC_", "LD_", "DYLD_", "PYTHON", "MALLOC_", "XDG_"),
    *("CUDA_", "CUDNN_", "NVIDIA_", "CUBLAS_", "TORCH", "PYTORCH_", "TRITON_"),
    *("OMP_", "MKL_", "KMP_", "GOMP_", "OPENBLAS_", "ATEN_", "DNNL_", "ONEDNN_"),
)


def public_environment(environment: Mapping[str, str]) -> dict[str, str]:
    """What any child may know of an environment: names on the list, and no others whatever they hold."""
    return {
        name: value for name, value in environment.items() if name in PASSED_ON or name.startswith(PASSED_ON_BEGINNINGS)
    }


def hide_environment() -> str | None:
    """Keep other processes of the same user from reading this one's environment and memory through /proc.

    -> None, or why they still can. Children begin visible again; forks that execute nothing stay hidden.
    """
    if not sys.platform.startswith("linux"):
        return "only Linux can hide it"
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(PR_SET_DUMPABLE, 0, 0, 0, 0) != 0:
        return f"the kernel refuses: {os.strerror(ctypes.get_errno())}"
    return "root reads everything: run it as another user" if os.geteuid() == 0 else None

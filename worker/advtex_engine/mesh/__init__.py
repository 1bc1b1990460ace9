"""Meshes: read, cleaned, decimated, moved onto the depth, or fused from it.

The room's names come when they are asked for: child processes import `quadric` from here, without torch.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from advtex_engine.mesh.borders import LOOKS
    from advtex_engine.mesh.fusion import fuse
    from advtex_engine.mesh.registration import MAX_FRAMES, register_mesh

__all__ = ["LOOKS", "MAX_FRAMES", "fuse", "register_mesh"]

_MODULES = {"LOOKS": "borders", "MAX_FRAMES": "registration", "fuse": "fusion", "register_mesh": "registration"}


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)

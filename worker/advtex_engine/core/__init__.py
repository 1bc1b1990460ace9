"""The words of all rooms: what a run is asked to do, what it says and how it fails.

Nothing here imports torch, so that the command line is quick; what a scan becomes is in `core/scene.py`, which does.
"""

from advtex_engine.core.config import PRESETS, Preset, TextureConfig, resolve_preset
from advtex_engine.core.errors import Diverged, Problem
from advtex_engine.core.monitor import Monitor, WarningKeeper

__all__ = [
    "PRESETS",
    "Diverged",
    "Monitor",
    "Preset",
    "Problem",
    "TextureConfig",
    "WarningKeeper",
    "resolve_preset",
]

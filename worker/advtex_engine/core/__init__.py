"""The words of all rooms: what a scan becomes, what a run is asked to do, what it says and how it fails."""

from advtex_engine.core.config import PRESETS, Preset, TextureConfig, resolve_preset
from advtex_engine.core.errors import Diverged, Problem
from advtex_engine.core.monitor import Monitor, WarningKeeper
from advtex_engine.core.scene import Atlas, Mesh, Scene, View

__all__ = [
    "PRESETS",
    "Atlas",
    "Diverged",
    "Mesh",
    "Monitor",
    "Preset",
    "Problem",
    "Scene",
    "TextureConfig",
    "View",
    "WarningKeeper",
    "resolve_preset",
]

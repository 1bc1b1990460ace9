"""Where every face lies in the texture: charts, their packing, and the density of texels.

The room's names come when they are asked for: child processes import `charting` from here, without torch.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from advtex_engine.atlas.build import begin_charts
    from advtex_engine.atlas.chart_cache import ChartMaker, charts_folder
    from advtex_engine.atlas.preparation import MeshPreparation

__all__ = ["ChartMaker", "MeshPreparation", "begin_charts", "charts_folder"]

_MODULES = {
    "ChartMaker": "chart_cache",
    "MeshPreparation": "preparation",
    "begin_charts": "build",
    "charts_folder": "chart_cache",
}


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)

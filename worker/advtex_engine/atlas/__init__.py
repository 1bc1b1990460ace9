"""Where every face lies in the texture: charts, their packing, and the density of texels."""

from advtex_engine.atlas.build import begin_charts
from advtex_engine.atlas.chart_cache import ChartMaker, charts_folder
from advtex_engine.atlas.preparation import MeshPreparation

__all__ = ["ChartMaker", "MeshPreparation", "begin_charts", "charts_folder"]

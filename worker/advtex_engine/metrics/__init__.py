"""How close a texture comes to photographs that it has not seen."""

from advtex_engine.metrics.speckle import speckle_share

__all__ = ["speckle_share"]

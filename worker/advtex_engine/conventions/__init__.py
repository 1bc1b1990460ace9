"""Whether a scan means what its layout says: axes, directions and units, measured."""

from advtex_engine.conventions.check import checked_conventions
from advtex_engine.conventions.sample import coarse_mesh

__all__ = ["checked_conventions", "coarse_mesh"]

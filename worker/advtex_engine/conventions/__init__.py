"""Whether a scan means what its layout says: axes, directions and units, measured."""

from advtex_engine.conventions.check import checked_conventions

__all__ = ["checked_conventions"]

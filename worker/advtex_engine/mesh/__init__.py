"""Meshes: read, cleaned, decimated, moved onto the depth, or fused from it."""

from advtex_engine.mesh.borders import LOOKS
from advtex_engine.mesh.fusion import fuse
from advtex_engine.mesh.registration import MAX_FRAMES, register_mesh

__all__ = ["LOOKS", "MAX_FRAMES", "fuse", "register_mesh"]

"""Refined cameras, then the mean (Zhou and Koltun 2014, "Color Map Optimization for 3D Reconstruction")."""

from __future__ import annotations

from torch import Tensor

from advtex_engine.methods.inputs import LossPoint, MethodInput


def colormap(given: MethodInput) -> tuple[Tensor, list[LossPoint]]:
    """The mean texture over cameras that the pipeline has refined (`TextureConfig.refines`), [H,W,3] in [0,1]."""
    assert given.config.refines
    return given.means[1], []

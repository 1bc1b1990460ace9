"""Refined cameras, smoothly corrected photographs, then the mean (Zhou and Koltun 2014, "Color Map Optimization")."""

from __future__ import annotations

from torch import Tensor

from advtex_engine.methods.inputs import LossPoint, MethodInput
from advtex_engine.methods.mean import mean_texture
from advtex_engine.refine.warp import warp_views
from advtex_engine.render.streaming import host_allocator
from advtex_engine.render.view_maps import build_view_maps


def colormap(given: MethodInput) -> tuple[Tensor, list[LossPoint]]:
    """The mean of the views as `warp_views` corrects them, [H,W,3] in [0,1]; no losses.

    The cameras are those that the pipeline has refined (`TextureConfig.refines`).
    """
    assert given.config.refines
    scene, device = given.scene, given.maps[1].device
    views, warp = warp_views(scene.mesh, scene.views, scene.kind, device, given.config.seed)
    given.facts["refinement"] = {"warp": warp}
    allocate = None if given.on_device is None else host_allocator(device, given.work.path)
    return mean_texture(build_view_maps(given.atlas, views, scene.kind, allocate)), []

"""The texture of least L1 distance to all photographs: what robust averaging can do, and no more (paper section 4).

The distance is taken at the pixels, where the texture is sampled bilinearly, and not per texel: a median per texel of
the colors splatted onto it would blur them by the splat's footprint. The problem is convex; Adam with a learning rate
that falls to zero settles at its minimum.
"""

from __future__ import annotations

import torch
from torch import Tensor

from advtex_engine.methods.descent import descend, drawn_views, gradient_of
from advtex_engine.methods.inputs import LossPoint, MethodInput
from advtex_engine.render.texture import bilinear_footprint, decode_uv, sample_texels
from advtex_engine.render.view_maps import ViewMaps

PASSES = 20  # over all views, unless the number of steps is asked for


def l1(given: MethodInput) -> tuple[Tensor, list[LossPoint]]:
    """One view per step, all views in a new random order per pass -> [H,W,3] float32 in [0,1] and the losses.

    Raises Stopped, after a checkpoint.
    """
    maps, device = given.maps[1], given.maps[1].device
    generator = torch.Generator().manual_seed(given.config.seed)
    order = drawn_views(maps, given.config.steps, PASSES, generator)
    size = torch.tensor(maps.slot_map.shape[::-1], dtype=torch.float32, device=device)
    gradient = torch.empty((maps.slots, 3), device=device)

    def distance(values: Tensor, step: int) -> Tensor:
        photograph, slots, weights = _footprints(maps.only(order[step]), size)
        return (sample_texels(values, slots, weights, gradient) - photograph).abs().mean()

    return descend(given, "l1", gradient_of(distance), len(order), generator)


def _footprints(view: ViewMaps, size: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Colors [P,3] in [0,1] of one view's foreground, and where they sample the texture: slots [P,4], weights [P,4]."""
    seen = view.depth[0] > 0
    height, width = view.slot_map.shape
    texels, weights = bilinear_footprint(decode_uv(view.uv[0][seen]) * size, width, height)
    slots = view.slot_map.flatten()[texels].clamp(min=0)
    return view.color[0][seen].to(torch.float32) / 255, slots, weights

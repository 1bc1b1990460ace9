"""One view per face, from the sharpest photographs (the paper's "sharpest view" baseline).

How sharp a photograph is, is measured as a whole. Steep colors in the neighborhood of a face would be no measure: they
prefer views in which something else, whose outline misses the geometry's, reaches onto the face.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.methods.best_view import one_view_texture
from advtex_engine.methods.inputs import LossPoint, MethodInput
from advtex_engine.metrics.image_metrics import gradient_magnitude, luminance
from advtex_engine.render.view_maps import ViewMaps

BLUR = 9
"""Pixels; side of the box that a photograph is blurred with, as in Crete et al."""


def sharpest(given: MethodInput) -> tuple[Tensor, list[LossPoint]]:
    """Every face from the view with most sharp pixels on it -> [H,W,3] float32 in [0,1], no losses."""
    maps = given.maps[1]
    sharp = [sharpness(maps, view) for view in range(maps.count)]
    return one_view_texture(given, lambda view, area: area.sqrt() * sharp[view]), []


def sharpness(maps: ViewMaps, view: int) -> float:
    """Share of a photograph's gradients that blurring takes away, 0 (blurred already) to 1 (Crete et al. 2007).

    "The blur effect: perception and estimation with a new no-reference perceptual blur metric"; over the foreground.
    """
    maps = maps.only(view)
    image = luminance(maps.color[0].view(maps.height, maps.width, 3)) / 255
    blurred = F.avg_pool2d(image[None, None], BLUR, 1, BLUR // 2, count_include_pad=False)[0, 0]
    foreground = (maps.depth[0] > 0).view(maps.height, maps.width)
    before, after = (gradient_magnitude(plane)[foreground].sum() for plane in (image, blurred))
    return float(1 - (after / before.clamp(min=torch.finfo(before.dtype).tiny)).clamp(max=1))

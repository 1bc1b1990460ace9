"""Detail that resampling loses: a texture is corrected until its renders show what its photographs do.

A photograph is resampled twice on its way to the screen, into the texture and out of it; each time its finest detail
fades. Iterative back-projection (Irani & Peleg 1991, "Improving resolution by image registration") renders the texture
in the views that it was taken from, and gives back to the texels what the render lacks. Each texel is corrected by its
own view alone, so views that are misaligned do not blur each other. The render's pixels are means over their areas, as
a photograph's are.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.render.sharpness import fineness, sharpness
from advtex_engine.render.texture import area_footprint, decode_uv
from advtex_engine.render.view_maps import ViewMaps

ROUNDS, FINE_ROUNDS = 2, 8
FINEST = 0.87
"""Fineness from which photographs are worth all rounds; what blurred ones have beyond two is mostly grain."""
SHARP_ENOUGH = 0.97
"""Gradients of renders as a share of the photographs', from which it ends: the texture shows the sharpest photographs,
so that it gets sharper than most of them."""
DETAIL_REACH = 4  # pixels; differences that are wider come from leveling and are meant
MIN_WEIGHT = 0.25  # pixels; a texel that hardly any pixel shows is corrected less


def back_project(texture: Tensor, label: Tensor, maps: ViewMaps) -> Tensor:
    """The texture [H,W,3] float32 in [0,1] with the detail of the views at working size that it was taken from.

    texture: without holes. label: [H,W] int64 view that each texel shows, -1 = none: such texels stay as they are. Not
    differentiable.
    """
    assert texture.shape[:2] == label.shape == maps.slot_map.shape
    values, labels = texture.reshape(-1, 3), label.flatten()
    fine = fineness(maps) >= FINEST
    for _ in range(FINE_ROUNDS if fine else ROUNDS):
        if not fine and sharpness(values.view_as(texture), maps) >= SHARP_ENOUGH:
            break
        lacking, weight = torch.zeros_like(values), torch.zeros_like(values[:, 0])
        for view in range(maps.count):
            texels, weights, detail = _lacking_detail(values, labels, maps.only(view), view)
            lacking.index_add_(0, texels.flatten(), (detail[:, None] * weights[..., None]).flatten(0, 1))
            weight.index_add_(0, texels.flatten(), weights.flatten())
        values = (values + lacking / weight.clamp(min=MIN_WEIGHT)[:, None]).clamp(0, 1)
    return values.view_as(texture)


def _lacking_detail(values: Tensor, labels: Tensor, view: ViewMaps, number: int) -> tuple[Tensor, Tensor, Tensor]:
    """Texels [P,9] and weights [P,9] of the pixels that show texels of this view alone; what they lack, [P,3]."""
    height, width = view.slot_map.shape
    position = decode_uv(view.uv[0]) * torch.tensor([width, height], dtype=torch.float32, device=values.device)
    column, row = position[:, 0].long().clamp(max=width - 1), position[:, 1].long().clamp(max=height - 1)
    seen, picture = view.depth[0] > 0, (view.height, view.width)
    pixels = (seen & (labels[row * width + column] == number)).nonzero()[:, 0]
    texels, weights = area_footprint(position.view(*picture, 2), seen.view(picture), width, height)
    texels, weights = texels[pixels], weights[pixels]
    own = ((labels[texels] == number) | (weights == 0)).all(1)
    pixels, texels, weights = pixels[own], texels[own], weights[own]
    lacking = view.color[0][pixels].to(torch.float32) / 255 - (values[texels] * weights[..., None]).sum(1)
    sums = torch.zeros((view.width * view.height, 4), device=values.device)
    sums[pixels] = F.pad(lacking, (0, 1), value=1.0)
    # Rows, then columns: 18 additions per pixel and not 81.
    wide = sums.T.contiguous().view(1, 4, view.height, view.width)
    for rows in (True, False):
        size, padding = (2 * DETAIL_REACH + 1, 1), (DETAIL_REACH, 0)
        wide = F.avg_pool2d(wide, size if rows else size[::-1], 1, padding if rows else padding[::-1])
    wide = wide.view(4, -1).T[pixels]
    return texels, weights, lacking - wide[:, :3] / wide[:, 3:]

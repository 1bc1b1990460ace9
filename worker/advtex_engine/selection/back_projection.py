"""Detail that resampling loses: a texture is corrected until its renders show what its photographs do.

A photograph is resampled twice on its way to the screen, into the texture and out of it; each time its finest detail
fades. Iterative back-projection (Irani & Peleg 1991, "Improving resolution by image registration") renders the texture
in the views that it was taken from, and gives back to the texels what the render lacks. Each texel is corrected by its
own view alone, so views that are misaligned do not blur each other.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.render.texture import bilinear_footprint, decode_uv
from advtex_engine.render.view_maps import ViewMaps

ROUNDS = 2  # more of them gain little, and raise the photographs' noise
DETAIL_REACH = 4  # pixels; differences that are wider come from leveling and are meant
MIN_WEIGHT = 0.25  # pixels; a texel that hardly any pixel shows is corrected less


def back_project(texture: Tensor, label: Tensor, maps: ViewMaps) -> Tensor:
    """The texture [H,W,3] float32 in [0,1] with the detail of the views at working size that it was taken from.

    label: [H,W] int64 view that each texel shows, -1 = none: such texels stay as they are. Not differentiable.
    """
    assert texture.shape[:2] == label.shape == maps.slot_map.shape
    values, labels = texture.reshape(-1, 3), label.flatten()
    for _ in range(ROUNDS):
        lacking, weight = torch.zeros_like(values), torch.zeros_like(values[:, 0])
        for view in range(maps.count):
            texels, weights, detail = _lacking_detail(values, labels, maps.only(view), view)
            lacking.index_add_(0, texels.flatten(), (detail[:, None] * weights[..., None]).flatten(0, 1))
            weight.index_add_(0, texels.flatten(), weights.flatten())
        values = (values + lacking / weight.clamp(min=MIN_WEIGHT)[:, None]).clamp(0, 1)
    return values.view_as(texture)


def _lacking_detail(values: Tensor, labels: Tensor, view: ViewMaps, number: int) -> tuple[Tensor, Tensor, Tensor]:
    """Footprints [P,4], weights [P,4] of the pixels that show texels of this view alone; what they lack, [P,3]."""
    height, width = view.slot_map.shape
    position = decode_uv(view.uv[0]) * torch.tensor([width, height], dtype=torch.float32, device=values.device)
    column, row = position[:, 0].long().clamp(max=width - 1), position[:, 1].long().clamp(max=height - 1)
    pixels = ((view.depth[0] > 0) & (labels[row * width + column] == number)).nonzero()[:, 0]
    texels, weights = bilinear_footprint(position[pixels], width, height)
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

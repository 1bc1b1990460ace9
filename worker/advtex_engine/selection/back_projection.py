"""Detail that resampling loses: a texture is corrected until its renders show what its photographs do.

A photograph is resampled twice on its way to the screen, into the texture and out of it; each time its finest detail
fades. Iterative back-projection (Irani & Peleg 1991, "Improving resolution by image registration") renders the texture
in the views that it was taken from, and gives back to the texels what the render lacks. Each texel is corrected by its
own view alone, so views that are misaligned do not blur each other. The render's pixels are means over their areas, as
a photograph's are.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.render.filtering import window_sums
from advtex_engine.render.sharpness import fineness, sharpness
from advtex_engine.render.texture import area_footprint, decode_uv, sample_texels
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
    own = list[_Own]()
    for number in range(FINE_ROUNDS if fine else ROUNDS):
        if not fine and sharpness(values.view_as(texture), maps) >= SHARP_ENOUGH:
            break
        if number == 0:
            own = [_own(labels, maps.only(view), view) for view in range(maps.count)]
        lacking, weight = torch.zeros_like(values), torch.zeros_like(values[:, 0])
        for view, part in enumerate(own):
            texels = _texels(part.corner, maps.slot_map.shape[1])
            detail = _lacking_detail(values, texels, part, maps.only(view))
            for channel in range(3):  # index_add_ of short rows takes three times as long on a CPU
                added = (detail[:, channel, None] * part.weights).flatten()
                lacking[:, channel].index_add_(0, texels.flatten(), added)
            weight.index_add_(0, texels.flatten(), part.weights.flatten())
        values = (values + lacking / weight.clamp(min=MIN_WEIGHT)[:, None]).clamp(0, 1)
    return values.view_as(texture)


@dataclass(frozen=True)
class _Own:
    """The P pixels of a view that show texels of this view alone, a thirtieth of all in a room of 60 views.

    pixels: [P] int64 of the view. corner: [P] int32, the first of the texels that each shows. weights: [P,9].
    """

    pixels: Tensor
    corner: Tensor
    weights: Tensor


def _own(labels: Tensor, view: ViewMaps, number: int) -> _Own:
    height, width = view.slot_map.shape
    position = decode_uv(view.uv[0]) * torch.tensor([width, height], dtype=torch.float32, device=labels.device)
    seen, picture = view.depth[0] > 0, (view.height, view.width)
    texels, weights = area_footprint(position.view(*picture, 2), seen.view(picture), width, height)
    pixels = (seen & (labels[texels[:, 4]] == number)).nonzero()[:, 0]
    texels, weights = texels[pixels], weights[pixels]
    whole = ((labels[texels] == number) | (weights == 0)).all(1)
    return _Own(pixels[whole], texels[whole, 0].to(torch.int32), weights[whole])


def _texels(corner: Tensor, width: int) -> Tensor:
    """[P,9] int64, as `area_footprint` has them."""
    cells = torch.arange(3, device=corner.device)
    return corner.long()[:, None] + (cells[:, None] * width + cells).flatten()


def _lacking_detail(values: Tensor, texels: Tensor, own: _Own, view: ViewMaps) -> Tensor:
    """What the view's own pixels lack in their photograph's detail, [P,3]."""
    shown = sample_texels(values, texels, own.weights)
    lacking = view.color[0][own.pixels].to(torch.float32) / 255 - shown
    if not len(lacking):
        return lacking
    # Of the rows that have any.
    first, last = (int(own.pixels[end]) // view.width for end in (0, -1))
    sums = torch.zeros(((last - first + 1) * view.width, 4), device=values.device)
    inside = own.pixels - first * view.width
    sums[inside] = F.pad(lacking, (0, 1), value=1.0)
    around = window_sums(sums.T.contiguous().view(4, -1, view.width), DETAIL_REACH).view(4, -1)[:, inside]
    return lacking - (around[:3] / around[3]).T

"""Views toned as the texture is that an optimization starts from.

Exposures agree from frame to frame, but a place seen early and late, in a bright and in a dark frame, still looks
different. A start from view selection is leveled. Without its tones in the views, real examples would pull the texture
to one brightness here and to another there: blotches on walls. Detail stays as photographed.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.render.texture import decode_uv, sample_image
from advtex_engine.render.view_maps import ViewMaps

REACH = 1 / 16  # of the view's width, the standard deviation of the weights that tones are averaged with
BLOCK = 8  # pixels that share a tone before it is interpolated
LARGEST = 64.0  # gray levels of 255; what differs by more is something else, not tone


def tone_views(maps: ViewMaps, texture: Tensor) -> None:
    """Shifts the colors of the maps, in place, so that wide averages are those of the texture [H,W,3] in [0,1].

    The texture may have another size than the maps' own. Where a view has no foreground nearby, nothing changes.
    """
    size = texture.new_tensor([texture.shape[1], texture.shape[0]])
    for index in range(maps.count):
        view = maps.only(index)
        color = view.color[0].to(torch.float32)
        shown = 255 * sample_image(texture, decode_uv(view.uv[0]) * size)
        seen = view.depth[0] > 0
        difference = (shown - color).view(maps.height, maps.width, 3)
        tone = tone_difference(difference, seen.view(maps.height, maps.width)).view(-1, 3)
        maps.color[index] = (color + tone).round().clamp(0, 255).to(torch.uint8)


def tone_difference(difference: Tensor, seen: Tensor) -> Tensor:
    """What a view [H,W,3] is to be shifted by, in gray levels: wide averages of what the texture shows less the view.

    seen: [H,W] bool, where the texture shows something. The shift is 0 where it shows nothing nearby.
    """
    known = torch.where(seen[..., None], difference.clamp(-LARGEST, LARGEST), 0.0)
    with_weight = torch.cat((known, seen[..., None].to(known.dtype)), 2)
    return _spread(with_weight.permute(2, 0, 1)[None])[0].permute(1, 2, 0)


def _spread(difference: Tensor) -> Tensor:
    """[1,C+1,h,w], sums and their weight last -> [1,C,h,w], weighted averages over REACH."""
    height, width = difference.shape[2:]
    blocks = F.avg_pool2d(difference, BLOCK, ceil_mode=True, count_include_pad=False)
    deviation = REACH * width / BLOCK
    radius = max(1, round(2 * deviation))
    offset = torch.arange(-radius, radius + 1, device=blocks.device, dtype=blocks.dtype)
    kernel = torch.exp(-0.5 * (offset / deviation).square())
    channels = blocks.transpose(0, 1)
    wide = F.conv2d(channels, kernel.view(1, 1, 1, -1), padding=(0, radius))
    wide = F.conv2d(wide, kernel.view(1, 1, -1, 1), padding=(radius, 0)).transpose(0, 1)
    tone = wide[:, :-1] / wide[:, -1:].clamp(min=1e-3)
    grown = F.interpolate(tone, scale_factor=float(BLOCK), mode="bilinear", align_corners=False)
    return grown[..., :height, :width]

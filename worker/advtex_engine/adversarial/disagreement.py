"""How far views are from a texture: the unit of a learning rate that suits scans of any contrast and any errors."""

from __future__ import annotations

import torch
from torch import Tensor

from advtex_engine.render.texture import decode_uv, sample_image
from advtex_engine.render.view_maps import ViewMaps


def disagreement(maps: ViewMaps, texture: Tensor) -> float:
    """Mean absolute difference of the views to a texture [H,W,3] in [0,1], each view's over what it shows of the mesh.

    Views that show nothing do not count; 0 where none shows anything. Waits for the device.
    """
    size = texture.new_tensor([texture.shape[1], texture.shape[0]])
    found = list[Tensor]()
    for index in range(maps.count):
        view = maps.only(index)
        seen = (view.depth[0] > 0)[:, None]
        shown = sample_image(texture, decode_uv(view.uv[0]) * size)
        apart = (shown - view.color[0].to(torch.float32) / 255).abs() * seen
        found.append(torch.stack((apart.mean(1).sum(), seen.sum())))
    sums, counts = torch.stack(found).unbind(1)
    return float((sums / counts.clamp(min=1)).sum() / (counts > 0).sum().clamp(min=1))

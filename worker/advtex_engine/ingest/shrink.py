"""Views at a part of their size, for coarse levels."""

from __future__ import annotations

import torch
import torch.nn.functional as F

from advtex_engine.core.cameras import scaled_camera
from advtex_engine.core.scene import View


def shrink(view: View, scale: int) -> View:
    """The view at 1/scale of its size: color averaged over blocks, depth taken from one pixel of each block.

    A mask lets a block be used if it does all of its pixels.
    """
    if scale == 1:
        return view
    width, height = view.camera.width // scale, view.camera.height // scale
    color = view.color[: height * scale, : width * scale].permute(2, 0, 1)[None].to(torch.float32)
    color = F.avg_pool2d(color, scale)[0].permute(1, 2, 0).round().to(torch.uint8)
    depth = None
    if view.depth is not None:
        depth = view.depth[scale // 2 : height * scale : scale, scale // 2 : width * scale : scale].contiguous()
    mask = None
    if view.mask is not None:
        mask = view.mask[: height * scale, : width * scale].reshape(height, scale, width, scale).all(3).all(1)
    return View(view.name, scaled_camera(view.camera, width, height), color, depth, mask)

"""How speckled a texture is: what no photograph asked for, and renders at the photographs' size hide in part."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from torch import Tensor

LEVELS = 25
"""A tenth of the range, of 255: a texel that differs by more from the median around it is a speckle."""


def speckle_share(texture: Tensor, known: Tensor) -> float | None:
    """Share of texels that differ from the median of their 3x3 by more than a tenth of the range in any channel.

    texture: [H,W,3] float in [0,1], on any device; measured as it is exported, in 8 bits. known: [H,W] bool, texels
    that views sample; those count whose whole 3x3 is known, so that a neighboring chart is nobody's neighbor. None
    where there are none. Thin lines count as well: compare with the share of another texture of the same scan.
    """
    assert texture.shape == (*known.shape, 3)
    image = (texture.detach().clamp(0, 1) * 255).round().to("cpu", torch.uint8).numpy()
    inside = cv2.erode(known.cpu().numpy().astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0) > 0
    if not inside.any():
        return None
    odd = cv2.absdiff(image, cv2.medianBlur(image, 3)).max(2) > LEVELS
    return float(odd[inside].mean())

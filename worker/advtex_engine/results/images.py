"""Textures as image files: PNG, or JPEG of so high a quality that renders hardly differ."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from advtex_engine.render.pictures import encode_jpeg, to_bytes

JPEG_QUALITY = 95
"""Renders of two kitchens with such an image are within .0041 LPIPS of those with a PNG, .0022 on the mean, for a
quarter of its bytes; at 92 within .0060, and at 95 with half of the chroma within .0100."""


@dataclass(frozen=True)
class EncodedImage:
    """The bytes of an image file. suffix: of its name, "png" or "jpg"."""

    data: bytes
    suffix: str

    @property
    def media_type(self) -> str:
        return {"png": "image/png", "jpg": "image/jpeg"}[self.suffix]


def encode_png(texture: Tensor) -> bytes:
    """[H,W,3] uint8 sRGB, or float in [0,1] (clamped), as a PNG."""
    done, data = cv2.imencode(".png", np.ascontiguousarray(to_bytes(texture)[..., ::-1]))
    assert done
    return data.tobytes()


def encode_texture(texture: Tensor, *, lossless: bool, quality: int = JPEG_QUALITY) -> EncodedImage:
    """[H,W,3] uint8 sRGB, or float in [0,1] (clamped), as a PNG if `lossless`, else as a JPEG.

    Its chroma has every texel (4:4:4): halved, the colors of neighboring charts would run into each other.
    """
    if lossless:
        return EncodedImage(encode_png(texture), "png")
    return EncodedImage(encode_jpeg(to_bytes(texture), quality, full_chroma=True), "jpg")


def shrunk(texture: Tensor, longest: int) -> Tensor:
    """The texture itself, or [h,w,3] uint8 averaged to fewer texels where a side is longer than `longest`."""
    height, width, _ = texture.shape
    if max(height, width) <= longest:
        return texture
    scale = longest / max(height, width)
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return torch.from_numpy(cv2.resize(to_bytes(texture), size, interpolation=cv2.INTER_AREA))

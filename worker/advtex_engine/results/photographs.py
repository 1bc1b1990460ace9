"""Photographs with their cameras, for viewers that lay them over the model: `previews/photographs.json`.

stream: the path of a file of JPEGs one behind the other (a Motion JPEG stream), relative to the result's folder.
views: name, heldout, width and height in pixels of the photograph in the stream, and there
    offset, bytes    where its JPEG lies in the stream
    K                [3,3] pixels; the first pixel's centre is (0.5, 0.5)
    camera_to_world  [4,4] camera (x right, y down, z forward) to the world of model.glb: metres, y up

Photographs have the tones of the texture (`toning.py`), so that none stands out when two are blended with it. Cameras
are those that the texture was made with. Held-out ones are among them to be compared with, not to be blended.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from advtex_engine.core.cameras import camera_to_world, scaled_camera
from advtex_engine.core.scene import TO_Y_UP, Atlas, Camera, Scene, View, evenly_spread
from advtex_engine.render.pictures import encode_jpeg
from advtex_engine.render.render_view import GBuffer, gbuffer, renders_at_once, shade
from advtex_engine.runtime.threads import in_threads
from advtex_engine.selection.toning import tone_difference
from advtex_scan.matrices import from_quaternion

MAX_PHOTOGRAPHS = 60
MAX_HELDOUT = 6
LONGEST_SIDE = 640
TONE_SIDE = 160  # pixels, of the renders that tell how tones differ: in averages over a sixteenth of the width
QUALITY = 90
"""60 photographs of a kitchen at 640x480 take 4 MB."""


def photograph_stream(
    scene: Scene, atlas: Atlas, texture: Tensor, threads: int = 1
) -> tuple[list[dict[str, Any]], bytes]:
    """The list `views` of the JSON, and the stream.

    texture: [atlas.height,atlas.width,3] float sRGB in [0,1] on the device of the atlas's mesh, which renders, in
    `threads` at once.
    """
    chosen = [(view, False) for view in evenly_spread(scene.views, MAX_PHOTOGRAPHS)]
    chosen += [(view, True) for view in evenly_spread(scene.heldout, MAX_HELDOUT)]
    as_glb = torch.tensor(from_quaternion(*TO_Y_UP[scene.up_axis], (0.0, 0.0, 0.0)), dtype=torch.float64)
    entries, stream = list[dict[str, Any]](), bytearray()

    def encoded(shown: tuple[View, Camera]) -> bytes:
        return encode_jpeg(_toned(*shown, atlas, texture), QUALITY)

    cameras = [_reduced(view.camera, LONGEST_SIDE) for view, _ in chosen]
    views = zip((view for view, _ in chosen), cameras, strict=True)
    jpegs = in_threads(encoded, views, renders_at_once(cameras, threads, supersample=1))
    for (view, heldout), camera, jpeg in zip(chosen, cameras, jpegs, strict=True):
        entries.append(
            {
                "name": view.name,
                "heldout": heldout,
                "width": camera.width,
                "height": camera.height,
                "offset": len(stream),
                "bytes": len(jpeg),
                "K": camera.K.tolist(),
                "camera_to_world": (as_glb @ camera_to_world(camera)).tolist(),
            }
        )
        stream += jpeg
    return entries, bytes(stream)


def _toned(view: View, camera: Camera, atlas: Atlas, texture: Tensor) -> NDArray[np.uint8]:
    """A view's color [h,w,3] as the reduced camera has it, in the tones of the texture."""
    coarse = _reduced(camera, TONE_SIDE)
    buffer = gbuffer(atlas, coarse, supersample=1)
    shown = 255 * shade(buffer, texture).cpu()
    tone = tone_difference(shown - torch.from_numpy(_resized(view.color.numpy(), coarse)), _seen(buffer).cpu())
    size = (camera.width, camera.height)
    toned = _resized(view.color.numpy(), camera) + cv2.resize(tone.numpy(), size, interpolation=cv2.INTER_LINEAR)
    return toned.round().clip(0, 255).astype(np.uint8)


def _resized(color: NDArray[np.uint8], camera: Camera) -> NDArray[np.float32]:
    """Averaged to the size of the camera's pictures."""
    size = (camera.width, camera.height)
    return np.asarray(cv2.resize(color, size, interpolation=cv2.INTER_AREA), np.float32)


def _reduced(camera: Camera, longest: int) -> Camera:
    scale = min(1.0, longest / max(camera.width, camera.height))
    return scaled_camera(camera, max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))


def _seen(buffer: GBuffer) -> Tensor:
    """[H,W] bool, where the picture shows the model. The buffer has one sample per pixel."""
    seen = torch.zeros(buffer.height * buffer.width, dtype=torch.bool, device=buffer.hit.device)
    return seen.index_fill_(0, buffer.hit, value=True).view(buffer.height, buffer.width)

"""The texture while it is being made: small pictures of a few fixed views, and how close they come to the photographs.

A glimpse is due every few seconds, and later while glimpses have taken more than MAX_SHARE of the time; looking up once
per level where the views meet the model does not count. It changes nothing in the run: it draws no random number, and
waits for the device only when it is due.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from advtex_engine.core.monitor import Glimpse, Monitor
from advtex_engine.core.scene import Atlas, Camera, Scene, View, evenly_spread
from advtex_engine.metrics.image_metrics import gradient_ratio, psnr
from advtex_engine.metrics.photograph import Photograph
from advtex_engine.previews.curves import curves
from advtex_engine.render.pictures import encode_jpeg, to_bytes
from advtex_engine.render.rasterize import rasterize
from advtex_engine.render.render_view import BACKGROUND
from advtex_engine.render.texture import bilinear_footprint, sample_texels
from advtex_engine.render.view_maps import DEPTH_TOLERANCE, ViewMaps
from advtex_engine.runtime.threads import one_thread_each

SECONDS = 5.0
MAX_SHARE = 0.01
VIEWS = 2
WIDTH = 320
QUALITY = 75  # of the JPEGs

Point = dict[str, float]


class Live:
    """Glimpses of one run. quality: {"step", "psnr", "gradient_ratio"} of each so far, means over the views.

    Held-out views where there are some. Every k-th pixel of a photograph is compared with the texture's color at that
    pixel, where the view shows the model (mesh, depth and mask agree).
    """

    def __init__(self, scene: Scene, atlas: Atlas, monitor: Monitor, seconds: float = SECONDS) -> None:
        self.scene, self.atlas, self.monitor, self.seconds = scene, atlas, monitor, seconds
        self.quality = list[Point]()
        self._started = self._last = time.monotonic()
        self._spent = 0.0
        self._seen = list[_Seen]()
        self._level: ViewMaps | None = None

    def due(self) -> bool:
        now = time.monotonic()
        return now >= self._last + self.seconds and self._spent <= MAX_SHARE * (now - self._started)

    def show(self, step: int, maps: ViewMaps, values: Tensor, mean: Tensor, losses: Sequence[Point]) -> None:
        """Tells the monitor what the texture is like.

        values: compact texture [slots,3] in [0,1] of the view maps. mean: [H,W,3] in [0,1], for texels that they lack.
        losses: the history so far.
        """
        with one_thread_each():
            self._show(step, maps, values, mean, losses)

    def _show(self, step: int, maps: ViewMaps, values: Tensor, mean: Tensor, losses: Sequence[Point]) -> None:
        if not self._seen:
            views = evenly_spread(self.scene.heldout or self.scene.views, VIEWS)
            self._seen = [_Seen(self.atlas, view, self.scene.kind) for view in views]
        if maps is not self._level:
            self._level = maps
            for seen in self._seen:
                seen.attach(maps, mean)
        began = time.monotonic()
        pictures = [seen.picture(values) for seen in self._seen]
        scores = [
            (psnr(picture, seen.photo), gradient_ratio(picture, seen.photo))
            for seen, picture in zip(self._seen, pictures, strict=True)
            if bool(seen.photo.mask.any())
        ]
        if scores:
            means = [sum(column) / len(column) for column in zip(*scores, strict=True)]
            self.quality.append({"step": step, "psnr": means[0], "gradient_ratio": means[1]})
        names = [f"{number}.jpg" for number in range(len(pictures))]
        jpegs = [encode_jpeg(to_bytes(picture), QUALITY) for picture in pictures]
        titles = [seen.name for seen in self._seen]
        glimpse = Glimpse(
            step,
            dict(zip(names, jpegs, strict=True)),
            dict(zip(names, titles, strict=True)),
            curves(losses, self.quality),
        )
        self.monitor.glimpsed(glimpse)
        self._last = time.monotonic()
        self._spent += self._last - began


@dataclass
class _Footprint:
    """Where a view's pixels sample a compact texture, and the part of their colors that it does not give."""

    slots: Tensor
    weights: Tensor
    rest: Tensor


class _Seen:
    """A view that is shown, at every k-th of its pixels.

    hit: [h,w] bool, where it shows the mesh. photo: with a mask of where it shows it too.
    """

    def __init__(self, atlas: Atlas, view: View, kind: str) -> None:
        device = atlas.mesh.v_pos.device
        stride = -(-view.camera.width // WIDTH)
        first = stride // 2
        pixels = (slice(first, None, stride), slice(first, None, stride))
        self.name = view.name
        color = view.color[pixels].to(device, torch.float32) / 255
        height, width, _ = color.shape
        fragments = rasterize(atlas.mesh, _every_pixel(view.camera, stride, width, height))
        self.hit = fragments.face_index >= 0
        mask = self.hit
        if view.depth is not None:
            measured = view.depth[pixels].to(device)
            near = (measured - fragments.depth).abs() < DEPTH_TOLERANCE[kind]
            mask = mask & ((measured == 0) | near)
        if view.mask is not None:
            mask = mask & view.mask[pixels].to(device)
        self.photo = Photograph(color, mask)
        assert atlas.mesh.v_uv is not None and atlas.mesh.t_uv_idx is not None
        corners = atlas.mesh.v_uv[atlas.mesh.t_uv_idx[fragments.face_index[self.hit].long()]]
        self._uv = (fragments.barycentric[self.hit][:, :, None] * corners).sum(1)
        self._footprint: _Footprint | None = None

    def attach(self, maps: ViewMaps, mean: Tensor) -> None:
        """Looks up the texels at the maps' size of the texture."""
        height, width = maps.slot_map.shape
        texels, weights = bilinear_footprint(self._uv * self._uv.new_tensor([width, height]), width, height)
        slots = maps.slot_map.flatten()[texels]
        known = slots >= 0
        lacking = torch.where(known, 0.0, weights)
        rest = (mean.reshape(-1, 3)[texels] * lacking[:, :, None]).sum(1)
        self._footprint = _Footprint(slots.clamp(min=0), torch.where(known, weights, 0.0), rest)

    def picture(self, values: Tensor) -> Tensor:
        """[h,w,3] float sRGB in [0,1]."""
        assert self._footprint is not None
        found = self._footprint
        picture = torch.full_like(self.photo.color, BACKGROUND)
        with torch.no_grad():
            picture[self.hit] = (sample_texels(values.detach(), found.slots, found.weights) + found.rest).clamp(0, 1)
        return picture


def _every_pixel(camera: Camera, stride: int, width: int, height: int) -> Camera:
    """The camera whose pixel centres are those of every stride-th pixel, beginning with number stride // 2."""
    K = camera.K.clone()
    K[:2, 2] -= stride // 2 + 0.5
    K[:2] /= stride
    K[:2, 2] += 0.5
    return Camera(K, camera.world_to_camera, width, height)

"""One pair of views per step: the source, the auxiliary view warped into it, and where the source samples the texture.

All draws come from one generator on the device, and nothing in `draw` waits for the device: the crop's size is fixed
and only its offset is drawn.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.reproject import reproject, unproject_pixels
from advtex_engine.texture import bilinear_footprint, decode_uv
from advtex_engine.views import DEPTH_TOLERANCE, Pairs, ViewMaps


@dataclass(frozen=True)
class Batch:
    """One pair, cropped to h x w: images [1,3,h,w] in [-1,1], masks [1,1,h,w] float 0/1, footprints [h*w,4]."""

    condition: Tensor
    real: Tensor
    foreground: Tensor
    visible: Tensor
    slots: Tensor
    weights: Tensor


class PairSampler:
    """Draws pairs and crops of fixed view maps.

    kind: "object" or "scene", for theta_z. crop: width and height in pixels. generator: on the maps' device; its state
    is all that decides the draws to come. perturbation: pixels by which a turn and a move of the auxiliary camera
    shift its image at most, each; from such virtual cameras few views give many examples (paper, supplement D).
    """

    def __init__(
        self,
        maps: ViewMaps,
        pairs: Pairs,
        kind: str,
        crop: tuple[int, int],
        generator: torch.Generator,
        perturbation: float = 0.0,
    ) -> None:
        assert crop[0] <= maps.width and crop[1] <= maps.height
        self.maps, self.pairs, self.crop, self.generator = maps, pairs, crop, generator
        self.perturbation = perturbation
        self.device = maps.color.device
        self.tolerance = DEPTH_TOLERANCE[kind]
        rows, columns = torch.arange(crop[1], device=self.device), torch.arange(crop[0], device=self.device)
        self._window = (rows[:, None] * maps.width + columns).flatten()
        self._window_xy = torch.stack((columns.repeat(len(rows)), rows.repeat_interleave(len(columns))), 1) + 0.5
        self._texture_size = torch.tensor(maps.slot_map.shape[::-1], dtype=torch.float32, device=self.device)
        self._slot_map = maps.slot_map.flatten()

    def draw(self) -> Batch:
        """A random pair and crop, with the auxiliary view warped into the source."""
        maps = self.maps
        random = torch.rand(4, generator=self.generator, device=self.device)
        source = self.pairs.sources[_pick(random[0], self.pairs.sources.shape[0])]
        candidate = _pick(random[1], self.pairs.count[source])
        auxiliary = self.pairs.auxiliary[source, candidate]
        width, height = self.crop
        left = _pick(random[2], maps.width - width + 1)
        top = _pick(random[3], maps.height - height + 1)
        pixels = self._window + (top * maps.width + left)
        flat = pixels + source * (maps.width * maps.height)
        depth = maps.depth.view(-1).index_select(0, flat).to(torch.float32)
        foreground = depth > 0
        points = unproject_pixels(self._window_xy + torch.stack((left, top)), depth, maps.intrinsics[source])
        relative = self.pairs.relative[source, candidate]
        if self.perturbation:
            distance = depth.sum() / foreground.sum().clamp(min=1)
            relative = self._virtual(relative, distance / maps.intrinsics[auxiliary][0], distance)
        real, visible = reproject(points, relative, maps, auxiliary, self.tolerance)
        visible = visible & foreground
        uv = decode_uv(maps.uv.view(-1, 2).index_select(0, flat))
        texels, weights = bilinear_footprint(uv * self._texture_size, maps.slot_map.shape[1], maps.slot_map.shape[0])
        # A background pixel has uv 0; its weight is 0, so any row may stand for the texel that nobody owns.
        slots = self._slot_map.index_select(0, texels.flatten()).view(texels.shape).clamp(min=0)
        return Batch(
            condition=self.image(maps.color.view(-1, 3).index_select(0, flat).to(torch.float32) / 127.5 - 1),
            real=self.image(real / 127.5 - 1),
            foreground=self.image(foreground.to(torch.float32)[:, None]),
            visible=self.image(visible.to(torch.float32)[:, None]),
            slots=slots,
            weights=weights * visible[:, None],
        )

    def _virtual(self, relative: Tensor, per_pixel: Tensor, distance: Tensor) -> Tensor:
        """The pose [3,4] of a virtual camera near that of `relative`; per_pixel: metres of a pixel at `distance`."""
        random = 2 * torch.rand(6, generator=self.generator, device=self.device) - 1
        shift = random * (self.perturbation * per_pixel)
        turned = torch.linalg.cross((shift[:3] / distance).expand(4, 3).mT, relative, dim=0)
        virtual: Tensor = relative + turned + F.pad(shift[3:, None], (3, 0))
        return virtual

    def image(self, rows: Tensor) -> Tensor:
        """Rows [h*w,C] as an image [1,C,h,w] (channels_last memory, no copy)."""
        return rows.view(1, self.crop[1], self.crop[0], rows.shape[1]).permute(0, 3, 1, 2)


def _pick(random: Tensor, count: int | Tensor) -> Tensor:
    """Uniform integer in [0, count) from a uniform number in [0, 1); float32 rounding must not reach count."""
    return (random * count).long().clamp(max=count - 1)

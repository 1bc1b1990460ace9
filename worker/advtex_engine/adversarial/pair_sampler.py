"""One pair of views per step: the source, the auxiliary view warped into it, and where the source samples the texture.

All draws come from one generator on the device, and nothing in `draw` waits for the device or is known to the host: the
crop's size is fixed and only its offset is drawn.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.render.pairs import Pairs
from advtex_engine.render.reproject import reproject, unproject_pixels
from advtex_engine.render.texture import footprints
from advtex_engine.render.view_maps import DEPTH_TOLERANCE, ViewMaps


@dataclass(frozen=True)
class DrawnPair:
    """One pair, cropped to h x w: images [1,3,h,w] in [-1,1], masks [1,1,h,w] float 0/1, `footprints` [h*w,K]."""

    condition: Tensor
    real: Tensor
    foreground: Tensor
    visible: Tensor
    slots: Tensor
    weights: Tensor


@dataclass(frozen=True)
class Choice:
    """[1] int64 each: the source and its auxiliary view, the pair's row in pairs.relative, the crop's corner."""

    source: Tensor
    auxiliary: Tensor
    pair: Tensor
    left: Tensor
    top: Tensor


class PairSampler:
    """Draws pairs and crops of fixed view maps.

    kind: "object" or "scene", for theta_z. crop: width and height in pixels. generator: on the maps' device; its state
    is all that decides the draws to come. perturbation: pixels by which a turn and a move of the auxiliary camera
    shift its image at most, each; from such virtual cameras few views give many examples (paper, supplement D). areas:
    whether a pixel shows the mean over its area or the value at its middle.
    """

    def __init__(
        self,
        maps: ViewMaps,
        pairs: Pairs,
        kind: str,
        crop: tuple[int, int],
        generator: torch.Generator,
        perturbation: float = 0.0,
        *,
        areas: bool = False,
    ) -> None:
        assert crop[0] <= maps.width and crop[1] <= maps.height
        self.maps, self.pairs, self.crop, self.generator = maps, pairs, crop, generator
        self.perturbation, self.areas = perturbation, areas
        self.device = maps.color.device
        self.tolerance = DEPTH_TOLERANCE[kind]
        rows, columns = torch.arange(crop[1], device=self.device), torch.arange(crop[0], device=self.device)
        self._window = (rows[:, None] * maps.width + columns).flatten()
        self._window_xy = torch.stack((columns.repeat(len(rows)), rows.repeat_interleave(len(columns))), 1) + 0.5
        # On the device, so that maps and pairs may be refilled in place under a captured step.
        self.source_count = torch.tensor([pairs.sources.shape[0]], device=self.device)

    def draw(self) -> DrawnPair:
        """A random pair and crop, with the auxiliary view warped into the source."""
        maps, chosen = self.maps, self.choose()
        flat = self.pixels(chosen)
        depth = self.depth(flat)
        foreground = depth > 0
        xy = self._window_xy + torch.cat((chosen.left, chosen.top))
        points = unproject_pixels(xy, depth, _row(maps.intrinsics, chosen.source))
        relative = self.relative(chosen, depth)
        real, visible = reproject(points, relative, maps, chosen.auxiliary[0], self.tolerance)
        visible = visible & foreground
        window = (self.crop[1], self.crop[0])
        uv = maps.uv.view(-1, 2).index_select(0, flat)
        slots, weights = footprints(uv.view(*window, 2), foreground.view(window), maps.slot_map, areas=self.areas)
        return DrawnPair(
            condition=self.image(maps.color.view(-1, 3).index_select(0, flat).to(torch.float32) / 127.5 - 1),
            real=self.image(real / 127.5 - 1),
            foreground=self.image(foreground.to(torch.float32)[:, None]),
            visible=self.image(visible.to(torch.float32)[:, None]),
            slots=slots,
            weights=weights,
        )

    def choose(self) -> Choice:
        """A source, one of its candidates and a crop's corner, all uniform."""
        pairs, (width, height) = self.pairs, self.crop
        random = torch.rand((4, 1), generator=self.generator, device=self.device)
        source = pairs.sources.index_select(0, _pick(random[0], self.source_count))
        candidate = _pick(random[1], pairs.count.index_select(0, source))
        pair = source * pairs.auxiliary.shape[1] + candidate
        auxiliary = pairs.auxiliary.view(-1).index_select(0, pair)
        left, top = _pick(random[2], self.maps.width - width + 1), _pick(random[3], self.maps.height - height + 1)
        return Choice(source, auxiliary, pair, left, top)

    def pixels(self, chosen: Choice) -> Tensor:
        """[P] of the crop, among those of all views in a row."""
        maps = self.maps
        return self._window + (chosen.top * maps.width + chosen.left) + chosen.source * (maps.width * maps.height)

    def depth(self, pixels: Tensor) -> Tensor:
        """[P] float32 metres of `pixels`."""
        return self.maps.depth.view(-1).index_select(0, pixels).to(torch.float32)

    def relative(self, chosen: Choice, depth: Tensor) -> Tensor:
        """[3,4] source camera to auxiliary camera, a virtual one with perturbation; depth: [P] of the crop."""
        relative = _row(self.pairs.relative.view(-1, 3, 4), chosen.pair)
        if not self.perturbation:
            return relative
        distance = depth.sum() / (depth > 0).sum().clamp(min=1)
        return self._virtual(relative, distance / _row(self.maps.intrinsics, chosen.auxiliary)[0], distance)

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


def _row(table: Tensor, index: Tensor) -> Tensor:
    """The row of a [1] index; table[index] with a 0-dim index would wait for the device."""
    return table.index_select(0, index)[0]


def _pick(random: Tensor, count: int | Tensor) -> Tensor:
    """Uniform integer in [0, count) from a uniform number in [0, 1); float32 rounding must not reach count."""
    return (random * count).long().clamp(max=count - 1)

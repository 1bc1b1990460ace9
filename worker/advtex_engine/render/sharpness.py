"""How sharp photographs are, by themselves and beside the renders of a texture."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence

import torch
from torch import Tensor

from advtex_engine.core.scene import View, evenly_spread
from advtex_engine.render.texture import footprints, sample_texels
from advtex_engine.render.view_maps import ViewMaps, foregrounds
from advtex_engine.runtime.threads import in_threads, one_thread_each

VIEWS = 12  # of which either is measured
AT_ONCE = 2  # of them on a CPU: a render of means takes half a kilobyte a pixel
FINE = 0.68
"""Fineness from which a pixel of the photographs is the mean of what lies before it, and no more. Rendered pictures
have .9 to 1.1, photographs of half a sensor's size .70 to .78, at its full size .60 and .66."""


def shows_areas(maps: ViewMaps) -> bool:
    """Whether a pixel of the photographs is the mean over its area, so that a render's pixel should be: see `FINE`.

    Photographs that a lens, motion or interpolation has blurred by more than that say nothing of what is as small as a
    pixel; a texture whose renders were means would take their grain for it.
    """
    return fineness(maps) >= FINE


def fineness(maps: ViewMaps) -> float:
    """Second differences of the photographs as a share of the differences two pixels apart; white noise has 1.7.

    Only what shows the mesh counts.
    """
    return _fineness((photograph, seen) for photograph, seen, _ in _pictures(maps))


def photographs_fineness(views: Sequence[View]) -> float:
    """`fineness` where masks leave photographs in and depth was read: for who does not know yet where the mesh is."""
    return _fineness((view.color / 255, _scanned(view)) for view in evenly_spread(views, VIEWS))


def _scanned(view: View) -> Tensor:
    scanned = torch.ones(view.color.shape[:2], dtype=torch.bool) if view.mask is None else view.mask
    return scanned if view.depth is None else scanned & (view.depth > 0)


def _fineness(pictures: Iterable[tuple[Tensor, Tensor]]) -> float:
    sums = torch.zeros(2, dtype=torch.float64)
    for photograph, seen in pictures:
        planes, weight = photograph.permute(2, 0, 1).contiguous(), seen.to(torch.float32)
        for axis in (1, 2):
            count = planes.shape[axis] - 2
            first, middle, last = (planes.narrow(axis, place, count) for place in range(3))
            whole = math.prod(weight.narrow(axis - 1, place, count) for place in range(3))
            parts = ((first + last).sub_(middle, alpha=2), last - first)
            sums += torch.stack([part.abs_().mul_(whole).sum() for part in parts]).cpu()
    return float(sums[0] / sums[1].clamp(min=1e-12))


def sharpness(texture: Tensor, maps: ViewMaps) -> float:
    """Gradients of the texture's renders, of means over areas, as a share of the photographs'; [H,W,3] in [0,1]."""
    values = texture[maps.slot_map >= 0]

    def steps(picture: tuple[Tensor, Tensor, Tensor]) -> Tensor:
        photograph, seen, uv = picture
        slots, weights = footprints(uv, seen, maps.slot_map, areas=True)
        render = sample_texels(values, slots, weights).view(photograph.shape)
        sums = torch.zeros(2, device=maps.device)
        for axis in (0, 1):
            count = seen.shape[axis] - 1
            both = seen.narrow(axis, 0, count) & seen.narrow(axis, 1, count)
            sums += torch.stack(
                [(image.diff(dim=axis).abs() * both[..., None]).sum() for image in (render, photograph)]
            )
        return sums

    with one_thread_each():
        found = list(in_threads(steps, _pictures(maps), AT_ONCE if maps.device.type == "cpu" else 1))
    rendered, photographed = torch.stack(found).sum(0).tolist() if found else (0.0, 0.0)
    return float(rendered / max(photographed, 1e-12))


def _pictures(maps: ViewMaps) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Of some views the photograph [h,w,3] in [0,1], where it shows the mesh [h,w] bool, and uv [h,w,2] int16."""
    size = (maps.height, maps.width)
    for number in evenly_spread(foregrounds(maps).nonzero().flatten().tolist(), VIEWS):
        view = maps.only(number)
        color = view.color.view(*size, 3).to(torch.float32) / 255
        yield color, view.depth.view(size) > 0, view.uv.view(*size, 2)

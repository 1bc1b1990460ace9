"""Fine detail of all photographs that agree with what is painted to a fraction of a pixel.

Each place is painted from one photograph, with that photograph's grain and the traces of its resampling. What other
photographs show of the same place is the same detail with other grain, a pixel or so beside it, as cameras and meshes
are off. So each is first moved onto the texture's render by a smooth displacement (Lucas and Kanade 1981, coarse to
fine), and then counts by how well its detail correlates with the render's: blurred, hidden, sheen or elsewhere, it
counts as nothing, and a place that no other photograph agrees about keeps its one. Means of several photographs, as
multi-frame super-resolution takes them (Irani and Peleg 1991), but of the finest band alone: what is wider, tones and
leveling have decided. A mean of what agrees only in part is softer than each of it, so photographs' detail is raised by
the more, the less they agree; but for grain, which a mean is to lose.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.render.filtering import halved, window_sums
from advtex_engine.render.motion import Taps, smeared
from advtex_engine.render.sharpness import shows_areas
from advtex_engine.render.texture import footprints, sample_texels
from advtex_engine.render.view_maps import ViewMaps, foregrounds
from advtex_engine.runtime.available_memory import available_memory
from advtex_engine.runtime.threads import in_threads, one_thread_each

OPTIMIZED = 0.5
"""Share of the correction for optimized textures: energies of all photographs are in these already, and photographs
that are moved to be compared are softer."""
BAND = 2  # pixels to each side; what is wider than such a window is no detail
WINDOW = 7  # pixels to each side, over which detail is correlated
POWER = 8  # of the correlation: what agrees by three quarters counts a tenth
NOISE = 1e-4
"""Variance of detail, of colors in [0, 1], that may be grain: what has hardly more counts little."""
CALM, SAMPLES = 0.02, 50_000  # share of the windows that differ by grain alone, and pixels that tell
RAISED, MOST_RAISED = 1.25, 2.0
"""Detail is raised by 1/correlation to this power, grain left out, and by so much at the most; to twice the power where
half of it is given: then it makes up for the other half, too."""
LEAST = 0.01  # what counts less is left out: two pixels of three, and a hundredth of all that counts
OCTAVES, ROUNDS = 3, 2  # of the displacement: pictures of half the size each, and steps in each
REACH = 12  # pixels to each side, over which it is one
SMOOTH = 6  # and over which the found ones are averaged: detail must not be bent to fit
LEAST_SIDE = 16  # pixels; smaller pictures have no octave of their own
FAINT = 1e-5
"""Variance of detail, and square of slopes, that count as none; of colors in [0, 1]: three thousandths."""
MIN_WEIGHT = 0.25  # pixels; a texel that hardly any pixel shows is corrected less
INSIDE = 0.99  # share of a moved pixel that must lie where its photograph shows the mesh
ROWS = 64
AT_ONCE = 4  # views; what they take is not in the run's estimate, whose steps take as much
BYTES_PER_PIXEL = 300  # of a view, while it is compared
LUMA = (0.299, 0.587, 0.114)


def share_detail(
    texture: Tensor, maps: ViewMaps, share: float = 1.0, motions: Mapping[int, Taps] | None = None
) -> Tensor:
    """The texture [H,W,3] float32 in [0,1] with the finest detail that the views at working size have in common.

    texture: without holes; texels that no view samples stay as they are. share: of the correction that is made; the
    rest of the texture's own detail stays. motions: of views whose cameras moved; what their photographs lack by that
    is not taken away. Not differentiable.
    """
    assert texture.shape[:2] == maps.slot_map.shape
    owned = maps.slot_map >= 0
    values = texture[owned]
    lacking, weight = torch.zeros_like(values), torch.zeros_like(values[:, 0])

    areas = shows_areas(maps)

    def agreed(view: int) -> tuple[Tensor, Tensor, Tensor]:
        return _agreed_detail(
            values, maps.only(view), areas=areas, power=RAISED / share, motion=(motions or {}).get(view, ())
        )

    # One view after the other takes two cores half as long again as a view on each. On a GPU there is nothing to gain.
    at_once = 1
    if maps.device.type == "cpu":
        room = available_memory(maps.device) // 2
        at_once = max(1, min(AT_ONCE, torch.get_num_threads(), room // (BYTES_PER_PIXEL * maps.width * maps.height)))
    with one_thread_each():
        for slots, shares, detail in in_threads(agreed, foregrounds(maps).nonzero().flatten().tolist(), at_once):
            for channel in range(3):  # index_add_ of short rows takes three times as long on a CPU
                lacking[:, channel].index_add_(0, slots, (detail[channel, :, None] * shares).flatten())
            weight.index_add_(0, slots, shares.flatten())
    values = (values + share * lacking / (weight + MIN_WEIGHT)[:, None]).clamp(0, 1)
    return texture.masked_scatter(owned[..., None], values)


def _agreed_detail(
    values: Tensor, view: ViewMaps, *, areas: bool, power: float, motion: Taps
) -> tuple[Tensor, Tensor, Tensor]:
    """What the render lacks of P pixels of a view: slots [P*K], how much each counts there [P,K], detail [3,P].

    power: of 1/correlation, that the photograph's detail is raised by.
    """
    size = (view.height, view.width)
    seen = view.depth.view(size) > 0
    slots, shares = _footprints(view.uv.view(*size, 2), seen, view.slot_map, areas=areas)
    photograph = view.color.view(*size, 3).permute(2, 0, 1).to(torch.float32) / 255
    render = sample_texels(values, slots, shares).view(*size, 3).permute(2, 0, 1)
    render = torch.where(seen, render, photograph)
    known = seen.to(torch.float32)
    luma = values.new_tensor(LUMA)
    ours, theirs = (torch.tensordot(luma, picture, 1) for picture in (render, photograph))
    moved = displacement(ours, theirs, known)
    photograph = _sampled(photograph, moved, "bicubic")
    known = known * (_sampled(known[None], moved, "bilinear")[0] > INSIDE)
    bands = _band(torch.cat((smeared(render, motion), photograph)), known, BAND).view(2, 3, *size)
    ours, theirs = torch.tensordot(bands, luma, ([1], [0]))
    agreement, without_grain = _correlations(ours, theirs, known)
    counts = (agreement.pow_(POWER) * known).flatten()
    counted = (counts > LEAST).nonzero()[:, 0]
    raised = without_grain.flatten()[counted].pow_(-power).clamp_(max=MOST_RAISED)
    render, photograph = bands.flatten(2)[:, :, counted]
    return slots[counted].long().flatten(), shares[counted] * counts[counted, None], raised * photograph - render


def _footprints(uv: Tensor, seen: Tensor, slot_map: Tensor, *, areas: bool) -> tuple[Tensor, Tensor]:
    """Some rows after the others: those of means over areas take six times the room while they are found."""
    parts = []
    for first in range(0, len(uv), ROWS):
        last = min(first + ROWS, len(uv))
        rows = slice(max(0, first - 1), min(last + 1, len(uv)))  # whose steps to either side count
        found = footprints(uv[rows], seen[rows], slot_map, areas=areas)
        inside = slice((first - rows.start) * uv.shape[1], (last - rows.start) * uv.shape[1])
        parts.append([part[inside] for part in found])
    slots, shares = (torch.cat(part) for part in zip(*parts, strict=True))
    return slots, shares


def displacement(render: Tensor, photograph: Tensor, known: Tensor) -> Tensor:
    """[2,h,w] pixels (right, down): what the render shows at p, the photograph shows at p + displacement(p).

    render, photograph: [h,w] in [0,1]; known: [h,w], 1 where they count, else 0. Smooth, and for some pixels of it.
    """
    octaves = [torch.stack((render, photograph, known))]
    while len(octaves) < OCTAVES and min(octaves[-1].shape[1:]) >= 2 * LEAST_SIDE:
        octaves.append(halved(octaves[-1]))
    moved = torch.zeros_like(halved(octaves[-1][:2]))
    for number, planes in enumerate(reversed(octaves)):
        if number:
            moved = _spread(2 * moved, halved(planes))
        moved = _improved(moved, planes[:2], (planes[2] > INSIDE).to(planes))
    return _spread(moved, render)


def _improved(moved: Tensor, planes: Tensor, known: Tensor) -> Tensor:
    """A displacement after ROUNDS of Gauss-Newton steps, of one octave's render and photograph [2,h,w], known [h,w].

    moved: [2,h/2,w/2]. All pixels are compared; means over windows of them are as well known at every second.
    """
    ours, theirs = _band(planes, known, SMOOTH - 2)
    right = F.pad((ours[:, 2:] - ours[:, :-2]) / 2, (1, 1))
    down = F.pad((ours[2:] - ours[:-2]) / 2, (0, 0, 1, 1))
    weight = halved(known[None])[0]
    wide, narrow = (_inverse_sums(weight, reach // 2) for reach in (REACH, SMOOTH))
    slopes = torch.stack((right, down)) * known
    products = window_sums(halved(torch.cat((slopes * right, slopes[1:] * down))), REACH // 2) * wide
    across, both, along = products[0] + FAINT, products[1], products[2] + FAINT
    determinant = across * along - both * both
    for _ in range(ROUNDS):
        off = _sampled(theirs[None], _spread(moved, ours), "bilinear")[0] - ours
        pull = window_sums(halved(slopes * off), REACH // 2) * wide
        step = torch.stack((along * pull[0] - both * pull[1], across * pull[1] - both * pull[0])) / determinant
        moved = window_sums((moved - step.clamp(-1, 1)) * weight, SMOOTH // 2) * narrow
    return moved


def _spread(moved: Tensor, picture: Tensor) -> Tensor:
    """A displacement [2,...] at every pixel of a picture [...,h,w]."""
    return F.interpolate(moved[None], picture.shape[-2:], mode="bilinear", align_corners=False)[0]


def _inverse_sums(known: Tensor, reach: int) -> Tensor:
    return window_sums(known[None], reach)[0].clamp(min=1).reciprocal()


def _correlations(ours: Tensor, theirs: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
    """Of two bands [h,w] over windows, each [h,w] in [0,1]: as they are, and as they were without their grain.

    Of the first, windows with hardly more than grain have little.
    """
    products = _means(torch.stack((ours * ours, theirs * theirs, ours * theirs)), known, WINDOW)
    variances, product = products[:2].clamp(min=0), products[2].clamp(min=0)
    differing = (variances.sum(0) - 2 * product)[known > 0]
    differing = differing[:: len(differing) // SAMPLES + 1]
    grain = torch.quantile(differing, CALM) / 2 if len(differing) else 0.0
    without = (variances - grain).clamp(min=FAINT)
    as_is, of_detail = (product / of.prod(0).sqrt() for of in (variances + NOISE, without))
    return as_is, of_detail.clamp(max=1)


def _band(planes: Tensor, known: Tensor, reach: int) -> Tensor:
    """Planes [C,h,w] less their means over windows, 0 where not known."""
    return (planes - _means(planes, known, reach)) * known


def _means(planes: Tensor, known: Tensor, reach: int) -> Tensor:
    """Means of planes [C,h,w] over what is known in the windows that reach so many pixels to each side."""
    return window_sums(planes * known, reach) / window_sums(known[None], reach).clamp(min=1)


def _sampled(planes: Tensor, moved: Tensor, mode: str) -> Tensor:
    """Planes [C,h,w] at p + moved(p), beyond the border as at it."""
    height, width = planes.shape[1:]
    rows = torch.arange(height, device=planes.device)[:, None] + moved[1]
    columns = torch.arange(width, device=planes.device) + moved[0]
    grid = torch.stack((columns * (2 / (width - 1)) - 1, rows * (2 / (height - 1)) - 1), -1)
    return F.grid_sample(planes[None], grid[None], mode, padding_mode="border", align_corners=True)[0]

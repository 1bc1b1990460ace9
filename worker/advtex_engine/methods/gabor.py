"""Selected photographs, descended to what all of them agree on but for displacement: no opponent is trained.

Each step compares two views' photographs with the texture's renders by Gabor energies (`adversarial/gabor.py`), which
forgive some pixels, so that every view adds to a texture that begins as a patchwork of single ones. Energies say
nothing of colors, and nothing of what is wider than their coarsest octave: there means over blocks are compared, which
some pixels of displacement hardly change either. The render's pixels are means over what they show, where a
photograph's are: values at their middles would make a texture that is as soft as these means, and softer still when it
is shown. A photograph whose camera moved is compared with a render that is smeared as it is (`render/motion.py`). At
the end half of the finest detail is that of all photographs that agree (`selection/shared_detail.py`).

What forgives some pixels has nothing to say where photographs are off by many more, as with cameras that nothing could
mend. There the texture stays as it is: photographs that it was not painted from do not look like it at all.
"""

from __future__ import annotations

import math
from functools import partial

import torch
from torch import Tensor

from advtex_engine.adversarial.gabor import gabor_filters, gabor_loss, gray_levels
from advtex_engine.adversarial.optimizer import crop_size
from advtex_engine.adversarial.probes import LeftOutCells
from advtex_engine.adversarial.unlikeness import structure_unlikeness
from advtex_engine.core.errors import Problem
from advtex_engine.methods.descent import descend, drawn_views
from advtex_engine.methods.inputs import LossPoint, MethodInput
from advtex_engine.methods.selected import with_detail
from advtex_engine.render.motion import Taps, found_motion, smeared
from advtex_engine.render.sharpness import shows_areas
from advtex_engine.render.texture import footprints, sample_texels
from advtex_engine.render.view_maps import ViewMaps, foregrounds
from advtex_engine.runtime.checkpoint import CHECKPOINT
from advtex_engine.runtime.threads import in_threads, one_thread_each, side_by_side
from advtex_engine.selection.shared_detail import OPTIMIZED, share_detail

PASSES = 5  # over all views, unless the number of steps is asked for
REACH = 1e-2
"""Rate of the first step times the passes, in colors of [0, 1]: how far texels may go. Further on they fit photographs
that are blurred, whatever the rate is, and edges soften; more steps take smaller ones."""
MAX_LR = 2e-3  # larger steps leave grain; by a single view
TOGETHER = 2
"""Views of a step. On a CPU they are looked at side by side, with half of the threads each: a view's many small
operations keep two threads busy for two thirds of the time."""
BLOCK = 8  # pixels a side, of which means are compared; every half of it
UNLIKE = 0.6
"""Of unrelated pictures' unlikeness, what the start has to photographs that it was not painted from where they have
too little in common: .07 to .48 on scans that gain by the descent, .72 where it is level, .90 where it harms
(`tests/benchmarks/agreement.py`)."""


def descended(
    given: MethodInput,
    steps: int | None = None,
    *,
    passes: float = PASSES,
    largest: tuple[int, int] | None = None,
    checkpoint: str = CHECKPOINT,
) -> tuple[Tensor, list[LossPoint]]:
    """Two views per step, all in a new random order per pass -> [H,W,3] float32 in [0,1] and the losses.

    From given.start, whose tones the views have: that of `selected_start`. It is the result, with its detail, and a
    warning says so, where they do not agree with it. steps: None for so many passes over all pixels. largest: crop
    (width, height) that a step sees. checkpoint: the name of its file. Raises Stopped, after a checkpoint.
    """
    maps, device = given.maps[1], given.maps[1].device
    areas = shows_areas(maps)
    if given.start is not None and (unlike := start_unlikeness(given)) > UNLIKE:
        given.monitor.warning(_disagree(unlike))
        if areas or given.painted is None:
            return given.start, []
        return with_detail(given.start, given.painted, maps), []
    generator = torch.Generator().manual_seed(given.config.seed)
    width, height = crop_size(maps.width, maps.height, largest)
    share = width * height / math.prod(crop_size(maps.width, maps.height))
    order = drawn_views(maps, steps and TOGETHER * steps, passes / share, generator)
    # Windows and octaves lie elsewhere each time, or the texture would fit those of one grid.
    margins = torch.tensor([maps.width - width + 1, maps.height - height + 1])
    corners = (torch.rand((len(order), 2), generator=generator) * margins).long().tolist()
    filters = gabor_filters(device)

    into = [torch.empty((maps.slots, 3), device=device) for _ in range(TOGETHER)]
    motions = start_motions(given.start, maps, areas=areas) if given.start is not None else {}

    def unlikeness(values: Tensor, number: int) -> tuple[Tensor, Tensor]:
        values = values.detach().requires_grad_(True)
        photograph, foreground, slots, weights = _seen(
            maps.only(order[number]), corners[number], (width, height), areas=areas
        )
        render = sample_texels(values, slots, weights, into[number % TOGETHER])
        render = render.view(1, height, width, 3).permute(0, 3, 1, 2) * 2 - 1
        moved = partial(smeared, taps=motions.get(order[number], ()))
        value = gabor_loss(render, photograph, foreground, filters, moved) + wide_loss(render, photograph, foreground)
        (slope,) = torch.autograd.grad(value, [values])
        return value.detach(), slope

    # Adam's step goes with the root of how often a texel is seen: a crop's are seen as often, in more steps.
    rate = min(MAX_LR, REACH * len(set(order)) / (len(order) * share**0.5)) * TOGETHER**0.5
    with side_by_side(TOGETHER if device.type == "cpu" else 1) as mapped:

        def gradient(values: Tensor, step: int) -> tuple[Tensor, Tensor]:
            numbers = range(step * TOGETHER, min((step + 1) * TOGETHER, len(order)))
            found = mapped(partial(unlikeness, values), numbers)
            total = found[0][1]
            for _, slope in found[1:]:
                total += slope
            return torch.stack([value for value, _ in found]).mean(), total

        steps = math.ceil(len(order) / TOGETHER)
        texture, losses = descend(given, "gabor", gradient, steps, generator, rate=rate, checkpoint=checkpoint)
    # Energies say how much detail there is, and not where.
    return share_detail(texture, maps, OPTIMIZED, motions), losses


def start_motions(start: Tensor, maps: ViewMaps, *, areas: bool) -> dict[int, Taps]:
    """Of each view that shows the mesh, by how much more motion its photograph is blurred than the start [H,W,3]."""
    values = start[maps.slot_map >= 0]
    views = foregrounds(maps).nonzero().flatten().tolist()

    def motion(number: int) -> Taps:
        photograph, foreground, slots, weights = _seen(
            maps.only(number), [0, 0], (maps.width, maps.height), areas=areas
        )
        render = sample_texels(values, slots, weights).view(1, maps.height, maps.width, 3).permute(0, 3, 1, 2) * 2 - 1
        return found_motion(gray_levels(render)[0], gray_levels(photograph)[0], foreground[0, 0])

    with one_thread_each():
        found = list(in_threads(motion, views, TOGETHER if maps.device.type == "cpu" else 1))
    return dict(zip(views, found, strict=True))


def start_unlikeness(given: MethodInput) -> float:
    """`structure_unlikeness` of given.start to photographs, where it was painted from others, as a share of what it is
    to the same photographs upside down; 0 where nothing tells."""
    maps, start = given.maps[1], given.start
    if start is None or given.painted is None:
        return 0.0
    cells = LeftOutCells(maps, given.painted, structure_unlikeness, areas=shows_areas(maps))
    some = cells.of(list(range(maps.count)))
    values = start[maps.slot_map >= 0]
    chance = cells.chance(some, values) if some else 0.0
    return cells.unlike(some, values) / chance if chance > 0 else 0.0


def _disagree(unlike: float) -> Problem:
    return Problem(
        "photographs_disagree",
        "the cameras' poses",
        f"photographs do not show the same at the same places of the mesh (they are {unlike:.0%} as unlike as"
        f" unrelated pictures; up to {UNLIKE:.0%} can be mended), so every place shows one of them as it is",
        "check that poses, intrinsics and mesh belong together (advtex-client check), and do not leave out refinement",
    )


def wide_loss(render: Tensor, photograph: Tensor, foreground: Tensor) -> Tensor:
    """0-dim: mean absolute difference of means over blocks; a gradient for the render.

    render, photograph: [1,3,h,w] in [-1,1], at least a block a side; they count where foreground [1,1,h,w] is not 0.
    """
    difference = torch.where(foreground > 0, render - photograph, 0.0)
    return _block_sums(_block_sums(difference, -2), -1).abs().mean() / BLOCK**2


def _block_sums(planes: Tensor, axis: int) -> Tensor:
    """Sums over BLOCK pixels along an axis (-2 or -1), every half of it. avg_pool2d takes a CPU four times as long."""
    half = BLOCK // 2
    count = planes.shape[axis] // half
    whole = planes.narrow(axis, 0, count * half)
    first, *rest = whole.unflatten(axis, (count, half)).unbind(axis)  # type: ignore[no-untyped-call]
    sums: Tensor = sum(rest, first)
    return sums.narrow(axis, 1, count - 1) + sums.narrow(axis, 0, count - 1)


def _seen(
    view: ViewMaps, corner: list[int], crop: tuple[int, int], *, areas: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """A crop of one view: photograph [1,3,h,w] in [-1,1], foreground [1,1,h,w], slots and weights [h*w,9] of what its
    pixels show, or [h*w,4] of what their middles do."""
    (left, top), (width, height) = corner, crop
    window = (slice(top, top + height), slice(left, left + width))
    color, uv = (part.view(view.height, view.width, -1)[window] for part in (view.color, view.uv))
    foreground = view.depth.view(view.height, view.width)[window] > 0
    slots, weights = footprints(uv, foreground, view.slot_map, areas=areas)
    photograph = color.permute(2, 0, 1)[None].to(torch.float32) / 127.5 - 1
    return photograph, foreground[None, None], slots, weights

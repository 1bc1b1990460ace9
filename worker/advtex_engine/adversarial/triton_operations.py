"""The step's operations on Triton kernels: same signatures and results as their plain twins (`operations.py`).

Tensors are on one GPU, or on the CPU when Triton interprets its kernels (TRITON_INTERPRET=1), which tests do.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from advtex_engine.adversarial import kernels
from advtex_engine.adversarial.alignment import BLOCK as OFFSET_BLOCK
from advtex_engine.adversarial.examples import Examples, InputForm
from advtex_engine.adversarial.operations import Operations
from advtex_engine.adversarial.pair_sampler import Choice, DrawnPair, PairSampler
from advtex_engine.adversarial.triton_gabor import gabor_loss
from advtex_engine.adversarial.triton_losses import judge, l1_loss, mean_difference
from advtex_engine.adversarial.triton_offsets import example_offsets
from advtex_engine.render.texture import FAR_APART, LEAST_WEIGHT

BLOCK = 256  # pixels of a program
LONG_BLOCK = 4096  # values of a program that only copies

assert kernels.GRID.value == OFFSET_BLOCK // 2
assert (kernels.FAR_APART.value, kernels.LEAST_WEIGHT.value) == (FAR_APART, LEAST_WEIGHT)


def triton_operations() -> Operations:
    return Operations(
        "triton",
        None,
        draw=draw,
        sample_texels=sample_texels,
        offsets=example_offsets,
        assemble=assemble,
        judge=judge,
        l1_loss=l1_loss,
        mean_difference=mean_difference,
        gabor_loss=gabor_loss,
        average=average,
    )


def draw(sampler: PairSampler) -> DrawnPair:
    """`PairSampler.draw` in two kernels, of the same random numbers; colors and depths are read as they are stored."""
    maps, (width, height) = sampler.maps, sampler.crop
    chosen = _choose(sampler)
    relative = sampler.pairs.relative.view(-1, 12)
    if sampler.perturbation:
        pair = Choice(*chosen.split(1))  # type: ignore[no-untyped-call]
        relative = sampler.relative(pair, sampler.depth(sampler.pixels(pair))).contiguous()
    else:
        relative = relative.index_select(0, chosen[2:3])
    pixels = width * height
    condition, real = (torch.empty((pixels, 3), device=maps.color.device) for _ in range(2))
    foreground, visible = (torch.empty((pixels, 1), device=maps.color.device) for _ in range(2))
    taps = 9 if sampler.areas else 4
    slots = torch.empty((pixels, taps), dtype=torch.int32, device=maps.color.device)
    weights = torch.empty((pixels, taps), device=maps.color.device)
    kernels.draw[_programs(pixels)](
        *(chosen, relative, maps.color, maps.uv, maps.depth, maps.intrinsics, maps.slot_map),
        *(condition, real, foreground, visible, slots, weights),
        sampler.tolerance,
        AREAS=sampler.areas,
        WIDTH=maps.width,
        HEIGHT=maps.height,
        CROP=width,
        PIXELS=pixels,
        TEXTURE_WIDTH=maps.slot_map.shape[1],
        TEXTURE_HEIGHT=maps.slot_map.shape[0],
        BLOCK=BLOCK,
    )
    image = sampler.image
    return DrawnPair(image(condition), image(real), image(foreground), image(visible), slots, weights)


def _choose(sampler: PairSampler) -> Tensor:
    """[5] int64, the members of `Choice`."""
    maps, pairs = sampler.maps, sampler.pairs
    random = torch.rand((4, 1), generator=sampler.generator, device=sampler.device)
    chosen = torch.empty(5, dtype=torch.int64, device=sampler.device)
    kernels.choose[(1,)](
        *(random, sampler.source_count, pairs.sources, pairs.count, pairs.auxiliary, chosen),
        COLUMNS=pairs.auxiliary.shape[1],
        FREE_X=maps.width - sampler.crop[0] + 1,
        FREE_Y=maps.height - sampler.crop[1] + 1,
    )
    return chosen


class _SampleTexels(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, slots: Tensor, weights: Tensor) -> Tensor:
        ctx.save_for_backward(slots, weights)
        ctx.rows = values.shape[0]
        rows = torch.empty((slots.shape[0], 3), device=values.device)
        sizes = {"PIXELS": len(rows), "TAPS": slots.shape[1], "BLOCK": BLOCK}
        kernels.sample[_programs(len(rows))](values, slots, weights, rows, **sizes)
        return rows

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> tuple[Tensor, None, None]:
        slots, weights = ctx.saved_tensors
        gradient = grads[0].contiguous()
        into = torch.zeros((ctx.rows, 3), device=gradient.device)
        pixels = gradient.shape[0]
        sizes = {"PIXELS": pixels, "TAPS": slots.shape[1], "BLOCK": BLOCK}
        kernels.sample_backward[_programs(pixels)](gradient, slots, weights, into, **sizes)
        return into, None, None


def sample_texels(values: Tensor, slots: Tensor, weights: Tensor) -> Tensor:
    """`texture.sample_texels` for three channels; the gradient's sums come in any order, so their rounding differs."""
    assert values.shape[1:] == (3,) and slots.shape == weights.shape
    out: Tensor = _SampleTexels.apply(values, slots, weights)  # type: ignore[no-untyped-call]
    return out


class _Assemble(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        condition: Tensor,
        real: Tensor,
        fake: Tensor,
        visible: Tensor,
        offsets: Tensor | None,
        form: InputForm,
    ) -> tuple[Tensor, ...]:
        height, width = fake.shape[-2:]
        inputs = [_image((1, form.channels, height, width), form.dtype, fake.device) for _ in range(2)]
        moved = [fake, real, visible]
        if offsets is not None:
            moved = [_image(image.shape, image.dtype, image.device) for image in moved]
        sizes = {"WIDTH": width, "HEIGHT": height, "CHANNELS": form.channels, "MOVED": offsets is not None}
        sizes |= {"ROWS": offsets.shape[1], "COLUMNS": offsets.shape[2]} if offsets is not None else _ONE_BLOCK
        rows = [_rows(image) for image in (condition, real, fake, visible)]
        kernels.assemble[_programs(width * height)](
            *rows,
            rows[0] if offsets is None else offsets,
            *(_rows(image) for image in (*inputs, *moved)),
            CONDITIONED=form.conditioned,
            **sizes,
            BLOCK=BLOCK,
        )
        ctx.save_for_backward(moved[2], *(() if offsets is None else (offsets,)))
        ctx.sizes = sizes
        ctx.set_materialize_grads(False)  # where L1 holds on to the start, nothing comes for the moved example
        if offsets is None:
            ctx.mark_non_differentiable(inputs[1])
            return (*inputs,)
        ctx.mark_non_differentiable(inputs[1], moved[1], moved[2])
        return (*inputs, *moved)

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> tuple[Tensor | None, ...]:
        visible, *offsets = ctx.saved_tensors
        assert grads[0] is not None, "the fake example is always judged"
        of_input = _rows(grads[0])
        of_moved = _rows(grads[2]) if len(grads) > 2 and grads[2] is not None else None
        height, width = visible.shape[-2:]
        into = _image((1, 3, height, width), torch.float32, visible.device)
        if offsets:
            into.zero_()
        kernels.assemble_backward[_programs(width * height)](
            of_input,
            of_input if of_moved is None else of_moved,
            _rows(visible),
            offsets[0][1] if offsets else of_input,
            _rows(into),
            WITH_MOVED=of_moved is not None,
            **ctx.sizes,
            BLOCK=BLOCK,
        )
        return None, None, into, None, None, None


_ONE_BLOCK = {"ROWS": 1, "COLUMNS": 1}


def assemble(
    condition: Tensor, real: Tensor, fake: Tensor, visible: Tensor, offsets: Tensor | None, form: InputForm
) -> Examples:
    """`examples.assemble` in one kernel, which writes the inputs in their form at once."""
    assert condition.shape == real.shape == fake.shape and condition.shape[:2] == (1, 3)
    assert visible.shape == (1, 1, *condition.shape[2:])
    out = _Assemble.apply(condition, real, fake, visible, offsets, form)  # type: ignore[no-untyped-call]
    fake_input, real_input, *moved = out
    if moved:
        fake, real, visible = moved
    return Examples(fake_input, real_input, fake, real, visible)


def average(mean: Tensor, state: Tensor, weight: Tensor) -> None:
    """Moves `mean` towards `state` by the weight, a 0-dim tensor on the device; a weight of 0 costs nothing."""
    assert mean.is_contiguous() and state.is_contiguous() and mean.shape == state.shape
    kernels.average[_programs(mean.numel(), LONG_BLOCK)](mean, state, weight, COUNT=mean.numel(), BLOCK=LONG_BLOCK)


def _programs(count: int, block: int | None = None) -> tuple[int]:
    return (-(-count // (block or BLOCK)),)


def _image(shape: tuple[int, ...] | torch.Size, dtype: torch.dtype, device: torch.device) -> Tensor:
    """[1,C,h,w] in channels_last memory, not yet written."""
    return torch.empty(shape, dtype=dtype, device=device, memory_format=torch.channels_last)


def _rows(image: Tensor) -> Tensor:
    """An image [1,C,h,w] as rows [h*w,C]; no copy in channels_last memory."""
    return image.permute(0, 2, 3, 1).contiguous()

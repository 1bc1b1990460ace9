"""The losses on Triton kernels, with the results of their plain twins in `losses.py`."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from advtex_engine.adversarial import kernels_losses as kernels
from advtex_engine.adversarial import losses
from advtex_engine.adversarial.losses import Verdict

BLOCK = 256  # pixels or logits of a program
LONG_BLOCK = 4096  # values of a program that only adds up
ALONE = 1024  # values at a time of a program that goes through all of them by itself: few are left by then

assert kernels.MIN_FOREGROUND.value == losses.MIN_FOREGROUND
assert kernels.MIN_UNOCCLUDED.value == losses.MIN_UNOCCLUDED


class _Judge(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, real: Tensor, fake: Tensor, shares: Tensor, pretraining: Tensor) -> tuple[Tensor, ...]:
        of_discriminator, of_texture, ahead = (torch.empty((), device=fake.device) for _ in range(3))
        counts, told = torch.empty(2, device=fake.device), torch.empty(losses.TOLD, device=fake.device)
        kernels.judge[(1,)](
            *(real, fake, shares, pretraining, of_discriminator, of_texture, ahead, counts, told),
            COUNT=fake.numel(),
            BLOCK=ALONE,
        )
        ctx.save_for_backward(real, fake, shares, counts)
        ctx.set_materialize_grads(False)  # of the two losses one has a gradient at a time
        ctx.mark_non_differentiable(ahead, told)
        return of_discriminator, of_texture, ahead, told

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> tuple[Tensor | None, ...]:
        real, fake, shares, counts = ctx.saved_tensors
        of_discriminator, of_texture, _, _ = grads
        into_fake = torch.empty_like(fake)
        into_real = None if of_discriminator is None else torch.empty_like(real)
        kernels.judge_backward[_programs(fake.numel())](
            *(real, fake, shares, counts),
            *(counts if one is None else one for one in (of_discriminator, of_texture)),
            into_fake if into_real is None else into_real,
            into_fake,
            COUNT=fake.numel(),
            JUDGED=of_discriminator is not None,
            DRAWN=of_texture is not None,
            BLOCK=BLOCK,
        )
        return into_real, into_fake, None, None


def judge(real: Tensor, fake: Tensor, shares: Tensor, pretraining: Tensor) -> Verdict:
    """`losses.judge` in one kernel, which reads the logits as they are."""
    assert real.shape == fake.shape and shares.numel() == 2 * fake.numel()
    found = _Judge.apply(real.contiguous(), fake.contiguous(), shares.contiguous(), pretraining)  # type: ignore[no-untyped-call]
    return Verdict(*found)


class _L1(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, a: Tensor, b: Tensor, visible: Tensor) -> Tensor:
        pixels = len(visible)
        parts = _programs(pixels)
        sums = torch.empty((2, *parts), device=a.device)
        mean, count = (torch.empty((), device=a.device) for _ in range(2))
        kernels.l1[parts](a, b, visible, sums, PARTS=parts[0], PIXELS=pixels, BLOCK=BLOCK)
        kernels.l1_mean[(1,)](sums, mean, count, PARTS=parts[0], BLOCK=ALONE)
        ctx.save_for_backward(a, b, visible, count)
        return mean

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> tuple[Tensor, None, None]:
        a, b, visible, count = ctx.saved_tensors
        into, pixels = torch.empty_like(a), len(visible)
        kernels.l1_backward[_programs(pixels)](
            a, b, visible, grads[0].contiguous(), count, into, PIXELS=pixels, BLOCK=BLOCK
        )
        return into, None, None


def l1_loss(fake: Tensor, real: Tensor, seen: Tensor) -> Tensor:
    """`losses.l1_loss` of images [1,3,H,W]; differentiable in `fake` only."""
    assert fake.shape == real.shape and fake.shape[:2] == (1, 3)
    rows = [image.permute(0, 2, 3, 1).reshape(-1, image.shape[1]).contiguous() for image in (fake, real, seen)]
    mean: Tensor = _L1.apply(rows[0], rows[1].detach(), rows[2])  # type: ignore[no-untyped-call]
    return mean


class _MeanDifference(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, a: Tensor, b: Tensor) -> Tensor:
        ctx.save_for_backward(a, b)
        parts = _programs(a.numel(), LONG_BLOCK)
        sums, mean = torch.empty(parts, device=a.device), torch.empty((), device=a.device)
        kernels.difference[parts](a, b, sums, COUNT=a.numel(), BLOCK=LONG_BLOCK)
        kernels.difference_mean[(1,)](sums, mean, COUNT=a.numel(), PARTS=parts[0], BLOCK=ALONE)
        return mean

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> tuple[Tensor, None]:
        a, b = ctx.saved_tensors
        into = torch.empty_like(a)
        kernels.difference_backward[_programs(a.numel(), LONG_BLOCK)](
            a, b, grads[0].contiguous(), into, COUNT=a.numel(), BLOCK=LONG_BLOCK
        )
        return into, None


def mean_difference(a: Tensor, b: Tensor) -> Tensor:
    """`losses.mean_difference`; both layers lie in memory as channels_last."""
    assert a.shape == b.shape
    a, b = (image.contiguous(memory_format=torch.channels_last) for image in (a, b.detach()))
    mean: Tensor = _MeanDifference.apply(a, b)  # type: ignore[no-untyped-call]
    return mean


def _programs(count: int, block: int | None = None) -> tuple[int]:
    return (-(-count // (block or BLOCK)),)

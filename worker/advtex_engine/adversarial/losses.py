"""The losses of both players, over the patches that count (paper sections 3.2 and 3.3), and feature matching."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.adversarial.discriminator import patch_shares

MIN_FOREGROUND = 0.1  # patches with more than 90 % background are left out
MIN_UNOCCLUDED = 0.5  # the discriminator learns from patches of which more than half is not occluded


@dataclass(frozen=True)
class PatchMasks:
    """Weights (0 or 1) of the logits [B,1,h,w] in the texture's and in the discriminator's adversarial loss."""

    texture: Tensor
    discriminator: Tensor


def patch_masks(foreground: Tensor, visible: Tensor) -> PatchMasks:
    """The paper's two rules, from the logits' exact receptive fields (the part inside the image).

    foreground: [B,1,H,W], pixels where the source view sees the mesh. visible: [B,1,H,W], those of them that the
    auxiliary view sees as well.
    """
    return _masks(example_shares(foreground, visible))


def example_shares(foreground: Tensor, visible: Tensor) -> Tensor:
    """What of each patch is foreground, and what of it is visible [B,2,h,w]; arguments as those of `patch_masks`."""
    return patch_shares(torch.cat((foreground, visible), 1).to(torch.float32))


def _masks(shares: Tensor) -> PatchMasks:
    inside, seen = shares[:, :1], shares[:, 1:]
    texture = (inside >= MIN_FOREGROUND).to(torch.float32)
    return PatchMasks(texture, texture * (seen > MIN_UNOCCLUDED * inside))


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Mean of values where mask is 1; 0 where the mask is empty. Mask broadcasts over values' channels."""
    channels = values.numel() // mask.numel()
    return (values * mask).sum() / (mask.sum() * channels).clamp(min=1.0)


def discriminator_loss(real: Tensor, fake: Tensor, mask: Tensor) -> Tensor:
    """-log D(real) - log(1 - D(fake)) over the discriminator's patches; real, fake: logits [B,1,h,w]."""
    return masked_mean(F.softplus(-real) + F.softplus(fake), mask)


def adversarial_loss(fake: Tensor, mask: Tensor) -> Tensor:
    """Non-saturating loss of the texture, -log D(fake), over the patches that count."""
    return masked_mean(F.softplus(-fake), mask)


TOLD = 7


def told_apart(real: Tensor, fake: Tensor, mask: Tensor) -> Tensor:
    """Sums over the discriminator's patches, [TOLD] float32, which say what it knows (`game.knowledge`); no gradient.

    real, fake: logits [1,1,h,w] float32; mask: [1,1,h,w], 1 or 0. In this order: the patches that count; of the real
    and of the fake ones those judged rightly, a logit of 0 being half right; their logits; their logits' squares.
    """
    real, fake = real.detach(), fake.detach()
    right = (1 + torch.cat((real, -fake)).sign()) / 2
    logits = torch.cat((real, fake))
    sums = (torch.stack((right, logits, logits.square())) * mask).sum((-3, -2, -1))
    return torch.cat((mask.sum().view(1), sums.flatten()))


@dataclass(frozen=True)
class Verdict:
    """0-dim tensors: both players' losses, and 1 where the discriminator is ahead, else 0. told: of `told_apart`."""

    discriminator: Tensor
    adversarial: Tensor
    ahead: Tensor
    told: Tensor


def judge(real: Tensor, fake: Tensor, shares: Tensor, pretraining: Tensor) -> Verdict:
    """Both losses of the logits [1,1,h,w] of any type, and what they tell apart.

    shares: `example_shares`. pretraining: 0-dim, 1 or 0. The discriminator is ahead where its loss is not above the
    texture's; while it learns alone it never is.
    """
    masks, real, fake = _masks(shares), real.float(), fake.float()
    of_discriminator = discriminator_loss(real, fake, masks.discriminator)
    adversarial = adversarial_loss(fake, masks.texture)
    ahead = (of_discriminator <= adversarial).to(torch.float32).detach() * (1 - pretraining)
    return Verdict(of_discriminator, adversarial, ahead, told_apart(real, fake, masks.discriminator))


def l1_loss(fake: Tensor, real: Tensor, seen: Tensor) -> Tensor:
    """Mean absolute difference of images [B,3,H,W] where seen [B,1,H,W] is 1."""
    return masked_mean((fake - real).abs(), seen)


class _MeanDifference(torch.autograd.Function):
    """Mean of |a - b|, float32, with a gradient for a; autograd's own chain reads and writes the layers twice more."""

    @staticmethod
    def forward(ctx: Any, a: Tensor, b: Tensor) -> Tensor:
        difference = a - b
        ctx.save_for_backward(difference)
        norm: Tensor = torch.linalg.vector_norm(difference, 1, dtype=torch.float32)
        return norm / difference.numel()

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> tuple[Tensor, None]:
        (difference,) = ctx.saved_tensors
        scale = (grads[0] / difference.numel()).to(difference.dtype)
        return difference.sign().mul_(scale), None


def mean_difference(a: Tensor, b: Tensor) -> Tensor:
    """Mean of |a - b| as a 0-dim float32; differentiable in `a` only."""
    assert a.shape == b.shape
    mean: Tensor = _MeanDifference.apply(a, b.detach())  # type: ignore[no-untyped-call]
    return mean


def feature_loss(
    fake: Sequence[Tensor], real: Sequence[Tensor], difference: Callable[[Tensor, Tensor], Tensor] = mean_difference
) -> Tensor:
    """Mean absolute difference of the discriminator's responses, summed over its layers (Wang et al. 2018, eq. 3).

    No gradient reaches the real example's. Where it is not visible both examples are the same, and the difference nil.
    """
    return torch.stack([difference(a, b) for a, b in zip(fake, real, strict=True)]).sum()

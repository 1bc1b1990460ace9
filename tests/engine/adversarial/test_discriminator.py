"""Architecture, receptive field and patch rules of the discriminator; losses against their printed form."""

from __future__ import annotations

import math

import pytest
import torch

from advtex_engine.adversarial.discriminator import (
    PATCH_OFFSET,
    PATCH_STRIDE,
    RECEPTIVE_FIELD,
    PatchDiscriminator,
    patch_shares,
)
from advtex_engine.adversarial.losses import adversarial_loss, discriminator_loss, l1_loss, masked_mean, patch_masks
from advtex_engine.bench.counts import discriminator_flops, step_flops


def discriminator() -> PatchDiscriminator:
    return PatchDiscriminator(torch.Generator().manual_seed(0))


def test_parameters_and_initialization() -> None:
    network = discriminator()
    assert sum(parameter.numel() for parameter in network.parameters()) == 664_001
    weights = torch.cat([p.detach().flatten() for p in network.parameters() if p.ndim == 4])
    assert abs(weights.std().item() - 0.02) < 2e-4
    assert all(p.abs().max() == 0 for p in network.parameters() if p.ndim == 1)


def test_two_more_channels_of_zeros_change_neither_logits_nor_gradients() -> None:
    network, x = discriminator(), torch.randn(1, 6, 40, 48, generator=torch.Generator().manual_seed(1))
    padded = torch.cat((x, torch.zeros(1, 2, 40, 48)), 1)
    results = [network.examine(image) for image in (x, padded)]
    torch.testing.assert_close(results[0], results[1], atol=1e-5, rtol=1e-4)
    plain, wide = (torch.autograd.grad(logits.sum(), list(network.parameters())) for logits, _ in results)
    torch.testing.assert_close(plain, wide, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize(("width", "height"), [(160, 120), (97, 131), (24, 24), (288, 208)])
def test_logits_and_patch_shares_have_one_shape(width: int, height: int) -> None:
    image = torch.zeros(1, 3, height, width)
    logits = discriminator()(image, image)
    assert logits.shape == (1, 1, height // 8 - 2, width // 8 - 2)
    assert patch_shares(image[:, :1]).shape == logits.shape


def test_the_stated_receptive_field_is_the_one_that_gradients_see() -> None:
    network = discriminator()
    residual = torch.randn(1, 3, 160, 200, requires_grad=True, generator=torch.Generator().manual_seed(1))
    logits = network(torch.zeros_like(residual), residual)
    (gradient,) = torch.autograd.grad(logits[0, 0, 7, 9], [residual])
    rows = gradient.abs().sum((0, 1, 3)).nonzero().flatten()
    columns = gradient.abs().sum((0, 1, 2)).nonzero().flatten()
    for touched, index in ((rows, 7), (columns, 9)):
        first = PATCH_STRIDE * index + PATCH_OFFSET
        assert (int(touched[0]), int(touched[-1])) == (first, first + RECEPTIVE_FIELD - 1)


def test_patch_shares_count_the_receptive_field_inside_the_image() -> None:
    mask = (torch.rand(1, 1, 96, 120, generator=torch.Generator().manual_seed(2)) < 0.4).float()
    shares = patch_shares(mask)[0, 0]
    for row in range(shares.shape[0]):
        for column in range(shares.shape[1]):
            top, left = PATCH_STRIDE * row + PATCH_OFFSET, PATCH_STRIDE * column + PATCH_OFFSET
            field = mask[0, 0, max(0, top) : top + RECEPTIVE_FIELD, max(0, left) : left + RECEPTIVE_FIELD]
            assert shares[row, column].item() == pytest.approx(field.mean().item(), abs=1e-6)


def test_the_papers_rules_decide_which_patches_count() -> None:
    foreground = torch.zeros(1, 1, 240, 320)
    foreground[..., 100:] = 1
    visible = foreground.clone()
    visible[:, :, 120:] = 0
    masks = patch_masks(foreground, visible)
    inside = patch_shares(foreground)
    seen = patch_shares(visible)
    assert torch.equal(masks.texture, (inside >= 0.1).float())
    assert torch.equal(masks.discriminator, ((inside >= 0.1) & (seen > 0.5 * inside)).float())
    assert 0 < masks.discriminator.sum() < masks.texture.sum() < masks.texture.numel()


def test_losses_are_the_printed_ones() -> None:
    generator = torch.Generator().manual_seed(3)
    real, fake = torch.randn(2, 1, 1, 5, 7, generator=generator)
    mask = (torch.rand(1, 1, 5, 7, generator=generator) < 0.5).float()
    kept = mask.bool()
    printed = -(torch.sigmoid(real).log() + (1 - torch.sigmoid(fake)).log())[kept].mean()
    torch.testing.assert_close(discriminator_loss(real, fake, mask), printed)
    torch.testing.assert_close(adversarial_loss(fake, mask), -torch.sigmoid(fake).log()[kept].mean())
    a, b = torch.rand(2, 1, 3, 5, 7, generator=generator)
    torch.testing.assert_close(l1_loss(a, b, mask), (a - b).abs()[kept.expand(1, 3, 5, 7)].mean())


def test_losses_survive_extreme_logits_and_empty_masks() -> None:
    logits = torch.tensor([[[[-200.0, 200.0]]]], requires_grad=True)
    loss = discriminator_loss(logits, logits, torch.ones(1, 1, 1, 2))
    (gradient,) = torch.autograd.grad(loss, [logits])
    assert math.isfinite(loss.item())
    assert gradient.isfinite().all()
    assert masked_mean(logits, torch.zeros(1, 1, 1, 2)).item() == 0


def test_counted_operations_match_the_known_figures() -> None:
    assert sum(discriminator_flops(640, 480)) / 1e9 == pytest.approx(10.96, abs=0.01)
    assert step_flops(640, 480) / 1e9 == pytest.approx(74.8, abs=0.1)

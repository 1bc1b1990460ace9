"""The step: what it changes and what not, the same result after a resume, losses against autograd on plain twins."""

from __future__ import annotations

import dataclasses
import io
from typing import Any

import pytest
import torch

from advtex_engine.adversarial.discriminator import PatchDiscriminator
from advtex_engine.adversarial.examples import assemble
from advtex_engine.adversarial.gabor import gabor_filters, gabor_loss
from advtex_engine.adversarial.losses import adversarial_loss, discriminator_loss, l1_loss, patch_masks
from advtex_engine.adversarial.operations import plain_operations
from advtex_engine.adversarial.optimizer import AdversarialOptimizer, crop_size
from advtex_engine.core.config import PRINTED, Preset
from advtex_engine.render.texture import bilinear_footprint, decode_uv
from advtex_engine.synthetic.planar import planar_views

WIDTH, HEIGHT = 96, 72
PRESET = dataclasses.replace(PRINTED, l1_decays=4)


def optimizer(seed: int = 0, steps: int = 20, preset: Preset = PRESET) -> AdversarialOptimizer:
    maps, pairs = planar_views(4, WIDTH, HEIGHT, 1.2, torch.device("cpu"))
    start = torch.rand(maps.slots, 3, generator=torch.Generator().manual_seed(5))
    network = PatchDiscriminator(torch.Generator().manual_seed(seed))
    generator = torch.Generator().manual_seed(seed)
    return AdversarialOptimizer(
        maps, pairs, start, preset, kind="scene", steps=steps, generator=generator, discriminator=network
    )


def state(of: AdversarialOptimizer) -> list[torch.Tensor]:
    return [of.values.detach().clone(), *(p.detach().clone() for p in of.parameters)]


@pytest.mark.parametrize("averaging", [0, 20])
def test_a_run_that_is_saved_and_loaded_ends_bit_identical(averaging: int) -> None:
    preset = dataclasses.replace(PRESET, averaging=averaging)
    whole = optimizer(preset=preset)
    for _ in range(8):
        whole.step()
    first = optimizer(preset=preset)
    for _ in range(3):
        first.step()
    file = io.BytesIO()
    torch.save(first.state_dict(), file)
    file.seek(0)
    second = optimizer(seed=9, preset=preset)
    second.load_state_dict(torch.load(file, weights_only=True))
    for _ in range(5):
        second.step()
    assert second.index == whole.index == 8
    assert torch.equal(whole.result, second.result)
    assert all(torch.equal(a, b) for a, b in zip(state(whole), state(second), strict=True))


def test_a_batch_is_what_its_crop_shows() -> None:
    of = optimizer()
    pair = of.draw()
    width, height = of.crop
    assert (width, height) == crop_size(WIDTH, HEIGHT)
    assert pair.condition.shape == pair.real.shape == (1, 3, height, width)
    # All cameras are the same, so the crop of some view is the condition, at one offset, and uv follows it.
    views = of.maps.color.view(-1, HEIGHT, WIDTH, 3).float() / 127.5 - 1
    found = [
        (top, left)
        for top in range(HEIGHT - height + 1)
        for left in range(WIDTH - width + 1)
        for view in views
        if torch.equal(view[top : top + height, left : left + width].permute(2, 0, 1), pair.condition[0])
    ]
    assert len(found) == 1
    top, left = found[0]
    uv = decode_uv(of.maps.uv[0]).view(HEIGHT, WIDTH, 2)[top : top + height, left : left + width].reshape(-1, 2)
    rows, columns = of.maps.slot_map.shape
    texels, weights = bilinear_footprint(uv * torch.tensor([columns, rows]), columns, rows)
    assert torch.equal(of.maps.slot_map.flatten()[texels], pair.slots)
    torch.testing.assert_close(pair.weights, weights * pair.foreground.flatten()[:, None])
    assert pair.visible.mean() > 0.9


def test_a_virtual_camera_moves_its_image_by_a_bounded_shift() -> None:
    """What the source shows at the middle, a virtual auxiliary camera shows up to a turn and a move away from there."""
    pixels = 3.0
    sampler = optimizer().sampler
    sampler.perturbation = pixels
    focal, distance = 200.0, 1.5
    per_pixel, deep = torch.tensor(distance / focal), torch.tensor(distance)
    relative = torch.eye(4)[:3]
    middle = torch.tensor([0.0, 0.0, distance])
    shifts = []
    for _ in range(200):
        virtual = sampler._virtual(relative, per_pixel, deep)
        torch.testing.assert_close(virtual[:, :3] @ virtual[:, :3].T, torch.eye(3), atol=1e-3, rtol=0)
        moved = virtual[:, :3] @ middle + virtual[:, 3]
        shifts.append(focal * moved[:2] / moved[2])
    found = torch.stack(shifts)
    assert found.abs().max() < 2.1 * pixels
    assert found.abs().mean() > 0.5 * pixels
    assert found.mean(0).norm() < 0.2 * pixels


def responses(network: PatchDiscriminator, condition: torch.Tensor, residual: torch.Tensor) -> list[torch.Tensor]:
    """Plain twin of the discriminator's features."""
    layers, x = [], torch.cat((condition, residual), 1)
    for layer in list(network.convolutions)[:-1]:
        x = torch.where((y := layer(x)) > 0, y, 0.2 * y)
        layers.append(x)
    return layers


@pytest.mark.parametrize("feature_weight", [0.0, 30.0])
def test_one_step_is_adam_on_the_printed_losses(feature_weight: float) -> None:
    """Against torch's plain (not fused) Adam and plain autograd over a dense image, without the compact sampling."""
    of = optimizer(preset=dataclasses.replace(PRESET, feature_weight=feature_weight))
    of.bfloat16 = False  # the twin computes in float32
    twin_network = PatchDiscriminator(torch.Generator().manual_seed(0))
    values = of.values.detach().clone().requires_grad_(True)
    adam_texture = torch.optim.Adam([values], lr=1e-3, betas=(0.5, 0.999), foreach=False)
    adam_network = torch.optim.Adam(twin_network.parameters(), lr=1e-4, betas=(0.5, 0.999), foreach=False)
    for _ in range(3):
        random_state = of.generator.get_state()
        pair = of.draw()
        of.generator.set_state(random_state)
        weight = of.schedule.l1_weight_at(of.index)
        of.step()

        width, height = of.crop
        fake = (values[pair.slots.long()] * pair.weights[..., None]).sum(1)
        fake = fake.view(1, height, width, 3).permute(0, 3, 1, 2) * 2 - 1
        masks = patch_masks(pair.foreground, pair.visible)
        fake_logits = twin_network(pair.condition, (fake - pair.condition) * pair.visible)
        real_logits = twin_network(pair.condition, (pair.real - pair.condition) * pair.visible)
        adversarial = adversarial_loss(fake_logits, masks.texture)
        loss = adversarial + weight * l1_loss(fake, pair.real, pair.visible)
        of_fake = responses(twin_network, pair.condition, (fake - pair.condition) * pair.visible)
        of_real = responses(twin_network, pair.condition, (pair.real - pair.condition) * pair.visible)
        for ours, theirs in zip(of_fake, of_real, strict=True):
            loss = loss + feature_weight * (ours - theirs).abs().mean()
        of_network = discriminator_loss(real_logits, fake_logits, masks.discriminator)
        values.grad = torch.autograd.grad(loss, [values], retain_graph=True)[0]
        adam_network.zero_grad()
        of_network.backward(inputs=list(twin_network.parameters()))
        assert of_network > adversarial, "an untrained discriminator is not ahead"
        adam_texture.step()
        adam_network.step()
    # The first Adam steps are lr * sign(gradient): where a gradient is nearly zero, rounding may turn its sign.
    assert ((of.values - values).abs() > 1e-4).float().mean() < 2e-3
    for parameter, twin in zip(of.parameters, twin_network.parameters(), strict=True):
        assert ((parameter - twin).abs() > 2e-5).float().mean() < 1e-2


def test_the_discriminator_rests_while_it_is_ahead() -> None:
    of = optimizer()
    losses = of.play(of.draw())
    before = state(of)
    of.update_discriminator(dataclasses.replace(losses, ahead=torch.tensor(1.0)))
    assert all(torch.equal(a, b) for a, b in zip(before, state(of), strict=True))
    of.update_discriminator(dataclasses.replace(losses, ahead=torch.tensor(0.0)))
    assert any(not torch.equal(a, b) for a, b in zip(before[1:], state(of)[1:], strict=True))


def test_both_players_follow_the_schedules_learning_rates() -> None:
    of = optimizer(steps=20, preset=dataclasses.replace(PRESET, lr_end=0.1))
    # Adam's first step is the learning rate itself, wherever there is a gradient.
    values, weights = of.values.detach().clone(), of.parameters[0].detach().clone()
    of.index = 10
    of.step()
    assert (of.values.detach() - values).abs().max().item() == pytest.approx(0.55e-3, rel=0.02)
    assert (of.parameters[0].detach() - weights).abs().max().item() == pytest.approx(0.55e-4, rel=0.02)


def test_losses_are_means_since_the_last_call() -> None:
    of = optimizer()
    assert of.drain_losses() == {}
    of.step()
    of.step()
    first = of.drain_losses()
    assert set(first) == {
        *("discriminator", "adversarial", "l1", "features", "gabor", "skipped"),
        *("accuracy", "accuracy_real", "accuracy_fake", "margin", "spread"),
    }
    assert first["discriminator"] == pytest.approx(2 * 0.693, abs=0.05)
    assert of.drain_losses() == {}


@pytest.mark.parametrize(("width", "height"), [(640, 480), (320, 240), (160, 120), (128, 128), (96, 72)])
def test_the_crop_moves_by_about_a_tenth_and_keeps_the_patch_grid(width: int, height: int) -> None:
    crop = crop_size(width, height)
    assert (width - crop[0]) % 8 == (height - crop[1]) % 8 == 0
    assert 0.05 <= (width - crop[0]) / width <= 0.15


def test_the_result_is_the_mean_of_every_tenth_state_and_then_a_moving_one() -> None:
    of = optimizer(steps=60, preset=dataclasses.replace(PRESET, pretraining=2, averaging=30))
    states = []
    for step in range(53):
        of.step()
        if step >= 2 and (step - 2) % 10 == 0:
            states.append(of.values.detach().clone())
        if step == 22:
            torch.testing.assert_close(of.result, torch.stack(states).mean(0))
    expected = torch.stack(states[:3]).mean(0)
    for state_later in states[3:]:
        expected = expected * (2 / 3) + state_later / 3
    torch.testing.assert_close(of.result, expected)
    assert torch.equal(optimizer().result, optimizer().values)


def test_pretraining_moves_the_discriminator_alone() -> None:
    of = optimizer(preset=dataclasses.replace(PRESET, pretraining=3))
    start, weights = of.values.detach().clone(), of.parameters[0].detach().clone()
    for _ in range(3):
        of.step()
    assert torch.equal(of.values, start)
    assert not torch.equal(of.parameters[0], weights)
    of.step()
    assert not torch.equal(of.values, start)


def test_the_gabor_term_is_of_the_render_against_its_photograph_where_the_mesh_is() -> None:
    of = optimizer(preset=dataclasses.replace(PRESET, gabor_weight=2.0))
    filters = gabor_filters(of.device)
    pair = of.draw()
    foreground = pair.foreground.clone()
    foreground[..., :20] = 0
    pair = dataclasses.replace(pair, foreground=foreground)
    fake = of.sampler.image((of.values.detach()[pair.slots.long()] * pair.weights[..., None]).sum(1)) * 2 - 1
    losses = of.play(pair)
    assert float(losses.gabor.detach()) == pytest.approx(
        float(gabor_loss(fake, pair.condition, foreground, filters)), rel=1e-5
    )
    with_it = of.texture_gradient(losses)
    (alone,) = torch.autograd.grad(losses.gabor, of.values, retain_graph=True)
    without = of.texture_gradient(dataclasses.replace(losses, gabor=torch.zeros(())))
    torch.testing.assert_close(with_it - without, 2 * alone, atol=1e-6, rtol=1e-3)
    assert float(alone.abs().max()) > 0


@pytest.mark.parametrize("target", ["source", "auxiliary"])
def test_l1_is_the_distance_to_what_the_preset_names(target: str) -> None:
    of = optimizer(preset=dataclasses.replace(PRESET, l1_target=target))
    pair = of.draw()
    hidden = torch.ones_like(pair.visible)
    hidden[..., ::3] = 0
    pair = dataclasses.replace(pair, visible=pair.visible * hidden)
    named, other, where = pair.condition, pair.real, pair.foreground
    if target == "auxiliary":
        named, other, where = other, named, pair.visible
    assert not torch.equal(named, other)
    seen = where.expand_as(named) > 0
    fake = of.sampler.image((of.values.detach()[pair.slots.long()] * pair.weights[..., None]).sum(1)) * 2 - 1
    distance, wrong = ((fake - image)[seen].abs().mean() for image in (named, other))
    found = float(of.play(pair).l1.detach())
    assert found == pytest.approx(float(distance), rel=1e-5)
    assert found != pytest.approx(float(wrong), rel=1e-3)


def test_l1_to_the_start_pulls_back_to_it() -> None:
    of = optimizer(preset=dataclasses.replace(PRESET, l1_target="start", l1_weight=1e6))
    pair = of.draw()
    assert float(of.play(pair).l1.detach()) == 0.0
    start = of.values.detach().clone()
    with torch.no_grad():
        of.values += 0.1
    gradient = of.texture_gradient(of.play(pair))
    seen = gradient[:, 0].abs() > 1.0
    assert bool(seen.any())
    assert bool((gradient[seen] > 0).all())
    assert of.start is not None
    assert torch.equal(of.start, start)


def test_a_run_that_holds_on_to_its_start_ends_bit_identical_after_a_resume_from_another_start() -> None:
    preset = dataclasses.replace(PRESET, l1_target="start", pretraining=1)
    whole, first, second = (optimizer(preset=preset) for _ in range(3))
    for _ in range(5):
        whole.step()
    for _ in range(2):
        first.step()
    assert second.start is not None
    second.start += 0.3  # a later level of a pyramid starts from what the level before made, not from the first start
    second.load_state_dict(first.state_dict())
    for _ in range(3):
        second.step()
    assert all(torch.equal(a, b) for a, b in zip(state(whole), state(second), strict=True))


def test_large_views_are_seen_in_parts() -> None:
    assert crop_size(640, 480) == (576, 416)
    assert crop_size(640, 480, (384, 288)) == (384, 288)
    assert crop_size(320, 240, (384, 288)) == (288, 208)


def test_examples_are_aligned_with_the_source_before_they_are_judged() -> None:
    of = optimizer(preset=dataclasses.replace(PRESET, alignment=True))
    pair = of.draw()
    moved = dataclasses.replace(pair, real=pair.condition.roll(2, -1), visible=torch.ones_like(pair.visible))
    plain = optimizer(preset=PRESET)
    inner = (..., slice(None), slice(8, -8))
    fake = moved.real.clone().requires_grad_(True)
    shown = assemble(moved.condition, moved.real, fake, moved.visible, of._offsets(moved, fake), of.form)
    torch.testing.assert_close(shown.real[inner], pair.condition[inner], atol=1e-3, rtol=0)
    torch.testing.assert_close(shown.fake, shown.real)
    assert shown.fake.requires_grad
    assert bool((shown.visible == 1).all())
    assert float(of.play(moved).l1.detach()) != float(plain.play(moved).l1.detach())


def test_a_run_goes_on_from_a_checkpoint_of_another_kind_of_device() -> None:
    first, second = optimizer(), optimizer()
    for _ in range(3):
        first.step()
    second.load_state_dict(first.state_dict() | {"generator": torch.zeros(16, dtype=torch.uint8)})
    second.step()
    assert second.index == 4
    assert second.values.isfinite().all()


def test_operations_that_fail_in_a_step_are_replaced_by_the_plain_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise RuntimeError("no such instruction")

    def chosen(**changes: Any) -> AdversarialOptimizer:
        operations = dataclasses.replace(plain_operations(), name="fast", **changes)
        monkeypatch.setattr("advtex_engine.adversarial.optimizer.choose_operations", lambda _: operations)
        return optimizer()

    assert chosen().operations.name == "fast"
    failing = chosen(assemble=broken)
    assert (failing.operations.name, failing.operations.reason) == ("torch", "fast failed: no such instruction")
    # Trying them out has changed nothing.
    monkeypatch.undo()
    plain = optimizer()
    for of in (failing, plain):
        of.step()
    assert all(torch.equal(a, b) for a, b in zip(state(failing), state(plain), strict=True))

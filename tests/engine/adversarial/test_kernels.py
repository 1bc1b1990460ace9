"""Every fused operation against its plain twin, values and gradients; on the CPU Triton interprets its kernels."""

from __future__ import annotations

import ast
import dataclasses
import importlib
import os
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from torch import Tensor

from advtex_engine.adversarial import alignment, examples, losses
from advtex_engine.adversarial.alignment import BLOCK
from advtex_engine.adversarial.backend import choose_operations
from advtex_engine.adversarial.discriminator import PatchDiscriminator
from advtex_engine.adversarial.examples import InputForm
from advtex_engine.adversarial.gabor import gabor_filters, gabor_loss
from advtex_engine.adversarial.operations import plain_operations
from advtex_engine.adversarial.optimizer import AdversarialOptimizer
from advtex_engine.adversarial.pair_sampler import PairSampler
from advtex_engine.core.config import PRESETS, PRINTED, Preset
from advtex_engine.render import texture
from advtex_engine.render.view_maps import ViewMaps
from advtex_engine.runtime.threads import one_thread_each
from advtex_engine.synthetic.planar import planar_views

pytest.importorskip("triton")
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes
from triton.runtime.interpreter import GridExecutor

fused_gabor: Any = importlib.import_module("advtex_engine.adversarial.triton_gabor")
fused_losses: Any = importlib.import_module("advtex_engine.adversarial.triton_losses")
fused_offsets: Any = importlib.import_module("advtex_engine.adversarial.triton_offsets")
DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")


@pytest.fixture(scope="module")
def fused() -> ModuleType:
    module = importlib.import_module("advtex_engine.adversarial.triton_operations")
    if DEVICE.type == "cpu":
        # The interpreter's time is one per program: two programs for an image of these tests.
        module.BLOCK, module.LONG_BLOCK = 2048, 1 << 17  # type: ignore[attr-defined]
        fused_losses.BLOCK, fused_losses.LONG_BLOCK, fused_offsets.BLOCK = 4096, 1 << 17, 4096
        fused_gabor.BLOCK, fused_gabor.LONG_BLOCK, fused_gabor.WINDOW_BLOCK = 8192, 8192, 256
    return module


def image(channels: int, height: int, width: int, seed: int) -> Tensor:
    """[1,C,h,w] in [-1,1], channels_last."""
    rows = torch.rand((height, width, channels), generator=torch.Generator().manual_seed(seed)) * 2 - 1
    return rows.to(DEVICE).permute(2, 0, 1)[None]


def rough(maps: ViewMaps) -> ViewMaps:
    """With depths that hide each other, background, cameras that differ, and texels that no view samples."""
    generator = torch.Generator().manual_seed(3)
    depth = 1 + (torch.rand(maps.depth.shape, generator=generator) < 0.2) * 0.5
    depth[torch.rand(maps.depth.shape, generator=generator) < 0.1] = 0
    intrinsics = maps.intrinsics * (1 + 0.1 * torch.rand(maps.intrinsics.shape, generator=generator).to(DEVICE))
    slot_map = maps.slot_map.clone()
    slot_map[::7] = -1
    return dataclasses.replace(maps, depth=depth.half().to(DEVICE), intrinsics=intrinsics, slot_map=slot_map)


@pytest.mark.parametrize(("perturbation", "areas"), [(0.0, True), (3.0, False)])
def test_a_pair_is_drawn_and_warped_as_by_torch(fused: ModuleType, perturbation: float, areas: bool) -> None:
    maps, pairs = planar_views(4, 90, 70, 1.2, DEVICE)
    generator = torch.Generator().manual_seed(1)
    relative = pairs.relative + 0.01 * torch.randn(pairs.relative.shape, generator=generator).to(DEVICE)
    pairs = dataclasses.replace(pairs, relative=relative)
    generator = torch.Generator(DEVICE).manual_seed(0)
    sampler = PairSampler(rough(maps), pairs, "scene", (56, 48), generator, perturbation, areas=areas)
    for _ in range(2):
        before = sampler.generator.get_state()
        plain = sampler.draw()
        after = sampler.generator.get_state()
        sampler.generator.set_state(before)
        ours = fused.draw(sampler)
        assert torch.equal(sampler.generator.get_state(), after)
        assert 0.2 < float(plain.visible.mean()) < 0.95
        torch.testing.assert_close(ours.condition, plain.condition, atol=1e-6, rtol=0)  # a GPU rounds once, torch twice
        assert torch.equal(ours.foreground, plain.foreground)
        assert torch.equal(ours.slots, plain.slots)
        # A point on the edge of a test may fall on the other side by rounding.
        same = ours.visible == plain.visible
        assert float(same.float().mean()) > 0.998
        seen = same & (plain.visible > 0)
        torch.testing.assert_close(ours.real * seen, plain.real * seen, atol=2e-4, rtol=0)
        torch.testing.assert_close(ours.weights, plain.weights)


@pytest.mark.parametrize("taps", [4, 9])
def test_a_texture_is_sampled_as_by_torch(fused: ModuleType, taps: int) -> None:
    generator = torch.Generator().manual_seed(0)
    slots = torch.randint(0, 50, (700, taps), dtype=torch.int32, generator=generator).to(DEVICE)
    weights = torch.rand((700, taps), generator=generator).to(DEVICE)
    weights[::5] = 0
    values, twin = (torch.rand((50, 3), generator=generator).to(DEVICE).requires_grad_() for _ in range(2))
    twin.data.copy_(values.data)
    ours, plain = fused.sample_texels(values, slots, weights), texture.sample_texels(twin, slots, weights)
    torch.testing.assert_close(ours, plain)
    gradient = torch.rand((700, 3), generator=generator).to(DEVICE)
    ours.backward(gradient)
    plain.backward(gradient)
    torch.testing.assert_close(values.grad, twin.grad, atol=1e-5, rtol=1e-5)


def test_examples_are_moved_and_assembled_as_by_torch(fused: ModuleType) -> None:
    generator = torch.Generator().manual_seed(0)
    offsets = ((torch.rand((2, 1, 2, 2), generator=generator) * 2 - 1) * 7.5).to(DEVICE)
    check_assembly(fused, offsets, (BLOCK - 23, BLOCK + 31), InputForm(8))


@pytest.mark.parametrize("conditioned", [True, False])
def test_examples_that_stay_are_assembled_as_by_torch(fused: ModuleType, conditioned: bool) -> None:
    check_assembly(fused, None, (50, 40), InputForm(6 if conditioned else 8, torch.float32, conditioned))


def check_assembly(fused: ModuleType, offsets: Tensor | None, size: tuple[int, int], form: InputForm) -> None:
    condition, real, fake = (image(3, *size, number) for number in range(3))
    visible = (image(1, *size, 3) > -0.8).float()
    ours, plain = fake.clone().requires_grad_(), fake.clone().requires_grad_()
    a = fused.assemble(condition, real, ours, visible, offsets, form)
    b = examples.assemble(condition, real, plain, visible, offsets, form)
    # Both masks come from bilinear sums beside a threshold.
    same = (a.visible == b.visible).float()
    assert float(same.mean()) > 0.999
    for name in ("fake_input", "real_input", "fake", "real"):
        torch.testing.assert_close(getattr(a, name) * same, getattr(b, name) * same, atol=1e-4, rtol=0)
        assert getattr(a, name).is_contiguous(memory_format=torch.channels_last)
    assert a.fake_input.requires_grad and not a.real_input.requires_grad
    of_input, of_fake = image(form.channels, *size, 4) * same, image(3, *size, 5)
    (first,) = torch.autograd.grad([a.fake_input, a.fake], [ours], [of_input, of_fake], retain_graph=True)
    (second,) = torch.autograd.grad([b.fake_input, b.fake], [plain], [of_input, of_fake], retain_graph=True)
    torch.testing.assert_close(first, second, atol=2e-4, rtol=1e-4)
    if offsets is None:  # what a move does without a gradient of the moved example itself, a whole step shows
        (first,) = torch.autograd.grad(a.fake_input, ours, of_input)
        (second,) = torch.autograd.grad(b.fake_input, plain, of_input)
        torch.testing.assert_close(first, second, atol=2e-4, rtol=1e-4)


def test_inputs_are_rounded_to_bfloat16_once(fused: ModuleType) -> None:
    condition, real, fake = (image(3, 40, 48, number) for number in range(3))
    visible = torch.ones_like(condition[:, :1])
    a = fused.assemble(condition, real, fake, visible, None, InputForm(8, torch.bfloat16))
    b = examples.assemble(condition, real, fake, visible, None, InputForm(8, torch.bfloat16))
    assert a.fake_input.dtype == torch.bfloat16
    torch.testing.assert_close(a.fake_input, b.fake_input, atol=0.008, rtol=0.008)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_the_mean_difference_is_torchs(monkeypatch: pytest.MonkeyPatch, dtype: torch.dtype) -> None:
    monkeypatch.setattr(fused_losses, "LONG_BLOCK", 1024)
    monkeypatch.setattr(fused_losses, "ALONE", 16)
    a, b = (image(64, 20, 30, number).to(dtype) for number in range(2))
    b[:, :, :4] = a[:, :, :4]  # nothing pulls where they are the same
    ours, plain = a.clone().requires_grad_(), a.clone().requires_grad_()
    first, second = fused_losses.mean_difference(ours, b), losses.mean_difference(plain, b)
    torch.testing.assert_close(first, second, atol=1e-5, rtol=2e-3)
    (3 * first).backward()
    (3 * second).backward()
    assert ours.grad is not None and bool((ours.grad[:, :, :4] == 0).all())
    torch.testing.assert_close(ours.grad, plain.grad)


def test_offsets_are_found_as_by_torch() -> None:
    """Of examples that are shifted, that are noise, and that are hardly visible, block by block."""
    height, width, bound = 3 * BLOCK // 2 + 9, 2 * BLOCK + 14, 5
    generator = torch.Generator().manual_seed(0)
    noise = torch.rand((1, 3, height + 16, width + 16), generator=generator) * 2 - 1
    condition = noise[:, :, 8:-8, 8:-8]
    real, fake = noise[:, :, 5:-11, 10:-6].clone(), noise[:, :, 8:-8, 6:-10].clone()
    fake[..., width // 2 :] = torch.rand(fake[..., width // 2 :].shape, generator=generator) * 2 - 1
    visible = torch.ones((1, 1, height, width))
    visible[..., :BLOCK, :BLOCK] = torch.rand((1, 1, BLOCK, BLOCK), generator=generator) < 0.5
    images = [one.contiguous(memory_format=torch.channels_last).to(DEVICE) for one in (condition, real, fake, visible)]
    ours = fused_offsets.example_offsets(*images, bound)
    plain = alignment.example_offsets(*images, bound)
    assert plain.shape == (2, 2, 3, 2)
    assert plain[0, 1, 2].tolist() == [-2, 3]
    assert plain[1, 1, 0].tolist() == [2, 0]
    assert plain[1, 1, 2].tolist() == plain[0, 0, 0].tolist() == [0, 0]
    torch.testing.assert_close(ours, plain)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("pretraining", [0.0, 1.0])
def test_the_players_are_judged_as_by_torch(
    monkeypatch: pytest.MonkeyPatch, dtype: torch.dtype, pretraining: float
) -> None:
    monkeypatch.setattr(fused_losses, "ALONE", 128)  # several rounds
    generator = torch.Generator().manual_seed(0)
    waits = torch.tensor([7.0, pretraining], device=DEVICE)[1]
    shares = torch.rand((1, 2, 17, 23), generator=generator).to(DEVICE) * torch.tensor([1.0, 0.7]).view(1, 2, 1, 1).to(
        DEVICE
    )
    shares[:, 0, :5] *= 0.15
    for strength in (0.1, 30.0):  # the texture is ahead, and the discriminator
        shares[:, :, 6, :3] = 1  # where a logit is 0 below
        logits = strength * (torch.rand((2, 17, 23), generator=generator).to(DEVICE) - 0.5)
        logits += strength * torch.tensor([0.6, -0.6], device=DEVICE).view(2, 1, 1)
        logits[:, 6, 1] = 0
        pairs = [[one[None, None].to(dtype).requires_grad_() for one in logits] for _ in range(2)]
        ours, plain = fused_losses.judge(*pairs[0], shares, waits), losses.judge(*pairs[1], shares, waits)
        for name in ("discriminator", "adversarial", "ahead"):
            torch.testing.assert_close(getattr(ours, name), getattr(plain, name), atol=1e-5, rtol=1e-5)
        assert float(plain.ahead) == (strength > 1) * (1 - pretraining)
        assert not ours.told.requires_grad
        torch.testing.assert_close(ours.told, plain.told, atol=1e-3, rtol=1e-5)
        assert torch.equal(ours.told[:3], plain.told[:3])
        for name in ("discriminator", "adversarial"):
            found, wanted = (
                torch.autograd.grad(3 * getattr(of, name), pair, retain_graph=True, allow_unused=True)
                for of, pair in ((ours, pairs[0]), (plain, pairs[1]))
            )
            for a, b in zip(found, wanted, strict=True):
                assert (a is None) == (b is None)
                if a is not None and b is not None:
                    assert float(b.abs().max()) > 0
                    torch.testing.assert_close(a, b, atol=1e-6, rtol=1e-5 if dtype == torch.float32 else 0.008)
        both = [
            torch.autograd.grad(of.discriminator + 2 * of.adversarial, pair)
            for of, pair in ((ours, pairs[0]), (plain, pairs[1]))
        ]
        torch.testing.assert_close(*both, atol=1e-6, rtol=1e-5 if dtype == torch.float32 else 0.016)


def test_nothing_that_counts_costs_nothing() -> None:
    logits = torch.randn((1, 1, 5, 7), generator=torch.Generator().manual_seed(0)).to(DEVICE).requires_grad_()
    none = torch.zeros((1, 2, 5, 7), device=DEVICE)
    verdict = fused_losses.judge(logits, logits * 2, none, torch.zeros((), device=DEVICE))
    assert float(verdict.discriminator.detach()) == float(verdict.adversarial.detach()) == 0
    (gradient,) = torch.autograd.grad(verdict.discriminator + verdict.adversarial, logits)
    assert bool((gradient == 0).all())
    images = image(3, 5, 7, 0), image(3, 5, 7, 1)
    assert float(fused_losses.l1_loss(*images, torch.zeros((1, 1, 5, 7), device=DEVICE))) == 0


def test_the_l1_loss_is_torchs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fused_losses, "BLOCK", 64)
    monkeypatch.setattr(fused_losses, "ALONE", 16)
    fake, real = image(3, 40, 30, 0), image(3, 40, 30, 1)
    real[:, :, :4] = fake[:, :, :4]  # nothing pulls where they are the same
    visible = (image(1, 40, 30, 2) > -0.5).float()
    ours, plain = fake.clone().requires_grad_(), fake.clone().requires_grad_()
    first, second = fused_losses.l1_loss(ours, real, visible), losses.l1_loss(plain, real, visible)
    torch.testing.assert_close(first, second)
    (3 * first).backward()
    (3 * second).backward()
    assert ours.grad is not None and bool((ours.grad[:, :, :4] == 0).all())
    torch.testing.assert_close(ours.grad, plain.grad)


@pytest.mark.parametrize(
    ("size", "channels_last"),
    [((56, 59), True), ((58, 57), False), ((30, 41), True), ((17, 25), False), ((12, 90), True)],
    ids=["3 octaves", "3 octaves, contiguous", "2 octaves", "1 octave, contiguous", "1 row of windows"],
)
def test_the_gabor_loss_is_torchs(monkeypatch: pytest.MonkeyPatch, size: tuple[int, int], channels_last: bool) -> None:
    monkeypatch.setattr(fused_gabor, "BLOCK", 2048)  # two programs, one of which has pixels of several octaves
    monkeypatch.setattr(fused_gabor, "LONG_BLOCK", 2048)
    monkeypatch.setattr(fused_gabor, "WINDOW_BLOCK", 128)
    monkeypatch.setattr(fused_gabor, "ALONE", 1)
    layout = torch.channels_last if channels_last else torch.contiguous_format
    render, photograph = (image(3, *size, number).contiguous(memory_format=layout) for number in range(2))
    foreground = (image(1, *size, 2) > -0.5).float()
    foreground[..., size[1] * 3 // 4 :] = 0
    check_gabor(render, photograph, foreground, gabor_filters(DEVICE))


def check_gabor(render: Tensor, photograph: Tensor, foreground: Tensor, filters: Tensor) -> None:
    ours, plain = render.clone().requires_grad_(), render.clone().requires_grad_()
    first = fused_gabor.gabor_loss(ours, photograph, foreground, filters)
    second = gabor_loss(plain, photograph, foreground, filters)
    assert float(second.detach()) > 0.01
    torch.testing.assert_close(first, second, atol=0, rtol=1e-5)
    (3 * first).backward()
    (3 * second).backward()
    assert ours.grad is not None and plain.grad is not None
    most = float(plain.grad.abs().max())
    assert most > 1e-3
    assert bool((ours.grad[(foreground == 0).expand_as(ours)] == 0).all())
    torch.testing.assert_close(ours.grad, plain.grad, atol=1e-5 * most, rtol=1e-4)


@pytest.mark.usefixtures("fused")
def test_of_equal_energies_the_first_has_the_gradient() -> None:
    """Rows are the same and columns repeat: a window has its greatest energy many times, exactly where a filter has but
    one pixel, as a sum of several is rounded in some order."""
    taps = torch.eye(49)[torch.randperm(49, generator=torch.Generator().manual_seed(0))]
    filters = taps[: len(gabor_filters(DEVICE))].reshape(-1, 1, 7, 7).to(DEVICE)
    render = image(3, 1, 4, 7).repeat(1, 1, 30, 8)
    check_gabor(render, image(3, 30, 32, 8), torch.ones_like(render[:, :1]), filters)


@pytest.mark.usefixtures("fused")
def test_a_flat_render_has_a_finite_gabor_gradient() -> None:
    flat = torch.full((1, 3, 30, 30), 0.3, device=DEVICE, requires_grad=True)
    photograph, foreground = image(3, 30, 30, 1), torch.ones((1, 1, 30, 30), device=DEVICE)
    loss = fused_gabor.gabor_loss(flat, photograph, foreground, gabor_filters(DEVICE))
    torch.testing.assert_close(loss, gabor_loss(flat, photograph, foreground, gabor_filters(DEVICE)))
    (gradient,) = torch.autograd.grad(loss, flat)
    assert bool(gradient.isfinite().all())


def test_images_smaller_than_a_window_have_no_gabor_loss() -> None:
    small = image(3, 8, 50, 0).requires_grad_()
    loss = fused_gabor.gabor_loss(small, image(3, 8, 50, 1), torch.ones_like(small[:, :1]), gabor_filters(DEVICE))
    assert float(loss) == 0 and not loss.requires_grad


def test_the_average_moves_by_its_weight(fused: ModuleType) -> None:
    mean, state = (torch.rand((3000, 3), generator=torch.Generator().manual_seed(n)).to(DEVICE) for n in range(2))
    for weight in (0.0, 0.25, 1.0):
        ours = mean.clone()
        fused.average(ours, state, torch.tensor([7.0, weight], device=DEVICE)[1])
        torch.testing.assert_close(ours, mean.lerp(state, weight))


ONE_STEP = dataclasses.replace(PRESETS["standard"], pretraining=0, averaging=20, max_crop=(64, 64))


def optimizer(fused: ModuleType | None, preset: Preset = ONE_STEP, steps: int = 100) -> AdversarialOptimizer:
    maps, pairs = planar_views(3, 72, 72, 1.2, DEVICE)
    of = AdversarialOptimizer(
        maps,
        pairs,
        torch.rand((maps.slots, 3), generator=torch.Generator().manual_seed(5)).to(DEVICE),
        preset,
        kind="scene",
        steps=steps,
        generator=torch.Generator(DEVICE).manual_seed(0),
        discriminator=PatchDiscriminator(torch.Generator().manual_seed(0)).to(DEVICE),
        operations=plain_operations() if fused is None else fused.triton_operations(),
    )
    of.branches, of.bfloat16 = False, False
    of.form = dataclasses.replace(of.form, channels=6 if fused is None else 8, dtype=torch.float32)
    return of


def test_a_step_on_the_kernels_is_a_step_on_torch(fused: ModuleType) -> None:
    """Adam's first step is lr * sign(gradient): only where a gradient is nearly zero may rounding turn its sign."""
    ours, plain = optimizer(fused), optimizer(None)
    ours.step()
    plain.step()
    a, b = (of.adam_texture.state[of.values]["exp_avg"] for of in (ours, plain))
    assert float(b.abs().max()) > 0
    torch.testing.assert_close(a, b, atol=1e-3 * float(b.abs().max()), rtol=0.05)
    lr, apart = ours.preset.lr_texture, (ours.values - plain.values).detach().abs()
    assert float((apart > 0.05 * lr).float().mean()) < 0.02
    torch.testing.assert_close(ours.average, plain.average, atol=2.1 * lr, rtol=0)
    for a, b in zip(ours.parameters, plain.parameters, strict=True):
        assert a.shape == b.shape
        assert float(((a - b).detach().abs() > 0.2 * ours.preset.lr_discriminator).float().mean()) < 0.02
    assert ours.drain_losses() == pytest.approx(plain.drain_losses(), rel=1e-3)


def test_a_step_is_few_kernels(fused: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each costs a graph about two microseconds of a step that should take 400: what is not a view or a bare allocation
    is counted, Triton's interpreter apart. A convolution's gradient counts as one and is up to three."""
    free = ("view", "permute", "expand", "slice", "select", "detach", "empty", "unfold", "split", "as_", "alias", "t.")

    class Counting(TorchDispatchMode):
        count = 0

        def __torch_dispatch__(self, function: Any, types: Any, given: Any = (), options: Any = None) -> Any:
            name = str(function).removeprefix("aten.").removeprefix("_").removeprefix("new_")
            self.count += str(function).startswith("aten.") and not name.startswith(free)
            return function(*given, **(options or {}))

    interpret, counts = GridExecutor.__call__, []

    def launch(kernel: Any, *given: Any, **options: Any) -> None:
        counts[-1] += 1
        with _disable_current_modes():
            interpret(kernel, *given, **options)

    monkeypatch.setattr(GridExecutor, "__call__", launch)
    for preset in (PRESETS["full"], PRESETS["paper"]):
        ours = optimizer(fused, dataclasses.replace(preset, pretraining=0, max_crop=(64, 64)))
        ours.bfloat16, ours.form = True, InputForm(8, torch.bfloat16)
        counts.append(0)
        with Counting() as counting:
            ours.device_step()
        counts[-1] += counting.count
    full, paper = counts
    assert full <= 155
    assert paper <= 100


@pytest.mark.slow
@pytest.mark.skipif(DEVICE.type == "cuda", reason="a GPU adds up in any order, which leads a game elsewhere")
def test_a_run_on_the_kernels_ends_like_one_on_torch(fused: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fused, "BLOCK", 1024)  # a crop: the interpreter computes what a program masks, too
    preset = dataclasses.replace(
        PRINTED, pretraining=10, averaging=25, lr_end=0.1, lr_discriminator=3e-4, max_crop=(32, 32)
    )
    with one_thread_each():  # how sums are cut into threads shows in their last digit, and then in the sign of an L1
        ours, plain = optimizer(fused, preset, 110), optimizer(None, preset, 110)
        start = plain.values.detach().clone()
        for _ in range(110):
            ours.step()
            plain.step()
    assert float((plain.values - start).detach().abs().mean()) > 0.01, "the texture has gone somewhere"
    losses = plain.drain_losses()
    assert 0.05 < losses["skipped"] < 0.95, "both ways were taken"
    assert losses == pytest.approx(ours.drain_losses(), rel=1e-3)
    torch.testing.assert_close(ours.values, plain.values, atol=2e-3, rtol=0)
    torch.testing.assert_close(ours.average, plain.average, atol=2e-3, rtol=0)


def test_the_operations_are_chosen_with_a_reason(fused: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    assert choose_operations(torch.device("cpu")).reason == "the device is not an NVIDIA GPU"
    monkeypatch.setattr("shutil.which", lambda name: f"/usr/bin/{name}")
    monkeypatch.setattr(fused, "triton_operations", lambda: 1 / 0)
    assert choose_operations(torch.device("cuda")).reason == "Triton failed: division by zero"
    monkeypatch.setattr("shutil.which", lambda _: None)
    without = choose_operations(torch.device("cuda"))
    assert (without.name, without.reason) == ("torch", "Triton needs a C compiler; install gcc")
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    assert choose_operations(torch.device("cuda")).reason == "the package triton is missing"


COMPILE = """
import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
from advtex_engine.adversarial import kernels, kernels_gabor, kernels_losses, kernels_offsets

TYPES = {
    "choose": "fp32 i64 i64 i64 i64 i64",
    "draw": "i64 fp32 u8 i16 fp16 fp32 i32 fp32 fp32 fp32 fp32 i32 fp32",
    "sample": "fp32 i32 fp32 fp32",
    "sample_backward": "fp32 i32 fp32 fp32",
    "assemble": "fp32 fp32 fp32 fp32 fp32 bf16 bf16 fp32 fp32 fp32",
    "assemble_backward": "bf16 fp32 fp32 fp32 fp32",
    "judge": "bf16 bf16 fp32 fp32 fp32 fp32 fp32 fp32 fp32",
    "judge_backward": "bf16 bf16 fp32 fp32 fp32 fp32 bf16 bf16",
    "l1": "fp32 fp32 fp32 fp32",
    "l1_mean": "fp32 fp32 fp32",
    "l1_backward": "fp32 fp32 fp32 fp32 fp32 fp32",
    "difference": "bf16 bf16 fp32",
    "difference_mean": "fp32 fp32",
    "difference_backward": "bf16 bf16 fp32 bf16",
    "octaves": "fp32 fp32 fp32 fp32",
    "energies": "fp32 fp32 fp32",
    "distances": "fp32 fp32 fp32 fp32 fp32 i32",
    "energies_backward": "fp32 fp32 i32 fp32",
    "octaves_backward": "fp32 fp32 fp32 fp32",
    "average": "fp32 fp32 fp32",
    "luminance": "fp32 fp32 fp32 fp32 fp32",
    "cut_blocks": "fp32 fp32 fp32 fp32 fp32",
    "whiten": "fp32 fp32 fp32",
    "find_peaks": "fp32 fp32 fp32 fp32",
}
SIZES = dict(
    COLUMNS=12, ROWS=12, FREE_X=65, FREE_Y=65, WIDTH=640, HEIGHT=480, CROP=576, PIXELS=576 * 416, TEXTURE_WIDTH=2048,
    TEXTURE_HEIGHT=2048, CHANNELS=8, CONDITIONED=True, MOVED=True, WITH_MOVED=True, COUNT=10**6, BLOCK=256,
    JUDGED=True, DRAWN=True, PARTS=1000, SIDE=64, VALUES=10**6, BOUND=5, MIN_SEEN=0.6, MIN_CORRELATION=0.25,
    MIN_GAIN=1.15, OCTAVES=3, WINDOWS=10**4, AREAS=True, TAPS=9,
)
# Not moved, and at pixels' middles, is how the published step runs; without a condition, its ablation; fp32, cards
# without bf16.
OTHERS = {"assemble": ("MOVED", "CONDITIONED"), "assemble_backward": ("MOVED", "WITH_MOVED")}
OTHERS |= {"judge_backward": ("JUDGED", "DRAWN"), "draw": ("AREAS",)}
variants = [(name, types, {}) for name, types in TYPES.items()]
variants += [
    (name, TYPES[name].replace("bf16", "fp32"), {one: False}) for name, flags in OTHERS.items() for one in flags
]
modules = (kernels, kernels_gabor, kernels_losses, kernels_offsets)
for name, types, off in variants:
    kernel = next(vars(module)[name] for module in modules if name in vars(module))
    signature = dict(zip(kernel.arg_names, ["*" + kind for kind in types.split()]))
    if name == "draw":
        signature["tolerance"] = "fp32"
    constants = {key: value for key, value in (SIZES | off).items() if key in kernel.arg_names}
    signature |= dict.fromkeys(constants, "constexpr")
    source = ASTSource(kernel, {key: signature[key] for key in kernel.arg_names}, constants)
    compiled = triton.compile(source, target=GPUTarget("cuda", 80, 32))
    assert compiled.asm["cubin"]
    print(name, compiled.metadata.num_warps)
"""


@pytest.mark.slow
def test_the_kernels_compile_for_a_gpu_that_is_not_here(tmp_path: Path) -> None:
    """For the first that has all they use, bfloat16; in a process of its own, in which they are not made for the
    interpreter."""
    environment = {name: value for name, value in os.environ.items() if name != "TRITON_INTERPRET"}
    environment["TRITON_CACHE_DIR"] = str(tmp_path)
    done = subprocess.run(
        [sys.executable, "-c", COMPILE], capture_output=True, text=True, check=False, timeout=300, env=environment
    )
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.splitlines()) == 31


def test_every_kernel_describes_its_parameters(fused: ModuleType) -> None:
    """What is launched names each pointer and number that it is given in its docstring; constants may speak for
    themselves."""
    described = 0
    for module in (fused.kernels, fused_gabor.kernels, fused_losses.kernels, fused_offsets.kernels):
        tree = ast.parse(Path(module.__file__).read_text(encoding="utf-8"))
        for function in (node for node in tree.body if isinstance(node, ast.FunctionDef)):
            if not any(isinstance(node, ast.Attribute) and node.attr == "store" for node in ast.walk(function)):
                continue  # a helper: what it returns is stored by the kernels
            given = [argument.arg for argument in function.args.args if argument.annotation is None]
            text = ast.get_docstring(function) or ""
            words = set(re.findall(r"\w+", text.partition("\n\n")[2]))
            assert set(given) <= words, f"{function.name}: {sorted(set(given) - words)}"
            described += len(given)
    assert described > 100

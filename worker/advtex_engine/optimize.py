"""The optimization: a texture against a discriminator (paper section 3, supplement "Training").

One step: draw a source view A and an auxiliary view B; warp B into A (real); render the texture at A (fake); let the
discriminator judge [I_A, real - I_A] and [I_A, fake - I_A]; update both players from the same forward passes.

The texture's values are in [0, 1], so that its learning rate is in those units; the networks see colors in [-1, 1].
Pixels that B does not see carry a zero residual in the real and in the fake example alike, so
that the discriminator cannot tell them apart by their holes. Nothing in `step` waits for the device: a skipped
discriminator update is a flag that Adam's kernel reads. On a CPU, where a branch costs nothing, the skipped gradient is
not computed.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from advtex_engine.alignment import BLOCK, block_offsets, search_bound, shift
from advtex_engine.batches import Batch, PairSampler
from advtex_engine.config import Preset
from advtex_engine.discriminator import MIN_SIZE, PatchDiscriminator
from advtex_engine.losses import adversarial_loss, discriminator_loss, feature_loss, l1_loss, patch_masks
from advtex_engine.texture import sample_texels
from advtex_engine.views import Pairs, ViewMaps

CROP_SHARE = 0.1  # the released code shifts its crop by up to 69 of 640 pixels, about a tenth of the width
AVERAGE_EVERY = 10  # steps between two states that enter the texture's average
WHOLLY_VISIBLE = 0.99  # a moved pixel that mixes in what is not visible does not count
LOSS_NAMES = ("discriminator", "adversarial", "l1", "features", "skipped")


@dataclass(frozen=True)
class Losses:
    """0-dim tensors: both players' losses, the L1 and feature terms, and 1 where the discriminator is ahead."""

    discriminator: Tensor
    adversarial: Tensor
    l1: Tensor
    features: Tensor
    ahead: Tensor


def native_bfloat16(device: torch.device) -> bool:
    """Whether bf16 arithmetic is done by the processor and not emulated (emulation is four times slower than fp32)."""
    if device.type == "cuda":
        return bool(torch.cuda.is_bf16_supported(including_emulation=False))
    probe = getattr(torch.cpu, "_is_avx512_bf16_supported", None)
    return bool(device.type == "cpu" and probe is not None and probe())


def crop_size(width: int, height: int, largest: tuple[int, int] | None = None) -> tuple[int, int]:
    """Fixed size of the randomly placed crop; the margin is a multiple of the patch stride."""
    margin = 8 * max(1, round(CROP_SHARE * width / 8))
    wide, high = max(MIN_SIZE, width - margin), max(MIN_SIZE, height - margin)
    return (wide, high) if largest is None else (min(wide, largest[0]), min(high, largest[1]))


class AdversarialOptimizer:
    """State and step of one optimization over fixed view maps.

    values: start of the compact texture, [slots,3] float32 in [0,1]. steps: the whole run's length, which the decay of
    lambda is scaled to; `index` counts the steps over all levels of a pyramid. In the first preset.pretraining of them
    the discriminator learns alone: a start that is sharp already is spoiled by one that knows nothing.
    """

    def __init__(
        self,
        maps: ViewMaps,
        pairs: Pairs,
        values: Tensor,
        preset: Preset,
        *,
        kind: str,
        steps: int,
        generator: torch.Generator,
        discriminator: PatchDiscriminator,
    ) -> None:
        assert values.shape == (maps.slots, 3)
        device = maps.color.device
        self.maps, self.pairs, self.preset, self.device = maps, pairs, preset, device
        self.steps, self.index = steps, 0
        self.generator = generator
        self.values = values.clone().to(device).requires_grad_(True)
        self.start = self.values.detach().clone() if preset.l1_target == "start" else None
        self.average = self.values.detach().clone() if preset.averaging else None
        self.discriminator = discriminator
        self.parameters = list(discriminator.parameters())
        self.adam_texture = _adam([self.values], preset.lr_texture, preset.beta1)
        self.adam_discriminator = _adam(self.parameters, preset.lr_discriminator, preset.beta1)
        self.bfloat16 = native_bfloat16(device)
        self.crop = crop_size(maps.width, maps.height, preset.max_crop)
        self.aligns = preset.alignment and min(self.crop) >= BLOCK
        perturbation = preset.perturbation * maps.width
        self.sampler = PairSampler(maps, pairs, kind, self.crop, generator, perturbation)
        self._sums = torch.zeros(len(LOSS_NAMES), device=device)
        self._summed = 0

    @property
    def l1_weight(self) -> float:
        """lambda: l1_weight times l1_decay for each passed period; the paper's 1,000 of 50,000 steps are one period."""
        periods = int(self.index * self.preset.l1_decays / self.steps)
        return self.preset.l1_weight * self.preset.l1_decay**periods

    @property
    def pretraining(self) -> bool:
        """Whether the texture still waits for the discriminator."""
        return self.index < self.preset.pretraining

    @property
    def lr_share(self) -> float:
        """Of both learning rates at this step: 1 while the discriminator learns alone, then straight to lr_end."""
        done = max(0.0, (self.index - self.preset.pretraining) / (self.steps - self.preset.pretraining))
        return 1 - (1 - self.preset.lr_end) * done

    def draw(self) -> Batch:
        """A random pair and crop, with the auxiliary view warped into the source."""
        return self.sampler.draw()

    def step(self) -> None:
        """Draws a pair, updates the texture, and the discriminator unless it is ahead (its loss <= the texture's)."""
        losses = self.play(self.draw())
        if self.pretraining:
            self.update_discriminator(losses)
        else:
            gradient = self.texture_gradient(losses)
            self.update_discriminator(losses)
            self.update_texture(gradient)
            self._take_average()
        named = (losses.discriminator, losses.adversarial, losses.l1, losses.features, losses.ahead)
        self._sums += torch.stack(named).detach()
        self._summed += 1
        self.index += 1

    def play(self, batch: Batch) -> Losses:
        """Renders the fake example and lets the discriminator judge both; one fake forward pass serves both players."""
        fake = self._render(self.values, batch)
        real, aligned, visible = self._align(batch, fake) if self.aligns else (batch.real, fake, batch.visible)
        masks = patch_masks(batch.foreground, visible)
        # Without the condition the network sees the example itself beside three empty channels.
        condition = batch.condition if self.preset.condition else torch.zeros_like(batch.condition)
        with self._autocast():
            fake_logits, of_fake = self.discriminator.examine(condition, (aligned - condition) * visible)
            real_logits, of_real = self.discriminator.examine(condition, (real - condition) * visible)
            fake_logits, real_logits = fake_logits.float(), real_logits.float()
        of_discriminator = discriminator_loss(real_logits, fake_logits, masks.discriminator)
        adversarial = adversarial_loss(fake_logits, masks.texture)
        ahead = (of_discriminator <= adversarial).to(torch.float32).detach()
        if self.pretraining:
            ahead = torch.zeros_like(ahead)
        if self.start is None:
            l1 = l1_loss(aligned, real, visible)
        else:
            l1 = l1_loss(fake, self._render(self.start, batch), batch.visible)
        features = feature_loss(of_fake, of_real) if self.preset.feature_weight else torch.zeros_like(l1)
        return Losses(of_discriminator, adversarial, l1, features, ahead)

    def _align(self, batch: Batch, fake: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The real and the fake example moved onto the source, and where both are still visible."""
        examples = torch.cat((batch.real, fake.detach()))
        offsets = block_offsets(batch.condition, examples, batch.visible, search_bound(self.maps.width))
        visible = shift(batch.visible.expand(2, -1, -1, -1), offsets).amin(0, keepdim=True) > WHOLLY_VISIBLE
        return shift(batch.real, offsets[:1]), shift(fake, offsets[1:]), batch.visible * visible

    def _render(self, values: Tensor, batch: Batch) -> Tensor:
        """The compact texture seen by the source view, [1,3,h,w] in [-1,1]."""
        return self.sampler.image(sample_texels(values, batch.slots, batch.weights)) * 2 - 1

    def texture_gradient(self, losses: Losses) -> Tensor:
        """Gradient [slots,3] of the texture's loss; keeps the graph, which the discriminator's gradient needs too."""
        loss = losses.adversarial + self.l1_weight * losses.l1 + self.preset.feature_weight * losses.features
        (gradient,) = torch.autograd.grad(loss, [self.values], retain_graph=True)
        return gradient

    def update_texture(self, gradient: Tensor) -> None:
        """One step of Adam over the compact texture."""
        self.values.grad = gradient
        self.adam_texture.param_groups[0]["lr"] = self.preset.lr_texture * self.lr_share
        self.adam_texture.step()

    @property
    def result(self) -> Tensor:
        """The compact texture that the run stands for, [slots,3]: its average, or its last state."""
        return self.values.detach() if self.average is None else self.average

    def _take_average(self) -> None:
        """The mean of the states so far, then a moving one over `averaging` steps."""
        taken, rest = divmod(self.index - self.preset.pretraining, AVERAGE_EVERY)
        if self.average is not None and rest == 0:
            window = max(1, self.preset.averaging // AVERAGE_EVERY)
            self.average.lerp_(self.values.detach(), 1 / min(taken + 1, window))

    def update_discriminator(self, losses: Losses) -> None:
        """One step of Adam over the discriminator, unless it is ahead."""
        if self.device.type == "cpu" and bool(losses.ahead):
            return
        gradients = torch.autograd.grad(losses.discriminator, self.parameters)
        for parameter, gradient in zip(self.parameters, gradients, strict=True):
            # The fused CPU kernel ignores strides: a channels_last gradient would be taken for a contiguous one.
            parameter.grad = gradient.contiguous()
        if self.device.type != "cpu":
            self.adam_discriminator.found_inf = losses.ahead  # type: ignore[attr-defined]  # the fused kernel's skip flag
        self.adam_discriminator.param_groups[0]["lr"] = self.preset.lr_discriminator * self.lr_share
        self.adam_discriminator.step()

    def drain_losses(self) -> dict[str, float]:
        """Means since the last call (waits for the device); empty when no step was taken."""
        if self._summed == 0:
            return {}
        means = (self._sums / self._summed).tolist()
        self._sums.zero_()
        self._summed = 0
        return dict(zip(LOSS_NAMES, means, strict=True))

    def state_dict(self) -> dict[str, Any]:
        """All that decides the remaining steps; tensors on the CPU."""
        state: dict[str, Any] = {
            "index": self.index,
            "values": self.values.detach(),
            "discriminator": self.discriminator.state_dict(),
            "adam_texture": self.adam_texture.state_dict(),
            "adam_discriminator": self.adam_discriminator.state_dict(),
            "generator": self.generator.get_state(),
        }
        if self.start is not None:
            state["start"] = self.start
        if self.average is not None:
            state["average"] = self.average
        return state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continues from `state_dict` of an optimizer over the same view maps."""
        assert state["values"].shape == self.values.shape
        self.index = int(state["index"])
        with torch.no_grad():
            self.values.copy_(state["values"])
            if self.start is not None:
                self.start.copy_(state["start"])
            if self.average is not None:
                self.average.copy_(state["average"])
        self.discriminator.load_state_dict(state["discriminator"])
        self.adam_texture.load_state_dict(state["adam_texture"])
        self.adam_discriminator.load_state_dict(state["adam_discriminator"])
        self.generator.set_state(state["generator"])

    def _autocast(self) -> contextlib.AbstractContextManager[Any]:
        if not self.bfloat16:
            return contextlib.nullcontext()
        return torch.autocast(self.device.type, dtype=torch.bfloat16)


def _adam(parameters: list[Any], lr: float, beta1: float) -> torch.optim.Adam:
    on_gpu = parameters[0].device.type == "cuda"
    return torch.optim.Adam(parameters, lr=lr, betas=(beta1, 0.999), fused=True, capturable=on_gpu)

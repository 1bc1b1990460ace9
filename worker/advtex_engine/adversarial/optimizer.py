"""The optimization: a texture against a discriminator (paper section 3, supplement "Training").

One step: draw a source view A and an auxiliary view B; warp B into A (real); render the texture at A (fake); let the
discriminator judge [I_A, real - I_A] and [I_A, fake - I_A]; update both players from the same forward passes.

The texture's values are in [0, 1], so that its learning rate is in those units; the networks see colors in [-1, 1].
Pixels that B does not see carry a zero residual in the real and in the fake example alike, so
that the discriminator cannot tell them apart by their holes.

Nothing in a step waits for the device, and nothing that changes from step to step is a number of Python's: what the
schedule says is read on the device, and a skipped update is a flag that Adam's kernel reads. So a step can be captured
as a CUDA graph (`cuda_graph.py`). All state keeps its address; loading a checkpoint copies into it. On a CPU, where a
branch costs nothing, what is skipped is not computed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from advtex_engine.adversarial.alignment import BLOCK, search_bound
from advtex_engine.adversarial.backend import choose_operations
from advtex_engine.adversarial.discriminator import MIN_SIZE, PatchDiscriminator
from advtex_engine.adversarial.examples import Examples, InputForm
from advtex_engine.adversarial.gabor import gabor_filters
from advtex_engine.adversarial.game import knowledge
from advtex_engine.adversarial.losses import TOLD, example_shares, feature_loss
from advtex_engine.adversarial.operations import Operations, plain_operations
from advtex_engine.adversarial.pair_sampler import DrawnPair, PairSampler
from advtex_engine.adversarial.schedule import Schedule
from advtex_engine.core.config import Preset
from advtex_engine.render.pairs import Pairs
from advtex_engine.render.view_maps import ViewMaps
from advtex_engine.runtime.checkpoint import restore_generator
from advtex_engine.runtime.shortage import memory_problem

CROP_SHARE = 0.1  # the released code shifts its crop by up to 69 of 640 pixels, about a tenth of the width
LOSS_NAMES = ("discriminator", "adversarial", "l1", "features", "gabor", "skipped")


@dataclass(frozen=True)
class Losses:
    """0-dim tensors: both players' losses, the L1, feature and Gabor terms, and 1 where the discriminator is ahead.

    told: [TOLD], what it tells apart, as `losses.told_apart` has it.
    """

    discriminator: Tensor
    adversarial: Tensor
    l1: Tensor
    features: Tensor
    gabor: Tensor
    ahead: Tensor
    told: Tensor


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

    values: start of the compact texture, [slots,3] float32 in [0,1]. steps: the whole run's length, which the schedule
    is scaled to; `index` counts the steps over all levels of a pyramid. In the first preset.pretraining of them
    the discriminator learns alone: a start that is sharp already is spoiled by one that knows nothing.
    operations: the device's own unless given. branches: whether the host may look at the device's values to skip work.
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
        operations: Operations | None = None,
    ) -> None:
        assert values.shape == (maps.slots, 3)
        device = maps.color.device
        self.maps, self.pairs, self.preset, self.device = maps, pairs, preset, device
        self.schedule = Schedule(preset, steps, device)
        self.operations = operations or choose_operations(device)
        self.branches = device.type == "cpu"
        self.generator = generator
        self.values = values.clone().to(device).requires_grad_(True)
        self.start = self.values.detach().clone() if preset.l1_target == "start" else None
        self.average = self.values.detach().clone() if preset.averaging else None
        self.discriminator = discriminator
        self.parameters = list(discriminator.parameters())
        self.adam_texture = _adam([self.values], self.schedule.lr_texture, preset.beta1)
        self.adam_discriminator = _adam(self.parameters, self.schedule.lr_discriminator, preset.beta1)
        self._gradients = [torch.zeros_like(parameter) for parameter in self.parameters]
        for parameter, into in zip(self.parameters, self._gradients, strict=True):
            parameter.grad = into
        self.bfloat16 = native_bfloat16(device)
        self.crop = crop_size(maps.width, maps.height, preset.max_crop)
        self.aligns = preset.alignment and min(self.crop) >= BLOCK
        on_gpu = device.type == "cuda"
        dtype = torch.bfloat16 if on_gpu and self.bfloat16 else torch.float32
        self.form = InputForm(8 if on_gpu else 6, dtype, preset.condition)
        perturbation = preset.perturbation * maps.width
        self.sampler = PairSampler(maps, pairs, kind, self.crop, generator, perturbation, areas=preset.areas)
        self._filters = gabor_filters(device)
        weights = (1.0, preset.feature_weight, preset.gabor_weight)
        self._one, self._feature_weight, self._gabor_weight = (torch.tensor(w, device=device) for w in weights)
        self._sums = torch.zeros(len(LOSS_NAMES) + TOLD, device=device)
        self._summed = 0
        if operations is None and self.operations.name != "torch":
            self._try_operations()

    @property
    def bfloat16(self) -> bool:
        """Whether the discriminator computes in bfloat16; its parameters and their gradients are float32."""
        return self._weights[0].dtype == torch.bfloat16

    @bfloat16.setter
    def bfloat16(self, half: bool) -> None:
        dtype = torch.bfloat16 if half else torch.float32
        self._own = [parameter.detach() for parameter in self.parameters]
        self._weights = [parameter.to(dtype) for parameter in self._own]
        # Leaves of their own for either example, of one memory: one kernel adds the gradients up, and not one for each.
        self._of_fake, self._of_real = (
            [weight.detach().requires_grad_() for weight in self._weights] for _ in range(2)
        )

    @property
    def index(self) -> int:
        """The number of the next step, over all levels."""
        return self.schedule.index

    @index.setter
    def index(self, index: int) -> None:
        self.schedule.index = index

    @property
    def pretraining(self) -> bool:
        """Whether the texture still waits for the discriminator."""
        return self.schedule.pretraining_at(self.index)

    def _try_operations(self) -> None:
        """Takes the plain ones, with the reason, where the device's own fail in a step that changes nothing."""
        before = self.generator.get_state()
        try:
            losses = self.play(self.draw())
            gradients = [self.texture_gradient(losses), *self._discriminator_gradients(losses)]
            finite = all(bool(gradient.isfinite().all()) for gradient in gradients)
        except Exception as error:
            if memory_problem(error) is not None:
                raise
            self.operations = plain_operations(f"{self.operations.name} failed: {error}")
        else:
            if not finite:
                self.operations = plain_operations(f"{self.operations.name} gives gradients that are not finite")
        self.generator.set_state(before)

    def draw(self) -> DrawnPair:
        """A random pair and crop, with the auxiliary view warped into the source."""
        return self.operations.draw(self.sampler)

    def step(self) -> None:
        """Draws a pair, updates the texture, and the discriminator unless it is ahead (its loss <= the texture's)."""
        self.device_step()
        self.count(1)

    def device_step(self) -> None:
        """The device's part of `step`, which may be captured once and replayed; whoever does so calls `count`."""
        self.schedule.read()
        losses = self.play(self.draw())
        if self.branches and self.pretraining:
            self.update_discriminator(losses)
        else:
            gradient = self.texture_gradient(losses)
            self.update_discriminator(losses)
            self.update_texture(gradient)
            self._take_average()
        named = torch.stack(
            (losses.discriminator, losses.adversarial, losses.l1, losses.features, losses.gabor, losses.ahead)
        )
        self._sums += torch.cat((named.detach(), losses.told))

    def count(self, steps: int) -> None:
        """Tells the host of steps that the device was given."""
        self.schedule.count(steps)
        self._summed += steps

    def play(self, pair: DrawnPair) -> Losses:
        """Renders the fake example and lets the discriminator judge both; one fake forward pass serves both players."""
        fake = self._render(self.values, pair)
        offsets = self._offsets(pair, fake) if self.aligns else None
        shown = self.operations.assemble(pair.condition, pair.real, fake, pair.visible, offsets, self.form)
        if self.bfloat16:
            torch._foreach_copy_(self._weights, self._own)
        fake_logits, of_fake = self.discriminator.examine(shown.fake_input, self._of_fake)
        real_logits, of_real = self.discriminator.examine(shown.real_input, self._of_real)
        shares = example_shares(pair.foreground, shown.visible)
        verdict = self.operations.judge(real_logits, fake_logits, shares, self.schedule.pretraining)
        l1 = self._l1(pair, fake, shown)
        features = torch.zeros_like(l1)
        if self.preset.feature_weight:
            features = feature_loss(of_fake, of_real, self.operations.mean_difference)
        gabor = torch.zeros_like(l1)
        if self.preset.gabor_weight:
            gabor = self.operations.gabor_loss(fake, pair.condition, pair.foreground, self._filters)
        return Losses(verdict.discriminator, verdict.adversarial, l1, features, gabor, verdict.ahead, verdict.told)

    def _l1(self, pair: DrawnPair, fake: Tensor, shown: Examples) -> Tensor:
        """L1 of the render [1,3,h,w] to what the preset names."""
        if self.start is not None:
            return self.operations.l1_loss(fake, self._render(self.start, pair), pair.visible)
        if self.preset.l1_target == "source":
            return self.operations.l1_loss(fake, pair.condition, pair.foreground)
        return self.operations.l1_loss(shown.fake, shown.real, shown.visible)

    def _offsets(self, pair: DrawnPair, fake: Tensor) -> Tensor:
        """Offsets [2,gh,gw,2] that move the real and the fake example onto the source."""
        bound = search_bound(self.maps.width)
        return self.operations.offsets(pair.condition, pair.real, fake, pair.visible, bound)

    def _render(self, values: Tensor, pair: DrawnPair) -> Tensor:
        """The compact texture seen by the source view, [1,3,h,w] in [-1,1]."""
        return self.sampler.image(self.operations.sample_texels(values, pair.slots, pair.weights)) * 2 - 1

    def texture_gradient(self, losses: Losses) -> Tensor:
        """Gradient [slots,3] of the texture's loss; keeps the graph, which the discriminator's gradient needs too."""
        terms = (losses.adversarial, losses.l1, losses.features, losses.gabor)
        weights = (self._one, self.schedule.l1_weight, self._feature_weight, self._gabor_weight)
        # Weights as the gradients of the terms: to weigh and add them up would be a dozen kernels more. A term that the
        # preset lacks has none.
        given = [pair for pair in zip(terms, weights, strict=True) if pair[0].requires_grad]
        outputs, seeds = zip(*given, strict=True)
        (gradient,) = torch.autograd.grad(outputs, [self.values], seeds, retain_graph=True)
        return gradient

    def update_texture(self, gradient: Tensor) -> None:
        """One step of Adam over the compact texture, unless it waits for the discriminator."""
        self.values.grad = gradient
        if not self.branches:
            self.adam_texture.found_inf = self.schedule.pretraining  # type: ignore[attr-defined]
        self.adam_texture.step()

    @property
    def result(self) -> Tensor:
        """The compact texture that the run stands for, [slots,3]: its average, or its last state."""
        return self.values.detach() if self.average is None else self.average

    def _take_average(self) -> None:
        """The mean of the states so far, then a moving one over `averaging` steps."""
        if self.average is None or (self.branches and not self.schedule.average_weight_at(self.index)):
            return
        self.operations.average(self.average, self.values.detach(), self.schedule.average_weight)

    def update_discriminator(self, losses: Losses) -> None:
        """One step of Adam over the discriminator, unless it is ahead."""
        if self.branches and bool(losses.ahead):
            return
        torch._foreach_copy_(self._gradients, self._discriminator_gradients(losses))
        if not self.branches:
            self.adam_discriminator.found_inf = losses.ahead  # type: ignore[attr-defined]  # the fused kernel's skip flag
        self.adam_discriminator.step()

    def _discriminator_gradients(self, losses: Losses) -> tuple[Tensor, ...]:
        """One per parameter, in the type of the arithmetic."""
        gradients = torch.autograd.grad(losses.discriminator, [*self._of_fake, *self._of_real])
        of_fake, of_real = gradients[: len(self._weights)], gradients[len(self._weights) :]
        torch._foreach_add_(of_fake, of_real)
        return of_fake

    def drain_losses(self) -> dict[str, float]:
        """Means since the last call, and what the discriminator knew (`knowledge`); empty when no step was taken.

        Waits for the device.
        """
        if self._summed == 0:
            return {}
        sums = self._sums.tolist()
        means = {name: total / self._summed for name, total in zip(LOSS_NAMES, sums[:-TOLD], strict=True)}
        self._sums.zero_()
        self._summed = 0
        return means | knowledge(sums[-TOLD:])

    def gradient_norms(self) -> dict[str, float]:
        """L2 norms, by the names of `game`, of what each term adds to the texture's gradient, its weight included.

        For the pair that the next step will draw. Changes nothing, the generator included; waits for the device. A pass
        forward and one back for each term: more than a step, and never part of a captured one.
        """
        before = self.generator.get_state()
        losses = self.play(self.draw())
        self.generator.set_state(before)
        terms = {
            "gradient_adversarial": (1.0, losses.adversarial),
            "gradient_l1": (self.schedule.l1_weight_at(self.index), losses.l1),
            "gradient_features": (self.preset.feature_weight, losses.features),
            "gradient_gabor": (self.preset.gabor_weight, losses.gabor),
        }
        norms = {
            name: weight * torch.autograd.grad(term, [self.values], retain_graph=True)[0].norm()
            for name, (weight, term) in terms.items()
            if weight
        }
        return dict(zip(norms, torch.stack(list(norms.values())).tolist(), strict=True))

    def finite(self) -> bool:
        """Whether the texture and the discriminator are (waits for the device)."""
        # A sum is not where one of its terms is not: one pass over a large texture, where asking each takes several.
        return bool(torch.stack([part.sum() for part in (self.values, *self.parameters)]).isfinite().all())

    def state_dict(self) -> dict[str, Any]:
        """All that decides the remaining steps and what is read out after them."""
        state: dict[str, Any] = {
            "index": self.index,
            "values": self.values.detach(),
            "discriminator": self.discriminator.state_dict(),
            "adam_texture": self.adam_texture.state_dict(),
            "adam_discriminator": self.adam_discriminator.state_dict(),
            "generator": self.generator.get_state(),
            "sums": self._sums,
            "summed": self._summed,
        }
        if self.start is not None:
            state["start"] = self.start
        if self.average is not None:
            state["average"] = self.average
        return state

    @torch.no_grad()
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continues from `state_dict` of an optimizer over the same view maps; every tensor keeps its address."""
        assert state["values"].shape == self.values.shape
        self.index = int(state["index"])
        self.values.copy_(state["values"])
        if self.start is not None:
            self.start.copy_(state["start"])
        if self.average is not None:
            self.average.copy_(state["average"])
        self.discriminator.load_state_dict(state["discriminator"])
        _load_adam(self.adam_texture, state["adam_texture"])
        _load_adam(self.adam_discriminator, state["adam_discriminator"])
        restore_generator(self.generator, state["generator"], self.index)
        self._sums.copy_(state["sums"])
        self._summed = int(state["summed"])


def _adam(parameters: list[Any], lr: Tensor, beta1: float) -> torch.optim.Adam:
    """lr: 0-dim, read anew at each step."""
    capturable = parameters[0].device.type == "cuda"
    adam = torch.optim.Adam(parameters, lr=lr, betas=(beta1, 0.999), fused=True, capturable=capturable)
    for parameter in parameters:
        # As the first step would: what exists before it can be loaded in place.
        adam.state[parameter] = {
            "step": torch.zeros((), device=parameter.device),
            "exp_avg": torch.zeros_like(parameter),
            "exp_avg_sq": torch.zeros_like(parameter),
        }
    return adam


def _load_adam(adam: torch.optim.Adam, saved: dict[str, Any]) -> None:
    (group,) = adam.param_groups
    for number, parameter in enumerate(group["params"]):
        for name, tensor in adam.state[parameter].items():
            tensor.copy_(saved["state"][number][name])

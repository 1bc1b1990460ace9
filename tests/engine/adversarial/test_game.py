"""What the discriminator knows: by hand, along runs in which it knows nothing or all, and read out at no one's cost."""

from __future__ import annotations

import dataclasses
import statistics
from collections.abc import Sequence
from typing import Any

import pytest
import torch
from torch import Tensor

from advtex_engine.adversarial.discriminator import PatchDiscriminator
from advtex_engine.adversarial.game import GRADIENT_NAMES, knowledge, problems, recent_accuracy, stretches, summary
from advtex_engine.adversarial.losses import told_apart
from advtex_engine.adversarial.optimizer import AdversarialOptimizer
from advtex_engine.core.config import PRESETS, PRINTED, Preset, PyramidLevel
from advtex_engine.methods.adversarial import _shown
from advtex_engine.synthetic.planar import planar_views

STEPS, EVERY = 60, 3
PRESET = dataclasses.replace(
    PRESETS["standard"], levels=(PyramidLevel(STEPS),), pretraining=6, averaging=20, max_crop=(24, 24), alignment=False
)

LONG = dataclasses.replace(PRESETS["standard"], levels=(PyramidLevel(1_500),), pretraining=150)


class Dead(PatchDiscriminator):
    """All weights are zero, and stay so: nothing has a gradient."""

    def __init__(self) -> None:
        super().__init__()
        for parameter in self.parameters():
            torch.nn.init.zeros_(parameter)


class Perfect(PatchDiscriminator):
    """It is shown the fake example first, and then the real one."""

    def __init__(self) -> None:
        super().__init__(torch.Generator().manual_seed(0))
        self.calls = 0

    def examine(self, x: Tensor, parameters: Sequence[Tensor] | None = None) -> tuple[Tensor, list[Tensor]]:
        logits, features = super().examine(x, parameters)
        self.calls += 1
        return 0.01 * logits + (5.0 if self.calls % 2 == 0 else -5.0), features


def optimizer(network: PatchDiscriminator | None = None, preset: Preset = PRESET) -> AdversarialOptimizer:
    maps, pairs = planar_views(4, 40, 32, 1.2, torch.device("cpu"))
    of = AdversarialOptimizer(
        maps,
        pairs,
        torch.rand(maps.slots, 3, generator=torch.Generator().manual_seed(5)),
        preset,
        kind="scene",
        steps=preset.steps,
        generator=torch.Generator().manual_seed(0),
        discriminator=network or PatchDiscriminator(torch.Generator().manual_seed(0)),
    )
    of.bfloat16 = False  # faster, where the crops are as small as these
    return of


def history(of: AdversarialOptimizer) -> list[dict[str, Any]]:
    points = []
    for step in range(1, of.preset.steps + 1):
        of.step()
        if step % EVERY == 0:
            points.append({"step": step, **of.drain_losses()})
    return points


def test_patches_are_counted_as_by_hand() -> None:
    real = [2.0, -1.0, 0.0, 3.0, 9.0]  # the last one does not count
    fake = [-2.0, -4.0, -1.0, 1.0, -9.0]
    mask = torch.tensor([1.0, 1.0, 1.0, 1.0, 0.0]).view(1, 1, 1, 5)
    logits = [torch.tensor(values).view(1, 1, 1, 5) for values in (real, fake)]
    seen = knowledge((told_apart(*logits, mask) + told_apart(*logits, mask)).tolist())
    assert seen["accuracy"] == 5.5 / 8
    assert seen["accuracy_real"] == 2.5 / 4, "a logit of 0 is a guess: half right"
    assert seen["accuracy_fake"] == 3 / 4
    assert seen["margin"] == pytest.approx(statistics.mean(real[:4]) - statistics.mean(fake[:4]))
    within = (statistics.pvariance(real[:4]) + statistics.pvariance(fake[:4])) / 2
    assert seen["spread"] == pytest.approx(within**0.5)
    assert knowledge(told_apart(*logits, torch.zeros_like(mask)).tolist()) == {}, "nothing was judged"


def test_reading_out_changes_nothing() -> None:
    """Neither texture nor discriminator nor what is drawn next, to the bit."""
    silent, read = optimizer(), optimizer()
    for step in range(12):
        silent.step()
        read.step()
        if step % 4 == 0:
            assert set(read.gradient_norms()) == set(GRADIENT_NAMES)
            read.drain_losses()
    for a, b in zip([silent.values, *silent.parameters], [read.values, *read.parameters], strict=True):
        assert torch.equal(a, b)
    assert torch.equal(silent.result, read.result)
    assert torch.equal(silent.generator.get_state(), read.generator.get_state())


def test_the_terms_gradients_are_those_that_the_texture_gets() -> None:
    """One by one: without the other terms, the texture's whole gradient is the one that is left."""
    names = {"l1_weight": "gradient_l1", "feature_weight": "gradient_features", "gabor_weight": "gradient_gabor"}
    preset = dataclasses.replace(PRESET, l1_target="source", l1_weight=3.0, gabor_weight=2.0)
    told = optimizer(preset=preset).gradient_norms()
    for kept in (*names, None):
        changed = dataclasses.replace(preset, **{name: 0.0 for name in names if name != kept})
        of = optimizer(preset=changed)
        before = of.generator.get_state()
        losses = of.play(of.draw())
        if kept is not None:
            losses = dataclasses.replace(losses, adversarial=torch.zeros(()))
        of.schedule.read()
        norm = float(of.texture_gradient(losses).norm())
        assert norm > 0
        assert told[names[kept] if kept else "gradient_adversarial"] == pytest.approx(norm, rel=1e-5)
        of.generator.set_state(before)
        assert of.gradient_norms().keys() == {"gradient_adversarial", *([names[kept]] if kept else [])}


def test_what_was_not_read_out_yet_is_saved() -> None:
    whole, first, second = optimizer(), optimizer(), optimizer()
    for _ in range(5):
        whole.step()
    for _ in range(2):
        first.step()
    second.load_state_dict(first.state_dict())
    for _ in range(3):
        second.step()
    assert whole.drain_losses() == second.drain_losses()
    assert second.drain_losses() == {}


def test_a_dead_discriminator_is_told_and_that_nothing_was_done() -> None:
    points = history(optimizer(Dead()))
    assert {point["accuracy"] for point in points} == {0.5}
    assert all(point["margin"] == point["spread"] == 0 for point in points)
    (problem,) = problems(points, PRESET)
    assert problem.code == "discriminator_at_chance"
    assert problem.where == "steps 4 to 60 of 60, at the end of its pretraining too"
    assert "told 50% of the patches apart, as guessing does (45% to 55%): it has learned nothing" in problem.message
    assert "about it: there the texture rests on L1 to its start and on matching its features" in problem.message
    assert "view_selection" in problem.remedy
    told = summary(points, PRESET)
    assert [point["at"] for point in told["points"]] == ["end of pretraining", "middle", "end"]
    assert [point["step"] for point in told["points"]] == [6, 33, 60]
    assert (told["at_chance"], told["certain"]) == (1.0, 0.0)
    assert [point["step"] for point in told["curve"]] == list(range(EVERY, STEPS + 1, EVERY))


def test_a_perfect_discriminator_is_told_and_how_often_it_rested() -> None:
    points = history(optimizer(Perfect()))
    (problem,) = problems(points, PRESET)
    assert problem.code == "discriminator_certain"
    assert "told 100% of the patches apart (above 95% it is certain)" in problem.message
    skipped = statistics.mean(point["skipped"] for point in points if point["step"] > 3)
    assert f"while it was ahead, in {skipped:.0%} of these steps" in problem.message
    assert 0.5 < skipped < 1, "not in the pretraining"
    assert summary(points, PRESET)["certain"] == 1.0


def told(*shares: float) -> list[dict[str, Any]]:
    """A history of LONG in which each twentieth of its steps, five points each, has a share of its own."""
    points = []
    for part, share in enumerate(shares):
        for fifth in range(5):
            known = {"accuracy": share, "accuracy_real": share + 0.1, "accuracy_fake": share - 0.1}
            known |= {"margin": 1.0, "spread": 2.0}
            points.append({"step": 75 * part + 15 * (fifth + 1), "skipped": 0.25, **known})
    return points


def test_one_that_learns_in_its_pretraining_and_tells_some_apart_is_no_problem() -> None:
    points = told(0.5, 0.6, *[0.62] * 18)
    assert problems(points, LONG) == []
    assert len(stretches(points, LONG.pretraining, LONG.steps)) == 19
    assert recent_accuracy(points, LONG.steps) == pytest.approx(0.62)
    assert summary(points, LONG)["at_chance"] == 0


def test_a_twentieth_of_the_run_is_enough_for_a_warning_that_says_where() -> None:
    (problem,) = problems(told(0.5, 0.6, *[0.62] * 8, 0.54, *[0.7] * 4, 0.5, *[0.7] * 4), LONG)
    assert problem.where == "steps 751 to 1200 of 1500, in 150 of these steps"
    assert "52% of the patches" in problem.message
    assert "it has not learned yet, or the texture fools it" in problem.message
    certain, chance = problems(told(0.5, 0.5, *[0.97] * 18), LONG)[::-1]
    assert (chance.where, chance.code) == (
        "steps 76 to 150 of 1500, at the end of its pretraining too",
        "discriminator_at_chance",
    )
    assert "it had not learned yet. The run did nothing about it: the texture was led by it as it was" in chance.message
    assert certain.where == "steps 151 to 1500 of 1500"


def test_runs_of_a_few_steps_are_not_judged() -> None:
    few = dataclasses.replace(PRINTED, levels=(PyramidLevel(24),))
    points = [{"step": step, "accuracy_real": 0.5, "accuracy_fake": 0.5, "skipped": 0} for step in range(1, 25)]
    points = [{**point, "accuracy": 0.5, "margin": 0.0, "spread": 0.0} for point in points]
    assert problems(points, few) == []
    assert summary(points, few)["at_chance"] == 1.0
    assert summary([{"step": 24, "skipped": 1.0}], few)["points"] == [], "nothing was judged"


def test_progress_tells_the_share_of_late_beside_the_losses() -> None:
    losses = {"discriminator": 1.3, "adversarial": 0.7, "l1": 0.1, "features": 0.0, "gabor": 0.0, "skipped": 0.25}
    points = [{**losses, **point} for point in told(0.5, 0.6)]
    assert _shown(points, 1500) == {**losses, "accuracy": pytest.approx(0.6)}
    assert _shown([{"step": 1, **losses}], 1500) == losses


def test_steps_that_a_level_ended_without_count_for_nothing() -> None:
    """The lower of two levels ends after step 40 of 60: the point at step 65 tells of five steps, and not of 25."""
    known = {"accuracy_real": 0.6, "accuracy_fake": 0.6, "margin": 0.1, "spread": 1.0, "skipped": 0.0}
    points = [{"step": step, "accuracy": 0.9 if step > 60 else 0.6, **known} for step in (20, 40, 65)]
    levels = (PyramidLevel(60, scale=2), PyramidLevel(40))
    (part,) = stretches(points[2:], 0, 100, levels)
    assert (part.first, part.last) == (60, 65)
    taken = [part.last - part.first for part in stretches(points, 0, 100, levels)]
    assert sum(taken) == 45

"""What the discriminator knows along a run, and what that means for the texture.

A game is worth its steps while the discriminator tells some of the patches apart, and not all. At chance it has nothing
to teach; where it is certain, no change that the texture can make fools it. A run reads out, beside its losses:

accuracy                       share of the patches that it tells apart, half of which are real
accuracy_real, accuracy_fake   shares of the real and of the fake patches that it tells for what they are
margin, spread                 mean logit of the real patches less that of the fake; standard deviation about them
gradient_adversarial, gradient_l1, gradient_features, gradient_gabor
                               L2 norms of what each term adds to the texture's gradient; now and then only
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

from advtex_engine.core.config import Preset, PyramidLevel
from advtex_engine.core.errors import Problem

KNOWLEDGE_NAMES = ("accuracy", "accuracy_real", "accuracy_fake", "margin", "spread")
GRADIENT_NAMES = ("gradient_adversarial", "gradient_l1", "gradient_features", "gradient_gabor")
GAME_NAMES = (*KNOWLEDGE_NAMES, *GRADIENT_NAMES)
CHANCE = (0.45, 0.55)  # of patches told apart: as many as by guessing
CERTAIN = 0.95  # more than this
SHARE = 0.05  # of the run's steps, in which it has to be so on average
MIN_STEPS = 50  # of a run: in fewer no discriminator could have learned anything

Point = Mapping[str, Any]
"""{"step": int, name: value, ...}; values are means since the point before."""


def knowledge(told: Sequence[float]) -> dict[str, float]:
    """KNOWLEDGE_NAMES from the sums of `losses.told_apart`; empty where no patch counted.

    Variances are differences of means of squares: the spread is exact to a thousandth of the logits' size.
    """
    patches, real_right, fake_right, real_sum, fake_sum, real_squares, fake_squares = told
    if not patches:
        return {}
    real, fake = real_sum / patches, fake_sum / patches
    variance = (real_squares + fake_squares) / patches - real**2 - fake**2
    return {
        "accuracy": (real_right + fake_right) / (2 * patches),
        "accuracy_real": real_right / patches,
        "accuracy_fake": fake_right / patches,
        "margin": real - fake,
        "spread": math.sqrt(max(variance, 0.0) / 2) if math.isfinite(variance) else math.nan,
    }


@dataclass(frozen=True)
class Stretch:
    """Means over about SHARE of the run, from after step `first` to step `last`."""

    first: int
    last: int
    means: Mapping[str, float]

    @property
    def at_chance(self) -> bool:
        return CHANCE[0] <= self.means["accuracy"] <= CHANCE[1]

    @property
    def certain(self) -> bool:
        return self.means["accuracy"] > CERTAIN

    def described(self, place: str) -> dict[str, Any]:
        """For the report."""
        return {"at": place, "step": self.last} | {name: self.means[name] for name in KNOWLEDGE_NAMES}


def stretches(
    points: Sequence[Point], pretraining: int, steps: int, levels: Sequence[PyramidLevel] = ()
) -> list[Stretch]:
    """Means of the history over equal stretches after the pretraining, and over its last one.

    What the discriminator does not know before is no fault. Stretches in which nothing was judged are left out, and so
    are the steps that a level of a pyramid ended without.
    """
    starts = accumulate(level.steps for level in levels)
    after = max(1, steps - pretraining)
    size = after / max(1, round(after / (SHARE * steps)))
    found = dict[int, list[tuple[int, Point]]]()
    before = 0
    start = next(starts, steps)
    for point in points:
        while point["step"] > start:
            before, start = start, next(starts, point["step"])
        number = math.ceil((point["step"] - pretraining) / size)
        if number >= 0 and "accuracy" in point:
            found.setdefault(number, []).append((before, point))
        before = point["step"]
    made = []
    for _, parts in sorted(found.items()):
        weights = [point["step"] - first for first, point in parts]
        names = (*KNOWLEDGE_NAMES, "skipped")
        means = {
            name: sum(w * point[name] for w, (_, point) in zip(weights, parts, strict=True)) / sum(weights)
            for name in names
        }
        made.append(Stretch(parts[0][0], parts[-1][1]["step"], means))
    return made


def recent_accuracy(points: Sequence[Point], steps: int) -> float | None:
    """The share told apart over the last SHARE of the run's steps; None where nothing was judged in them."""
    since = points[-1]["step"] - SHARE * steps if points else 0
    known = [float(point["accuracy"]) for point in points if point["step"] > since and "accuracy" in point]
    return sum(known) / len(known) if known else None


def summary(points: Sequence[Point], preset: Preset) -> dict[str, Any]:
    """The report's part `game`: what the discriminator knew at three points, for how long it was no help, the curve.

    at_chance, certain: shares of the steps after its pretraining.
    """
    steps, pretraining = preset.steps, preset.pretraining
    parts = stretches(points, pretraining, steps, preset.levels)
    played = [part for part in parts if part.last > pretraining]
    shown = [part.described("end of pretraining") for part in parts if part.last <= pretraining]
    if played:
        shown += [played[(len(played) - 1) // 2].described("middle"), played[-1].described("end")]
    whole = max(1, sum(part.last - part.first for part in played))
    return {
        "points": shown,
        "at_chance": sum(part.last - part.first for part in played if part.at_chance) / whole,
        "certain": sum(part.last - part.first for part in played if part.certain) / whole,
        "curve": [{name: point[name] for name in ("step", *GAME_NAMES) if name in point} for point in points],
    }


def problems(points: Sequence[Point], preset: Preset) -> list[Problem]:
    """What a user should know: a discriminator that was at chance, or certain, for SHARE of the run; pretraining's end
    counts. Nothing of runs below MIN_STEPS."""
    if preset.steps < MIN_STEPS:
        return []
    parts = stretches(points, preset.pretraining, preset.steps, preset.levels)
    chance, certain = ([part for part in parts if getattr(part, name)] for name in ("at_chance", "certain"))
    found = []
    if chance:
        found.append(_chance(chance, len(parts), preset))
    if certain:
        found.append(_certain(certain, preset))
    return found


def _chance(parts: Sequence[Stretch], judged: int, preset: Preset) -> Problem:
    features = " and on matching its features" if preset.feature_weight else ""
    target = {"start": "its start", "source": "the source view", "auxiliary": "the auxiliary view"}[preset.l1_target]
    rests = f"there the texture rests on L1 to {target}{features}"
    if parts[-1].last <= preset.pretraining:
        why, rests = "it had not learned yet", "the texture was led by it as it was"
    else:
        why = "it has learned nothing" if len(parts) == judged else "it has not learned yet, or the texture fools it"
    return Problem(
        "discriminator_at_chance",
        _place(parts, preset),
        f"the discriminator told {_share(parts)} of the patches apart, as guessing does ({CHANCE[0]:.0%} to"
        f" {CHANCE[1]:.0%}): {why}. The run did nothing about it: {rests}",
        _remedy(preset),
    )


def _certain(parts: Sequence[Stretch], preset: Preset) -> Problem:
    skipped = sum(part.means["skipped"] * (part.last - part.first) for part in parts) / _steps(parts)
    return Problem(
        "discriminator_certain",
        _place(parts, preset),
        f"the discriminator told {_share(parts)} of the patches apart (above {CERTAIN:.0%} it is certain): no change of"
        " the texture fooled it, so its gradient hardly says what would help. The run did nothing about it, but that"
        f" the discriminator rested while it was ahead, in {skipped:.0%} of these steps",
        _remedy(preset),
    )


def _place(parts: Sequence[Stretch], preset: Preset) -> str:
    """The steps from the first to the last of them, and how many these are."""
    within = _steps(parts)
    whole = parts[-1].last - parts[0].first
    some = "" if within == whole else f", in {within} of these steps"
    trained = ", at the end of its pretraining too" if parts[0].last <= preset.pretraining else ""
    return f"steps {parts[0].first + 1} to {parts[-1].last} of {preset.steps}{some}{trained}"


def _share(parts: Sequence[Stretch]) -> str:
    return f"{sum(part.means['accuracy'] * (part.last - part.first) for part in parts) / _steps(parts):.0%}"


def _steps(parts: Sequence[Stretch]) -> int:
    return sum(part.last - part.first for part in parts)


def _remedy(preset: Preset) -> str:
    if preset.start == "selection":
        return "compare with the method view_selection, whose texture the run began with"
    return "compare with the method l1, which has no discriminator"

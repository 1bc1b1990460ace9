"""The adversarial method over its coarse-to-fine levels, with checkpoints (paper section 3; presets in config.py)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.adversarial.cuda_graph import Stepper
from advtex_engine.adversarial.disagreement import disagreement
from advtex_engine.adversarial.discriminator import PatchDiscriminator
from advtex_engine.adversarial.game import GAME_NAMES, problems, recent_accuracy, summary
from advtex_engine.adversarial.optimizer import LOSS_NAMES, AdversarialOptimizer
from advtex_engine.adversarial.probes import LeftOutCells, Probed, Probes, probed
from advtex_engine.adversarial.schedule import AVERAGE_EVERY
from advtex_engine.adversarial.unlikeness import structure_unlikeness
from advtex_engine.core.config import Preset
from advtex_engine.core.errors import Diverged, Problem, Stopped
from advtex_engine.methods.gabor import start_motions
from advtex_engine.methods.inputs import LossPoint, MethodInput
from advtex_engine.methods.mean import dense_texture
from advtex_engine.metrics.evaluate import configured_lpips
from advtex_engine.render.motion import Taps
from advtex_engine.render.pairs import Pairs, own_pairs, related_pairs
from advtex_engine.render.sharpness import shows_areas
from advtex_engine.render.streaming import PairViews, pair_views
from advtex_engine.render.view_maps import ViewMaps
from advtex_engine.runtime.available_memory import give_back_unused
from advtex_engine.runtime.checkpoint import Checkpoints
from advtex_engine.runtime.threads import fit_threads
from advtex_engine.selection.shared_detail import OPTIMIZED, share_detail

NEEDED = ("level", "step", "losses", "quality", "halved", "probed", "optimizer", "views", "probes")
"""What a checkpoint holds."""
HISTORY_POINTS = 200  # means kept for the report and shown as progress
PROBE_EVERY = 200
"""Steps between two looks at each term's gradient, which cost a step and a quarter each."""
PROBE_EVERY_ON_GPU = 2_000  # there a step is one of many of a graph, and a look is not: it costs ten times as much


@dataclass
class _Run:
    """Where the run stands: pyramid level, global step, the history so far, and whether it goes at half the rates.

    losses: means, and what the discriminator knew, since the point before. probed: what the levels before were told by
    views that were left out.
    """

    level: int
    step: int
    losses: list[LossPoint]
    halved: bool
    probed: list[Probed]


def adversarial(given: MethodInput) -> tuple[Tensor, list[LossPoint]]:
    """Optimizes the texture; goes on from the work folder's checkpoint when there is one.

    From view selection, the finest detail is shared once more at the end (`share_detail`), unless the start is kept.
    Cameras' motions (`start_motions`) are put onto what photographs are compared with then, and when views that are
    left out judge the texture.
    Returns the dense texture [H,W,3] float32 in [0,1] and the loss history; what the discriminator knew is the fact
    "game", and a warning where that was no help to the texture. Raises Stopped, after a checkpoint, when
    the monitor asks for it. On a CPU the result does not depend on whether and where the run was interrupted. A run
    that diverges goes back to its last checkpoint once, with half the learning rates, and warns; then Diverged.
    """
    checkpoints = Checkpoints(given.work, given.config.checkpoint_seconds, given.preset.steps)
    saved = checkpoints.load(*NEEDED)
    try:
        return _optimized(given, checkpoints, saved, halved=saved is not None and saved["halved"])
    except _FirstDivergence as error:
        step = error.step
    # Not in the handler: the error's traceback holds the run that diverged.
    saved = checkpoints.load(*NEEDED)
    given.monitor.warning(
        Problem(
            "diverged",
            f"step {step} of {given.preset.steps}",
            "the losses or the texture were no longer finite; the run went on from"
            f" step {saved['step'] if saved else 0} with half the learning rates",
            "compare the result with that of another preset or seed",
        )
    )
    return _optimized(given, checkpoints, saved, halved=True)


class _FirstDivergence(Exception):
    def __init__(self, step: int) -> None:
        self.step = step


def _optimized(
    given: MethodInput, checkpoints: Checkpoints, saved: dict[str, Any] | None, *, halved: bool
) -> tuple[Tensor, list[LossPoint]]:
    """From the checkpoint that was `saved`, or from the start."""
    preset = given.preset
    if halved:
        preset = replace(preset, lr_texture=preset.lr_texture / 2, lr_discriminator=preset.lr_discriminator / 2)
    device = given.maps[1].device
    # Weights are drawn on the CPU, so that a run starts from the same discriminator on every device.
    discriminator = PatchDiscriminator(torch.Generator().manual_seed(given.config.seed)).to(device)
    generator = torch.Generator(device).manual_seed(given.config.seed)
    run = _Run(0, 0, [], halved, [])
    if saved:
        run = _Run(saved["level"], saved["step"], saved["losses"], halved, saved["probed"])
        given.live.quality = saved["quality"]
    start = starting_texture(given)
    motions = _motions(given, start)
    texture = start
    for number, level in enumerate(preset.levels):
        if number < run.level:
            continue
        maps = given.maps[level.scale]
        # Smaller views need less room each.
        on_device = None if given.on_device is None else given.on_device * level.scale**2
        pairs = pairs_of(given, maps)
        views = pair_views(maps, pairs, on_device, given.config.seed)
        optimizer = AdversarialOptimizer(
            views.maps,
            views.pairs,
            _resized(texture, maps.slot_map.shape)[maps.slot_map >= 0],
            fitted(preset, maps, start),
            kind=given.scene.kind,
            steps=preset.steps,
            generator=generator,
            discriminator=discriminator,
        )
        optimizer.index = run.step
        end = sum(part.steps for part in preset.levels[: number + 1])
        probes = _probes(given, maps, pairs, optimizer, views, end, motions.get(level.scale))
        if saved:
            optimizer.load_state_dict(saved["optimizer"])
            if probes is not None:
                probes.load_state_dict(saved["probes"], optimizer.result)
            views.load_state_dict(saved["views"])
            saved = None
        _run_level(given, optimizer, views, probes, run, end, checkpoints)
        helped = probes is None or probes.best is not None
        if probes is not None:
            run.probed.append(probes.told)
        if helped:
            result = optimizer.result if probes is None else probes.kept
            texture = _refined(start, dense_texture(maps, result))
        del optimizer, views, probes  # before the next level makes its own
        run.level = number + 1
        if not helped:
            break
    if preset.start == "selection" and texture is not start:
        texture = share_detail(texture.clamp(0, 1), given.maps[1], OPTIMIZED, motions[1])
    told = probed(run.probed, preset.steps)
    if told is not None:
        given.monitor.note(told["told"])
    if run.losses[-1]["step"] < preset.steps:
        given.monitor.progress(preset.steps, preset.steps, _shown(run.losses, preset.steps))
    given.facts["game"] = summary(run.losses, preset) | {"probes": told}
    for problem in problems(run.losses, preset):
        given.monitor.warning(problem)
    losses = [{name: value for name, value in point.items() if name not in GAME_NAMES} for point in run.losses]
    return texture.clamp(0, 1), losses


def _motions(given: MethodInput, start: Tensor) -> dict[int, dict[int, Taps]]:
    """By scale, those of its views; none from other starts than view selection's.

    Before there is an optimizer, and with what that took given back: it is not in the estimate.
    """
    if given.preset.start != "selection":
        return {}
    found = {}
    for scale in {1, *(level.scale for level in given.preset.levels)}:
        maps = given.maps[scale]
        found[scale] = start_motions(_resized(start, maps.slot_map.shape), maps, areas=shows_areas(maps))
    give_back_unused()
    return found


def _probes(
    given: MethodInput,
    maps: ViewMaps,
    pairs: Pairs,
    optimizer: AdversarialOptimizer,
    views: PairViews,
    end: int,
    motions: Mapping[int, Taps] | None,
) -> Probes | None:
    """What says whether the level's steps pay; None where the preset asks for none, or no view can be left out.

    Runs whose turns would be too short for the texture's average to move are not probed.
    """
    preset = given.preset
    if given.painted is None or preset.turn < AVERAGE_EVERY:
        return None
    lpips, _ = configured_lpips()
    unlikeness = structure_unlikeness if lpips is None else lpips.to(maps.device).maps

    def leave_out(left_out: Tensor) -> None:
        optimizer.sampler.source_count.fill_(views.leave_out(left_out))

    probes = Probes(
        LeftOutCells(maps, given.painted, unlikeness, areas=optimizer.preset.areas, motions=motions),
        pairs.sources.tolist(),
        leave_out,
        judged_by="structure" if lpips is None else "LPIPS",
        start=optimizer.values.detach().clone() if optimizer.start is None else optimizer.start,
        first=max(preset.pretraining, optimizer.index),
        end=end,
        turn=preset.turn,
        patience=preset.patience,
    )
    return probes if probes.possible else None


def adversarial_no_auxiliary(given: MethodInput) -> tuple[Tensor, list[LossPoint]]:
    """Ablation: the real example is the source image itself, so nothing teaches the misalignments."""
    return adversarial(replace(given, preset=replace(given.preset, auxiliary=False, perturbation=0.0)))


def adversarial_no_condition(given: MethodInput) -> tuple[Tensor, list[LossPoint]]:
    """Ablation: the discriminator sees the example without the source image, so it cannot tell what belongs where."""
    return adversarial(replace(given, preset=replace(given.preset, condition=False)))


def fitted(preset: Preset, maps: ViewMaps, start: Tensor) -> Preset:
    """The preset for these views: its rate in colors, areas where photographs show them. start: [H,W,3] in [0,1]."""
    preset = replace(preset, areas=preset.areas and shows_areas(maps))
    if preset.lr_unit == "color":
        return preset
    return replace(preset, lr_texture=preset.lr_texture * disagreement(maps, start) ** 0.5, lr_unit="color")


def pairs_of(given: MethodInput, maps: ViewMaps) -> Pairs:
    """Which views the preset pairs with each other."""
    if not given.preset.auxiliary:
        return own_pairs(maps)
    preset = given.preset
    return related_pairs(maps, given.scene.kind, preset.max_pair_angle, preset.min_pair_overlap, preset.nearest_share)


def _run_level(
    given: MethodInput,
    optimizer: AdversarialOptimizer,
    views: PairViews,
    probes: Probes | None,
    run: _Run,
    end: int,
    checkpoints: Checkpoints,
) -> None:
    total = given.preset.steps
    every = max(1, total // HISTORY_POINTS)
    probe_every = PROBE_EVERY_ON_GPU if optimizer.device.type == "cuda" else PROBE_EVERY
    stepper = Stepper(optimizer)
    if probes is not None:
        probes.reached(run.step, optimizer.result)
    while run.step < end and not (probes is not None and probes.over):
        fit_threads()
        before = run.step
        run.step += stepper.take((end if probes is None else min(end, probes.next)) - run.step)
        views.advance(run.step - before)
        if probes is not None:
            probes.reached(run.step, optimizer.result)
        over = run.step == end or (probes is not None and probes.over)
        if run.step // every > before // every or over:
            losses = optimizer.drain_losses()
            _check(optimizer, losses, run, total)
            read = run.losses[-1]["step"] if run.losses else 0
            if run.step // probe_every > read // probe_every or run.step == total:
                losses |= optimizer.gradient_norms()
            run.losses.append({"step": run.step, **losses})
            given.monitor.progress(run.step, total, _shown(run.losses, total))
        if over or given.live.due():
            mean = given.means[given.preset.levels[run.level].scale]
            shown = probes.kept if over and probes is not None else optimizer.result
            given.live.show(run.step, optimizer.maps, shown, mean, run.losses)
        stop = given.monitor.stop_requested()
        if stop or checkpoints.due():
            _check(optimizer, {}, run, total)
            state = {"level": run.level, "step": run.step, "losses": run.losses, "quality": given.live.quality}
            state |= {"halved": run.halved, "probed": run.probed}
            state["probes"] = None if probes is None else probes.state_dict()
            checkpoints.save({**state, "optimizer": optimizer.state_dict(), "views": views.state_dict()})
        if stop:
            raise Stopped(f"stopped after step {run.step} of {total}; resume goes on from there")
    run.step = end  # the next level begins where its schedule does, also where this one has ended before
    given.facts["step"] = stepper.describe() | {"lr_texture": optimizer.preset.lr_texture}


def _shown(history: Sequence[LossPoint], total: int) -> dict[str, float]:
    """The newest losses, and what share of patches the discriminator has told apart of late."""
    newest = {name: history[-1][name] for name in LOSS_NAMES}
    recent = recent_accuracy(history, total)
    return newest if recent is None else newest | {"accuracy": recent}


def _check(optimizer: AdversarialOptimizer, losses: Mapping[str, float], run: _Run, total: int) -> None:
    """Raises where something is not finite, so that no checkpoint holds it (waits for the device)."""
    if optimizer.finite() and all(map(math.isfinite, losses.values())):
        return
    if run.halved:
        raise Diverged(
            f"the losses or the texture were no longer finite at step {run.step} of {total}, also with half the"
            " learning rates; choose another preset or method"
        )
    raise _FirstDivergence(run.step)


def starting_texture(given: MethodInput) -> Tensor:
    """What the run starts from: dense [H,W,3] in [0,1], at full size."""
    if given.start is not None:
        return given.start
    mean = given.means[1]
    return torch.zeros_like(mean) if given.preset.start == "zero" else mean


def _refined(start: Tensor, texture: Tensor) -> Tensor:
    """The start with what a texture of smaller size changed in it; it keeps the detail that the smaller one lacks."""
    if texture.shape == start.shape:
        return texture
    return start + _resized(texture - _resized(start, texture.shape), start.shape)


def _resized(texture: Tensor, shape: Sequence[int]) -> Tensor:
    """A dense texture [H,W,3] at the size `shape` [h,w,...], without aliasing."""
    if texture.shape[:2] == tuple(shape[:2]):
        return texture
    image = texture.permute(2, 0, 1)[None]
    image = F.interpolate(image, tuple(shape[:2]), mode="bilinear", align_corners=False, antialias=True)
    return image[0].permute(1, 2, 0)

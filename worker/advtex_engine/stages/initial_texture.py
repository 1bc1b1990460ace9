"""What the method begins with: mean textures, and for some the texture of view selection and views in one tone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from torch import Tensor

from advtex_engine.budget.limits import Budget
from advtex_engine.budget.workload import Workload
from advtex_engine.core.scene import Atlas, Scene
from advtex_engine.methods import MethodInput
from advtex_engine.methods.adversarial import starting_texture
from advtex_engine.methods.gabor import descended
from advtex_engine.methods.mean import mean_texture
from advtex_engine.methods.selected import selected_start
from advtex_engine.previews.live import Live
from advtex_engine.render.view_maps import ViewMaps
from advtex_engine.runtime.available_memory import give_back_unused
from advtex_engine.runtime.stage_records import Stages
from advtex_engine.selection.toning import tone_views


def method_input(
    scene: Scene, atlas: Atlas, maps: Mapping[int, ViewMaps], work: Workload, budget: Budget, stages: Stages
) -> MethodInput:
    """All that the method is given, within the budget's limits."""
    config, monitor = budget.config, stages.monitor
    preset = budget.preset(work.preset)
    with stages.run("initial_texture"):
        means = {scale: mean_texture(level) for scale, level in maps.items()}
        live = Live(scene, atlas, monitor)
        given = MethodInput(scene, atlas, maps, means, preset, config, monitor, budget.texture_folder(), live)
        given = replace(given, on_device=budget.limits.on_device)
        if work.starts_selected:
            start, painted = _selected_start(given, makes_detail=work.makes_detail)
            given = replace(given, start=start, painted=painted)
        if work.toned:
            for level in maps.values():
                tone_views(level, starting_texture(given))
        budget.begin(given.held_bytes)
        if work.descends:
            given = replace(given, start=_descended_start(given))
            give_back_unused()
    stages.save()
    return given


def _selected_start(given: MethodInput, *, makes_detail: bool) -> tuple[Tensor, Tensor]:
    """The texture by view selection, and which view each texel shows; from the work folder when they are there.

    makes_detail: whether steps will, so that the texture need not have it.
    """
    saved = given.work.load("initial_texture", ("texture", "painted"))
    if saved is not None:
        return saved["texture"].to(given.means[1]), saved["painted"].to(given.means[1].device)
    texture, painted = selected_start(given, makes_detail=makes_detail)
    given.work.save("initial_texture", {"texture": texture, "painted": painted})
    return texture, painted


def _descended_start(given: MethodInput) -> Tensor:
    """The start brought nearer to the photographs; from the work folder when it is there, or from where it stood."""
    saved = given.work.load("descended", ("texture",))
    if saved is not None:
        kept: Tensor = saved["texture"].to(given.means[1])
        return kept
    passes, crop = given.preset.passes, given.preset.descent_crop
    texture, losses = descended(given, passes=passes, largest=crop, checkpoint="descent")
    given.work.earlier_seconds = 0.0  # what earlier attempts spent here is no part of the optimization
    if losses:  # else what was warned of is to be said again by the next attempt
        given.work.save("descended", {"texture": texture})
    return texture

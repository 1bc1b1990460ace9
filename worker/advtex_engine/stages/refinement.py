"""Cameras, exposures and geometry refined by the photographs, from the work folder or found anew."""

from __future__ import annotations

from typing import Any

import torch

from advtex_engine.core.scene import Scene
from advtex_engine.refine.run import (
    Refinement,
    apply_refinement,
    refine_scene,
    refinement_from_dict,
    refinement_to_dict,
)
from advtex_engine.runtime.stage_records import Stages


def refined_scene(scene: Scene, stages: Stages, device: torch.device, seed: int) -> tuple[Scene, dict[str, Any]]:
    """The scene with refined cameras, exposures and vertices, and the report's part about them.

    What was found is small and cached by itself: the scene as it came stays in its own cache.
    """
    saved = stages.folder.load("refinement", Refinement.__dataclass_fields__)
    if saved is not None:
        stages.restore("refinement")
        refinement = refinement_from_dict(saved)
        return apply_refinement(scene, refinement), refinement.report
    with stages.run("refinement"):
        refinement = refine_scene(scene, device, seed)
        refined = apply_refinement(scene, refinement)
    stages.folder.save("refinement", refinement_to_dict(refinement))
    stages.save()
    return refined, refinement.report

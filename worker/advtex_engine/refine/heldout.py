"""Poses of held-out views against the finished texture: the model stands still, each photograph's camera moves.

What is compared is the photograph with the model's own render at the given pose, point by point on the surface, by the
solver of `refine_pose`. Nothing else of the view is changed, and the model never sees it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from advtex_engine.core.scene import Atlas, View
from advtex_engine.refine.check import improved
from advtex_engine.refine.pose import refine_poses, sample_points
from advtex_engine.refine.working_views import CONTRAST_SCALE, motion, working_views
from advtex_engine.render.render_view import render_view
from advtex_engine.render.texture import fill_holes

STANDARD_ERRORS = 2.0  # of its improvement, for a view that stands alone: no others vouch for it


def refine_heldout(
    atlas: Atlas,
    texture: Tensor,
    views: Sequence[View],
    kind: str,
    seed: int = 0,
    standard_errors: float = STANDARD_ERRORS,
) -> tuple[tuple[View, ...], list[dict[str, Any]]]:
    """The views with refined poses, and per view its name, whether it kept its pose, and how far the camera moved.

    texture: [atlas.height,atlas.width,3] uint8 sRGB or float in [0,1]. A view keeps its pose unless it shows the model
    better from the new one, by so many standard errors, at points that were set aside. Not differentiable.
    """
    refined, report = [], []
    for view in views:
        pose, moved = _refined_pose(atlas, texture, view, kind, seed, standard_errors)
        refined.append(view if pose is None else replace(view, camera=replace(view.camera, world_to_camera=pose)))
        millimetres, degrees, pixels = (round(float(part), 4) for part in moved)
        described = {"moved_mm": millimetres, "turned_degrees": degrees, "moved_pixels": pixels}
        report.append({"name": view.name, "kept_pose": pose is None, **described})
    return tuple(refined), report


def _refined_pose(
    atlas: Atlas, texture: Tensor, view: View, kind: str, seed: int, standard_errors: float
) -> tuple[Tensor | None, Tensor]:
    """world_to_camera [4,4], None to keep the given one; and millimetres, degrees, and pixels of the view, [3]."""
    render = render_view(atlas, texture, view.camera)
    if view.mask is not None:
        render = fill_holes(render, view.mask.to(render.device))  # as the photograph is filled
    model = replace(view, name="model", color=(render.clamp(0, 1) * 255).round().to(torch.uint8))
    working = working_views(atlas.mesh, (view, model), kind, texture.device, seed)
    if working is None:
        return None, torch.zeros(3)
    found = refine_poses(working.contrast, working.size, kind, working.K, working.given, working.fitted)
    before, after = (
        sample_points(working.features, working.K, pose, working.checked, working.size)
        for pose in (working.given, found)
    )
    values = before.value[..., None], after.value[..., None]
    both = before.valid & after.valid
    if not improved(*values, both, working.checked, working.checked_cell, CONTRAST_SCALE, standard_errors)[0]:
        return None, torch.zeros(3)
    scale = torch.tensor([1.0, 1.0, view.camera.width / working.size[0]])
    return found[0].to(view.camera.world_to_camera), motion(found, working)[0] * scale

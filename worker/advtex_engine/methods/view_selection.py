"""View selection: every face shows one photograph (after Waechter et al. 2014, "Let There Be Color!")."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from advtex_engine.assignment import assign_views
from advtex_engine.candidates import OCCLUSION_SHARE, find_candidates
from advtex_engine.leveling import Sampler, blend_texels
from advtex_engine.methods.inputs import LossPoint, MethodInput
from advtex_engine.texels import map_texels
from advtex_engine.texture import fill_holes
from advtex_engine.views import DEPTH_TOLERANCE


@dataclass(frozen=True)
class Selection:
    """texture: [H,W,3] float32 in [0,1], filled where not known. known: [H,W] bool, texels that a view shows.

    confidence: [H,W] float32 in [0,1], lower where the view disagrees with the face's other views and along seams, 0
    where not known. labels: [T] int64 view of each face, -1 = none.
    """

    texture: Tensor
    known: Tensor
    confidence: Tensor
    labels: Tensor


def view_selection(given: MethodInput) -> tuple[Tensor, list[LossPoint]]:
    """The texture of `select_views`; no iterations, so no losses."""
    return select_views(given).texture, []


def select_views(given: MethodInput) -> Selection:
    """One view per face, sampled texel by texel from the views at working size, leveled. Not differentiable."""
    atlas, maps = given.atlas, given.maps[1]
    mesh = atlas.mesh
    # What is hidden by less than this counts as seen.
    tolerance = DEPTH_TOLERANCE[given.scene.kind] * OCCLUSION_SHARE
    candidates = find_candidates(mesh, maps, tolerance)
    assignment = assign_views(mesh.t_pos_idx, candidates)
    texels = map_texels(atlas)
    blend = blend_texels(mesh, texels, assignment.view, candidates.view, Sampler(maps, tolerance))
    color, known, confidence = (
        torch.zeros((atlas.height * atlas.width, *part.shape[1:]), dtype=part.dtype, device=part.device)
        for part in (blend.color, blend.known, blend.own)
    )
    color[texels.texel], known[texels.texel] = blend.color, blend.known
    confidence[texels.texel] = torch.where(blend.known, blend.own * assignment.agreement[texels.face], 0.0)
    shape = (atlas.height, atlas.width)
    texture = fill_holes(color.view(*shape, 3), known.view(shape))
    return Selection(texture, known.view(shape), confidence.view(shape), assignment.view)

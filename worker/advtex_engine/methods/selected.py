"""The texture of view selection by itself: every face shows one photograph (after Waechter et al. 2014, "Let There Be
Color!"), and what others have in common with it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from advtex_engine.mesh.split import LONGEST_SIDE, split_long_sides
from advtex_engine.methods.inputs import MethodInput
from advtex_engine.render.sharpness import shows_areas
from advtex_engine.render.texels import map_texels
from advtex_engine.render.texture import fill_holes
from advtex_engine.render.view_maps import DEPTH_TOLERANCE, ViewMaps
from advtex_engine.selection.back_projection import back_project
from advtex_engine.selection.candidates import OCCLUSION_SHARE, find_candidates
from advtex_engine.selection.detail import blur_cost
from advtex_engine.selection.leveling import Sampler, blend_texels
from advtex_engine.selection.mrf import assign_views
from advtex_engine.selection.shared_detail import share_detail
from advtex_engine.selection.tones import shared_tones


@dataclass(frozen=True)
class Selection:
    """texture: [H,W,3] float32 in [0,1], filled where not known. known: [H,W] bool, texels that a view shows.

    painted: [H,W] int16, the view that each texel shows, -1 where not known. confidence: [H,W] float32 in [0,1], lower
    where the view disagrees with the face's other views and along seams, 0 where not known.
    """

    texture: Tensor
    known: Tensor
    painted: Tensor
    confidence: Tensor


def selected_start(given: MethodInput, *, makes_detail: bool) -> tuple[Tensor, Tensor]:
    """The texture [H,W,3] of `select_views`, and the view that each texel shows, [H,W] int16.

    makes_detail: whether `gabor.descended` follows. To it the detail of photographs that are blurred is worth nothing,
    which takes a tenth of the whole run; that of others is worth .7 % of LPIPS.
    """
    selection, maps = select_views(given), given.maps[1]
    if makes_detail and not shows_areas(maps):
        return selection.texture, selection.painted
    return with_detail(selection.texture, selection.painted, maps), selection.painted


def with_detail(texture: Tensor, painted: Tensor, maps: ViewMaps) -> Tensor:
    """The texture [H,W,3] of `select_views` with the detail that resampling took, and what its photographs share.

    painted: as `Selection` has it.
    """
    return fill_holes(share_detail(back_project(texture, painted.long(), maps), maps), painted >= 0)


def select_views(given: MethodInput) -> Selection:
    """One view per face of at most LONGEST_SIDE, from the views at working size, leveled.

    Not differentiable.
    """
    maps = given.maps[1]
    atlas = split_long_sides(given.atlas, LONGEST_SIDE * maps.width)
    mesh = atlas.mesh
    # What is hidden by less than this counts as seen.
    tolerance = DEPTH_TOLERANCE[given.scene.kind] * OCCLUSION_SHARE
    candidates = find_candidates(mesh, maps, tolerance)
    candidates = replace(candidates, cost=candidates.cost + blur_cost(mesh, candidates, maps))
    assignment = assign_views(mesh, candidates)
    texels = map_texels(atlas)
    blend = blend_texels(mesh, texels, assignment.view, candidates.view, Sampler(maps, tolerance))
    color = (blend.color + shared_tones(mesh, texels, blend.color, blend.known, candidates)).clamp(0, 1)
    own = torch.where(blend.known, assignment.view[texels.face], -1)
    agreement = torch.where(blend.known, blend.own * assignment.agreement[texels.face], 0.0)
    color, label, confidence = (
        torch.full((atlas.height * atlas.width, *part.shape[1:]), nothing, dtype=part.dtype, device=part.device)
        .index_copy_(0, texels.texel, part)
        .view(atlas.height, atlas.width, *part.shape[1:])
        for part, nothing in ((color, 0), (own, -1), (agreement, 0))
    )
    known = label >= 0
    return Selection(fill_holes(color, known), known, label.to(torch.int16), confidence)

"""View selection: every face shows one photograph (after Waechter et al. 2014, "Let There Be Color!")."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.assignment import assign_views
from advtex_engine.candidates import find_candidates
from advtex_engine.methods.inputs import LossPoint, MethodInput
from advtex_engine.texels import map_texels, surface_points
from advtex_engine.texture import fill_holes
from advtex_engine.views import DEPTH_TOLERANCE, ViewMaps


@dataclass(frozen=True)
class Selection:
    """texture: [H,W,3] float32 in [0,1], filled where not known. known: [H,W] bool, texels that a view shows.

    confidence: [H,W] float32 in [0,1], 0 where not known. labels: [T] int64 view of each face, -1 = none.
    """

    texture: Tensor
    known: Tensor
    confidence: Tensor
    labels: Tensor


def view_selection(given: MethodInput) -> tuple[Tensor, list[LossPoint]]:
    """The texture of `select_views`; no iterations, so no losses."""
    return select_views(given).texture, []


def select_views(given: MethodInput) -> Selection:
    """One view per face, sampled texel by texel from the views at working size. Not differentiable."""
    atlas, maps = given.atlas, given.maps[1]
    candidates = find_candidates(atlas.mesh, maps, DEPTH_TOLERANCE[given.scene.kind])
    assignment = assign_views(atlas.mesh.t_pos_idx, candidates)
    texels = map_texels(atlas)
    label = assignment.view[texels.face]
    points = surface_points(atlas.mesh, texels)
    color = torch.zeros((len(texels.texel), 3), device=points.device)
    for view in range(maps.count):
        mine = (label == view).nonzero()[:, 0]
        if len(mine):
            color[mine] = sample_view(maps, view, points[mine])
    known = label >= 0
    texture = torch.zeros((atlas.height * atlas.width, 3), device=points.device)
    texture[texels.texel[known]] = color[known]
    mask = torch.zeros(atlas.height * atlas.width, dtype=torch.bool, device=points.device)
    mask[texels.texel[known]] = True
    confidence = torch.zeros(atlas.height * atlas.width, device=points.device)
    confidence[texels.texel] = torch.where(known, 1 - torch.exp(-assignment.margin.clamp(0, 10)[texels.face]), 0.0)
    shape = (atlas.height, atlas.width)
    dense = fill_holes(texture.view(*shape, 3), mask.view(shape))
    return Selection(dense.clamp(0, 1), mask.view(shape), confidence.view(shape), assignment.view)


def sample_view(maps: ViewMaps, view: int, points: Tensor) -> Tensor:
    """Colors [N,3] float32 of world points [N,3] in a view, bicubic; pixels beyond the border repeat the last."""
    pose = maps.world_to_camera[view]
    seen = (points.double() @ pose[:3, :3].T + pose[:3, 3]).to(torch.float32)
    focal, principal = maps.intrinsics[view, :2], maps.intrinsics[view, 2:]
    pixel = seen[:, :2] / seen[:, 2:].clamp(min=1e-6) * focal + principal
    grid = pixel / pixel.new_tensor([maps.width, maps.height]) * 2 - 1
    image = maps.color[view].view(maps.height, maps.width, 3).permute(2, 0, 1)[None].to(torch.float32) / 255
    sampled = F.grid_sample(image, grid[None, None], mode="bicubic", padding_mode="border", align_corners=False)
    return sampled[0, :, 0].T.clamp(0, 1)

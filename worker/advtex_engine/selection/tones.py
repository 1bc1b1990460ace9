"""Tones from many photographs, detail from one: two bands of the texture (Baumberg 2002; Burt and Adelson 1983).

Each photograph shows a place a little too bright, too blue or with a sheen of its own. What is wide, as that is, many
photographs show alike, whatever a pixel of error displaces: their mean is nearer to what the next photograph will
show. What is fine would blur, and stays that of the one photograph. Photographs that show something else there, or in
another light than a sheen would explain, do not count.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from advtex_engine.core.scene import Mesh
from advtex_engine.render.texels import TexelMap
from advtex_engine.selection.candidates import Candidates, mean_colors
from advtex_engine.selection.leveling import Rings

REACH = 6.0  # texels, about the standard deviation of the means over the surface: what is finer is detail
MOST_RINGS = 64  # where faces are smaller than texels the reach shrinks, and the time does not grow
SCALE = 0.05  # difference in color, of 1, beyond which a photograph hardly counts


def shared_tones(mesh: Mesh, texels: TexelMap, color: Tensor, known: Tensor, candidates: Candidates) -> Tensor:
    """[N,3] what to add to the colors of N texels so that their wide means are those of all photographs.

    color: [N,3] in [0,1], of one photograph each; known: [N] bool, the others are left as they are. candidates: of the
    mesh's faces, whose data terms say how much each photograph counts beside the best. Not differentiable.
    """
    faces = len(mesh.t_pos_idx)
    sums = color.new_zeros((faces, 4))
    sums.index_add_(0, texels.face[known], torch.cat((color[known], torch.ones_like(color[known, :1])), 1))
    count = sums[:, 3:]
    difference = mean_colors(candidates.color) - (sums[:, :3] / count.clamp(min=1))[:, None]
    worse = candidates.cost - candidates.cost.amin(1, keepdim=True)
    weight = torch.exp(-worse - difference.square().mean(2) / (2 * SCALE**2)) * (candidates.view >= 0) * (count > 0)
    total = weight.sum(1, keepdim=True)
    lacking = (difference * weight[..., None]).sum(1) / total.clamp(min=1e-6)
    field = _spread(mesh, torch.cat((lacking, torch.ones_like(total)), 1) * (total > 1e-6), _rings(texels, faces))
    added = (field[mesh.t_pos_idx[texels.face]] * texels.barycentric.clamp(min=0)[..., None]).sum(1)
    return torch.where(known[:, None], added, 0.0)


def _rings(texels: TexelMap, faces: int) -> int:
    """How often means over neighboring vertices are taken for REACH, by how long the sides of the mean face are."""
    side = math.sqrt(2 * max(1, len(texels.texel)) / faces)
    return min(MOST_RINGS, math.ceil((REACH / side) ** 2))


def _spread(mesh: Mesh, values: Tensor, rings: int) -> Tensor:
    """Values [T,4] of faces, the last their weight -> [V,3], means over neighborhoods of the vertices by area."""
    corners = mesh.v_pos[mesh.t_pos_idx]
    area = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).norm(dim=1)
    # As shares of the mean face, or a scan in millimetres would vanish in float32.
    shares = values * (area / area.mean().clamp(min=1e-30))[:, None]
    field = values.new_zeros((len(mesh.v_pos), 4))
    for corner in mesh.t_pos_idx.unbind(1):
        field.index_add_(0, corner, shares)
    field = Rings(mesh.t_pos_idx, len(mesh.v_pos)).fade(field, rings)
    return field[:, :3] / field[:, 3:].clamp(min=1e-6)

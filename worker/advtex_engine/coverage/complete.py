"""Every texel of a texture is seen, guessed from beside it, or unseen; and has a color.

Seen: a photograph shows it. Guessed: no photograph does, but one shows the surface within GUESS_REACH of it, along the
surface and without passing a fold. Unseen: all else. What is not seen takes the tone of its surroundings on the
surface, whatever lies beside it in the texture: between the vertices that photographs show, colors are harmonic
(`smooth_surface.py`), and where a chart's seen texels border on others, their difference to these tones fades out.
Pieces between folds of which nothing is seen have the model's mean tone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from advtex_engine.core.scene import Atlas
from advtex_engine.coverage.smooth_surface import FOLD, SmoothSurface, connected, cut_at_folds, distances, harmonic
from advtex_engine.render.texels import TexelMap, map_texels, surface_points
from advtex_engine.render.texture import fill_holes

UNSEEN, GUESSED, SEEN = 0, 128, 255
"""The states, as `model_seen.png` has them. Texels between charts are as those beside them, or else UNSEEN."""
GUESS_REACH = 0.05
"""Metres: up to here, a guess is half as far from what was hidden for a test as the model's mean tone is."""
GRAY = 0.5
DETAIL_STEPS = 24  # texels over which the detail of seen texels fades


@dataclass(frozen=True)
class Completed:
    """texture: [H,W,3] float, defined everywhere. state: [H,W] uint8, UNSEEN, GUESSED or SEEN.

    faces: [T] bool, of which anything is seen or guessed. shares: of the surface's area, by the states' names.
    """

    texture: Tensor
    state: Tensor
    faces: Tensor
    shares: dict[str, float]


def complete_texture(
    atlas: Atlas, texture: Tensor, seen: Tensor, *, made_up: Tensor | None = None, gray: bool = False
) -> Completed:
    """The texture with a guess wherever it is not seen. Not differentiable.

    texture: [H,W,3] float in [0,1]; seen: [H,W] bool, texels that stay as they are; both on the atlas's device.
    made_up: [T] bool, faces that close holes: they keep what photographs show there, and never count as seen. gray:
    what is unseen is gray instead.
    """
    assert texture.shape == (atlas.height, atlas.width, 3)
    assert seen.shape == texture.shape[:2]
    texels, surface = map_texels(atlas), cut_at_folds(atlas.mesh)
    points = surface_points(atlas.mesh, texels)
    known = seen.flatten()[texels.texel]
    sure = known if made_up is None else known & ~made_up[texels.face]
    reach = _seen_distance(surface, texels, points, sure)
    reach = _nearer_texels(_links(atlas, texels, surface, ~sure), points, reach)
    links = _links(atlas, texels, surface, ~known)
    color = _guess(surface, texels, links, texture.reshape(-1, 3)[texels.texel], known)
    state = torch.where(sure, SEEN, torch.where(reach <= GUESS_REACH, GUESSED, UNSEEN)).to(torch.uint8)
    if gray:
        color[state == UNSEEN] = GRAY
    states = torch.zeros(seen.numel(), dtype=torch.uint8, device=seen.device)
    states[seen.flatten()] = SEEN
    states[texels.texel] = state
    whole = texture.reshape(-1, 3).clone()
    whole[texels.texel] = color.to(whole)
    mapped = seen.flatten().clone()
    mapped[texels.texel] = True
    # Between charts, so that filtering across their borders never bleeds.
    whole = fill_holes(whole.view(texture.shape), mapped.view(seen.shape))
    states = states.view(seen.shape)
    shares, shown = _measured(atlas, texels, state, states)
    return Completed(whole, states, shown, shares)


@dataclass(frozen=True)
class _Links:
    """Texels that no photograph shows, and those of four neighbors that lie on the same surface.

    texel: [M] int64, rows of the texel map. neighbor: [M,4] int64, likewise; the texel itself where there is none.
    """

    texel: Tensor
    neighbor: Tensor


def _links(atlas: Atlas, texels: TexelMap, surface: SmoothSurface, unknown: Tensor) -> _Links:
    """Neighbors of the texels `unknown` [N]: of the same chart, and not across a fold."""
    mesh = atlas.mesh
    assert mesh.t_uv_idx is not None
    corners = mesh.t_uv_idx
    pairs = corners[:, :1].expand(-1, 2).flatten(), corners[:, 1:].flatten()
    chart = connected(*pairs, int(corners.max()) + 1)[corners[:, 0]]
    row_of = torch.full((atlas.height * atlas.width,), -1, dtype=torch.int32, device=corners.device)
    row_of[texels.texel] = torch.arange(len(texels.texel), dtype=torch.int32, device=corners.device)
    rows = unknown.nonzero()[:, 0]
    texel, face = texels.texel[rows], texels.face[rows]
    row, column = texel // atlas.width, texel % atlas.width
    neighbors = []
    for down, right in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        there = (row + down).clamp(0, atlas.height - 1) * atlas.width + (column + right).clamp(0, atlas.width - 1)
        other = row_of[there].long()
        beside = texels.face[other.clamp(min=0)]
        flat = (surface.normals[face] * surface.normals[beside]).sum(1) > math.cos(math.radians(FOLD))
        linked = (other >= 0) & (chart[face] == chart[beside]) & (flat | (face == beside))
        neighbors.append(torch.where(linked, other, rows))
    return _Links(rows, torch.stack(neighbors, 1))


def _seen_distance(surface: SmoothSurface, texels: TexelMap, points: Tensor, known: Tensor) -> Tensor:
    """Metres [N] from each texel to one that is `known` [N], by way of the vertices; infinite beyond GUESS_REACH."""
    corners = surface.corners[texels.face]
    to_corner = torch.stack([(surface.position[corners[:, side]] - points).norm(dim=1) for side in range(3)], 1)
    of_vertex = torch.full((len(surface.position),), torch.inf, device=points.device)
    of_vertex.scatter_reduce_(0, corners[known].flatten(), to_corner[known].flatten(), "amin")
    of_vertex = distances(surface, of_vertex, GUESS_REACH)
    return torch.where(known, 0.0, (of_vertex[corners] + to_corner).amin(1))


def _nearer_texels(links: _Links, points: Tensor, distance: Tensor) -> Tensor:
    """The distances [N] with the shorter ways from texel to texel: a large face has its corners far away."""
    step = (points[links.neighbor] - points[links.texel, None]).norm(dim=2)
    while True:
        nearest = torch.minimum((distance[links.neighbor] + step).amin(1), distance[links.texel])
        shorter = (nearest < distance[links.texel]) & (nearest <= GUESS_REACH)
        if not bool(shorter.any()):
            return distance
        distance = distance.index_copy(0, links.texel[shorter], nearest[shorter])


def _guess(surface: SmoothSurface, texels: TexelMap, links: _Links, color: Tensor, known: Tensor) -> Tensor:
    """Colors [N,3] of all texels; those of the `known` [N] are their own."""
    corners, weights = surface.corners[texels.face], texels.barycentric.clamp(min=0)
    total = torch.zeros((len(surface.position), 4), device=color.device)
    four = torch.cat((color.float(), torch.ones_like(color[:, :1], dtype=torch.float32)), 1)
    for side in range(3):
        total.index_add_(0, corners[known, side], four[known] * weights[known, side, None])
    value = total[:, :3] / total[:, 3:].clamp(min=1e-12)
    value, has = harmonic(surface, value, total[:, 3] > 0)
    seen = four[known, :3]
    value = torch.where(has[:, None], value, seen.mean(0) if len(seen) else torch.full_like(value[:1], GRAY))
    tone = torch.stack([value[corners[:, side]] * weights[:, side, None] for side in range(3)]).sum(0)
    tone /= weights.sum(1, keepdim=True)
    difference = torch.where(known[:, None], four[:, :3] - tone, 0.0)
    for _ in range(DETAIL_STEPS):
        difference[links.texel] = difference[links.neighbor].mean(1)
    return torch.where(known[:, None], four[:, :3], (tone + difference).clamp(0, 1))


def _measured(atlas: Atlas, texels: TexelMap, state: Tensor, states: Tensor) -> tuple[dict[str, float], Tensor]:
    """Shares of the surface's area, and [T] bool, faces of which anything is seen or guessed.

    A face's area is shared among the texels whose centers lie on it; one that has none is as the texel at its middle.
    """
    mesh = atlas.mesh
    assert mesh.v_uv is not None
    assert mesh.t_uv_idx is not None
    count = len(mesh.t_pos_idx)
    a, b, c = mesh.v_pos[mesh.t_pos_idx].double().unbind(1)
    area = torch.linalg.cross(b - a, c - a).norm(dim=1)
    on = texels.barycentric.amin(1) >= 0
    texels_of = torch.bincount(texels.face[on], minlength=count)
    size = states.new_tensor([atlas.width, atlas.height], dtype=torch.float64)
    middle = (mesh.v_uv[mesh.t_uv_idx].double().mean(1) * size).long().clamp(min=0)
    column, row = middle[:, 0].clamp(max=atlas.width - 1), middle[:, 1].clamp(max=atlas.height - 1)
    of_middle = states[row, column]
    shown = of_middle != UNSEEN
    shown[texels.face[state != UNSEEN]] = True
    shares = {}
    for name, wanted in (("seen", SEEN), ("guessed", GUESSED), ("unseen", UNSEEN)):
        mine = torch.bincount(texels.face[on & (state == wanted)], minlength=count).double()
        share = torch.where(texels_of > 0, mine / texels_of.clamp(min=1), (of_middle == wanted).double())
        shares[name] = float((share * area).sum() / area.sum().clamp(min=1e-30))
    return shares, shown

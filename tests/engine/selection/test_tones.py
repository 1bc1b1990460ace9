"""Wide means of many photographs under the detail of one, on a plane of squares of four texels."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from advtex_engine.core.scene import Atlas, Mesh
from advtex_engine.render.texels import TexelMap, map_texels
from advtex_engine.selection.candidates import NO_VIEW, POINTS, Candidates
from advtex_engine.selection.tones import REACH, SCALE, shared_tones

CELLS = 24
SIDE = 4 * CELLS


def plane(size: float = 1.0) -> tuple[Mesh, TexelMap]:
    """A square of `size` metres at z = 0, and its texels."""
    line = torch.linspace(0, size, CELLS + 1)
    y, x = torch.meshgrid(line, line, indexing="ij")
    position = torch.stack((x, y, torch.zeros_like(x)), 2).view(-1, 3)
    corner = (torch.arange(CELLS)[:, None] * (CELLS + 1) + torch.arange(CELLS)).flatten()
    a, b, c, d = corner, corner + 1, corner + CELLS + 2, corner + CELLS + 1
    faces = torch.cat((torch.stack((a, b, c), 1), torch.stack((a, c, d), 1)))
    mesh = Mesh(position, faces, position[:, :2] / size, faces)
    return mesh, map_texels(Atlas(mesh, SIDE, SIDE, "scan", 1))


def seen(mesh: Mesh, *shown: float | Tensor) -> Candidates:
    """Photographs, each of one gray or of one per face [T], that are equally good; then an empty place."""
    faces = len(mesh.t_pos_idx)
    grays = torch.stack([torch.as_tensor(gray, dtype=torch.float32).expand(faces) for gray in (*shown, 0.0)], 1)
    view = torch.arange(len(shown) + 1).expand(faces, -1).clone()
    view[:, -1] = -1
    cost = torch.where(view < 0, NO_VIEW, 1.0)
    color = (grays * 255).round().to(torch.uint8)[:, :, None, None].expand(-1, -1, POINTS, 3)
    return Candidates(view, cost, torch.zeros_like(cost), color)


def added_to(mesh: Mesh, texels: TexelMap, color: float | Tensor, candidates: Candidates) -> Tensor:
    """[N]; color of all texels, or [N]."""
    colors = torch.as_tensor(color, dtype=torch.float32).expand(len(texels.texel))[:, None].expand(-1, 3).contiguous()
    known = torch.ones(len(texels.texel), dtype=torch.bool)
    added = shared_tones(mesh, texels, colors, known, candidates)
    assert torch.equal(added[:, 0], added[:, 2])
    return added[:, 0]


def test_the_tone_becomes_the_weighted_mean_of_the_photographs() -> None:
    mesh, texels = plane()
    candidates = seen(mesh, 0.4, 0.44, 0.46)
    candidates.cost[:, 2] += math.log(2)  # its photograph counts half as much
    grays = torch.tensor([0.4, 0.44, 0.46]).mul(255).round() / 255 - 0.4
    weights = torch.tensor([1, 1, 0.5]) * torch.exp(-grays.square() / (2 * SCALE**2))
    torch.testing.assert_close(
        added_to(mesh, texels, 0.4, candidates), ((grays * weights).sum() / weights.sum()).expand(len(texels.texel))
    )


def test_a_scan_in_millimetres_is_toned_alike() -> None:
    (mesh, texels), (small, same) = plane(), plane(1e-3)
    x = mesh.v_pos[mesh.t_pos_idx].mean(1)[:, 0]
    torch.testing.assert_close(
        added_to(mesh, texels, 0.5, seen(mesh, 0.5, 0.5 + 0.05 * x)),
        added_to(small, same, 0.5, seen(small, 0.5, 0.5 + 0.05 * x)),
    )


def test_what_shows_something_else_does_not_count() -> None:
    mesh, texels = plane()
    assert float(added_to(mesh, texels, 0.4, seen(mesh, 0.4, 0.9)).abs().max()) < 1e-3


def test_detail_stays_the_photographs_own() -> None:
    """Stripes of two squares in one photograph, none in the other: all that is added is the other's mean."""
    mesh, texels = plane()
    x = mesh.v_pos[mesh.t_pos_idx].mean(1)[:, 0]
    stripes = 0.5 + 0.04 * (x * CELLS / 2).floor().remainder(2)
    added = added_to(mesh, texels, stripes[texels.face], seen(mesh, stripes, 0.56))
    inner = (texels.texel % SIDE - SIDE / 2).abs() < SIDE / 4
    assert float(added[inner].max() - added[inner].min()) < 0.004
    assert 0.01 < float(added[inner].mean()) < 0.025


def test_a_step_of_tone_is_spread_over_the_reach() -> None:
    mesh, texels = plane()
    right = mesh.v_pos[mesh.t_pos_idx].mean(1)[:, 0] > 0.5
    added = added_to(mesh, texels, 0.4, seen(mesh, 0.4, torch.where(right, 0.44, 0.4)))
    across = torch.zeros(SIDE).index_add_(0, texels.texel % SIDE, added) / SIDE
    assert float(across[-10]) > 0.015
    assert float(across[10]) < 0.001
    slope = across.diff()
    mean = (slope * torch.arange(1, SIDE)).sum() / slope.sum()
    width = ((slope * (torch.arange(1, SIDE) - mean).square()).sum() / slope.sum()).sqrt()
    assert 0.6 * REACH < float(width) < 1.4 * REACH


def test_texels_that_no_photograph_shows_stay_as_they_are() -> None:
    mesh, texels = plane()
    color = torch.full((len(texels.texel), 3), 0.5)
    known = texels.texel % SIDE < SIDE / 2
    color[~known] = 0.0
    added = shared_tones(mesh, texels, color, known, seen(mesh, 0.5, 0.55))
    assert bool((added[~known] == 0).all())
    torch.testing.assert_close(added[known], added[known][:1].expand_as(added[known]))


def test_nothing_is_added_where_there_is_no_candidate() -> None:
    mesh, texels = plane()
    candidates = seen(mesh)
    assert bool((added_to(mesh, texels, 0.5, candidates) == 0).all())

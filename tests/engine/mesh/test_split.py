"""Large faces are cut into small ones of the same surface and the same texture."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from advtex_engine.core.scene import Atlas, Mesh, face_areas
from advtex_engine.mesh.split import split_long_sides
from advtex_engine.render.texels import map_texels, surface_points
from advtex_engine.selection.mrf import face_adjacency

SIDE = 128


def fan(corners: int, seed: int) -> Atlas:
    """Faces of all shapes around a vertex, each half of them with texture coordinates of its own."""
    generator = torch.Generator().manual_seed(seed)
    step = torch.rand(corners, generator=generator).clamp(min=0.05)
    angle = 2 * torch.pi * step.cumsum(0) / step.sum()
    radius = 0.2 + 0.8 * torch.rand(corners, generator=generator)
    rim = torch.stack((radius * angle.cos(), radius * angle.sin()), 1)
    flat = torch.cat((torch.zeros(1, 2), rim))
    number = torch.arange(corners)
    faces = torch.stack((torch.zeros_like(number), number + 1, (number + 1) % corners + 1), 1)
    position = torch.cat((flat, torch.rand((len(flat), 1), generator=generator)), 1)
    uv = torch.cat((0.25 + 0.24 * flat, 0.75 + 0.24 * flat))
    return Atlas(
        Mesh(position, faces, uv, faces + (number >= corners // 2)[:, None] * len(flat)), SIDE, SIDE, "scan", 2
    )


def sides(atlas: Atlas) -> Tensor:
    """[T,3] texels."""
    assert atlas.mesh.v_uv is not None
    assert atlas.mesh.t_uv_idx is not None
    corners = SIDE * atlas.mesh.v_uv[atlas.mesh.t_uv_idx]
    length: Tensor = (corners.roll(-1, 1) - corners).norm(dim=2)
    return length


@given(st.integers(3, 12), st.integers(0, 1000), st.floats(3, 60))
def test_no_side_is_longer_and_neighbors_stay_neighbors(corners: int, seed: int, longest: float) -> None:
    atlas = fan(corners, seed)
    cut = split_long_sides(atlas, longest)
    assert sides(cut).max() <= longest
    assert float(face_areas(cut.mesh).sum()) == pytest.approx(float(face_areas(atlas.mesh).sum()), rel=1e-4)
    # A disk: inner sides have two faces each, and Euler's number is 1, whatever it is cut into.
    inner = len(face_adjacency(cut.mesh.t_pos_idx).face)
    edges = 3 * len(cut.mesh.t_pos_idx) - inner
    assert len(cut.mesh.v_pos) - edges + len(cut.mesh.t_pos_idx) == 1


@pytest.mark.parametrize("longest", [5.0, 17.0])
def test_every_texel_shows_the_same_place(longest: float) -> None:
    atlas = fan(7, 3)
    cut = split_long_sides(atlas, longest)
    assert len(cut.mesh.t_pos_idx) > 2 * len(atlas.mesh.t_pos_idx)
    found = []
    for each in (atlas, cut):
        texels = map_texels(each)
        places = torch.full((SIDE * SIDE, 3), torch.nan)
        places[texels.texel] = surface_points(each.mesh, texels)
        inside = torch.zeros(SIDE * SIDE, dtype=torch.bool)
        inside[texels.texel] = (texels.barycentric >= 0).all(1)
        found.append((places, inside))
    (before, inside), (after, still) = found
    assert torch.equal(inside, still)
    assert inside.sum() > 500
    assert torch.allclose(before[inside], after[inside], atol=1e-4)
    # Beside charts, thin faces are followed along their own sides.
    assert (before.isnan() ^ after.isnan()).any(1).sum() < 0.12 * inside.sum()


def test_faces_keep_their_front() -> None:
    cut = split_long_sides(fan(9, 5), 7.0)
    assert cut.mesh.t_uv_idx is not None
    assert cut.mesh.v_uv is not None
    a, b, c = cut.mesh.v_uv[cut.mesh.t_uv_idx].unbind(1)
    assert ((b - a)[:, 0] * (c - a)[:, 1] > (b - a)[:, 1] * (c - a)[:, 0]).all()


def test_an_atlas_of_small_faces_stays_as_it_is() -> None:
    atlas = fan(5, 0)
    assert split_long_sides(atlas, float(sides(atlas).max()) + 1) is atlas

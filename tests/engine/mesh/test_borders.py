"""Pinholes and notches of a scanned mesh's border."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh

from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import Mesh
from advtex_engine.mesh.borders import close_pinholes, fill_notches, grow_borders, mend_borders
from advtex_engine.mesh.clean import decimate


def make(positions: list[tuple[float, float, float]], faces: list[list[int]]) -> Mesh:
    return Mesh(torch.tensor(positions, dtype=torch.float32), torch.tensor(faces))


def grid(side: int, without: set[int]) -> Mesh:
    """A flat square of side x side cells, two faces each; the faces of `without` are left out."""
    positions = [(float(x), float(y), 0.0) for y in range(side + 1) for x in range(side + 1)]
    faces = []
    for y in range(side):
        for x in range(side):
            a, b = y * (side + 1) + x, (y + 1) * (side + 1) + x
            faces += [[a, a + 1, b + 1], [a, b + 1, b]]
    return make(positions, [face for index, face in enumerate(faces) if index not in without])


def area_vectors(mesh: Mesh) -> torch.Tensor:
    a, b, c = mesh.v_pos[mesh.t_pos_idx].unbind(1)
    return torch.linalg.cross(b - a, c - a) / 2


@pytest.mark.parametrize("hole", [{88}, {88, 89}, {88, 89, 90, 91}])
def test_pinholes_are_closed_in_the_direction_of_their_neighbors(hole: set[int]) -> None:
    closed = close_pinholes(grid(10, hole))
    areas = area_vectors(closed)
    assert float(areas[:, 2].sum()) == pytest.approx(100.0)
    assert bool((areas[:, 2] > 0).all())
    watertight = trimesh.Trimesh(closed.v_pos.numpy(), closed.t_pos_idx.numpy(), process=False)
    assert len(trimesh.grouping.group_rows(watertight.edges_sorted, require_count=1)) == 40  # the outer border


def test_two_pinholes_that_touch_in_a_vertex_keep_the_mesh_as_it_is() -> None:
    around = grid(10, {88, 110})  # faces of two cells that share a corner only
    assert close_pinholes(around).t_pos_idx.shape == around.t_pos_idx.shape


def test_large_holes_and_separate_pieces_stay() -> None:
    missing = {2 * (10 * y + x) + side for y in range(3, 7) for x in range(3, 7) for side in (0, 1)}
    open_square = grid(10, missing)
    assert close_pinholes(open_square) is open_square
    piece = make([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], [[0, 1, 2], [0, 2, 3]])
    assert close_pinholes(piece) is piece


def test_a_toothed_border_is_straightened_and_nothing_else() -> None:
    side = 10
    teeth = {2 * (side * (side - 1) + x) + 1 for x in range(side)}  # the upper triangle of each cell of the last row
    toothed = grid(side, teeth)
    filled = fill_notches(toothed)
    areas = area_vectors(filled)[:, 2]
    assert bool((areas > 0).all())
    # The first cell's tooth has no neighbor to the left: it is a slope, not a notch.
    assert float(areas.sum()) == pytest.approx(side * side - 0.5)


def test_corners_wider_than_a_notch_stay() -> None:
    missing = {2 * (10 * y + x) + part for y in range(5, 10) for x in range(5, 10) for part in (0, 1)}
    corner = grid(10, missing)
    filled = float(area_vectors(mend_borders(corner))[:, 2].sum())
    assert filled - float(area_vectors(corner)[:, 2].sum()) <= 2.0


def test_a_drawn_mesh_keeps_its_openings() -> None:
    box = trimesh.creation.box()
    faces = torch.from_numpy(box.faces.astype("int64"))[2:]
    opened = Mesh(torch.from_numpy(box.vertices.astype("float32")), faces)
    assert decimate(opened, 80_000, Monitor()) is opened


def test_borders_grow_outward_in_their_plane_and_nothing_else_moves() -> None:
    sheet = grid(10, without={2 * (10 * y + x) + side for y in range(4, 6) for x in range(4, 6) for side in (0, 1)})
    grown = grow_borders(sheet, 0.1)
    before, after = sheet.v_pos, grown.v_pos
    assert grown.t_pos_idx is sheet.t_pos_idx
    moved = (after - before).norm(dim=1)
    inside = ((before[:, :2] - 5).abs().amax(1) < 5) & ((before[:, :2] - 5).abs().amax(1) > 1)
    assert float(moved[inside].max()) == 0.0
    assert float(moved.max()) <= 0.1 + 1e-6
    assert torch.equal(after[:, 2], before[:, 2])
    left = (before[:, 0] == 0) & (before[:, 1] > 0) & (before[:, 1] < 10)
    np.testing.assert_allclose(after[left], before[left] - torch.tensor([0.1, 0.0, 0.0]), atol=1e-6)
    into_the_hole = (before == torch.tensor([4.0, 5.0, 0.0])).all(dim=1)
    np.testing.assert_allclose(after[into_the_hole], [[4.1, 5.0, 0.0]], atol=1e-6)


def test_a_closed_mesh_does_not_grow() -> None:
    sphere = trimesh.creation.icosphere(subdivisions=2)
    mesh = make(sphere.vertices.tolist(), sphere.faces.tolist())
    assert torch.equal(grow_borders(mesh, 0.1).v_pos, mesh.v_pos)

"""Pinholes and notches of a scanned mesh's border."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import Camera, DepthFrame, Mesh
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


def flat(x: torch.Tensor, _: torch.Tensor) -> torch.Tensor:
    return torch.full_like(x, 10.0)


def above(side: int, depth: Callable[[torch.Tensor, torch.Tensor], torch.Tensor]) -> DepthFrame:
    """Of a camera that looks down on `grid(side)` and a metre around it from 10 m, 40 pixels a metre.

    depth: of the pixels' world x and y [H,W], metres.
    """
    pixels = 40 * (side + 2)
    K = torch.tensor([[400.0, 0, pixels / 2], [0, 400.0, pixels / 2], [0, 0, 1]], dtype=torch.float64)
    # x right, y down, z forward: turned by half a turn about the world's x.
    camera_to_world = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
    camera_to_world[:3, 3] = torch.tensor([side / 2, side / 2, 10.0])
    camera = Camera(K, torch.linalg.inv(camera_to_world), pixels, pixels)
    across = (torch.arange(pixels) + 0.5) / 40 - 1
    y, x = torch.meshgrid(side - across, across, indexing="ij")
    return DepthFrame(camera, depth(x, y).float())


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
    filled = fill_notches(toothed, [above(side, flat)] * 2)
    areas = area_vectors(filled)[:, 2]
    assert bool((areas > 0).all())
    # The first cell's tooth has no neighbor to the left: it is a slope, not a notch.
    assert float(areas.sum()) == pytest.approx(side * side - 0.5)


def test_teeth_stay_where_the_frames_look_past_them() -> None:
    toothed = grid(10, {2 * (10 * 9 + x) + 1 for x in range(10)})
    between = above(10, lambda _, y: torch.where(y > 9, 12.0, 10.0))
    assert fill_notches(toothed, [between]) is toothed
    assert len(fill_notches(toothed, []).t_pos_idx) > len(toothed.t_pos_idx)


def test_corners_wider_than_a_notch_stay() -> None:
    missing = {2 * (10 * y + x) + part for y in range(5, 10) for x in range(5, 10) for part in (0, 1)}
    corner = grid(10, missing)
    filled = float(area_vectors(mend_borders(corner, [above(10, flat)] * 2))[:, 2].sum())
    assert filled - float(area_vectors(corner)[:, 2].sum()) <= 2.0


def test_a_drawn_mesh_keeps_its_openings() -> None:
    box = trimesh.creation.box()
    faces = torch.from_numpy(box.faces.astype("int64"))[2:]
    opened = Mesh(torch.from_numpy(box.vertices.astype("float32")), faces)
    assert decimate(opened, 80_000, Monitor()) is opened


def test_borders_grow_outward_as_far_as_depth_shows_that_the_surface_goes_on() -> None:
    sheet = grid(10, without={2 * (10 * y + x) + side for y in range(4, 6) for x in range(4, 6) for side in (0, 1)})

    def ten(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        """Goes on by .3 m to the left, without end above, not at all to the right; below there are no readings."""
        depth = torch.where((x < -0.3) | (x > 10), 12.0, 10.0)
        return torch.where(y < 0, 0.0, depth)

    grown = grow_borders(sheet, 1.0, [above(10, ten)] * 2)
    before, after = sheet.v_pos, grown.v_pos
    assert grown.t_pos_idx is sheet.t_pos_idx
    moved = after - before
    middle = (before[:, :2] > 0).all(1) & (before[:, :2] < 10).all(1)
    inside = middle & ((before[:, :2] - 5).abs().amax(1) > 1)
    assert float(moved[inside].norm(dim=1).max()) == 0.0
    assert float(moved[:, 2].abs().max()) == 0.0
    left, low = before[:, 0] == 0, before[:, 1] == 0
    along_x, along_y = ((before[:, axis] > 0) & (before[:, axis] < 10) for axis in (0, 1))
    for place, step in (
        (left & along_y, (-0.15, 0.0)),
        ((before[:, 1] == 10) & along_x, (0.0, 0.5)),
        ((before[:, 0] == 10) & along_y, (0.0, 0.0)),
        (low & along_x, (0.0, -0.15)),
        ((before == torch.tensor([4.0, 5.0, 0.0])).all(dim=1), (0.5, 0.0)),  # into the hole
    ):
        assert bool(place.any())
        np.testing.assert_allclose(moved[place, :2], torch.tensor(step).expand(int(place.sum()), 2), atol=1e-6)


def test_borders_grow_a_little_where_nothing_is_known_and_more_where_two_frames_agree() -> None:
    sheet = grid(10, without=set())
    frame = above(10, flat)
    unsure = replace(frame, confidence=torch.zeros_like(frame.depth))
    past = replace(frame, depth=frame.depth + 2)
    for frames, step in (
        ([], 0.15),
        ([unsure, unsure], 0.15),
        ([frame], 0.15),
        ([frame, frame], 0.5),
        ([frame, frame, past], 0.5),
        ([frame, frame, past, past], 0.15),
        ([frame, past, past], 0.0),
    ):
        moved = (grow_borders(sheet, 1.0, frames).v_pos - sheet.v_pos).norm(dim=1)
        assert float(moved.max()) == pytest.approx(step, abs=1e-6)


def test_a_closed_mesh_does_not_grow() -> None:
    sphere = trimesh.creation.icosphere(subdivisions=2)
    mesh = make(sphere.vertices.tolist(), sphere.faces.tolist())
    assert torch.equal(grow_borders(mesh, 0.1, [above(2, flat)] * 2).v_pos, mesh.v_pos)

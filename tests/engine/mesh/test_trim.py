"""What is left out of a mesh: outside of a box, and floaters."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from atlases import bumpy_sphere, of_trimesh

from advtex_engine.core.errors import ScanError
from advtex_engine.core.scene import TO_Y_UP, Mesh
from advtex_engine.mesh.faces import keep_faces
from advtex_engine.mesh.trim import FLOATER_DISTANCE, crop, drop_floaters, in_box
from advtex_options.box import Box


@pytest.mark.parametrize("up_axis", TO_Y_UP)
def test_a_box_turns_counter_clockwise_seen_from_above(up_axis: str) -> None:
    x, y, z, w = TO_Y_UP[up_axis]
    to_y_up = trimesh.transformations.quaternion_matrix([w, x, y, z])[:3, :3]
    generator = np.random.default_rng(0)
    points = torch.from_numpy(generator.uniform(-2, 2, (500, 3)))
    box = Box((0.3, -0.2, 0.1), (1.0, 2.0, 3.0), yaw=30)
    turned = in_box(points, box, up_axis)
    # The twin turns the points back in a world whose y is up: seen from above, x is right and -z is ahead.
    above = (points.numpy() - box.center) @ to_y_up.T
    back = trimesh.transformations.rotation_matrix(math.radians(-box.yaw), [0, 1, 0])[:3, :3]
    plain = in_box(
        torch.from_numpy(above @ back.T @ to_y_up) + torch.tensor(box.center), replace(box, yaw=0.0), up_axis
    )
    assert torch.equal(turned, plain)
    assert not torch.equal(turned, in_box(points, replace(box, yaw=0.0), up_axis))


def test_faces_with_their_middle_in_the_box_stay_as_they_are() -> None:
    mesh = bumpy_sphere(3)
    cropped = crop(mesh, Box((0, 0, 1), (4, 4, 2)), "+z")
    middles = mesh.v_pos[mesh.t_pos_idx].mean(1)
    assert torch.equal(cropped.v_pos[cropped.t_pos_idx], mesh.v_pos[mesh.t_pos_idx][middles[:, 2] >= 0])
    assert len(torch.unique(cropped.t_pos_idx)) == len(cropped.v_pos)
    assert crop(mesh, Box((0, 0, 0), (4, 4, 4), 45), "+z") is mesh


def test_an_empty_box_is_refused_and_told_where_the_mesh_is() -> None:
    with pytest.raises(
        ScanError, match=r"nothing of the mesh lies in it; the mesh reaches from \(-1\.\d+, .*widen the box"
    ):
        crop(bumpy_sphere(2), Box((9, 9, 9), (1, 1, 1)), "+z")


def joined(*parts: Mesh) -> Mesh:
    starts = np.cumsum([0, *(len(part.v_pos) for part in parts)])
    faces = [part.t_pos_idx + int(start) for part, start in zip(parts, starts, strict=False)]
    return Mesh(torch.cat([part.v_pos for part in parts]), torch.cat(faces))


def ball(radius: float, center: tuple[float, float, float], subdivisions: int) -> Mesh:
    mesh = of_trimesh(trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius))
    return Mesh(mesh.v_pos + torch.tensor(center), mesh.t_pos_idx)


BODY = ball(1.0, (0, 0, 0), 5)
CRUMBS = [ball(0.01, (1.02 + 0.03 * number, 0, 0), 1) for number in range(3)]  # 80 faces each
DRIFTER = ball(0.02, (0, 0, 1.02 + FLOATER_DISTANCE + 0.01), 3)  # 1,280 faces, away from all else


def test_small_pieces_of_few_faces_or_far_away_are_dropped_and_counted() -> None:
    near = ball(0.02, (0, 0, -1.02 - FLOATER_DISTANCE + 0.01), 3)  # of many faces, and not far
    mesh, dropped = drop_floaters(joined(CRUMBS[0], BODY, CRUMBS[1], DRIFTER, near, CRUMBS[2]))
    assert dropped == 4
    expected = joined(BODY, near)
    assert torch.equal(mesh.v_pos, expected.v_pos)
    assert torch.equal(mesh.t_pos_idx, expected.t_pos_idx)


def test_a_long_thing_of_few_faces_stays_where_something_is_near() -> None:
    """The rails of a chair in a room of large faces: 44 faces of 13 cm² each."""
    floor = of_trimesh(trimesh.creation.box((8.0, 8.0, 0.1)))
    rail = of_trimesh(trimesh.creation.box((0.36, 0.02, 0.06)))
    for height, kept in ((0.1, True), (FLOATER_DISTANCE + 0.1, False)):
        lifted = Mesh(rail.v_pos + torch.tensor([0.0, 0.0, height]), rail.t_pos_idx)
        mesh, dropped = drop_floaters(joined(floor, lifted))
        assert (len(mesh.t_pos_idx), dropped) == ((24, 0) if kept else (12, 1))


def test_a_mesh_without_floaters_stays_itself() -> None:
    second = ball(0.1, (3, 0, 0), 2)  # far away, and too large for a floater
    for mesh in (BODY, joined(BODY, second)):
        assert drop_floaters(mesh) == (mesh, 0)


def test_large_faces_are_near_where_their_vertices_are_not() -> None:
    floor = of_trimesh(trimesh.creation.box((8.0, 8.0, 0.1)))
    lamp = ball(0.02, (2.0, 1.0, 0.2), 3)
    kept, dropped = drop_floaters(joined(floor, lamp))
    assert dropped == 0
    assert len(kept.t_pos_idx) == 12 + 1280


def test_uv_follow_the_faces_that_stay() -> None:
    mesh = bumpy_sphere(1)
    count = len(mesh.t_pos_idx)
    with_uv = Mesh(mesh.v_pos, mesh.t_pos_idx, torch.rand(3 * count, 2), torch.arange(3 * count).view(-1, 3))
    kept = torch.arange(count) % 3 == 0
    part = keep_faces(with_uv, kept)
    assert part.v_uv is not None
    assert part.t_uv_idx is not None
    assert with_uv.v_uv is not None
    assert with_uv.t_uv_idx is not None
    assert torch.equal(part.v_uv[part.t_uv_idx], with_uv.v_uv[with_uv.t_uv_idx[kept]])
    assert len(part.v_uv) == 3 * int(kept.sum())

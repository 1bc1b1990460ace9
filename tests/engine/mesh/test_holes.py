"""Holes of a mesh are closed, by the least area, with the winding of what is around them."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import torch
import trimesh
from atlases import of_trimesh

from advtex_engine.core.scene import Mesh
from advtex_engine.mesh.holes import close_holes, least_area


def twin(mesh: Mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.v_pos.numpy(), mesh.t_pos_idx.numpy(), process=False)


def punched(mesh: trimesh.Trimesh, *directions: tuple[float, float, float], width: float) -> Mesh:
    """The mesh without the faces whose middles lie within `width` of these places."""
    middles = mesh.triangles_center
    away = [np.linalg.norm(middles - np.array(direction), axis=1) > width for direction in directions]
    return of_trimesh(trimesh.Trimesh(mesh.vertices, mesh.faces[np.all(away, axis=0)], process=True))


SPHERE = trimesh.creation.icosphere(subdivisions=4)


def test_a_sphere_with_holes_becomes_whole_again() -> None:
    open_ = punched(SPHERE, (0, 0, 1), (1, 0, 0), width=0.3)
    assert not twin(open_).is_watertight
    closed, holes = close_holes(open_, 4.0)
    assert holes == 2
    assert twin(closed).is_watertight
    assert twin(closed).is_winding_consistent
    assert torch.equal(closed.v_pos, open_.v_pos)
    assert torch.equal(closed.t_pos_idx[: len(open_.t_pos_idx)], open_.t_pos_idx)
    # The lids are flat, where the sphere is not.
    assert twin(closed).volume == pytest.approx(SPHERE.volume, rel=0.02)


def test_holes_with_a_longer_border_stay() -> None:
    mesh = punched(punched_sphere(), (1, 0, 0), width=0.1)
    closed, holes = close_holes(mesh, 1.2)
    assert holes == 1
    edges = trimesh.grouping.group_rows(twin(closed).edges_sorted, require_count=1)
    border = twin(closed).edges[edges]
    assert float(np.linalg.norm(np.diff(twin(closed).vertices[border], axis=1), axis=2).sum()) > 1.2
    assert close_holes(mesh, 0.05) == (mesh, 0)


def punched_sphere() -> trimesh.Trimesh:
    return twin(punched(SPHERE, (0, 0, 1), width=0.3))


def test_the_outer_border_of_a_sheet_is_no_hole_and_the_end_of_a_tube_is_one() -> None:
    sheet = of_trimesh(trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]]))
    assert close_holes(sheet, 100.0) == (sheet, 0)
    tube = trimesh.creation.cylinder(0.1, 1.0, sections=24)
    side = of_trimesh(trimesh.Trimesh(tube.vertices, tube.faces[np.abs(tube.face_normals[:, 2]) < 0.5], process=True))
    closed, holes = close_holes(side, 1.0)
    assert holes == 2
    assert twin(closed).is_watertight
    assert twin(closed).volume == pytest.approx(tube.volume, rel=1e-3)


def plain_least_area(place: np.ndarray) -> float:
    """The least area over all triangulations, tried one by one."""

    @cache
    def least(first: int, last: int) -> float:
        if last - first < 2:
            return 0.0
        return min(
            least(first, middle) + least(middle, last) + triangle(first, middle, last)
            for middle in range(first + 1, last)
        )

    def triangle(a: int, b: int, c: int) -> float:
        return float(np.linalg.norm(np.cross(place[b] - place[a], place[c] - place[a])) / 2)

    return least(0, len(place) - 1)


@pytest.mark.parametrize("count", [3, 4, 9, 20])
def test_the_area_is_the_least_there_is(count: int) -> None:
    generator = np.random.default_rng(count)
    angle = np.sort(generator.uniform(0, 2 * np.pi, count))
    radius = generator.uniform(0.3, 1.0, count)  # concave
    place = np.stack((radius * np.cos(angle), radius * np.sin(angle), generator.normal(0, 0.1, count)), axis=1)
    triangles = least_area(place)
    assert len(triangles) == count - 2
    a, b, c = np.moveaxis(place[triangles], 1, 0)
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2 == pytest.approx(plain_least_area(place))

"""Cleaning and decimation."""

from __future__ import annotations

import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from advtex_engine.core.errors import Problem, ScanError
from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import Mesh
from advtex_engine.mesh import quadric
from advtex_engine.mesh.clean import ROUNDS, clean, collapse_edges, decimate


class Listener(Monitor):
    def __init__(self) -> None:
        self.warnings: list[Problem] = []

    def warning(self, problem: Problem) -> None:
        self.warnings.append(problem)


def make(positions: list[tuple[float, float, float]], faces: list[list[int]]) -> Mesh:
    return Mesh(torch.tensor(positions, dtype=torch.float32), torch.tensor(faces))


def sphere(subdivisions: int) -> Mesh:
    twin = trimesh.creation.icosphere(subdivisions=subdivisions)
    return Mesh(torch.tensor(twin.vertices, dtype=torch.float32), torch.tensor(twin.faces))


def test_clean_merges_equal_vertices_in_order_of_appearance() -> None:
    mesh = make([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 1, -0.0), (1, 0, 0), (1, 1, 0)], [[0, 1, 2], [3, 4, 5]])
    cleaned = clean(mesh)
    assert cleaned.v_pos.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]
    assert cleaned.t_pos_idx.tolist() == [[0, 1, 2], [2, 1, 3]]


@pytest.mark.parametrize(
    "face",
    [
        pytest.param([0, 0, 1], id="repeated corner"),
        pytest.param([0, 1, 4], id="collinear"),
        pytest.param([0, 1, 5], id="coincident after merging"),
        pytest.param([0, 1, 6], id="not finite"),
        pytest.param([2, 0, 1], id="duplicate, turned"),
        pytest.param([1, 0, 2], id="duplicate, flipped"),
    ],
)
def test_clean_drops_faces_that_cannot_be_textured(face: list[int]) -> None:
    positions = [(0.0, 0, 0), (1, 0, 0), (0, 1, 0), (5, 5, 5), (2, 0, 0), (1, 0, 0), (float("nan"), 0, 0)]
    cleaned = clean(make(positions, [[0, 1, 2], face]))
    assert cleaned.t_pos_idx.tolist() == [[0, 1, 2]]
    assert cleaned.v_pos.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]


def test_clean_keeps_small_faces_and_pieces() -> None:
    tiny = 1e-4
    mesh = make(
        [(0, 0, 0), (9, 0, 0), (0, 9, 0), (3, 3, 3), (3 + tiny, 3, 3), (3, 3 + tiny, 3)], [[0, 1, 2], [3, 4, 5]]
    )
    assert len(clean(mesh).t_pos_idx) == 2


def test_clean_without_any_area_is_an_error() -> None:
    with pytest.raises(ScanError, match="no face of the mesh has an area"):
        clean(make([(0, 0, 0), (1, 1, 1), (2, 2, 2)], [[0, 1, 2], [0, 0, 1]]))


def test_clean_keeps_uv_and_their_seams() -> None:
    mesh = Mesh(
        torch.tensor([(0.0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)]),
        torch.tensor([[0, 0, 1], [0, 1, 2], [4, 3, 5]]),
        torch.tensor([(0.9, 0.9), (0.0, 0.0), (0.4, 0.0), (0.0, 0.4), (0.6, 0.6), (0.6, 0.5), (0.8, 0.8)]),
        torch.tensor([[0, 0, 0], [1, 2, 3], [4, 5, 6]]),
    )
    cleaned = clean(mesh)
    assert cleaned.t_pos_idx.tolist() == [[0, 1, 2], [2, 1, 3]]
    assert cleaned.v_uv is not None
    assert cleaned.t_uv_idx is not None
    assert cleaned.v_uv[cleaned.t_uv_idx].tolist() == mesh.v_uv[mesh.t_uv_idx][1:].tolist()
    assert len(cleaned.v_uv) == 6


@given(
    st.lists(st.tuples(*[st.integers(-2, 2)] * 3), min_size=3, max_size=12),
    st.lists(st.tuples(*[st.integers(0, 11)] * 3), min_size=1, max_size=20),
)
@settings(max_examples=100, deadline=None)
def test_clean_is_idempotent_and_keeps_the_surface(
    points: list[tuple[int, int, int]], triangles: list[tuple[int, int, int]]
) -> None:
    faces = [[index % len(points) for index in triangle] for triangle in triangles]
    mesh = make([(float(x), float(y), float(z)) for x, y, z in points], faces)

    def surface(of: Mesh) -> set[frozenset[tuple[float, ...]]]:
        corners = of.v_pos[of.t_pos_idx].double()
        area = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).norm(dim=1)
        return {frozenset(map(tuple, triangle)) for triangle in corners[area > 0].tolist()}

    expected = surface(mesh)
    if not expected:
        with pytest.raises(ScanError):
            clean(mesh)
        return
    once = clean(mesh)
    twice = clean(once)
    assert surface(once) == expected
    assert len(once.t_pos_idx) == len(expected)
    assert len(once.v_pos.unique(dim=0)) == len(once.v_pos)
    assert twice.v_pos.equal(once.v_pos)
    assert twice.t_pos_idx.equal(once.t_pos_idx)


def test_decimate_meets_the_budget_stays_on_the_surface_and_repeats_itself() -> None:
    listener = Listener()
    mesh = sphere(5)  # 20,480 faces
    first, second = decimate(mesh, 2_000, listener), decimate(mesh, 2_000, Listener())
    assert 1_800 <= len(first.t_pos_idx) <= 2_000
    assert first.v_pos.dtype == torch.float32
    assert first.t_pos_idx.dtype == torch.int64
    assert first.v_pos.norm(dim=1).sub(1).abs().max() < 0.01
    assert first.v_pos.numpy().tobytes() == second.v_pos.numpy().tobytes()
    assert first.t_pos_idx.equal(second.t_pos_idx)
    assert listener.warnings == []


def test_decimate_meets_a_small_budget_on_noise() -> None:
    rng = np.random.default_rng(3)
    grid = np.stack([*np.meshgrid(np.arange(60.0), np.arange(60.0)), rng.normal(0, 3, (60, 60))], axis=2).reshape(-1, 3)
    first = np.arange(59 * 60).reshape(59, 60)[:, :-1].reshape(-1)
    faces = np.concatenate(
        [np.stack([first, first + 1, first + 60], 1), np.stack([first + 1, first + 61, first + 60], 1)]
    )
    decimated = decimate(Mesh(torch.from_numpy(grid).float(), torch.from_numpy(faces)), 100, Listener())
    assert 0 < len(decimated.t_pos_idx) <= 100


def test_a_mesh_within_the_budget_keeps_everything() -> None:
    mesh = Mesh(torch.eye(3), torch.tensor([[0, 1, 2]]), torch.rand(3, 2), torch.tensor([[0, 1, 2]]))
    listener = Listener()
    assert decimate(mesh, 100, listener) is mesh
    assert listener.warnings == []


def test_decimation_says_that_uv_are_dropped() -> None:
    mesh = sphere(3)
    with_uv = Mesh(mesh.v_pos, mesh.t_pos_idx, mesh.v_pos[:, :2].contiguous(), mesh.t_pos_idx)
    listener = Listener()
    assert decimate(with_uv, 500, listener).v_uv is None
    assert [problem.code for problem in listener.warnings] == ["uv_dropped"]
    assert "1,280 faces" in listener.warnings[0].message


def test_threads_that_collapse_at_the_same_time_do_not_mix_up_their_meshes() -> None:
    """A scan's mesh is decimated while another of it is made coarse to judge its conventions."""
    meshes = [sphere(3), sphere(4)] * 100
    alone = [collapse_edges(mesh, 200, Monitor()) for mesh in meshes[:2]]
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(4) as pool:
            together = list(pool.map(lambda mesh: collapse_edges(mesh, 200, Monitor()), meshes))
    finally:
        sys.setswitchinterval(interval)
    for number, collapsed in enumerate(together):
        assert torch.equal(collapsed.v_pos, alone[number % 2].v_pos)
        assert torch.equal(collapsed.t_pos_idx, alone[number % 2].t_pos_idx)


def test_a_child_collapses_as_the_process_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = sphere(4)
    here = collapse_edges(mesh, 300, Monitor(), ROUNDS)
    monkeypatch.setattr(quadric, "CHILD_FACES", 1)
    apart = collapse_edges(mesh, 300, Monitor(), ROUNDS)
    assert len(apart.t_pos_idx) <= 300
    assert torch.equal(here.v_pos, apart.v_pos)
    assert torch.equal(here.t_pos_idx, apart.t_pos_idx)

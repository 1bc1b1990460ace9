"""Registration: a model placed by hand is found back from depth, and never fits worse than it came."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from advtex_engine.core.cameras import project
from advtex_engine.core.scene import Camera, DepthFrame, Mesh
from advtex_engine.mesh import registration
from advtex_engine.mesh.registration import move_mesh, register_camera, register_mesh
from advtex_engine.render.rasterize import rasterize
from advtex_engine.synthetic.patches import look_at

NOISE = 0.002


def of(shape: trimesh.Trimesh) -> Mesh:
    return Mesh(torch.tensor(np.array(shape.vertices)).float(), torch.tensor(np.array(shape.faces)).long())


def chair() -> Mesh:
    """A seat, a back and one armrest: nothing about it is symmetric."""
    parts = [((0.5, 0.5, 0.08), (0, 0, 0.4)), ((0.5, 0.06, 0.5), (0, 0.22, 0.65)), ((0.05, 0.4, 0.2), (0.22, 0, 0.5))]
    boxes = [trimesh.creation.box(size, trimesh.transformations.translation_matrix(at)) for size, at in parts]
    return of(trimesh.util.concatenate(boxes))


def frames_of(mesh: Mesh, seed: int = 0, count: int = 8) -> list[DepthFrame]:
    generator = torch.Generator().manual_seed(seed)
    K = torch.tensor([[150.0, 0, 80], [0, 150, 60], [0, 0, 1]], dtype=torch.float64)
    frames = []
    for angle in np.arange(count) * 2 * np.pi / count:
        eye = np.array([1.4 * np.cos(angle), 1.4 * np.sin(angle), 1.1])
        camera = Camera(K, torch.from_numpy(look_at(eye, np.array([0, 0, 0.5]))), 160, 120)
        depth = rasterize(mesh, camera).depth
        noisy = depth + NOISE * torch.randn(depth.shape, generator=generator)
        frames.append(DepthFrame(camera, torch.where(depth > 0, noisy, 0.0)))
    return frames


def motion_of(shift: tuple[float, float, float], degrees: float, axis: tuple[float, float, float]) -> torch.Tensor:
    return torch.from_numpy(
        trimesh.transformations.translation_matrix(shift)
        @ trimesh.transformations.rotation_matrix(math.radians(degrees), axis, (0, 0, 0.5))
    )


TRUE = chair()
FRAMES = frames_of(TRUE)
FEW = frames_of(TRUE, count=3)


def off(mesh: Mesh) -> float:
    """Metres by which the vertices are misplaced at most."""
    return float((mesh.v_pos - TRUE.v_pos).norm(dim=1).max())


def misfit(mesh: Mesh) -> float:
    """Mean distance along z of all readings, the whole reach where the mesh does not meet them."""
    total = []
    for frame in FEW:
        seen, measured = rasterize(mesh, frame.camera).depth, frame.depth
        met = measured > 0
        total.append(torch.where(seen > 0, (seen - measured).abs(), 1.0).minimum(0.1 * measured)[met])
    return float(torch.cat(total).mean())


@pytest.mark.parametrize("shift", [(0.03, -0.02, 0.02), (-0.05, 0.0, 0.03)])
def test_a_misplaced_model_is_found_back(shift: tuple[float, float, float]) -> None:
    placed = move_mesh(TRUE, motion_of(shift, 4, (1, 2, 3)))
    assert off(placed) > 0.03
    mesh, report = register_mesh(placed, FRAMES)
    assert report["accepted"]
    assert off(mesh) < 0.001
    assert report["median_mm_after"] < 2 < 10 < report["median_mm_before"]
    assert report["turned_degrees"] == pytest.approx(4, abs=0.2)
    assert report["scale"] == 1
    assert torch.equal(mesh.t_pos_idx, TRUE.t_pos_idx)


def test_scale_is_found_where_it_is_asked_for() -> None:
    grown = Mesh((TRUE.v_pos - 0.3) * 1.05 + 0.3, TRUE.t_pos_idx)
    mesh, report = register_mesh(grown, FRAMES, with_scale=True)
    assert off(mesh) < 0.002
    assert report["scale"] == pytest.approx(1 / 1.05, abs=2e-3)
    rigid, report = register_mesh(grown, FRAMES)
    assert report["scale"] == 1
    assert off(rigid) > 0.005


def test_what_stands_around_the_model_does_not_pull_it() -> None:
    floor = of(trimesh.creation.box((3, 3, 0.02), trimesh.transformations.translation_matrix((0, 0, -0.01))))
    room = Mesh(torch.cat((TRUE.v_pos, floor.v_pos)), torch.cat((TRUE.t_pos_idx, floor.t_pos_idx + len(TRUE.v_pos))))
    placed = move_mesh(TRUE, motion_of((0.02, 0.02, 0.01), 2, (0, 0, 1)))
    mesh, _ = register_mesh(placed, frames_of(room))
    assert off(mesh) < 0.002


def test_a_plane_does_not_slide() -> None:
    wall = of(trimesh.creation.box((1, 0.02, 1), trimesh.transformations.translation_matrix((0, 0, 0.5))))
    placed = move_mesh(wall, motion_of((0.0, 0.02, 0.0), 0, (0, 0, 1)))
    mesh, report = register_mesh(placed, frames_of(wall)[1:4])
    assert report["accepted"]
    moved = (mesh.v_pos - placed.v_pos).mean(0)
    assert moved[1] == pytest.approx(-0.02, abs=2e-3)
    assert abs(moved[0]) < 3e-3
    assert abs(moved[2]) < 3e-3


@settings(max_examples=8, deadline=None)
@given(
    shift=st.tuples(*[st.floats(-0.4, 0.4)] * 3),
    degrees=st.floats(-90, 90),
    axis=st.sampled_from([(0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (1.0, 1.0, 0.0)]),
    with_scale=st.booleans(),
)
def test_wherever_it_was_put_it_never_fits_worse(
    shift: tuple[float, float, float], degrees: float, axis: tuple[float, float, float], with_scale: bool
) -> None:
    placed = move_mesh(TRUE, motion_of(shift, degrees, axis))
    mesh, report = register_mesh(placed, FEW, with_scale=with_scale)
    assert misfit(mesh) <= misfit(placed) + 1e-6
    assert report["median_mm_after"] <= report["median_mm_before"]
    if not report["accepted"]:
        assert mesh is placed
        assert report["moved_mm"] == 0


def test_a_step_never_mirrors_the_mesh() -> None:
    """Readings that all lie on the far side of a sphere's center ask for a growth below -1."""
    normals = torch.nn.functional.normalize(
        torch.randn((500, 3), generator=torch.Generator().manual_seed(1), dtype=torch.float64), dim=1
    )
    offsets = torch.full((500,), -1.4, dtype=torch.float64)
    pairs = registration._Pairs(normals, normals, offsets, torch.ones_like(offsets))
    step = registration._solve(pairs, 1.0, with_scale=True)
    assert 0.1 < float(torch.linalg.det(step[:3, :3])) ** (1 / 3) < 0.4


def test_without_depth_the_model_stays() -> None:
    empty = [DepthFrame(frame.camera, torch.zeros_like(frame.depth)) for frame in FRAMES]
    mesh, report = register_mesh(TRUE, empty)
    assert mesh is TRUE
    assert not report["accepted"]


def misplaced(frame: DepthFrame, shift: tuple[float, float, float], degrees: float) -> DepthFrame:
    pose = frame.camera.world_to_camera @ motion_of(shift, degrees, (0.3, 0.5, 0.8))
    return replace(frame, camera=replace(frame.camera, world_to_camera=pose))


def pixels_off(pose: torch.Tensor, camera: Camera) -> float:
    """Median over the vertices."""
    there, _ = project(replace(camera, world_to_camera=pose), TRUE.v_pos)
    true, _ = project(camera, TRUE.v_pos)
    return float((there - true).norm(dim=1).median())


@pytest.mark.parametrize("frame", FRAMES[1::2])  # seen from straight ahead, boxes slide along their faces
def test_a_grossly_wrong_camera_is_put_where_its_depth_fits(frame: DepthFrame) -> None:
    wrong = misplaced(frame, (0.03, -0.04, 0.03), 6)
    found = register_camera(TRUE, wrong)
    assert found is not None
    before = pixels_off(wrong.camera.world_to_camera, frame.camera)
    assert before > 2.5
    assert pixels_off(found, frame.camera) < 0.1 * before


@pytest.mark.parametrize(
    ("index", "shift", "degrees"),
    [(3, (0.03, 0.12, 0.0), 5), (7, (0.09, 0.01, -0.15), 10), (1, (0.09, 0.07, -0.05), 10)],
)
def test_a_camera_that_slides_along_surfaces_has_the_time_to_arrive(
    index: int, shift: tuple[float, float, float], degrees: float
) -> None:
    wrong = misplaced(FRAMES[index], shift, degrees)
    found = register_camera(TRUE, wrong)
    assert found is not None
    assert pixels_off(wrong.camera.world_to_camera, FRAMES[index].camera) > 10
    assert pixels_off(found, FRAMES[index].camera) < 0.1


@pytest.mark.parametrize("degrees", [0, 0.2])
def test_a_camera_that_is_nearly_right_stays_for_the_photographs_to_judge(degrees: float) -> None:
    assert register_camera(TRUE, misplaced(FRAMES[0], (0, 0, 0), degrees)) is None


def test_a_camera_stays_where_its_depth_fits_from_nowhere() -> None:
    generator = torch.Generator().manual_seed(0)
    frame = FRAMES[0]
    noise = 1 + 0.08 * torch.randn(frame.depth.shape, generator=generator)
    assert register_camera(TRUE, replace(frame, depth=frame.depth * noise)) is None
    assert register_camera(TRUE, replace(frame, depth=torch.zeros_like(frame.depth))) is None
    away = replace(frame.camera, world_to_camera=frame.camera.world_to_camera @ motion_of((9, 0, 0), 0, (0, 0, 1)))
    assert register_camera(TRUE, replace(frame, camera=away)) is None

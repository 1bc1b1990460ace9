"""Vertices that follow photographs and depth: a bumpy mesh of a hilly sheet whose shape is known."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from wavy_sheet import HEIGHT, WIDTH, camera_over, paint, sheet

from advtex_engine.core.scene import Camera, Mesh, Scene, View
from advtex_engine.mesh.normals import vertex_normals
from advtex_engine.refine import geometry
from advtex_engine.refine.check import MARGIN
from advtex_engine.refine.geometry import GeometryRefinement, refine_geometry
from advtex_engine.refine.points import Candidates, Observations
from advtex_engine.refine.run import (
    apply_refinement,
    refine_scene,
    refinement_from_dict,
    refinement_to_dict,
)
from advtex_engine.render.rasterize import rasterize

VIEWS = 10
CPU = torch.device("cpu")
BUMPS = 0.02  # metres, of the mesh: 2 pixels from the side


def photograph(mesh: Mesh, camera: Camera, name: str) -> View:
    """With its depth, off by 2 mm of noise."""
    fragments = rasterize(mesh, camera)
    corners = mesh.v_pos[mesh.t_pos_idx[fragments.face_index.clamp(min=0).long()]]
    color = paint((corners * fragments.barycentric[..., None]).sum(2))
    color[fragments.face_index < 0] = 0
    noise = torch.randn(HEIGHT, WIDTH, generator=torch.Generator().manual_seed(len(name)))
    depth = torch.where(fragments.depth > 0, fragments.depth + 0.002 * noise, 0.0)
    return View(name, camera, (color * 255).round().to(torch.uint8), depth)


@pytest.fixture(scope="module")
def true_scene() -> Scene:
    mesh = sheet(2.0, 40, (0.1, 4, 3, 0))
    return Scene(mesh, tuple(photograph(mesh, camera_over(i, VIEWS), f"view{i}") for i in range(VIEWS)))


@pytest.fixture(scope="module")
def bumpy(true_scene: Scene) -> Scene:
    """With a mesh that waves about the true one along its normals, by at most BUMPS."""
    x, y, _ = true_scene.mesh.v_pos.unbind(1)
    offset = BUMPS * torch.sin(9 * x + 1) * torch.cos(8 * y)
    return replace(true_scene, mesh=bent(true_scene.mesh, offset))


@pytest.fixture(scope="module")
def found(bumpy: Scene) -> GeometryRefinement:
    return refine_geometry(bumpy, CPU, 0)


def bent(mesh: Mesh, offset: Tensor) -> Mesh:
    return replace(mesh, v_pos=mesh.v_pos + offset[:, None] * vertex_normals(mesh))


def without_depth(scene: Scene) -> Scene:
    return replace(scene, views=tuple(replace(view, depth=None) for view in scene.views))


def with_depth(scene: Scene, factor: float) -> Scene:
    """What a depth camera tells that is wrong by a factor."""
    views = [replace(view, depth=view.depth * factor) for view in scene.views if view.depth is not None]
    return replace(scene, views=tuple(views))


def error(v_pos: Tensor, truth: Scene) -> float:
    """Metres along the normals that the vertices are off, root of the mean square, where most views look."""
    inside = truth.mesh.v_pos[:, :2].abs().amax(1) < 0.5
    off = ((v_pos - truth.mesh.v_pos) * vertex_normals(truth.mesh)).sum(1)[inside]
    return float(off.square().mean().sqrt())


def test_photographs_alone_find_the_surface(bumpy: Scene, true_scene: Scene) -> None:
    found = refine_geometry(without_depth(bumpy), CPU, 0)
    assert found.v_pos is not None
    assert error(bumpy.mesh.v_pos, true_scene) > 0.008
    assert error(found.v_pos, true_scene) < 0.35 * error(bumpy.mesh.v_pos, true_scene)
    assert found.report["residual_after"] < 0.75 * found.report["residual_before"]


def test_depth_finds_it_better(bumpy: Scene, true_scene: Scene, found: GeometryRefinement) -> None:
    assert found.v_pos is not None
    assert error(found.v_pos, true_scene) < 0.2 * error(bumpy.mesh.v_pos, true_scene)


def test_what_is_right_stays(true_scene: Scene) -> None:
    found = refine_geometry(true_scene, CPU, 0)
    assert found.v_pos is None or error(found.v_pos, true_scene) < 0.0007


def test_depth_that_the_photographs_deny_is_not_followed(true_scene: Scene) -> None:
    found = refine_geometry(with_depth(true_scene, 1.02), CPU, 0)
    assert found.v_pos is None
    assert not found.report["refined"]
    assert found.report["residual_after"] > found.report["residual_before"]


@pytest.fixture(scope="module")
def misled(bumpy: Scene) -> Scene:
    """An object whose depth has the errors of its mesh, as of one that was fused from it."""
    views = tuple(replace(view, depth=rasterize(bumpy.mesh, view.camera).depth) for view in bumpy.views)
    return replace(bumpy, views=views, kind="object")


def test_an_object_is_tried_by_photographs_alone_where_its_depth_has_its_errors(
    misled: Scene, true_scene: Scene
) -> None:
    assert refine_geometry(replace(misled, kind="scene"), CPU, 0).v_pos is None, "a room's mesh stays"
    found = refine_geometry(misled, CPU, 0)
    assert found.v_pos is not None
    assert found.alone
    assert error(found.v_pos, true_scene) < 0.4 * error(misled.mesh.v_pos, true_scene)
    assert found.report["residual_after"] < MARGIN * found.report["residual_before"]


def test_what_photographs_alone_have_moved_they_move_again(misled: Scene, true_scene: Scene) -> None:
    """By the cameras that were found beside it; no view is left then that could judge."""
    found = refine_geometry(misled, CPU, 0, alone=True)
    assert found.v_pos is not None
    assert found.alone
    assert error(found.v_pos, true_scene) < 0.4 * error(misled.mesh.v_pos, true_scene)
    refinement = refine_scene(misled, CPU, 0)
    assert [told["refined"] for told in refinement.report["geometry"]] == [True, True]
    assert refinement.v_pos is not None
    assert error(refinement.v_pos, true_scene) < 0.4 * error(misled.mesh.v_pos, true_scene)


def test_an_object_that_is_right_stays_by_photographs_alone(true_scene: Scene) -> None:
    found = refine_geometry(replace(with_depth(true_scene, 1.02), kind="object"), CPU, 0)
    assert found.v_pos is None
    assert not found.alone
    assert not found.report["refined"]


def test_vertices_move_along_their_normals_alone(bumpy: Scene, found: GeometryRefinement) -> None:
    assert found.v_pos is not None
    moved = found.v_pos - bumpy.mesh.v_pos
    normal = vertex_normals(bumpy.mesh)
    assert (moved - (moved * normal).sum(1, keepdim=True) * normal).abs().max() < 1e-6


def test_the_same_seed_finds_the_same(bumpy: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(geometry, "LEVELS", ((2, 2),))
    first, second = (refine_geometry(bumpy, CPU, 3).v_pos for _ in range(2))
    assert first is not None and second is not None
    assert torch.equal(first, second)


def test_a_mesh_that_one_view_sees_stays(bumpy: Scene) -> None:
    found = refine_geometry(replace(bumpy, views=bumpy.views[:1]), CPU, 0)
    assert found.v_pos is None
    assert found.report["refined"] is False


def test_where_views_share_too_little_to_judge_the_mesh_stays(bumpy: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(geometry, "CHECKED_SHARE", 0.0)
    found = refine_geometry(bumpy, CPU, 0)
    assert found.v_pos is None
    assert found.report == {"refined": False, "residual_before": None, "residual_after": None}


def test_the_far_side_of_a_wall_is_not_seen_where_errors_push_it_through(true_scene: Scene) -> None:
    near = true_scene.mesh
    deep = torch.where(near.v_pos[:, :2].norm(dim=1) < 0.2, -0.005, 0.04)  # metres; in the middle it lies before
    far = near.v_pos - deep[:, None] * torch.tensor([0.0, 0.0, 1.0])
    faces = torch.cat((near.t_pos_idx, near.t_pos_idx.flip(1) + len(far)))
    wall = replace(true_scene, mesh=Mesh(torch.cat((near.v_pos, far)), faces))
    color = geometry.working_color(wall.views, CPU)
    seen = geometry.Surface(wall.mesh, wall, color, torch.Generator().manual_seed(0)).look(wall.mesh)
    assert seen is not None
    drawn, looked_at = seen.surface.face, seen.points.point[seen.points.seen]
    assert int((drawn >= len(near.t_pos_idx)).sum()) > 500
    assert bool((drawn[looked_at] < len(near.t_pos_idx)).all())


def test_a_step_is_that_of_dense_normal_equations(bumpy: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """The offsets of a step against all of its terms written out, as one dense system."""
    monkeypatch.setattr(geometry, "SOLVER_STEPS", 400)
    mesh = sheet(2.0, 6, (0.1, 4, 3, 0))
    scene = replace(bumpy, mesh=mesh)
    color = geometry.working_color(scene.views, CPU)
    surface = geometry.Surface(mesh, scene, color, torch.Generator().manual_seed(0))
    seen = surface.look(mesh)
    assert seen is not None
    offsets = 0.002 * torch.randn(len(mesh.v_pos), generator=torch.Generator().manual_seed(1))
    features = geometry.local_contrast(geometry.luminance(color), 1)
    found = surface.step(offsets, features, seen, 100)

    points = replace(seen.points, position=seen.surface.on(surface.moved(offsets)))
    corners, weights = mesh.t_pos_idx[seen.surface.face], seen.surface.weights
    normal = (vertex_normals(mesh)[corners] * weights[..., None].float()).sum(1)
    a, b = surface.evidence(
        features,
        seen,
        points,
        normal / normal.norm(dim=1, keepdim=True),
        ~surface.aside[seen.surface.face][points.point],
        geometry.DEPTH_WEIGHT,
    )
    rows = torch.zeros(len(a), len(offsets), dtype=torch.float64).scatter_add_(1, corners, weights)
    matrix, right = rows.T @ (a.double()[:, None] * rows), rows.T @ b.double()
    reached = rows.T @ a.double()
    mean = reached.sum() / (reached > 0).sum()
    sides = {tuple(sorted((int(f[i]), int(f[i - 1])))) for f in mesh.t_pos_idx for i in range(3)}
    smooth = torch.zeros_like(matrix)
    for i, j in sides:
        smooth[i, i] += 1
        smooth[j, j] += 1
        smooth[i, j] -= 1
        smooth[j, i] -= 1
    smooth = mean * (geometry.SMOOTH * smooth + geometry.SMALL * torch.eye(len(offsets)))
    change = torch.linalg.solve(matrix + smooth, right - smooth @ offsets.double())
    most = geometry.MOST * surface.depth
    assert torch.allclose(found.double(), (offsets.double() + change).clamp(-most, most), atol=2e-5)


def test_a_vector_step_is_that_of_dense_normal_equations(bumpy: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """By photographs alone, of the views that count, and with vertices that are held in some directions."""
    monkeypatch.setattr(geometry, "SOLVER_STEPS", 400)
    monkeypatch.setattr(geometry, "LARGEST_STEP", 100.0)
    mesh = sheet(2.0, 6, (0.1, 4, 3, 0))
    color = geometry.working_color(bumpy.views, CPU)
    surface = geometry.Surface(mesh, replace(bumpy, mesh=mesh), color, torch.Generator().manual_seed(0))
    seen = surface.look(mesh)
    assert seen is not None
    count = len(mesh.v_pos)
    generator = torch.Generator().manual_seed(1)
    offsets = 0.002 * torch.randn(count, 3, generator=generator)
    counted = (torch.arange(VIEWS) % 3 > 0)[:, None]
    factors = torch.randn(count, 3, 2, generator=generator)
    held = factors @ factors.mT * (torch.arange(count) % 4 == 0)[:, None, None]
    found = surface.vector_step(offsets, seen, counted, held)

    corners, weights = mesh.t_pos_idx[seen.surface.face], seen.surface.weights
    points = replace(seen.points, position=seen.surface.on(replace(mesh, v_pos=mesh.v_pos + offsets)))
    normal = (vertex_normals(mesh)[corners] * weights[..., None].float()).sum(1)
    normal = normal / normal.norm(dim=1, keepdim=True)
    a, b = surface.evidence(surface.features, seen, points, normal, counted, 0.0)
    rows = torch.zeros(len(a), count, 3, dtype=torch.float64)
    rows.scatter_add_(1, corners[..., None].expand(-1, -1, 3), weights[..., None] * normal.double()[:, None])
    rows = rows.flatten(1)
    reached = torch.zeros(count, dtype=torch.float64).index_add_(
        0, corners.flatten(), (a.double()[:, None] * weights).flatten()
    )
    mean = reached.sum() / (reached > 0).sum()
    laplacian = torch.zeros(count, count, dtype=torch.float64)
    for i, j in {tuple(sorted((int(f[i]), int(f[i - 1])))) for f in mesh.t_pos_idx for i in range(3)}:
        laplacian[[i, j], [i, j]] += 1
        laplacian[[i, j], [j, i]] -= 1
    smooth = torch.kron(geometry.SMOOTH * laplacian + geometry.SMALL * torch.eye(count), torch.eye(3)).double()
    smooth = mean * (smooth + torch.block_diag(*held.double()))
    change = torch.linalg.solve(
        rows.T @ (a.double()[:, None] * rows) + smooth, rows.T @ b.double() - smooth @ offsets.double().flatten()
    )
    expected = offsets.double() + change.view(-1, 3)
    most = geometry.MOST * surface.depth
    expected *= (most / expected.norm(dim=1, keepdim=True)).clamp(max=1)
    assert torch.allclose(found.double(), expected, atol=2e-5)


def test_what_lies_at_an_outline_is_held_but_for_the_direction_to_the_view(true_scene: Scene) -> None:
    """A square before a wall, seen by one view straight on: its border is held sideways, all else is free."""
    near, wall = sheet(0.5, 10, (0.0, 0, 0, 0)), sheet(2.0, 10, (0.0, 0, 0, 0))
    lifted = near.v_pos + torch.tensor([0.0, 0.0, 0.3])
    mesh = Mesh(torch.cat((lifted, wall.v_pos)), torch.cat((near.t_pos_idx, wall.t_pos_idx + len(lifted))))
    above = torch.eye(4, dtype=torch.float64)
    above[1, 1] = above[2, 2] = -1
    above[2, 3] = 2.0
    view = replace(true_scene.views[0], camera=replace(true_scene.views[0].camera, world_to_camera=above), depth=None)
    scene = Scene(mesh, (view, view), kind="object")
    color = geometry.working_color(scene.views, CPU)
    held = geometry.Surface(mesh, scene, color, torch.Generator().manual_seed(0)).held_at_outlines()
    border = torch.zeros(len(mesh.v_pos), dtype=torch.bool)
    border[: len(lifted)] = lifted[:, :2].abs().amax(1) > 0.249
    inner = torch.zeros_like(border)
    inner[: len(lifted)] = lifted[:, :2].abs().amax(1) < 0.15
    assert bool((held[border].diagonal(dim1=1, dim2=2).sum(1) > 1.9 * geometry.OUTLINE).all())
    assert bool((held[inner] == 0).all())
    ray = torch.nn.functional.normalize(torch.tensor([0.0, 0.0, 2.0]) - mesh.v_pos[border], dim=1)
    assert (held[border] @ ray[..., None]).abs().max() < 1e-5
    inside_wall = torch.zeros_like(border)
    inside_wall[len(lifted) :] = wall.v_pos[:, :2].abs().amax(1) < 0.7
    assert bool((held[inside_wall] == 0).all())


def test_the_evidence_is_the_slope_of_what_views_see(bumpy: Scene) -> None:
    """How far off and how sure, by differences of the samples as points move along their normals."""
    scene = without_depth(bumpy)
    color = geometry.working_color(scene.views, CPU)
    surface = geometry.Surface(scene.mesh, scene, color, torch.Generator().manual_seed(0))
    count = 50
    rows = torch.randint(len(scene.mesh.t_pos_idx), (count,), generator=torch.Generator().manual_seed(2))
    thirds = torch.full((count, 3), 1 / 3, dtype=torch.float64)
    position = (scene.mesh.v_pos.double()[scene.mesh.t_pos_idx[rows]] * thirds[..., None]).sum(1)
    normal = torch.nn.functional.normalize(vertex_normals(scene.mesh)[scene.mesh.t_pos_idx[rows]].sum(1), dim=1)
    every = torch.arange(count).expand(VIEWS, -1)
    seen_by_all = torch.ones_like(every, dtype=torch.bool)
    candidates = Candidates(position, normal.double(), torch.ones(count), rows, thirds, seen_by_all.mT)
    points = Observations(position, every, seen_by_all)
    seen = geometry.Seen(candidates, points, torch.zeros(every.shape))
    # Linear images, so that differences are exact.
    down, across = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    slopes = 0.01 * torch.randn(VIEWS, 2, generator=torch.Generator().manual_seed(3))
    value = slopes[:, :1, None] * across + slopes[:, 1:, None] * down
    features = torch.stack((value, *(slopes[:, k, None, None].expand_as(value) for k in (0, 1))), 1)
    sure, pull = surface.evidence(features, seen, points, normal, ~surface.aside[rows][every], 0.0)
    step = 1e-3  # metres; the samples are float32

    def energy(move: float) -> Tensor:
        """Per point, for the weights that the residuals have where they are."""
        placed = replace(points, position=position + move * normal.double())
        samples = geometry.sample_points(features, surface.K, surface.poses, placed, (WIDTH, HEIGHT))
        base = geometry.sample_points(features, surface.K, surface.poses, points, (WIDTH, HEIGHT))
        residual, weight = geometry.residuals(base.value, base.valid, points, geometry.ROBUST_SCALE)
        now = residual + samples.value - base.value
        weight = weight.double()
        mean = (weight * now).sum(0) / weight.sum(0).clamp(min=1e-6)
        kept = (~surface.aside[rows]).double()
        return kept * (weight * (now - mean).square()).sum(0) / geometry.ROBUST_SCALE**2

    slope = (energy(step) - energy(-step)) / (2 * step)
    assert torch.allclose(slope, -2 * pull.double(), rtol=0.05, atol=0.05 * float(pull.abs().mean()))
    ahead, behind = (
        geometry.sample_points(
            features,
            surface.K,
            surface.poses,
            replace(points, position=position + sign * step * normal.double()),
            (WIDTH, HEIGHT),
        )
        for sign in (1, -1)
    )
    base = geometry.sample_points(features, surface.K, surface.poses, points, (WIDTH, HEIGHT))
    _, weight = geometry.residuals(base.value, base.valid, points, geometry.ROBUST_SCALE)
    slopes_of_views = (ahead.value - behind.value) / (2 * step)
    mean = (weight * slopes_of_views).sum(0) / weight.sum(0).clamp(min=1e-6)
    squares = (weight * (slopes_of_views - mean).square()).sum(0) * ~surface.aside[rows] / geometry.ROBUST_SCALE**2
    assert torch.allclose(squares, sure, rtol=0.05, atol=0.02 * float(sure.mean()))


def test_a_refined_scene_has_the_vertices_and_keeps_all_else(bumpy: Scene, true_scene: Scene) -> None:
    refinement = refine_scene(bumpy, CPU, 0)
    assert refinement.report["geometry"][0]["refined"]
    again = apply_refinement(bumpy, refinement_from_dict(refinement_to_dict(refinement)))
    assert error(again.mesh.v_pos, true_scene) < 0.2 * error(bumpy.mesh.v_pos, true_scene)
    assert again.mesh.v_uv is bumpy.mesh.v_uv and again.mesh.t_pos_idx is bumpy.mesh.t_pos_idx

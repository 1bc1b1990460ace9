"""A lens that bends all photographs alike: found where the scan does not tell of it, left alone where there is none."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from wavy_sheet import HEIGHT, WIDTH, camera_over, paint, sheet

from advtex_engine.core.cameras import pixel_centers
from advtex_engine.core.scene import Camera, Mesh, Scene, View
from advtex_engine.refine import distortion
from advtex_engine.refine.distortion import bent, fit_distortion, refine_distortion, straightened
from advtex_engine.refine.points import Observations
from advtex_engine.refine.pose import exponential, pose_jacobian, sample_points
from advtex_engine.refine.run import (
    apply_refinement,
    refine_cameras,
    refinement_from_dict,
    refinement_to_dict,
)
from advtex_engine.refine.solve import weighted_mean
from advtex_engine.refine.working_views import WorkingViews, working_views
from advtex_engine.render.rasterize import rasterize

VIEWS = 10
CPU = torch.device("cpu")
TRUE = torch.tensor([-0.2, 0.08])  # up to 7 of 160 pixels
MARGIN = 16  # pixels around the image that a bent ray may come from


def photograph(mesh: Mesh, camera: Camera, name: str, distortion: Tensor) -> View:
    """What a lens shows: each pixel the color of the surface where its ray, bent back, meets it."""
    K = camera.K.clone()
    K[:2, 2] += MARGIN
    wide = Camera(K, camera.world_to_camera, WIDTH + 2 * MARGIN, HEIGHT + 2 * MARGIN)
    fragments = rasterize(mesh, wide)
    assert bool((fragments.face_index >= 0).all())
    corners = mesh.v_pos[mesh.t_pos_idx[fragments.face_index.long()]]
    surface = (corners * fragments.barycentric[..., None]).sum(2)
    seen = pixel_centers(camera).float().view(1, -1, 2)
    ray = seen
    for _ in range(30):
        ray = ray - (bent(ray, camera.K[None], distortion) - seen)
    grid = 2 * (ray + MARGIN).view(1, HEIGHT, WIDTH, 2) / torch.tensor([wide.width, wide.height]) - 1
    points = torch.nn.functional.grid_sample(surface.permute(2, 0, 1)[None].float(), grid, align_corners=False)
    color = paint(points[0].permute(1, 2, 0))
    return View(name, camera, (color * 255).round().clamp(0, 255).to(torch.uint8))


def scene_through(distortion: Tensor) -> Scene:
    mesh = sheet(8.0, 160, (0.1, 4, 3, 0))
    views = [photograph(mesh, camera_over(i, VIEWS), f"view{i}", distortion) for i in range(VIEWS)]
    return Scene(mesh, tuple(views[1:]), (views[0],))


@pytest.fixture(scope="module")
def bent_scene() -> Scene:
    return scene_through(TRUE)


@pytest.fixture(scope="module")
def pinhole_scene() -> Scene:
    return scene_through(torch.zeros(2))


def working(scene: Scene) -> WorkingViews:
    found = working_views(scene.mesh, scene.views, scene.kind, CPU, 0)
    assert found is not None
    return found


def off(distortion: Tensor, camera: Camera) -> float:
    """Mean pixels between where this lens and the true one show the image's pixels."""
    pixel = pixel_centers(camera).float().view(1, -1, 2)
    shown, true = (bent(pixel, camera.K[None], lens) for lens in (distortion, TRUE))
    return float((shown - true).norm(dim=-1).mean())


def difference(views: tuple[View, ...], truth: tuple[View, ...]) -> float:
    """Mean difference of the photographs, of 255, where they are not masked."""
    found = []
    for view, true in zip(views, truth, strict=True):
        mask = torch.ones(HEIGHT, WIDTH, dtype=torch.bool) if view.mask is None else view.mask
        found.append((view.color.float() - true.color.float()).abs()[mask].mean())
    return float(torch.stack(found).mean())


def test_a_lens_is_found(bent_scene: Scene) -> None:
    seen = working(bent_scene)
    found, report = refine_distortion(seen, seen.given)
    assert found is not None
    camera = bent_scene.views[0].camera
    assert off(torch.zeros(2), camera) > 1.5
    assert off(found, camera) < 0.2
    assert report["corrected"]
    assert report["residual_after"] < 0.8 * report["residual_before"]


def test_it_is_found_beside_wrong_poses(bent_scene: Scene, pinhole_scene: Scene) -> None:
    twists = torch.randn(VIEWS, 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    twists *= 2 / 150 * torch.tensor([1, 1, 1, 1.7, 1.7, 1.7])
    views = [
        replace(view, camera=replace(view.camera, world_to_camera=motion @ view.camera.world_to_camera))
        for view, motion in zip(bent_scene.views, exponential(twists[1:]), strict=True)
    ]
    given = replace(bent_scene, views=tuple(views))
    refinement = refine_cameras(given, CPU, 0)
    assert refinement.distortion is not None
    assert off(refinement.distortion, views[0].camera) < 0.2
    again = apply_refinement(given, refinement_from_dict(refinement_to_dict(refinement)))
    before, after = (difference(part.heldout, pinhole_scene.heldout) for part in (bent_scene, again))
    assert after < 0.4 * before


def test_a_lens_that_bends_little_is_left_to_the_poses() -> None:
    seen = working(scene_through(0.1 * TRUE))
    found, report = refine_distortion(seen, seen.given)
    assert found is None
    assert not report["corrected"]


def test_photographs_are_straightened(bent_scene: Scene, pinhole_scene: Scene) -> None:
    views = tuple(straightened(view, TRUE) for view in bent_scene.views)
    assert difference(views, pinhole_scene.views) < 0.2 * difference(bent_scene.views, pinhole_scene.views)
    assert all(view.mask is not None and float(view.mask.float().mean()) > 0.95 for view in views)


def test_a_pinhole_stays(pinhole_scene: Scene) -> None:
    refinement = refine_cameras(pinhole_scene, CPU, 0)
    assert refinement.distortion is None
    assert not refinement.report["distortion"]["corrected"]
    assert apply_refinement(pinhole_scene, refinement).heldout is pinhole_scene.heldout


def test_points_that_no_camera_sees_say_nothing(bent_scene: Scene) -> None:
    """Pads may lie behind a camera, at pixels that no number holds."""
    seen = working(bent_scene)
    behind = seen.given.clone()
    behind[:, 2, 3] -= 10
    found, poses = fit_distortion(replace(seen, given=behind), seen.fitted, torch.zeros(2), behind)
    assert torch.equal(found, torch.zeros(2))
    assert torch.allclose(poses, behind, atol=1e-6)


def test_a_step_is_the_best_that_poses_leave(bent_scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Against least squares over the lens and every view's own pose, written out as one dense system."""
    monkeypatch.setattr(distortion, "PRIOR", 0.0)
    seen = working(bent_scene)
    few = Observations(seen.fitted.position, seen.fitted.point[:, :60], seen.fitted.seen[:, :60])
    at = sample_points(seen.features, seen.K, seen.given, few, seen.size)
    weight = at.valid * torch.rand(at.value.shape, generator=torch.Generator().manual_seed(0))
    lens, poses = distortion._jacobian(at, seen.K) * 1e-2, pose_jacobian(at, seen.K) / 150
    found = distortion._step(lens, at.value, weight, poses, few, torch.zeros(2))

    def relative(column: Tensor) -> Tensor:
        return column - weighted_mean(column, weight, few)[0][few.point]

    root = weight.flatten().double().sqrt()
    columns = [relative(lens[..., i]).flatten().double() * root for i in range(2)]
    for view in range(len(poses)):
        for part in poses[view]:
            column = torch.zeros_like(at.value)
            column[view] = part
            columns.append(column.flatten().double() * root)
    target = -relative(at.value).flatten().double() * root
    expected = torch.linalg.lstsq(torch.stack(columns, 1), target[:, None]).solution[:2, 0]
    assert torch.allclose(found.double(), expected, rtol=0.02)

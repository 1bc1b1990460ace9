"""Correction of what all frames share: found where gross, left alone where not, given to held-out views too."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from advtex_engine.core.cameras import project, unproject
from advtex_engine.core.scene import Camera, Mesh, Scene, View
from advtex_engine.refine.rig import Device
from advtex_engine.refine.run import (
    DEVICE_MARGIN,
    Refinement,
    apply_refinement,
    refine_cameras,
    refinement_from_dict,
    refinement_to_dict,
)
from advtex_engine.render.rasterize import rasterize

WIDTH, HEIGHT, FOCAL = 160, 120, 130.0
VIEWS = 12
CPU = torch.device("cpu")
ZOOM = 1.1  # of the given focal length over the true one
ASIDE = torch.tensor([0.025, -0.005, 0.0])  # metres between the given camera and the color camera, in its own axes


def corner() -> Mesh:
    """Floor and two walls of 2 m, each of 20 x 20 squares: depths and directions that tell a zoom from a motion."""
    side = torch.linspace(0, 2, 21)
    a, b = (part.flatten() for part in torch.meshgrid(side, side, indexing="ij"))
    zero = torch.zeros_like(a)
    position = torch.cat([torch.stack(part, 1) for part in ((a, b, zero), (zero, a, b), (a, zero, b))])
    first = (torch.arange(20)[:, None] * 21 + torch.arange(20)).flatten()
    square = torch.cat(
        (torch.stack((first, first + 1, first + 22), 1), torch.stack((first, first + 22, first + 21), 1))
    )
    return Mesh(position, torch.cat([square + 441 * plane for plane in range(3)]))


def paint(points: Tensor) -> Tensor:
    """Colors [...,3] of surface points: waves of 8 to 60 cm in all directions."""
    generator = torch.Generator().manual_seed(5)
    waves = torch.randn(60, 3, generator=generator)
    waves = waves / waves.norm(dim=1, keepdim=True) * torch.logspace(1, 1.9, 60)[:, None]
    angles = (points.float() @ waves.T)[..., None, :] + 2 * math.pi * torch.rand(3, 60, generator=generator)
    return 0.45 + 0.35 * torch.tanh(angles.sin().mean(-1) * 5)


def true_camera(index: int) -> Camera:
    """One of VIEWS cameras in front of the corner, at different heights, distances and rolls."""
    turn = math.pi / 2 * (index + 0.5) / VIEWS
    distance = 2.0 + 0.4 * math.sin(5 * turn)
    center = torch.tensor([distance * math.cos(turn), distance * math.sin(turn), 1.0 + 0.5 * math.cos(9 * turn)])
    forward = torch.tensor([0.4, 0.4, 0.5 + 0.2 * math.sin(7 * turn)]) - center
    forward = forward / forward.norm()
    right = torch.linalg.cross(forward, torch.tensor([0.2 * math.sin(11 * turn), 0.0, 1.0]))
    right = right / right.norm()
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.stack((right, torch.linalg.cross(forward, right), forward)).double()
    pose[:3, 3] = -pose[:3, :3] @ center.double()
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64)
    return Camera(K, pose, WIDTH, HEIGHT)


def photograph(mesh: Mesh, camera: Camera, name: str) -> View:
    fragments = rasterize(mesh, camera)
    corners = mesh.v_pos[mesh.t_pos_idx[fragments.face_index.clamp(min=0).long()]]
    color = paint((corners * fragments.barycentric[..., None]).sum(2))
    color[fragments.face_index < 0] = 0
    return View(name, camera, (color * 255).round().clamp(0, 255).to(torch.uint8))


def misread(view: View, mesh: Mesh) -> View:
    """The view as if its color were registered to a depth camera with another focal length, ASIDE of it."""
    offset = torch.eye(4, dtype=torch.float64)
    offset[:3, 3] = -ASIDE
    K = view.camera.K.clone()
    K[:2, :2] *= ZOOM
    camera = replace(view.camera, K=K, world_to_camera=offset @ view.camera.world_to_camera)
    return replace(view, camera=camera, depth=rasterize(mesh, camera).depth)


@pytest.fixture(scope="module")
def true_scene() -> Scene:
    mesh = corner()
    views = [photograph(mesh, true_camera(index), f"view{index}") for index in range(VIEWS)]
    return Scene(mesh, tuple(view for view in views if view.name != "view5"), (views[5],))


@pytest.fixture(scope="module")
def corrected(true_scene: Scene) -> tuple[Scene, Refinement]:
    views, heldout = (
        tuple(misread(view, true_scene.mesh) for view in part) for part in (true_scene.views, true_scene.heldout)
    )
    given = replace(true_scene, views=views, heldout=heldout)
    return given, refine_cameras(given, CPU, 0)


def errors(views: tuple[View, ...], truth: tuple[View, ...], mesh: Mesh) -> Tensor:
    """[V]: median pixels that what each view sees of the mesh is off."""
    off = []
    for view, true in zip(views, truth, strict=True):
        depth = rasterize(mesh, true.camera).depth
        rows, columns = (depth > 0).nonzero().unbind(1)
        pixels = torch.stack((columns, rows), 1) + 0.5
        shown, _ = project(view.camera, unproject(true.camera, pixels, depth[rows, columns]))
        off.append((shown - pixels).norm(dim=1).median())
    return torch.stack(off)


def test_a_camera_taken_for_the_depth_camera_is_found(true_scene: Scene, corrected: tuple[Scene, Refinement]) -> None:
    given, refinement = corrected
    scene = apply_refinement(given, refinement)
    for new, old, true in (
        (scene.views, given.views, true_scene.views),
        (scene.heldout, given.heldout, true_scene.heldout),
    ):
        before, after = (errors(views, true, true_scene.mesh) for views in (old, new))
        assert before.min() > 3
        assert after.max() < 1
    described = refinement.report["device"]
    assert described["corrected"]
    assert described["residual_after"] < 0.9 * described["residual_before"]
    assert described["fx"] == pytest.approx(FOCAL, rel=0.02)
    assert described["fx"] / described["fy"] == pytest.approx(1, abs=0.01)


def test_its_depth_stays_in_the_world(corrected: tuple[Scene, Refinement]) -> None:
    given, refinement = corrected
    view = apply_refinement(given, refinement).heldout[0]
    assert view.depth is not None
    expected = rasterize(given.mesh, view.camera).depth
    both = (view.depth > 0) & (expected > 0)
    assert both.float().mean() > 0.6
    assert (view.depth - expected)[both].abs().median() < 0.01


def test_the_correction_survives_its_cache(corrected: tuple[Scene, Refinement]) -> None:
    given, refinement = corrected
    again = apply_refinement(given, refinement_from_dict(refinement_to_dict(refinement)))
    expected = apply_refinement(given, refinement)
    assert torch.equal(again.heldout[0].camera.K, expected.heldout[0].camera.K)
    assert torch.equal(again.heldout[0].camera.world_to_camera, expected.heldout[0].camera.world_to_camera)


def test_a_right_camera_is_left_alone(true_scene: Scene) -> None:
    refinement = refine_cameras(true_scene, CPU, 0)
    assert not refinement.report["device"]["corrected"]
    assert apply_refinement(true_scene, refinement).heldout is true_scene.heldout
    assert refinement.lens is None


def test_poses_that_drift_are_no_device(true_scene: Scene) -> None:
    """Half of the cameras 3 cm aside: a device halfway explains much of it, poses alone all."""
    offset = torch.eye(4, dtype=torch.float64)
    offset[0, 3] = -0.03
    views = [
        replace(view, camera=replace(view.camera, world_to_camera=offset @ view.camera.world_to_camera))
        for view in true_scene.views[:5]
    ]
    refinement = refine_cameras(replace(true_scene, views=(*views, *true_scene.views[5:])), CPU, 0)
    described, mean = refinement.report["device"], refinement.report["mean"]
    assert described["residual_after"] < DEVICE_MARGIN * described["residual_before"]
    assert not described["corrected"]
    assert refinement.lens is None
    assert mean["residual_after"] < described["residual_after"]


def test_the_same_correction_at_another_image_size() -> None:
    lens = torch.tensor([[0.9, 0, 7.0], [0, 0.95, -3.0], [0, 0, 1]], dtype=torch.float64)
    device = Device(lens, torch.eye(4, dtype=torch.float64))
    pixel = torch.tensor([40.0, 30.0, 1.0], dtype=torch.float64)
    scale = torch.tensor([2.0, 3.0, 1.0], dtype=torch.float64)
    assert torch.allclose(device.at_scale(2.0, 3.0).lens @ (scale * pixel), scale * (lens @ pixel))

"""Conventions of cameras: formulas written out by hand, round trips, and what scaling leaves in place."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from advtex_engine.core.cameras import (
    camera_center,
    camera_forward,
    camera_to_world,
    pixel_centers,
    project,
    scaled_camera,
    stack_cameras,
    unproject,
)
from advtex_engine.core.scene import Camera


def turned_camera(yaw: float, pitch: float, center: tuple[float, float, float]) -> Camera:
    cy, sy, cp, sp = math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch)
    around_y = torch.tensor([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]], dtype=torch.float64)
    around_x = torch.tensor([[1, 0, 0], [0, cp, -sp], [0, sp, cp]], dtype=torch.float64)
    world_to_camera = torch.eye(4, dtype=torch.float64)
    world_to_camera[:3, :3] = around_x @ around_y
    world_to_camera[:3, 3] = -world_to_camera[:3, :3] @ torch.tensor(center, dtype=torch.float64)
    K = torch.tensor([[500.0, 0, 300], [0, 510, 250], [0, 0, 1]], dtype=torch.float64)
    return Camera(K, world_to_camera, 640, 480)


angles = st.floats(-math.pi, math.pi)
coordinates = st.floats(-100, 100)
cameras = st.builds(turned_camera, angles, angles, st.tuples(coordinates, coordinates, coordinates))


def test_axes_are_x_right_y_down_z_forward() -> None:
    camera = turned_camera(0, 0, (0, 0, 0))
    pixels, depth = project(camera, torch.tensor([[0.0, 0, 2], [1, 0, 2], [0, 1, 2]]))
    assert pixels.tolist() == [[300, 250], [550, 250], [300, 505]]
    assert depth.tolist() == [2, 2, 2]
    assert camera_forward(camera).tolist() == [0, 0, 1]


def test_first_pixel_center_is_half_half() -> None:
    centers = pixel_centers(turned_camera(0, 0, (0, 0, 0)))
    assert centers.shape == (480, 640, 2)
    assert centers[0, 0].tolist() == [0.5, 0.5]
    assert centers[2, 7].tolist() == [7.5, 2.5]


@given(cameras, st.floats(0, 640), st.floats(0, 480), st.floats(0.01, 50))
def test_unproject_inverts_project(camera: Camera, u: float, v: float, z: float) -> None:
    pixels, depth = torch.tensor([[u, v]], dtype=torch.float64), torch.tensor([z], dtype=torch.float64)
    again, seen = project(camera, unproject(camera, pixels, depth))
    assert torch.allclose(again, pixels, atol=1e-6, rtol=0)
    assert torch.allclose(seen, depth, atol=1e-10, rtol=0)


@given(cameras)
def test_camera_to_world_is_the_inverse(camera: Camera) -> None:
    product = camera_to_world(camera) @ camera.world_to_camera
    assert torch.allclose(product, torch.eye(4, dtype=torch.float64), atol=1e-12)


@given(cameras)
def test_center_and_forward_lie_on_the_axis(camera: Camera) -> None:
    axis = unproject(camera, camera.K[None, :2, 2], torch.tensor([3.0]))[0]
    assert torch.allclose(axis, camera_center(camera) + 3 * camera_forward(camera), atol=1e-10)
    assert abs(float(camera_forward(camera).norm()) - 1) < 1e-12


@given(cameras, st.integers(1, 2000), st.integers(1, 2000))
def test_scaling_keeps_the_relative_place_of_a_point(camera: Camera, width: int, height: int) -> None:
    point = camera_center(camera) + camera_forward(camera) + 0.1
    before, _ = project(camera, point)
    after, _ = project(scaled_camera(camera, width, height), point)
    ratio = torch.tensor([width / 640, height / 480], dtype=torch.float64)
    assert torch.allclose(after, before * ratio, rtol=1e-9, atol=1e-9)


def test_stacked_cameras_project_as_single_ones() -> None:
    both = [turned_camera(0.3, -0.2, (1, 2, 3)), turned_camera(-1, 0.5, (0, 1, -2))]
    K, world_to_camera = stack_cameras(both)
    assert K.shape == (2, 3, 3)
    assert world_to_camera.shape == (2, 4, 4)
    assert K.dtype == world_to_camera.dtype == torch.float64
    point = torch.tensor([0.5, -0.25, 9, 1], dtype=torch.float64)
    image: Tensor = K @ (world_to_camera @ point)[:, :3, None]
    for camera, seen in zip(both, image[..., 0], strict=True):
        assert torch.allclose(project(camera, point[:3])[0], seen[:2] / seen[2])


def test_project_carries_gradients_to_the_points() -> None:
    points = torch.tensor([[0.1, 0.2, 2.0]], dtype=torch.float64, requires_grad=True)
    pixels, _ = project(turned_camera(0.1, 0.1, (0, 0, 0)), points)
    pixels.sum().backward()  # type: ignore[no-untyped-call]
    assert points.grad is not None
    assert bool((points.grad.abs() > 0).all())


def test_wrong_shapes_are_refused() -> None:
    camera = turned_camera(0, 0, (0, 0, 0))
    with pytest.raises(AssertionError):
        project(camera, torch.zeros(4, 2))
    with pytest.raises(AssertionError):
        unproject(camera, torch.zeros(4, 2), torch.zeros(3))

"""Pinhole projection and the conventions of cameras, stated once.

World in metres. Camera axes OpenCV: x right, y down, z forward. `world_to_camera` [4,4] takes world points to camera
points; `K` [3,3] takes those to pixels: (u, v, 1) ~ K (x, y, z). Pixel (row i, column j) has its centre at
(u, v) = (j + 0.5, i + 0.5); the image covers [0, width] x [0, height]. Depth is z in metres, not the ray's length.

Cameras are float64: a projection subtracts numbers of the scene's size to get differences of a pixel's size.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from advtex_engine.core.scene import Camera


def project(camera: Camera, points: Tensor) -> tuple[Tensor, Tensor]:
    """World points [...,3] in metres -> pixels [...,2] and depth [...], both float64 on the points' device.

    Pixels of points at or behind the camera's plane (depth <= 0) have no meaning; test the depth. Differentiable in
    the points.
    """
    assert points.shape[-1] == 3
    K, world_to_camera = camera.K.to(points.device), camera.world_to_camera.to(points.device)
    seen = points.double() @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
    homogeneous = seen @ K.T
    return homogeneous[..., :2] / homogeneous[..., 2:], seen[..., 2]


def unproject(camera: Camera, pixels: Tensor, depth: Tensor) -> Tensor:
    """Pixels [...,2] at depth [...] (metres along z) -> world points [...,3], float64; the inverse of `project`."""
    assert pixels.shape[-1] == 2
    assert pixels.shape[:-1] == depth.shape
    K, to_world = camera.K.to(pixels.device), camera_to_world(camera).to(pixels.device)
    homogeneous = torch.cat([pixels.double(), torch.ones_like(pixels[..., :1], dtype=torch.float64)], dim=-1)
    seen: Tensor = (homogeneous @ torch.linalg.inv(K).T) * depth.double()[..., None]
    return seen @ to_world[:3, :3].T + to_world[:3, 3]


def pixel_centers(camera: Camera, device: torch.device | None = None) -> Tensor:
    """Centres of all pixels [H,W,2] float64, (u, v) in that order."""
    u = torch.arange(camera.width, dtype=torch.float64, device=device) + 0.5
    v = torch.arange(camera.height, dtype=torch.float64, device=device) + 0.5
    return torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1)


def scaled_camera(camera: Camera, width: int, height: int) -> Camera:
    """The same camera with another image size; corners stay corners, so K scales without half-pixel terms."""
    scale = camera.K.new_tensor([width / camera.width, height / camera.height, 1.0])
    return Camera(camera.K * scale[:, None], camera.world_to_camera, width, height)


def camera_to_world(camera: Camera) -> Tensor:
    """The inverse [4,4] of the rigid `world_to_camera`, by transposition of its rotation."""
    rotation, translation = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    inverse = torch.eye(4, dtype=camera.world_to_camera.dtype, device=camera.world_to_camera.device)
    inverse[:3, :3] = rotation.T
    inverse[:3, 3] = -rotation.T @ translation
    return inverse


def camera_center(camera: Camera) -> Tensor:
    """The centre of projection in world coordinates, [3] metres."""
    return camera_to_world(camera)[:3, 3]


def camera_forward(camera: Camera) -> Tensor:
    """The optical axis in world coordinates, a unit vector [3]."""
    return camera.world_to_camera[2, :3]


def stack_cameras(cameras: Sequence[Camera], device: torch.device | None = None) -> tuple[Tensor, Tensor]:
    """K [V,3,3] and world_to_camera [V,4,4], float64, of V >= 1 cameras, for batched work."""
    K = torch.stack([camera.K for camera in cameras]).double()
    world_to_camera = torch.stack([camera.world_to_camera for camera in cameras]).double()
    return K.to(device), world_to_camera.to(device)

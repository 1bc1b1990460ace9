"""Cameras of a scan's frames, from what its manifest says."""

from __future__ import annotations

import torch
from torch import Tensor

from advtex_engine.core.scene import Camera
from advtex_scan.manifest import FrameEntry, Intrinsics, Matrix4


def frame_camera(intrinsics: Intrinsics, world_to_camera: Tensor) -> Camera:
    """The pinhole camera of an image without distortion; world_to_camera: [4,4] float64."""
    K = torch.tensor(
        [[intrinsics.fx, 0, intrinsics.cx], [0, intrinsics.fy, intrinsics.cy], [0, 0, 1]], dtype=torch.float64
    )
    return Camera(K, world_to_camera, intrinsics.width, intrinsics.height)


def inverse_pose(camera_to_world: Matrix4) -> Tensor:
    """The inverse [4,4] of a pose, its rotation replaced by the nearest true one (files round to few digits)."""
    pose = torch.tensor(camera_to_world, dtype=torch.float64)
    u, _, vt = torch.linalg.svd(pose[:3, :3])
    rotation = (u @ vt).T
    world_to_camera = torch.eye(4, dtype=torch.float64)
    world_to_camera[:3, :3] = rotation
    world_to_camera[:3, 3] = -rotation @ pose[:3, 3]
    return world_to_camera


def depth_camera(entry: FrameEntry, intrinsics: Intrinsics, depth_to_color: Matrix4) -> Camera:
    """The camera of a frame's depth image, which has these intrinsics."""
    return frame_camera(intrinsics, inverse_pose(depth_to_color) @ inverse_pose(entry.camera_to_world))

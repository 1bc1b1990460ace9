"""Meshes and cameras for tests of atlases, and what every atlas must hold."""

from __future__ import annotations

import numpy as np
import torch
import trimesh

from advtex_engine.atlas.build import SIZE_STEP, texel_coverage
from advtex_engine.core.scene import Atlas, Camera, Mesh


def camera(eye: tuple[float, float, float], width: int = 320, height: int = 240, focal: float = 300.0) -> Camera:
    """Looks from `eye` at the origin."""
    z = -np.array(eye, dtype=np.float64) / np.linalg.norm(eye)
    x = np.cross(z, (0.0, 0.3, 1.0))
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z])
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3], world_to_camera[:3, 3] = rotation, -rotation @ np.array(eye)
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float64)
    return Camera(K, torch.from_numpy(world_to_camera), width, height)


AROUND = [camera(eye) for eye in ((4, 0, 0), (-4, 0, 0), (0, 4, 0), (0, -4, 0), (0, 0.5, 4), (0, 0.5, -4))]


def of_trimesh(twin: trimesh.Trimesh) -> Mesh:
    return Mesh(torch.tensor(np.array(twin.vertices), dtype=torch.float32), torch.tensor(np.array(twin.faces)))


def bumpy_sphere(subdivisions: int, seed: int = 0) -> Mesh:
    mesh = of_trimesh(trimesh.creation.icosphere(subdivisions=subdivisions))
    torch.manual_seed(seed)
    return Mesh(mesh.v_pos * (1 + 0.05 * torch.randn(len(mesh.v_pos), 1)), mesh.t_pos_idx)


def texel_corners(atlas: Atlas) -> np.ndarray:
    assert atlas.mesh.v_uv is not None
    assert atlas.mesh.t_uv_idx is not None
    return atlas.mesh.v_uv[atlas.mesh.t_uv_idx].double().numpy() * [atlas.width, atlas.height]


def area(triangles: np.ndarray) -> np.ndarray:
    return np.abs(np.linalg.det(triangles[:, 1:] - triangles[:, :1])) / 2


def check_sound(atlas: Atlas, mesh: Mesh) -> None:
    corners = texel_corners(atlas)
    assert atlas.mesh.v_pos is mesh.v_pos
    assert atlas.mesh.t_pos_idx is mesh.t_pos_idx
    assert atlas.width == atlas.height
    assert atlas.width % SIZE_STEP == 0
    assert corners.min() >= 0
    assert corners.max() <= atlas.width
    counts = texel_coverage(corners, atlas.width, atlas.height, reach=0.0)
    assert (counts > 1).sum() <= 0.001 * (counts > 0).sum()
    # xatlas may give the thinnest of slivers no area; all others have their place.
    assert (area(corners) > 0).mean() > 0.99

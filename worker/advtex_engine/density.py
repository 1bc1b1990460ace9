"""How densely the cameras sample the surface: what decides how many texels a face is worth."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from advtex_engine.scene import Camera, Mesh

# Of more cameras an even selection is measured: quantiles over views change little, and memory stays bounded.
MAX_CAMERAS = 160
MAX_MEASUREMENTS = 20_000_000  # cameras x faces
# Which of the views that see a face counts: nearly the best one, so that a single close pass does not set the size.
VIEW_QUANTILE = 0.9
# Visibility is decided on a coarse depth buffer of points: cells of this many pixels, and relative depth tolerance.
CELL_PIXELS = 8
DEPTH_TOLERANCE = 0.1


def face_areas(mesh: Mesh) -> Tensor:
    """[T] float64, square metres."""
    a, b, c = mesh.v_pos.double()[mesh.t_pos_idx].unbind(1)
    area: Tensor = torch.linalg.vector_norm(torch.linalg.cross(b - a, c - a), dim=1) / 2
    return area


def pixel_density(mesh: Mesh, cameras: Sequence[Camera]) -> Tensor:
    """[T] float32: pixels per square metre of each face where the cameras see it best (VIEW_QUANTILE), 0 = unseen.

    A pinhole camera maps the area element with unit normal n at the camera-space point p to
    fx * fy * |n . p| / z^3 pixels. Occlusion is approximate: it is tested on a coarse depth buffer that vertices and
    centroids are splatted into, which is enough to size a texture and costs milliseconds per camera.
    """
    count = min(len(cameras), MAX_CAMERAS, max(1, MAX_MEASUREMENTS // len(mesh.t_pos_idx)))
    chosen = torch.linspace(0, len(cameras) - 1, count).round().long().tolist()
    corners = mesh.v_pos[mesh.t_pos_idx]
    normal = torch.nn.functional.normalize(
        torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), dim=1
    )
    centroid = corners.mean(dim=1)
    points = torch.cat([centroid, mesh.v_pos])
    density = torch.stack([_density_in(cameras[index], points, centroid, normal) for index in chosen])
    density[density == 0] = torch.nan
    return torch.nanquantile(density, VIEW_QUANTILE, dim=0).nan_to_num(0.0)


def _density_in(camera: Camera, points: Tensor, centroid: Tensor, normal: Tensor) -> Tensor:
    """[T] pixels per square metre in one camera, 0 where a face's centroid is hidden or out of the image."""
    world_to_camera, K = camera.world_to_camera.float(), camera.K.float()
    rotation, translation = world_to_camera[:3, :3], world_to_camera[:3, 3]
    p = points @ rotation.T + translation
    z = p[:, 2]
    in_front = z > 1e-6
    x = p[:, 0] / z * K[0, 0] + K[0, 2]
    y = p[:, 1] / z * K[1, 1] + K[1, 2]
    seen = in_front & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)

    columns, rows = -(-camera.width // CELL_PIXELS), -(-camera.height // CELL_PIXELS)
    cell = torch.zeros(len(points), dtype=torch.int64)
    cell[seen] = (y[seen] / CELL_PIXELS).long() * columns + (x[seen] / CELL_PIXELS).long()
    nearest = torch.full((rows * columns,), torch.inf)
    nearest.scatter_reduce_(0, cell[seen], z[seen], "amin")
    # A 3x3 minimum closes the holes between points that lie further apart than a cell.
    nearest = -torch.nn.functional.max_pool2d(-nearest.view(1, 1, rows, columns), 3, 1, 1).view(-1)

    faces = len(centroid)
    visible = seen[:faces] & (z[:faces] < nearest[cell[:faces]] * (1 + DEPTH_TOLERANCE))
    value = K[0, 0] * K[1, 1] * (normal @ rotation.T * p[:faces]).sum(dim=1).abs() / z[:faces] ** 3
    return torch.where(visible, value, 0.0)

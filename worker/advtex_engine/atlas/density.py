"""How densely the cameras sample the surface: what decides how many texels a face is worth."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from advtex_engine.core.scene import Camera, Mesh, face_areas
from advtex_engine.render.filtering import greatest

# Of more cameras an even selection is measured: quantiles over views change little, and memory stays bounded.
MAX_CAMERAS = 160
MAX_MEASUREMENTS = 20_000_000  # cameras x samples
# Where the surface is measured: about so many points, no fewer than one per face and MAX_CUTS^2 at most.
MIN_SAMPLES = 20_000
MAX_CUTS = 64
# Which of the views that see a face counts: nearly the best one, so that a single close pass does not set the size.
VIEW_QUANTILE = 0.9
# Visibility is decided on a coarse depth buffer of points: cells of this many pixels, and relative depth tolerance.
CELL_PIXELS = 8
DEPTH_TOLERANCE = 0.1


def pixel_density(mesh: Mesh, cameras: Sequence[Camera]) -> Tensor:
    """[T] float32: pixels per square metre of each face where the cameras see it best (VIEW_QUANTILE), 0 = unseen.

    A pinhole camera maps the area element with unit normal n at the camera-space point p to
    fx * fy * |n . p| / z^3 pixels. It is measured at points on the faces, one on a small face and many on a large one,
    and averaged over those that are seen. Occlusion is approximate: it is tested on a coarse depth buffer that the
    points are splatted into, which is enough to size a texture and costs milliseconds per camera.
    """
    face, point = _samples(mesh)
    corners = mesh.v_pos[mesh.t_pos_idx]
    normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = torch.nn.functional.normalize(normal, dim=1)[face]
    count = min(len(cameras), MAX_CAMERAS, max(1, MAX_MEASUREMENTS // len(face)))
    chosen = torch.linspace(0, len(cameras) - 1, count).round().long().tolist()
    points = torch.cat([point, mesh.v_pos])
    density = torch.stack([_density_in(cameras[index], points, normal) for index in chosen])
    density[density == 0] = torch.nan
    best = torch.nanquantile(density, VIEW_QUANTILE, dim=0).nan_to_num(0.0)
    total = torch.zeros(len(mesh.t_pos_idx)).index_add_(0, face, best)
    seen = torch.zeros(len(mesh.t_pos_idx)).index_add_(0, face, (best > 0).float())
    return total / seen.clamp(min=1)


def _samples(mesh: Mesh) -> tuple[Tensor, Tensor]:
    """Points spread over the surface: their faces [S] int64 and positions [S,3]; at least one per face.

    Each is the centroid of one of the k^2 equal triangles of a face, about 1 / MIN_SAMPLES of the surface.
    """
    area = face_areas(mesh)
    cuts = (area * (MIN_SAMPLES / area.sum())).sqrt().round().clamp(1, MAX_CUTS).long()
    faces, points = list[Tensor](), list[Tensor]()
    for k in range(1, int(cuts.max()) + 1):
        which = torch.nonzero(cuts == k)[:, 0]
        i, j = torch.meshgrid(torch.arange(k), torch.arange(k), indexing="ij")
        upright = torch.stack([i, j], dim=2)[i + j < k] + 1 / 3
        inverted = torch.stack([i, j], dim=2)[i + j < k - 1] + 2 / 3
        weight = torch.cat([upright, inverted]) / k
        weight = torch.cat([weight, 1 - weight.sum(dim=1, keepdim=True)], dim=1)  # [k^2,3]
        points.append((weight @ mesh.v_pos[mesh.t_pos_idx[which]]).view(-1, 3))
        faces.append(which.repeat_interleave(k * k))
    return torch.cat(faces), torch.cat(points)


def _density_in(camera: Camera, points: Tensor, normal: Tensor) -> Tensor:
    """[S] pixels per square metre in one camera, 0 where a sample is hidden or out of the image.

    points: [S+V,3], the samples and what else hides; normal: [S,3] of the samples.
    """
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
    nearest = -greatest(-nearest.view(rows, columns), 1).view(-1)

    samples = len(normal)
    visible = seen[:samples] & (z[:samples] < nearest[cell[:samples]] * (1 + DEPTH_TOLERANCE))
    value = K[0, 0] * K[1, 1] * (normal @ rotation.T * p[:samples]).sum(dim=1).abs() / z[:samples] ** 3
    return torch.where(visible, value, 0.0)

"""How far two surfaces lie apart: points spread over one, and their distances to the nearest faces of the other."""

from __future__ import annotations

import torch
from torch import Tensor

from advtex_engine.core.scene import Mesh

NEAREST = 8  # faces by centroid, of which the nearest is taken: enough where faces are of one size
CHUNK = 64
CELL, MARGIN = 0.25, 0.1  # metres; points of one cell are compared with the faces about it, and then with all


def spread_points(mesh: Mesh, count: int, seed: int = 0) -> Tensor:
    """Points [N,3] float64 on the mesh, spread by area."""
    generator = torch.Generator().manual_seed(seed)
    a, b, c = mesh.v_pos.double()[mesh.t_pos_idx].unbind(1)
    area = torch.linalg.cross(b - a, c - a).norm(dim=1)
    ends = area.cumsum(0)
    at = torch.rand(count, generator=generator, dtype=torch.float64) * ends[-1]
    face = torch.searchsorted(ends, at).clamp(max=len(ends) - 1)
    s, t = torch.rand((2, count, 1), generator=generator, dtype=torch.float64)
    s = s.sqrt()
    return (1 - s) * a[face] + s * (1 - t) * b[face] + s * t * c[face]


def distances(points: Tensor, mesh: Mesh) -> Tensor:
    """Metres [N] from each point to the mesh."""
    corners = mesh.v_pos.double()[mesh.t_pos_idx]
    centroids = corners.mean(1).float()
    cells = (points / CELL).floor()
    found = torch.full((len(points),), torch.inf, dtype=torch.float64)
    for cell in cells.unique(dim=0):
        mine = (cells == cell).all(1)
        low, high = (cell * CELL - MARGIN).float(), ((cell + 1) * CELL + MARGIN).float()
        near = ((centroids > low) & (centroids < high)).all(1).nonzero()[:, 0]
        if len(near):
            found[mine] = _to_nearest(points[mine], corners[near], centroids[near])
    far = found > MARGIN
    if bool(far.any()):
        found[far] = _to_nearest(points[far], corners, centroids)
    return found


def _to_nearest(points: Tensor, corners: Tensor, centroids: Tensor) -> Tensor:
    found = []
    for part in points.split(CHUNK):
        apart = torch.cdist(part.float(), centroids, compute_mode="donot_use_mm_for_euclid_dist")
        nearest = apart.topk(min(NEAREST, len(centroids)), largest=False).indices
        found.append(_to_triangles(part[:, None], corners[nearest]).amin(1))
    return torch.cat(found)


def _to_triangles(points: Tensor, corners: Tensor) -> Tensor:
    """Distances [...] of points [...,3] to triangles [...,3,3]."""
    a, b, c = corners.unbind(-2)
    normal = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
    height = ((points - a) * normal).sum(-1)
    foot = points - height[..., None] * normal
    inside = torch.ones_like(height, dtype=torch.bool)
    to_edges = torch.full_like(height, torch.inf)
    for p, q in ((a, b), (b, c), (c, a)):
        inside &= (torch.linalg.cross(q - p, foot - p) * normal).sum(-1) >= 0
        along = ((points - p) * (q - p)).sum(-1) / (q - p).square().sum(-1).clamp(min=1e-30)
        to_edges = torch.minimum(to_edges, (p + along.clamp(0, 1)[..., None] * (q - p) - points).norm(dim=-1))
    return torch.where(inside, height.abs(), to_edges)

"""Surface points for camera refinement, and which view sees which of them.

Points are spread over the mesh by area and drawn more often where the photographs have detail. All views share one
order of preference, so that the few points that a view takes are largely those that its neighbors take too.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.core.cameras import scaled_camera
from advtex_engine.core.rows import distinct_rows
from advtex_engine.core.scene import Camera, Mesh, View
from advtex_engine.render.filtering import greatest
from advtex_engine.render.rasterize import rasterize_views
from advtex_engine.render.view_maps import DEPTH_TOLERANCE

CANDIDATES = 150_000
EDGE_STEP = 0.04  # relative change of depth between neighboring pixels that counts as an edge
EDGE_RADIUS = 3  # pixels around an edge whose color may belong to either side
SURFACE_TOLERANCE = 0.01  # relative to depth: how far behind the rendered surface a point may lie and still be seen
MIN_COSINE = 0.2  # between the surface's normal and the ray: beyond 78 degrees a pixel covers too much
BORDER = 3.0  # pixels from the image's edge
DETAIL_FLOOR = 0.1  # preference for a point without any detail, relative to the mean detail
CELL_SIZE = 0.08  # of the median depth: about 25 of 320 pixels
CELLS_ACROSS = 8  # at least, what a view sees of an object: by a few cells nothing could be said of a small one


@dataclass(frozen=True)
class Observations:
    """V views and the up to K points that each looks at.

    position: [P,3] float64 world metres. point: [V,K] int64, rows of `position` (0 where pad). seen: [V,K] bool, False
    where pad.
    """

    position: Tensor
    point: Tensor
    seen: Tensor


@dataclass(frozen=True)
class Candidates:
    """Surface points that at least two views see: position and normal [N,3] float64 (world), and detail [N] >= 0.

    face: [N] int64, where each lies. weights: [N,3] float64, of the face's corners. seen: [N,V] bool, by which views.
    """

    position: Tensor
    normal: Tensor
    detail: Tensor
    face: Tensor
    weights: Tensor
    seen: Tensor

    def chosen(self, rows: Tensor) -> Candidates:
        """Some of them, by rows [M] int64 or [N] bool."""
        return Candidates(*(part[rows] for part in vars(self).values()))

    def on(self, mesh: Mesh) -> Tensor:
        """The same points of a mesh whose vertices have moved, [N,3] float64."""
        return (mesh.v_pos.double()[mesh.t_pos_idx[self.face]] * self.weights[..., None]).sum(1)


def surface_depths(
    mesh: Mesh, views: tuple[View, ...], size: tuple[int, int], kind: str
) -> tuple[list[Camera], Tensor, Tensor]:
    """The cameras at `size` (width, height), what they see of the mesh, [V,h,w] float32 metres, and which pixels show
    it at all, [V,h,w] bool.

    Depth is 0 where nothing is hit, near a depth edge, where the device's depth shows something else than the mesh, and
    where the view's mask leaves a pixel out.
    """
    width, height = size
    cameras = [scaled_camera(view.camera, width, height) for view in views]
    depths, shown = [], []
    for view, fragments in zip(views, rasterize_views(mesh, cameras), strict=True):
        depth = fragments.depth
        hit = fragments.face_index >= 0
        keep = hit & ~_near_edge(depth)
        if view.depth is not None:
            measured = F.interpolate(view.depth[None, None].to(depth.device), (height, width), mode="nearest")[0, 0]
            keep &= (measured == 0) | ((measured - depth).abs() < DEPTH_TOLERANCE[kind])
        if view.mask is not None:
            used = view.mask[None, None].to(depth)
            wholly = -F.adaptive_max_pool2d(-used, (height, width))[0, 0] > 0
            keep, hit = keep & wholly, hit & wholly
        depths.append(torch.where(keep, depth, 0.0))
        shown.append(hit)
    return cameras, torch.stack(depths), torch.stack(shown)


def _near_edge(depth: Tensor) -> Tensor:
    """[h,w] bool: within EDGE_RADIUS of a jump in depth or of the mesh's outline."""
    most, least = greatest(depth, 1), -greatest(-depth, 1)
    return greatest(most - least > 2 * EDGE_STEP * most, EDGE_RADIUS)


def draw_candidates(
    mesh: Mesh, cameras: list[Camera], depths: Tensor, detail: Tensor, generator: torch.Generator
) -> Candidates:
    """CANDIDATES points by area, without those that fewer than two views see.

    depths: [V,h,w] of `surface_depths`. detail: [V,h,w] float32, the image's local contrast; a point's is the mean over
    the views that see it. generator: on the CPU, so that every device draws the same.
    """
    device = mesh.v_pos.device
    corners = mesh.v_pos.double().cpu()[mesh.t_pos_idx.cpu()]
    normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = normal.norm(dim=1)
    # Inverse of the cumulative area: torch.multinomial takes no more than 2^24 faces.
    place = torch.rand(CANDIDATES, generator=generator, dtype=torch.float64) * area.sum()
    face = torch.searchsorted(area.cumsum(0), place).clamp(max=len(area) - 1)
    a, b = torch.rand(2, CANDIDATES, generator=generator, dtype=torch.float64)
    root = a.sqrt()
    weights = torch.stack((1 - root, root * (1 - b), root * b), 1)
    position = (corners[face] * weights[..., None]).sum(1).to(device)
    unit = (normal[face] / area[face].clamp(min=1e-30)[:, None]).to(device)
    total = torch.zeros(CANDIDATES, dtype=torch.float64, device=device)
    seen = torch.zeros((CANDIDATES, len(cameras)), dtype=torch.bool, device=device)
    for view, (rows, pixel) in enumerate(looks(position, unit, cameras, depths)):
        total[rows] += detail[view].flatten()[pixel]
        seen[rows, view] = True
    count = seen.sum(1)
    detail_of = total / count.clamp(min=1)
    return Candidates(position, unit, detail_of, face.to(device), weights.to(device), seen).chosen(count >= 2)


def observe(candidates: Candidates, most: int) -> Observations:
    """The first `most` of the candidates that each view sees."""
    views = candidates.seen.shape[1]
    point = torch.zeros((views, most), dtype=torch.int64, device=candidates.seen.device)
    seen = torch.zeros_like(point, dtype=torch.bool)
    for view in range(views):
        taken = candidates.seen[:, view].nonzero()[:most, 0]
        point[view, : len(taken)] = taken
        seen[view, : len(taken)] = True
    return Observations(candidates.position, point, seen)


def order_of_preference(candidates: Candidates, generator: torch.Generator) -> Tensor:
    """[N] int64: a random order in which points with more detail tend to come first (weighted, no replacement)."""
    weight = candidates.detail + DETAIL_FLOOR * candidates.detail.mean()
    wait = torch.rand(len(weight), generator=generator, dtype=torch.float64).clamp(min=1e-12).log().neg()
    return (wait.to(weight.device) / weight.clamp(min=1e-12)).argsort()


def surface_cells(candidates: Candidates, cameras: list[Camera], depths: Tensor, kind: str) -> Tensor:
    """[N] int64: the cell of a grid in space that each point lies in.

    depths: what the cameras see, [V,h,w]. Cells are CELL_SIZE of their median wide, those of an object less if need be,
    so that there are CELLS_ACROSS of them to what a view sees.
    """
    width = CELL_SIZE
    if kind == "object":
        across = (depths > 0).flatten(1).sum(1).double().sqrt().median() / float(cameras[0].K[0, 0])
        width = min(width, float(across) / CELLS_ACROSS)
    return grid_cells(candidates.position, width * float(depths[depths > 0].median()))


def grid_cells(position: Tensor, width: float) -> Tensor:
    """[N] int64: the cell of a grid in space, so many metres wide, that each position [N,3] lies in."""
    return distinct_rows((position / width).floor().long())[1]


def looks(position: Tensor, normal: Tensor, cameras: list[Camera], depths: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """Per view: the points (position and normal [N,3], world) [S] int64 that it sees, in order, and the pixels [S]
    (flat) where it sees them.

    depths: [V,h,w] of `surface_depths`.
    """
    height, width = depths.shape[1:]
    points, normals = (part.mT.contiguous() for part in (position, normal))
    for camera, depth in zip(cameras, depths, strict=True):
        K, pose = camera.K.to(position), camera.world_to_camera.to(position)
        x, y, z = (K @ pose[:3, :3]) @ points + (K @ pose[:3, 3])[:, None]
        inside = (x > BORDER * z) & (x < (width - BORDER) * z) & (y > BORDER * z) & (y < (height - BORDER) * z)
        near = (inside & (z > 0)).nonzero()[:, 0]
        far = z[near]
        pixel = (y[near] / far).long() * width + (x[near] / far).long()
        surface = depth.flatten()[pixel]
        shown = (surface > 0) & (far < surface.double() * (1 + SURFACE_TOLERANCE))
        near, pixel = near[shown], pixel[shown]
        ray = points[:, near] + (pose[:3, :3].T @ pose[:3, 3])[:, None]
        cosine = (normals[:, near] * ray).sum(0).abs() / ray.square().sum(0).sqrt()
        seen = cosine > MIN_COSINE
        yield near[seen], pixel[seen]

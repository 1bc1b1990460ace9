"""Seams: what makes faces that show different views meet without a visible edge.

Two steps, after Waechter et al. 2014, section 4.2, and Burt & Adelson 1983. Global: each region of one view gets a
smooth color offset, least squares over the corners of its faces, so that regions meet in the same color. Local: near a
seam the low frequencies of the views on both sides are blended over a few rings of faces, while the fine detail is
that of one view alone; blending the detail of views that are off by a pixel would blur it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.core.neighbors import Neighbors
from advtex_engine.core.scene import Mesh
from advtex_engine.render.reproject import MIN_DEPTH
from advtex_engine.render.texels import TexelMap, surface_points
from advtex_engine.render.texture import bilinear_footprint
from advtex_engine.render.view_maps import ViewMaps
from advtex_engine.selection.mrf import Adjacency, edge_ends, face_adjacency

LOW_BAND = 8  # pixels that an average takes along each side to be called low-frequency
BLEND_RINGS = 2  # steps between neighboring vertices that views fade over, on either side of a seam
SMOOTHNESS = 0.1  # of the offsets within a region, against 1 for meeting at a seam (Waechter et al.)
ANCHOR = 1e-3  # pull of every offset to 0: far from all seams a view keeps its colors
# Two views that differ by more than this across a seam show different things, and no exposure explains it.
ROBUST_SCALE = 0.1
SOLVER_ROUNDS = 150
SOLVER_TOLERANCE = 1e-4


@dataclass(frozen=True)
class Nodes:
    """Pairs of a vertex and a view that some face at the vertex shows.

    vertex, view: [N] int64. corner: [T,3] int64, the node of each face's corners; -1 where the face has no view.
    """

    vertex: Tensor
    view: Tensor
    corner: Tensor


def make_nodes(t_pos_idx: Tensor, label: Tensor, views: int) -> Nodes:
    """Nodes of a labeling [T] (-1 = none), in ascending order of vertex and view."""
    keys = t_pos_idx * views + label[:, None]
    seen = label >= 0
    unique, inverse = torch.unique(keys[seen], return_inverse=True)
    corner = torch.full_like(t_pos_idx, -1)
    corner[seen] = inverse
    return Nodes(unique // views, unique % views, corner)


def seam_offsets(t_pos_idx: Tensor, label: Tensor, adjacency: Adjacency, nodes: Nodes, color: Tensor) -> Tensor:
    """[N,3] what to add to a view's color at each node so that views meet at seams.

    color: [N,3] low-frequency color of the node's view at its vertex, in [0,1].
    """
    sides = label[adjacency.face]
    seam = (sides >= 0).all(1) & (sides[:, 0] != sides[:, 1])
    a, b = (
        nodes.corner[adjacency.face[seam, k]].gather(1, edge_ends(t_pos_idx, adjacency, k)[seam]).flatten()
        for k in (0, 1)
    )
    gap = color[b] - color[a]
    weight = 1 / (1 + (gap.square().mean(1, keepdim=True) / ROBUST_SCALE**2)).square()
    inner = nodes.corner[label >= 0]
    first, second = inner.flatten(), inner.roll(-1, 1).flatten()

    strength = torch.cat((weight[:, 0], weight.new_full((len(first),), SMOOTHNESS)))
    linked = Neighbors(torch.cat((a, first)), torch.cat((b, second)), len(color), strength)

    def apply(x: Tensor) -> Tensor:
        return ANCHOR * x + linked.laplacian(x)

    push = torch.zeros_like(color).index_add_(0, a, gap * weight).index_add_(0, b, -gap * weight)
    return conjugate_gradients(apply, push)


def conjugate_gradients(apply: Callable[[Tensor], Tensor], b: Tensor) -> Tensor:
    """x [N,C] with apply(x) = b, per column; apply: symmetric positive definite."""
    x, r = torch.zeros_like(b), b.clone()
    p, rr = r.clone(), r.square().sum(0)
    goal = rr * SOLVER_TOLERANCE**2
    for _ in range(SOLVER_ROUNDS):
        if bool((rr <= goal).all()):
            break
        q = apply(p)
        step = rr / (p * q).sum(0).clamp(min=1e-30)
        x += step * p
        r -= step * q
        new = r.square().sum(0)
        p = r + p * (new / rr.clamp(min=1e-30))
        rr = new
    return x


@dataclass(frozen=True)
class Sampler:
    """Where world points are in the views and whether they are seen there, up to `tolerance` metres in depth."""

    maps: ViewMaps
    tolerance: float

    def image(self, view: int) -> Tensor:
        """[1,3,H,W] in [0,1]."""
        size = (self.maps.height, self.maps.width, 3)
        image = self.maps.color[view].to(self.maps.device).view(size)
        return image.permute(2, 0, 1)[None].to(torch.float32) / 255

    def grid(self, view: int, points: Tensor) -> tuple[Tensor, Tensor]:
        """World points [N,3] -> positions [1,1,N,2] for grid_sample, and depth [N] in metres."""
        pose = self.maps.world_to_camera[view]
        # float64 would cost twice the time; float32 about the camera's center is as good.
        center = -pose[:3, :3].T @ pose[:3, 3]
        seen = (points - center.to(points)) @ pose[:3, :3].T.to(points)
        focal, principal = self.maps.intrinsics[view, :2], self.maps.intrinsics[view, 2:]
        pixel = seen[:, :2] / seen[:, 2:].clamp(min=MIN_DEPTH) * focal + principal
        return (pixel / pixel.new_tensor([self.maps.width, self.maps.height]) * 2 - 1)[None, None], seen[:, 2]

    def sees(self, view: int, grid: Tensor, depth: Tensor) -> Tensor:
        """[N] whether one of the four pixels around a position shows the surface at about this depth."""
        pixel = (grid[0, 0] + 1) / 2 * grid.new_tensor([self.maps.width, self.maps.height])
        indices, _ = bilinear_footprint(pixel, self.maps.width, self.maps.height)
        surface = self.maps.depth[view].to(self.maps.device)[indices].to(torch.float32)
        return ((surface > 0) & ((surface - depth[:, None]).abs() < self.tolerance)).any(1)


def full_band(image: Tensor, grid: Tensor) -> Tensor:
    """[N,3] bicubic samples of an image [1,3,H,W]."""
    return F.grid_sample(image, grid, mode="bicubic", padding_mode="border", align_corners=False)[0, :, 0].T


def low_band(image: Tensor, grid: Tensor) -> Tensor:
    """[N,3] smooth samples of the averages over LOW_BAND x LOW_BAND pixels."""
    height, width = image.shape[2:]
    small = F.adaptive_avg_pool2d(image, (-(-height // LOW_BAND), -(-width // LOW_BAND)))
    return F.grid_sample(small, grid, mode="bilinear", padding_mode="border", align_corners=False)[0, :, 0].T


def node_colors(mesh: Mesh, sampler: Sampler, nodes: Nodes) -> Tensor:
    """[N,3] low-frequency color of each node's view at its vertex."""
    color = torch.zeros((len(nodes.vertex), 3), device=mesh.v_pos.device)
    for view in range(sampler.maps.count):
        mine = (nodes.view == view).nonzero()[:, 0]
        if len(mine):
            grid, _ = sampler.grid(view, mesh.v_pos[nodes.vertex[mine]])
            color[mine] = low_band(sampler.image(view), grid)
    return color


@dataclass(frozen=True)
class Blend:
    """color: [N,3] of N texels, 0 where not known. known: [N] bool, whether the view of the texel's face sees it.

    own: [N] share of that view in the texel's low band.
    """

    color: Tensor
    known: Tensor
    own: Tensor


def blend_texels(mesh: Mesh, texels: TexelMap, label: Tensor, sees: Tensor, sampler: Sampler) -> Blend:
    """Colors of texels: detail of their face's view, low band of all views that are shown nearby, leveled.

    label: [T] view of each face, -1 = none. sees: [T,K] views that see the face, -1 = none; a view fades only over
    faces that it sees.
    """
    maps, adjacency = sampler.maps, face_adjacency(mesh.t_pos_idx)
    nodes = make_nodes(mesh.t_pos_idx, label, maps.count)
    offset = seam_offsets(mesh.t_pos_idx, label, adjacency, nodes, node_colors(mesh, sampler, nodes))
    rings = Rings(mesh.t_pos_idx, len(mesh.v_pos))
    incidence = torch.bincount(nodes.corner[label >= 0].flatten(), minlength=len(nodes.vertex))
    faces = torch.bincount(nodes.vertex, incidence.double(), minlength=len(mesh.v_pos)).clamp(min=1)
    share = (incidence / faces[nodes.vertex]).to(torch.float32)[:, None]
    weighted = torch.cat((offset * share, share), 1)
    count = len(texels.texel)
    detail, low, weight, own = (torch.zeros((count, n), device=mesh.v_pos.device) for n in (3, 3, 1, 1))
    known = torch.zeros(count, dtype=torch.bool, device=mesh.v_pos.device)
    points = surface_points(mesh, texels)
    for view in range(maps.count):
        mine = nodes.view == view
        if not bool(mine.any()):
            continue
        field = torch.zeros((len(mesh.v_pos), 4), device=points.device)
        field[nodes.vertex[mine]] = weighted[mine]
        field = rings.fade(field, BLEND_RINGS)
        shown = (field[mesh.t_pos_idx, 3] > 0).any(1) & ((sees == view).any(1) | (label == view))
        which = shown[texels.face].nonzero()[:, 0]
        face = texels.face[which]
        at = (field[mesh.t_pos_idx[face]] * texels.barycentric[which].clamp(min=0)[..., None]).sum(1)
        image, (grid, depth) = sampler.image(view), sampler.grid(view, points[which])
        smooth = low_band(image, grid)
        low[which] += at[:, 3:] * smooth + at[:, :3]
        weight[which] += at[:, 3:]
        detailed = (label[face] == view).nonzero()[:, 0]
        detail[which[detailed]] = full_band(image, grid[:, :, detailed]) - smooth[detailed]
        own[which[detailed]] = at[detailed, 3:]
        known[which[detailed]] = sampler.sees(view, grid[:, :, detailed], depth[detailed])
    weight = weight.clamp(min=1e-6)
    return Blend(torch.where(known[:, None], low / weight + detail, 0.0).clamp(0, 1), known, (own / weight)[:, 0])


class Rings:
    """Averages of vertex values over their neighbors."""

    def __init__(self, t_pos_idx: Tensor, vertices: int) -> None:
        ends = torch.stack((t_pos_idx, t_pos_idx.roll(-1, 1)), 2).sort(2).values.view(-1, 2)
        key = torch.unique(ends[:, 0] * vertices + ends[:, 1])
        self._linked = Neighbors(key // vertices, key % vertices, vertices)
        self._over = 1 / (1 + self._linked.degree[:, None])

    def fade(self, field: Tensor, times: int) -> Tensor:
        """[V,C], `times` replaced by the mean of each vertex and its neighbors."""
        for _ in range(times):
            field = (field + self._linked.sums(field)) * self._over
        return field

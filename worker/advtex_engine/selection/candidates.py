"""Which views show a face well: the data term of view selection.

Each face is looked at in POINTS places, three corners, three edge midpoints and the centroid, which are shared between
faces. A view is a candidate for a face when it sees most of them, and a poor one if not all. Of the candidates the best
K are kept while the views go by, so that memory does not grow with the number of views; then those that disagree with
the others are marked down.

The data term is a sum of logarithms, each the factor by which another view of the same face is better:
resolution (square root of the projected area), frontality, the right side, sharpness of the frame, distance from depth
discontinuities and from the image's border, and agreement in color with the face's other candidates. `detail.py` adds
what a frame is blurred by in one region and not in another.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.core.scene import Camera, Mesh
from advtex_engine.render.rasterize import rasterize_views
from advtex_engine.render.reproject import MIN_DEPTH
from advtex_engine.render.texture import bilinear_footprint
from advtex_engine.render.view_maps import ViewMaps

POINTS = 7
KEPT_VIEWS = 16
NO_VIEW = 1e4  # data term of an empty place
# Of theta_z, the tolerance of reprojection between views: here one surface is told from another.
OCCLUSION_SHARE = 0.3
# Pixels from an edge of the view's surface at which a place is as good as any: poses and depth are off by some pixels.
SAFE_DISTANCE = 8
# Neighboring pixels whose depths differ by more than this share of the depth belong to different surfaces.
DEPTH_JUMP = 0.03
MIN_SHARE = 0.5  # of a face's places must be seen
ORIENTED_SHARE = 0.9  # of the pixels must show the same side of faces for the mesh to tell front from back
ORIENTING_VIEWS = 12
HIDDEN_WEIGHT = 6.0
BEHIND_WEIGHT = 6.0
GRAZING_WEIGHT = 0.5
EDGE_WEIGHT = 1.0
SHARPNESS_WEIGHT = 1.0
AGREEMENT_WEIGHT = 0.75
AGREEMENT_ROUNDS = 4
AGREEMENT_SCALE = 0.05  # least deviation in color, of 1, that counts as disagreement
MAX_DISAGREEMENT = 3.0


@dataclass(frozen=True)
class FacePoints:
    """The places at which faces are looked at: position [P,3] world metres, index [T,7] of each face's.

    Order: corners 0, 1, 2; midpoints of the sides 0-1, 1-2, 2-0; centroid.
    """

    position: Tensor
    index: Tensor


@dataclass(frozen=True)
class Candidates:
    """The best K views of each of T faces, in no order.

    view: [T,K] int64, -1 = none. cost: [T,K] float32, the data term without agreement; NO_VIEW where none.
    disagreement: [T,K] float32, the data term's part for agreement with the other views.
    color: [T,K,7,3] uint8, what the view shows at the face's places.
    """

    view: Tensor
    cost: Tensor
    disagreement: Tensor
    color: Tensor


def face_points(mesh: Mesh) -> FacePoints:
    """Corners, edge midpoints and centroids; neighbors share corners and midpoints."""
    corners = mesh.t_pos_idx
    count = len(mesh.v_pos)
    ends = torch.stack((corners, corners.roll(-1, 1)), 2).sort(2).values
    keys, side = torch.unique(ends[..., 0] * count + ends[..., 1], return_inverse=True)
    midpoint = (mesh.v_pos[keys // count] + mesh.v_pos[keys % count]) / 2
    centroid = mesh.v_pos[corners].mean(1)
    own = torch.arange(len(corners), device=corners.device)[:, None] + count + len(keys)
    return FacePoints(torch.cat((mesh.v_pos, midpoint, centroid)), torch.cat((corners, side + count, own), 1))


def find_candidates(mesh: Mesh, maps: ViewMaps, tolerance: float) -> Candidates:
    """The best KEPT_VIEWS views of each face and their data terms.

    tolerance: metres in depth by which a place may lie behind what a view shows there. maps: at the size that the
    texture is sampled from. Not differentiable.
    """
    points = face_points(mesh)
    faces, device = len(mesh.t_pos_idx), mesh.v_pos.device
    corners = mesh.v_pos[mesh.t_pos_idx]
    normal = F.normalize(torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), dim=1)
    kept = Candidates(
        torch.full((faces, KEPT_VIEWS), -1, device=device),
        torch.full((faces, KEPT_VIEWS), NO_VIEW, device=device),
        torch.zeros((faces, KEPT_VIEWS), device=device),
        torch.zeros((faces, KEPT_VIEWS, POINTS, 3), dtype=torch.uint8, device=device),
    )
    blur, front = frame_blur(maps), front_side(mesh, normal, maps)
    for view in range(maps.count):
        _look(view, points, normal, front, maps, float(blur[view]), tolerance, kept)
    return replace(kept, disagreement=disagreement(kept.color, kept.view >= 0))


def front_side(mesh: Mesh, normal: Tensor, maps: ViewMaps) -> int:
    """1 if views see faces on the side of their normals [T,3], -1 if on the other, 0 if the mesh has no such order.

    The far side of a wall that is thinner than the tolerance would else be painted with what its near side shows. Such
    walls are the exception: what holds for ORIENTED_SHARE of the pixels holds for all.
    """
    center = mesh.v_pos[mesh.t_pos_idx].mean(1)
    some = range(0, maps.count, -(-maps.count // ORIENTING_VIEWS))
    front, count = torch.zeros((2, 1), device=center.device)
    for view, seen in zip(some, rasterize_views(mesh, [_camera(maps, view) for view in some]), strict=True):
        face = seen.face_index[seen.face_index >= 0]
        front += ((normal[face] * _rays(center[face], maps, view)).sum(1) < 0).sum()
        count += len(face)
    share = float(front / count.clamp(min=1))
    if ORIENTED_SHARE > share > 1 - ORIENTED_SHARE:
        return 0
    return 1 if share > 0.5 else -1


def _camera(maps: ViewMaps, view: int) -> Camera:
    fx, fy, cx, cy = maps.intrinsics[view].double().tolist()
    K = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)
    return Camera(K, maps.world_to_camera[view].double().cpu(), maps.width, maps.height)


def _rays(position: Tensor, maps: ViewMaps, view: int) -> Tensor:
    """Unit vectors [P,3] from the camera to world points."""
    center = -maps.world_to_camera[view, :3, :3].T @ maps.world_to_camera[view, :3, 3]
    return F.normalize(position - center.to(position), dim=1)


def _look(
    view: int,
    points: FacePoints,
    normal: Tensor,
    front: int,
    maps: ViewMaps,
    blur: float,
    tolerance: float,
    kept: Candidates,
) -> None:
    """Puts a view into the places of worse ones, for the faces that it sees. front: as `front_side` says."""
    pixel, depth = project_points(points.position, maps, view)
    inside = (depth > MIN_DEPTH) & (pixel > 0.5).all(1)
    inside &= (pixel[:, 0] < maps.width - 0.5) & (pixel[:, 1] < maps.height - 0.5)
    face = inside[points.index[:, :3]].all(1).nonzero()[:, 0]
    index = points.index[face]
    needed = torch.zeros_like(inside)
    needed[index] = True
    safe, color = _sample(pixel, depth, needed.nonzero()[:, 0], maps, view, tolerance)
    at = safe[index]
    share = (at > 0).to(torch.float32).mean(1)
    cosine = -(normal[face] * _rays(points.position[index[:, 6]], maps, view)).sum(1)
    behind = cosine * front < 0
    enough = share > MIN_SHARE
    face, index, at, share, cosine, behind = (part[enough] for part in (face, index, at, share, cosine.abs(), behind))
    a, b, c = pixel[index[:, :3]].unbind(1)
    area = ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]).abs() / 2
    cost = -0.5 * area.clamp(min=1e-6).log() - GRAZING_WEIGHT * cosine.clamp(min=1e-3).log()
    cost += HIDDEN_WEIGHT * (1 - share) + EDGE_WEIGHT * (1 - at.amin(1)) + SHARPNESS_WEIGHT * blur
    cost += BEHIND_WEIGHT * behind
    worst, place = kept.cost[face].max(1)
    better = cost < worst
    face, place = face[better], place[better]
    kept.view[face, place] = view
    kept.cost[face, place] = cost[better]
    kept.color[face, place] = color[index[better]]


def project_points(position: Tensor, maps: ViewMaps, view: int) -> tuple[Tensor, Tensor]:
    """Pixels [P,2] and depth [P] of world points."""
    pose = maps.world_to_camera[view].to(position)
    seen = position @ pose[:3, :3].T + pose[:3, 3]
    depth = seen[:, 2]
    on_plane = seen[:, :2] / torch.where(depth > MIN_DEPTH, depth, 1.0)[:, None]
    return on_plane * maps.intrinsics[view, :2] + maps.intrinsics[view, 2:], depth


def _sample(
    pixel: Tensor, depth: Tensor, which: Tensor, maps: ViewMaps, view: int, tolerance: float
) -> tuple[Tensor, Tensor]:
    """Safety [P] in [0,1], 0 where the view does not see the point, and its color [P,3] uint8; of points `which`."""
    indices, weights = bilinear_footprint(pixel[which], maps.width, maps.height)
    maps = maps.only(view)
    view_depth = maps.depth[0].to(torch.float32)
    surface = view_depth[indices]
    # The best of four pixels decides, or else every point beside an occluding edge would count as hidden.
    apart = torch.where(surface > 0, (surface - depth[which, None]).abs(), torch.inf).amin(1)
    safety = edge_distance(view_depth.view(maps.height, maps.width)).flatten() / SAFE_DISTANCE
    reliable = (safety[indices] * weights).sum(1).clamp(min=1e-3)
    safe = torch.zeros_like(depth)
    safe[which] = torch.where(apart < tolerance, reliable, 0.0)
    color = torch.zeros((len(pixel), 3), dtype=torch.uint8, device=pixel.device)
    image = maps.color[0].to(torch.float32)
    color[which] = F.embedding_bag(indices, image, per_sample_weights=weights, mode="sum").round().to(torch.uint8)
    return safe, color


def edge_distance(depth: Tensor) -> Tensor:
    """[H,W] pixels (chessboard) to the nearest border, hole or discontinuity of a depth map, at most SAFE_DISTANCE."""
    edge = F.pad(depth == 0, (1, 1, 1, 1), value=True)
    for axis in (0, 1):
        before, after = depth.narrow(axis, 0, depth.shape[axis] - 1), depth.narrow(axis, 1, depth.shape[axis] - 1)
        nearer = torch.minimum(before, after)
        jump = (nearer > 0) & ((before - after).abs() > DEPTH_JUMP * nearer)
        inner = edge[1:-1, 1:-1]
        inner.narrow(axis, 0, depth.shape[axis] - 1).logical_or_(jump)
        inner.narrow(axis, 1, depth.shape[axis] - 1).logical_or_(jump)
    distance = torch.zeros(edge.shape, device=depth.device)
    for _ in range(SAFE_DISTANCE):
        distance += ~edge
        edge = _dilated(edge)
    return distance[1:-1, 1:-1]


def _dilated(mask: Tensor) -> Tensor:
    """[H,W] bool, grown by one pixel in all eight directions."""
    rows = mask.clone()
    rows[1:] |= mask[:-1]
    rows[:-1] |= mask[1:]
    both = rows.clone()
    both[:, 1:] |= rows[:, :-1]
    both[:, :-1] |= rows[:, 1:]
    return both


def luminance(color: Tensor) -> Tensor:
    """[...,3] uint8 -> [...] float32 in [0,1] (Rec. 601 weights, of the sRGB values)."""
    return color.to(torch.float32) @ torch.tensor([0.299, 0.587, 0.114], device=color.device) / 255


def frame_blur(maps: ViewMaps) -> Tensor:
    """[V] how much blurrier each frame is than the median frame: a logarithm, 0 for the sharper half.

    The ratio of the energies of fine and of coarse detail falls with motion blur and depends little on the content.
    """
    ratios = []
    for view in range(maps.count):
        gray = luminance(maps.color[view].to(maps.device)).view(1, 1, maps.height, maps.width)
        coarse = F.avg_pool2d(gray, 2)
        ratios.append(_gradient(gray) / _gradient(coarse).clamp(min=1e-6))
    ratio = torch.stack(ratios).clamp(min=1e-6).log()
    return (ratio.median() - ratio).clamp(min=0)


def _gradient(gray: Tensor) -> Tensor:
    """Root of the mean squared difference of neighbors."""
    return ((gray.diff(dim=2) ** 2).mean() + (gray.diff(dim=3) ** 2).mean()).sqrt()


def mean_colors(color: Tensor) -> Tensor:
    """[T,K,7,3] uint8 -> [T,K,3] float32 in [0,1], the means over a face's places."""
    # Place by place: all of them in float32 would be the largest thing in a run's memory.
    total = color[:, :, 0].to(torch.float32)
    for place in range(1, POINTS):
        total += color[:, :, place]
    return total / POINTS / 255


def disagreement(color: Tensor, valid: Tensor) -> Tensor:
    """[T,K] how far each view's mean color lies from what most views of the face show, 0 to MAX_DISAGREEMENT.

    color: [T,K,7,3] uint8; valid: [T,K] bool. Means over a face, because the places themselves agree best in views
    that lack detail, such as thin lines that the others show in different places. The consensus is a mean with weights
    exp(-d^2 / 2 s^2) found by repetition, s the root mean square deviation so far but at least AGREEMENT_SCALE.
    """
    values = mean_colors(color)
    weight = valid.to(torch.float32)
    for _ in range(AGREEMENT_ROUNDS):
        total = weight.sum(1, keepdim=True).clamp(min=1e-6)
        mean = (values * weight[..., None]).sum(1, keepdim=True) / total[..., None]
        squared = ((values - mean) ** 2).mean(2)
        scale = ((squared * weight).sum(1, keepdim=True) / total).clamp(min=AGREEMENT_SCALE**2)
        weight = torch.exp(-squared / (2 * scale)) * valid
    return AGREEMENT_WEIGHT * torch.where(valid, (squared / AGREEMENT_SCALE**2 / 2).clamp(max=MAX_DISAGREEMENT), 0.0)

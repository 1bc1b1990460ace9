"""Cameras that circle a model, for pictures of it from all around.

A room is looked into from above and outside: faces that turn their back to the camera are left out, so that the walls
and the ceiling in front are not in the way. Of a closed object that leaves nothing out that could be seen. What was
scanned from one side alone has no other: the cameras swing to and fro on that side.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from advtex_engine.core.cameras import camera_center
from advtex_engine.core.scene import Atlas, Camera, Mesh, View
from advtex_engine.render.rasterize import rasterize_views

FRAMES = 24
SIZE = (480, 360)
FIELD_OF_VIEW = 40.0  # degrees, of the image's shorter side
ELEVATION = {True: 48.0, False: 22.0}
"""Degrees above the horizon, by whether the scan's cameras stand inside of the model."""
INSIDE_SHARE = 0.5  # of the cameras within the model's box: then it is a room
OUTLIERS = 0.01  # of the vertices, on each side of the box
CERTAIN = 0.8  # share of the seen pixels that show one side of the surface: then the other side is its back
PROBES, PROBE_WIDTH = 4, 160
LEVEL = 0.966  # cosine between a level face's normal and the up axis
LEVEL_SHARE = 0.1  # of the surface, to overrule the up axis that the scan tells
ONE_SIDE, BEYOND = math.radians(75.0), math.radians(20.0)
MARGIN = 1.05
NEAREST = 0.05  # metres
POINTS = 20_000
AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


@dataclass(frozen=True)
class Circle:
    """Where the turntable's cameras stand.

    points: [P,3] what the pictures have to hold. center: [3] what they look at. up: [3] unit. front: [3] unit, across
    `up`: from the center to the first camera's side. inside: whether it is a room. outer: 1 where faces are seen from
    the side that their corners circle counterclockwise, -1 from the other, 0 when both sides are seen. swing: how far
    the cameras go to both sides of the front, radians; pi is all the way around.
    """

    points: Tensor
    center: Tensor
    up: Tensor
    front: Tensor
    inside: bool
    outer: int
    swing: float


def find_circle(mesh: Mesh, views: Sequence[View], up_axis: str) -> Circle:
    """A circle around the model on the scan's side of it. Not differentiable."""
    points = mesh.v_pos.double().cpu()
    points = points[torch.unique(mesh.t_pos_idx.cpu())]
    points = points[:: max(1, len(points) // POINTS)]
    low, high = (torch.quantile(points, share, dim=0) for share in (OUTLIERS, 1 - OUTLIERS))
    center = (low + high) / 2
    centers = torch.stack([camera_center(view.camera) for view in views]).double()
    within = ((centers > low) & (centers < high)).all(1)
    inside = float(within.double().mean()) >= INSIDE_SHARE
    up = _up(mesh, views, up_axis)
    side = centers.mean(0) - center
    # A camera inside looks at what lies before it: the circle begins behind its back.
    if inside:
        side = -torch.stack([view.camera.world_to_camera[2, :3] for view in views]).double().mean(0)
    front = _across(side, up)
    swing = math.pi if inside else _swing(centers - center, up, front)
    return Circle(points.clamp(low, high), center, up, front, inside, _outer_side(mesh, views), swing)


def _swing(directions: Tensor, up: Tensor, front: Tensor) -> float:
    """As far as the scan's cameras [V,3] went to either side, and a little more; pi if that is most of the way."""
    across = directions @ torch.linalg.cross(up, front)
    widest = float(torch.atan2(across, directions @ front).abs().max())
    return math.pi if widest > ONE_SIDE else widest + BEYOND


def circle_cameras(circle: Circle, size: tuple[int, int] = SIZE, frames: int = FRAMES) -> list[Camera]:
    """Cameras around the model, the last one's neighbor is the first; as near as all of them hold the whole model."""
    directions = [_outward(circle, frame / frames) for frame in range(frames)]
    poses = [camera_at(circle.center + direction, circle.center, circle.up, size) for direction in directions]
    reach = MARGIN * max(_reach(circle, camera) for camera in poses)
    return [camera_at(circle.center + reach * way, circle.center, circle.up, size) for way in directions]


def _outward(circle: Circle, turn: float) -> Tensor:
    """The unit vector from the center to the camera at `turn` in [0,1) of the way around."""
    angle, elevation = 2 * math.pi * turn, math.radians(ELEVATION[circle.inside])
    if circle.swing < math.pi:
        angle = circle.swing * math.sin(angle)
    side = torch.linalg.cross(circle.up, circle.front)
    flat = math.cos(angle) * circle.front + math.sin(angle) * side
    outward: Tensor = math.cos(elevation) * flat + math.sin(elevation) * circle.up
    return outward


def _reach(circle: Circle, camera: Camera) -> float:
    """How far from the center a camera that looks the same way has to be for the model to fit into its image."""
    seen = (circle.points - circle.center) @ camera.world_to_camera[:3, :3].T
    half = torch.tensor([camera.width, camera.height]) / 2 / camera.K[0, 0]
    return max(float((seen[:, :2].abs() / half - seen[:, 2:]).max()), NEAREST)


def camera_at(position: Tensor, target: Tensor, up: Tensor, size: tuple[int, int]) -> Camera:
    """A camera at `position` [3] that looks at `target` [3], with `up` [3] towards the image's top."""
    forward = (target - position) / (target - position).norm()
    right = torch.linalg.cross(forward, up)
    right = right / right.norm()
    world_to_camera = torch.eye(4, dtype=torch.float64)
    world_to_camera[:3, :3] = torch.stack((right, torch.linalg.cross(forward, right), forward))
    world_to_camera[:3, 3] = -world_to_camera[:3, :3] @ position
    width, height = size
    focal = min(size) / 2 / math.tan(math.radians(FIELD_OF_VIEW) / 2)
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float64)
    return Camera(K, world_to_camera, width, height)


def facing(atlas: Atlas, camera: Camera, outer: int) -> Atlas:
    """The atlas without the faces whose back the camera would see; `outer` as in Circle."""
    if outer == 0:
        return atlas
    mesh = atlas.mesh
    assert mesh.t_uv_idx is not None
    kept = outer * _front(mesh, camera, mesh.t_pos_idx) > 0
    part = replace(mesh, t_pos_idx=mesh.t_pos_idx[kept], t_uv_idx=mesh.t_uv_idx[kept])
    return replace(atlas, mesh=part)


def _front(mesh: Mesh, camera: Camera, faces: Tensor) -> Tensor:
    """[F] positive where the camera sees the face's corners [F,3] counterclockwise."""
    a, b, c = (mesh.v_pos[faces[:, corner]] for corner in range(3))
    towards = camera_center(camera).to(a) - a
    normal = torch.linalg.cross(b - a, c - a)
    side: Tensor = (normal * towards).sum(1)
    return side


def _outer_side(mesh: Mesh, views: Sequence[View]) -> int:
    """Which side of the faces the scan's cameras saw."""
    chosen = views[:: max(1, len(views) // PROBES)][:PROBES]
    cameras = [_small(view.camera) for view in chosen]
    seen = front = 0
    for camera, fragments in zip(cameras, rasterize_views(mesh, cameras), strict=True):
        shown = fragments.face_index[fragments.face_index >= 0].long()
        sides = _front(mesh, camera, mesh.t_pos_idx[shown])
        seen, front = seen + len(sides), front + int((sides > 0).sum())
    if seen == 0 or abs(2 * front - seen) < (2 * CERTAIN - 1) * seen:
        return 0
    return 1 if 2 * front > seen else -1


def _small(camera: Camera) -> Camera:
    scale = PROBE_WIDTH / camera.width
    K = camera.K * camera.K.new_tensor([scale, scale, 1.0])[:, None]
    return Camera(K, camera.world_to_camera, PROBE_WIDTH, max(1, round(camera.height * scale)))


def _up(mesh: Mesh, views: Sequence[View], up_axis: str) -> Tensor:
    """The scan's up axis, unless its cameras were held level around another one that more surface is level to."""
    told = torch.tensor(AXES[up_axis[1]], dtype=torch.float64) * (-1 if up_axis[0] == "-" else 1)
    rotations = torch.stack([view.camera.world_to_camera[:3, :3] for view in views]).double()
    right = rotations[:, 0]
    _, axes = torch.linalg.eigh(right.T @ right)
    level = axes[:, 0]  # nearly across all of them
    level = level * torch.sign(-rotations[:, 1].mean(0) @ level)
    share, found = _level_surface(mesh, level)
    if share > LEVEL_SHARE and share > 2 * _level_surface(mesh, told)[0]:
        return found
    return told


def _level_surface(mesh: Mesh, up: Tensor) -> tuple[float, Tensor]:
    """Share of the surface that lies level, floors and table tops, and the up axis [3] that it lies level to."""
    v_pos = mesh.v_pos.double().cpu()
    a, b, c = (v_pos[mesh.t_pos_idx[:, corner].cpu()] for corner in range(3))
    areas = torch.linalg.cross(b - a, c - a)
    along = areas @ up
    level = along.abs() > LEVEL * areas.norm(dim=1)
    total = (areas[level] * along[level].sign()[:, None]).sum(0)
    share = float(areas[level].norm(dim=1).sum() / areas.norm(dim=1).sum().clamp(min=1e-30))
    return share, total / total.norm().clamp(min=1e-30)


def _across(direction: Tensor, up: Tensor) -> Tensor:
    """The unit vector across `up` nearest to `direction`; any one where that says nothing."""
    for candidate in (direction, *torch.eye(3, dtype=torch.float64)):
        flat = candidate - (candidate @ up) * up
        if float(flat.norm()) > 1e-3 * max(1.0, float(candidate.norm())):
            across: Tensor = flat / flat.norm()
            return across
    raise AssertionError("two of three axes are never both along the third")

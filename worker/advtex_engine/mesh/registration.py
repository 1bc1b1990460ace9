"""A mesh moved onto what the depth images measured: for models that were placed by hand, as CAD models are. And the
other way round: a camera moved to where its depth image fits the mesh, for poses that are grossly wrong.

Iterated closest points with projected pairs (Blais & Levine 1995) and point-to-plane distances (Chen & Medioni 1992):
the mesh is rasterized into the depth cameras, each pixel pairs a reading with the face behind it, and the motion that
takes the faces' planes to the readings is found by reweighted least squares (Tukey's weights), until it stands still.

World metres. A mesh's motion is rigid, with a change of scale where that is asked for.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.core.cameras import camera_center, pixel_centers, unproject
from advtex_engine.core.scene import Camera, DepthFrame, Mesh
from advtex_engine.render.rasterize import rasterize_views

MAX_FRAMES = 16
WIDTH = 160  # pixels, about, at which frames are compared
REACH = 0.1  # of the distance: a mesh that is further off than this is not pulled in
MIN_COSINE = 0.3  # of the angle at which a face is seen; projected pairs of grazing faces lie far apart
MIN_PAIRS = 300
ITERATIONS = 150  # most take 10; a pose that is 40 of 256 pixels off may slide along its own surface for 100
STILL = 1e-4  # metres that the mesh's points move in the last iteration
TUKEY = 4.685  # in standard deviations: 95 % efficiency on normal noise
LEAST_DEVIATION = 0.001  # metres
# What the pairs do not hold (a plane slides in itself) stays as it was given.
DAMPING = 1e-4
# Of the distance: where the readings' median lies further from the mesh, the pose is looked into. On three real scans
# it lies at .4 to .9 %, for the worst frame at 1.7 %, and no pose leaves half of that.
GROSS = 0.01
LEFT = 0.5


@dataclass(frozen=True)
class _Pairs:
    """Points on the mesh [N,3], its normals there [N,3], readings' distances along them [N], weights [N]; float64."""

    points: Tensor
    normals: Tensor
    offsets: Tensor
    weights: Tensor


@dataclass(frozen=True)
class _Fit:
    """Over the readings where the mesh is or was: the mean distance along z, cut off at the reach, and the median."""

    mean: float
    median: float


def register_mesh(mesh: Mesh, frames: Sequence[DepthFrame], *, with_scale: bool = False) -> tuple[Mesh, dict[str, Any]]:
    """The mesh where the depth images see it, and what was done; the same mesh if no motion improves the fit.

    mesh, frames: on one device. The fit is judged by distances along z over all readings that meet the mesh before or
    after, so that a motion that moves the mesh away from readings does not count as better. Not differentiable.
    """
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(len(frames), MAX_FRAMES)).round().astype(int))
    thinned = [_thinned(frames[index]) for index in chosen]
    motion, iterations = _iterate(mesh, thinned, with_scale)
    still = torch.eye(4, dtype=torch.float64)
    before, after = _fits((mesh, move_mesh(mesh, motion)), thinned)
    accepted = after.mean < before.mean and after.median <= before.median
    if not accepted:
        motion, after = still, before
    scale = float(torch.linalg.det(motion[:3, :3])) ** (1 / 3)
    cosine = (float(motion[:3, :3].trace()) / scale - 1) / 2
    middle = mesh.v_pos.double().mean(0).cpu()
    report = {
        "accepted": accepted,
        "iterations": iterations,
        "median_mm_before": round(1000 * before.median, 2),
        "median_mm_after": round(1000 * after.median, 2),
        "moved_mm": round(1000 * float((motion[:3, :3] @ middle + motion[:3, 3] - middle).norm()), 2),
        "turned_degrees": round(math.degrees(math.acos(min(max(cosine, -1), 1))), 3),
        "scale": round(scale, 5),
    }
    return (move_mesh(mesh, motion) if accepted else mesh), report


def register_camera(mesh: Mesh, frame: DepthFrame) -> Tensor | None:
    """Where the frame's depth fits the mesh, as world_to_camera [4,4] float64 on the CPU; None if it is not grossly off
    as given, or fits from nowhere near.

    mesh, frame: on one device; the mesh stays. Not differentiable.
    """
    thinned = _thinned(frame)
    met = _fits((mesh,), [thinned])[0]
    readings = thinned.depth[thinned.depth > 0]
    if len(readings) < MIN_PAIRS or met.median <= GROSS * float(readings.median()):
        return None
    motion, _ = _iterate(mesh, [thinned], with_scale=False)
    before, after = _fits((mesh, move_mesh(mesh, motion)), [thinned])
    if after.mean > LEFT * before.mean or after.median > LEFT * before.median:
        return None
    return frame.camera.world_to_camera.double().cpu() @ motion


def move_mesh(mesh: Mesh, motion: Tensor) -> Mesh:
    """The mesh with `motion` [4,4] applied to its vertices; faces and uv are kept."""
    motion = motion.to(mesh.v_pos.device, torch.float64)
    moved = mesh.v_pos.double() @ motion[:3, :3].T + motion[:3, 3]
    return replace(mesh, v_pos=moved.to(mesh.v_pos.dtype))


def _iterate(mesh: Mesh, frames: Sequence[DepthFrame], with_scale: bool) -> tuple[Tensor, int]:
    """The motion [4,4] that the pairs ask for, and after how many iterations it stood still."""
    motion = torch.eye(4, dtype=torch.float64)
    radius = float((mesh.v_pos - mesh.v_pos.mean(0)).norm(dim=1).max())
    for iteration in range(1, ITERATIONS + 1):
        pairs = _pair(move_mesh(mesh, motion), frames)
        if len(pairs.offsets) < MIN_PAIRS:
            return motion, iteration
        step = _solve(pairs, radius, with_scale)
        motion = step @ motion
        travel = step - torch.eye(4, dtype=torch.float64)
        middle = pairs.points.mean(0).cpu()
        if float(travel[:3, :3].norm()) * radius + float((travel[:3, :3] @ middle + travel[:3, 3]).norm()) < STILL:
            break
    return motion, iteration


def _pair(mesh: Mesh, frames: Sequence[DepthFrame]) -> _Pairs:
    """For every reading within reach of a face that its pixel sees: the point on the face, its normal, the distance."""
    a, b, c = mesh.v_pos.double()[mesh.t_pos_idx].unbind(1)
    face_normals = F.normalize(torch.linalg.cross(b - a, c - a), dim=1)
    parts = []
    cameras = [frame.camera for frame in frames]
    for frame, fragments in zip(frames, rasterize_views(mesh, cameras), strict=True):
        pixels = pixel_centers(frame.camera, frame.depth.device)
        rendered = fragments.depth
        near = (rendered > 0) & (frame.depth > 0) & ((rendered - frame.depth).abs() < REACH * frame.depth)
        points = unproject(frame.camera, pixels[near], rendered[near])
        readings = unproject(frame.camera, pixels[near], frame.depth[near])
        normals = face_normals[fragments.face_index[near].long()]
        rays = F.normalize(points - camera_center(frame.camera).to(points), dim=1)
        facing = (rays * normals).sum(1).abs() > MIN_COSINE
        offsets = ((readings - points) * normals).sum(1)
        weights = torch.ones_like(offsets) if frame.confidence is None else frame.confidence[near].to(offsets)
        parts.append((points[facing], normals[facing], offsets[facing], weights[facing]))
    return _Pairs(*(torch.cat(column) for column in zip(*parts, strict=True)))


def _solve(pairs: _Pairs, radius: float, with_scale: bool) -> Tensor:
    """The motion [4,4] of one step: turn, shift and growth about the pairs' middle, reweighted by what it leaves.

    Lengths are in units of the mesh's radius, so that turning, shifting and growing are damped alike.
    """
    middle = pairs.points.mean(0)
    arms = (pairs.points - middle) / radius
    columns = [torch.linalg.cross(arms, pairs.normals), pairs.normals]
    if with_scale:
        columns.append((arms * pairs.normals).sum(1, keepdim=True))
    jacobian, offsets = torch.cat(columns, 1), pairs.offsets / radius
    deviation = 1.4826 * float(offsets.abs().median())
    weights = pairs.weights * _tukey(offsets, max(deviation, LEAST_DEVIATION / radius))
    normal_matrix = jacobian.T @ (weights[:, None] * jacobian)
    normal_matrix.diagonal().add_(DAMPING * float(weights.sum()))
    step = torch.linalg.solve(normal_matrix, jacobian.T @ (weights * offsets)).cpu()
    turn = torch.zeros((3, 3), dtype=torch.float64)
    turn[2, 1], turn[0, 2], turn[1, 0] = step[:3]
    # As the turn is: a long step must not mirror the mesh.
    growth = math.exp(float(step[6])) if with_scale else 1.0
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, :3] = growth * torch.linalg.matrix_exp(turn - turn.T)
    middle = middle.cpu()
    motion[:3, 3] = middle + radius * step[3:6] - motion[:3, :3] @ middle
    return motion


def _tukey(offsets: Tensor, deviation: float) -> Tensor:
    return (1 - (offsets / (TUKEY * deviation)).square()).clamp(min=0).square()


def _fits(meshes: Sequence[Mesh], frames: Sequence[DepthFrame]) -> list[_Fit]:
    """How far the readings lie from each mesh along z, all judged on the readings that meet any of them."""
    cameras = [frame.camera for frame in frames]
    rendered = [torch.stack([seen.depth for seen in rasterize_views(mesh, cameras)]) for mesh in meshes]
    measured = torch.stack([frame.depth for frame in frames])
    met = (measured > 0) & (torch.stack(rendered) > 0).any(0)
    if not bool(met.any()):
        return [_Fit(0.0, 0.0) for _ in meshes]
    fits = []
    for depth in rendered:
        reach = REACH * measured[met]
        off = torch.where(depth[met] > 0, (depth[met] - measured[met]).abs().minimum(reach), reach)
        fits.append(_Fit(float(off.mean()), float(off.median())))
    return fits


def _thinned(frame: DepthFrame) -> DepthFrame:
    """Every few pixels of a frame, in both directions, with the camera that has just these pixels."""
    stride = max(1, frame.camera.width // WIDTH)
    first = stride // 2
    depth = frame.readings[first::stride, first::stride].contiguous()
    confidence = None if frame.confidence is None else frame.confidence[first::stride, first::stride].contiguous()
    K = frame.camera.K.clone()
    K[:2] /= stride
    K[:2, 2] += 0.5 - (first + 0.5) / stride
    camera = Camera(K, frame.camera.world_to_camera, depth.shape[1], depth.shape[0])
    return DepthFrame(camera, depth, confidence)

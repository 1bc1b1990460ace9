"""Radial distortion that all frames of a device share, where the photographs tell of it and the scan does not.

What a pinhole would show at (x, y), in focal lengths from its principal point, the photograph shows at
(1 + k1 r^2 + k2 r^4) (x, y), r^2 = x^2 + y^2 (OpenCV's k1 and k2). A camera that moves shows the same surface at the
middle and at the edge of its image, so the two numbers are no matter of poses; and two numbers for all frames make tiny
normal equations (`refine_solve` explains what is compared).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from advtex_engine.core.scene import View
from advtex_engine.refine.check import better, disagreement, rounded
from advtex_engine.refine.points import Observations
from advtex_engine.refine.pose import (
    ROBUST_SCALE,
    PointSamples,
    PoseSteps,
    sample_features,
    sample_points,
)
from advtex_engine.refine.solve import residuals, weighted_mean
from advtex_engine.refine.warp import warp_view
from advtex_engine.refine.working_views import CONTRAST_SCALE, WorkingViews

POINTS = 1250  # per view
# Of the disagreement may be left for a lens to be straightened. A lens that bends by a pixel is in held-out photographs
# and in those of one's neighbors, too: on scans where less was won than a fifth, nothing was gained in the end.
MARGIN = 0.8
LEVELS = ((4, 3), (2, 3), (1, 3))  # shrink factor of the image, Gauss-Newton steps
PRIOR = 1e-3  # pull of what each number does at the image's corner to 0, relative to the evidence about it
LARGEST_STEP = 2.0  # pixels of the level, at the corner
NODES = 65  # along each side of the grid that a photograph is straightened by: between them lines are straight


def refine_distortion(working: WorkingViews, world_to_camera: Tensor) -> tuple[Tensor | None, dict[str, Any]]:
    """k1 and k2, [2] float32, if without them points that were set aside disagree grossly; and the report about it.

    world_to_camera: [V,4,4] float64, the best poses of pinholes.
    """
    checked, cell, size = working.checked, working.checked_cell, working.size
    fitted = working.fitted
    few = Observations(fitted.position, fitted.point[:, :POINTS], fitted.seen[:, :POINTS])
    nothing = torch.zeros(2, device=working.color.device)
    found, poses = fit_distortion(working, few, nothing, world_to_camera)
    pinhole = sample_points(working.features, working.K, world_to_camera, checked, size)
    lens = _through(found, working.features, working.K, poses, checked, size)
    old, new, valid = pinhole.value[..., None], lens.value[..., None], pinhole.valid & lens.valid
    before, after = (disagreement(part, valid, checked, CONTRAST_SCALE).nanmean() for part in (old, new))
    taken = bool(after < MARGIN * before) and better(old, new, valid, checked, cell, CONTRAST_SCALE)
    if taken:
        found, _ = fit_distortion(working, fitted, found, poses)
    numbers = {"k1": found[0], "k2": found[1], "residual_before": before, "residual_after": after}
    report = {"corrected": taken, **{name: rounded(number) for name, number in numbers.items()}}
    return (found.cpu() if taken else None), report


def fit_distortion(working: WorkingViews, points: Observations, found: Tensor, poses: Tensor) -> tuple[Tensor, Tensor]:
    """k1 and k2, [2] float32, and poses [V,4,4] float64, by which the views agree best at `points`; from such values.

    Poses make up for most of what a lens does to one view, so that each step of the lens is what no pose can do
    instead; how poses depend on each other, they find out in steps of their own.
    """
    K, given, spread, size = working.K, working.given, working.spread, working.size
    focal, reach = float(K[0, 0, 0]), _corner(K[0], size)
    unit = torch.tensor([1 / (focal * reach**3), 1 / (focal * reach**5)], device=K.device)  # a pixel at the corner
    for scale, steps in LEVELS:
        features = working.contrast(scale)
        for _ in range(steps):
            at = _through(found, features, K, poses, points, size)
            residual, weight = residuals(at.value, at.valid, points, ROBUST_SCALE)
            held = _through(found, features, K, poses, spread, size)
            moving = PoseSteps(at, weight, K, given, poses, points, held, spread)
            jacobian = unit * _jacobian(at, K)
            step = _step(jacobian, residual, weight, moving.jacobian, points, found / unit)
            step = step * (LARGEST_STEP * scale / step.norm().clamp(min=1e-12)).clamp(max=1)
            bends = jacobian @ step
            bends = bends - weighted_mean(bends, weight, points)[0][points.point]
            poses = moving.moved(moving.solve(residual + bends), LARGEST_STEP * scale)
            found = found + unit * step
    return found, poses


def bent(pixel: Tensor, K: Tensor, distortion: Tensor) -> Tensor:
    """Where photographs show what pinholes K [V,3,3] would show at pixels [V,N,2]."""
    place, square = _normalized(pixel, K)
    return pixel + _focal(K) * place * (square * (distortion[0] + square * distortion[1]))


def straightened(view: View, distortion: Tensor) -> View:
    """The view as a pinhole would show it; what comes from outside of its photograph or its mask is masked.

    Its depth is in the pinhole's pixels already.
    """
    camera = view.camera
    rows = max(2, round((NODES - 1) * camera.height / camera.width) + 1)
    across = torch.linspace(0, camera.width, NODES)
    down = torch.linspace(0, camera.height, rows)
    pixel = torch.stack(torch.meshgrid(across, down, indexing="xy"), -1)
    offsets = bent(pixel.view(1, -1, 2), camera.K[None], distortion.cpu()).view_as(pixel) - pixel
    return warp_view(view, offsets)


def _through(
    distortion: Tensor,
    features: Tensor,
    K: Tensor,
    world_to_camera: Tensor,
    points: Observations,
    size: tuple[int, int],
) -> PointSamples:
    """`sample_points` of photographs that a lens has bent; `pixel` is the pinhole's."""
    at = sample_points(features, K, world_to_camera, points, size)
    # Pads may be anywhere.
    pixel = torch.where(at.valid[..., None], at.pixel, 0.0)
    value, gradient, inside = sample_features(features, bent(pixel, K, distortion), size)
    return replace(at, value=value, gradient=gradient, pixel=pixel, valid=at.valid & inside)


def _jacobian(samples: PointSamples, K: Tensor) -> Tensor:
    """Derivative [V,K,2] of the value with respect to k1 and k2."""
    place, square = _normalized(samples.pixel, K)
    outwards = (samples.gradient * _focal(K) * place).sum(-1, keepdim=True) * square
    return torch.cat((outwards, outwards * square), -1)


def _step(
    jacobian: Tensor, residual: Tensor, weight: Tensor, poses: Tensor, points: Observations, now: Tensor
) -> Tensor:
    """The step [2] for derivatives [V,K,2], from where the numbers are `now` [2]; poses: derivatives [V,6,K] of these.

    What its own view's pose could do is taken out of each derivative and of the residual [V,K].
    """
    columns = torch.cat((jacobian, residual[..., None]), -1)
    means = [weighted_mean(part, weight, points)[0][points.point] for part in columns.unbind(-1)]
    columns = columns - torch.stack(means, -1)
    weighted = poses * weight[:, None]
    blocks = (weighted @ poses.mT).double()
    blocks += (1e-6 * blocks.diagonal(dim1=1, dim2=2).mean() + 1e-12) * torch.eye(6, dtype=blocks.dtype).to(blocks)
    columns = columns - poses.mT @ torch.linalg.solve(blocks, (weighted @ columns).double()).to(columns)
    own, rest = columns[..., :2].flatten(0, 1), columns[..., 2].flatten()
    matrix = (own.T @ (own * weight.flatten()[:, None])).double()
    pull = PRIOR * matrix.diagonal().mean() + 1e-12
    right = -(own.T @ (weight.flatten() * rest)).double() - pull * now.double()
    step: Tensor = torch.linalg.solve(matrix + pull * torch.eye(2).to(matrix), right)
    return step.to(now.dtype)


def _normalized(pixel: Tensor, K: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels [V,N,2] in focal lengths from the principal point, and their squared distance [V,N,1] from it."""
    place = (pixel - K[:, None, :2, 2].to(pixel)) / _focal(K)
    return place, place.square().sum(-1, keepdim=True)


def _focal(K: Tensor) -> Tensor:
    """[V,1,2] float32 pixels."""
    return torch.stack((K[:, 0, 0], K[:, 1, 1]), -1)[:, None].float()


def _corner(K: Tensor, size: tuple[int, int]) -> float:
    """Focal lengths from the principal point to the farthest corner of the image."""
    x, y = (max(float(K[axis, 2]), size[axis] - float(K[axis, 2])) / float(K[axis, axis]) for axis in (0, 1))
    return math.hypot(x, y)

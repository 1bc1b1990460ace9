"""What all frames of a device share: the color camera's intrinsics, and where it sits beside the given poses' camera.

A mesh that was built from depth is in the depth camera's world. Where color is wrongly taken as registered to depth,
every frame's color camera is off by the same rigid motion in its own frame, and its image by the same zoom and shift.
Unlike a motion of the world, that is no matter of gauge, and it holds for held-out frames too.
Ten numbers for all frames together make small, dense normal equations (`refine_solve` explains them).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from advtex_engine.refine.points import Observations
from advtex_engine.refine.pose import (
    ROBUST_SCALE,
    PointSamples,
    exponential,
    pose_jacobian,
    sample_points,
    twist,
)
from advtex_engine.refine.solve import residuals, weighted_mean

LEVELS = ((8, 8), (4, 6), (2, 4), (1, 3))  # shrink factor of the image, Gauss-Newton steps
# Pulls towards what was given, relative to the evidence about a shift of the image. A turn of the camera is nearly such
# a shift, and a motion along its axis nearly a zoom: they are left to the intrinsics.
ZOOM_PRIOR, SHIFT_PRIOR, TURN_PRIOR, SIDEWAYS_PRIOR, FORWARD_PRIOR = 1e-4, 1e-4, 1e-2, 1e-3, 1e-2
ASPECT_PRIOR = 0.1  # pixels are as square as was given
LARGEST_STEP = 2.0  # pixels of the level


@dataclass(frozen=True)
class Device:
    """Corrections for every frame: K' = lens @ K, [3,3], and world_to_camera' = offset @ world_to_camera, [4,4].

    float64; lens is a zoom and shift of the image plane, in pixels of one image size.
    """

    lens: Tensor
    offset: Tensor

    def at_scale(self, x: float, y: float) -> Device:
        """The same for images x times as wide and y times as high."""
        scale = torch.diag(self.lens.new_tensor([x, y, 1.0]))
        return Device(scale @ self.lens @ torch.linalg.inv(scale), self.offset)


def refine_device(
    contrast: Callable[[int], Tensor], size: tuple[int, int], K: Tensor, given: Tensor, points: Observations
) -> Device:
    """The device with which the views agree best while each keeps its place beside the others; coarse to fine.

    contrast: the views' `local_contrast` at a shrink factor of their `size` (width, height). K: [V,3,3] and given:
    [V,4,4], world_to_camera, float64.
    """
    center = torch.eye(3, dtype=K.dtype, device=K.device)
    center[:2, 2] = center.new_tensor(size) / 2
    device = Device(torch.eye(3, dtype=K.dtype, device=K.device), torch.eye(4, dtype=K.dtype, device=K.device))
    for scale, steps in LEVELS:
        features = contrast(scale)
        for _ in range(steps):
            lens, pose = device.lens @ K, device.offset @ given
            samples = sample_points(features, lens, pose, points, size)
            unit = _units(samples, lens)
            jacobian = (
                torch.cat((_lens_jacobian(samples, size), pose_jacobian(samples, lens)), 1) * unit[:, None].float()
            )
            centered = torch.linalg.inv(center) @ device.lens @ center
            now = torch.cat((centered.diagonal()[:2] - 1, centered[:2, 2], twist(device.offset[None])[0])) / unit
            step = _step(jacobian, samples, points, now)
            step = unit * step * (LARGEST_STEP * scale / step.norm().clamp(min=1e-12)).clamp(max=1)
            change = torch.eye(3, dtype=K.dtype, device=K.device)
            change[[0, 1, 0, 1], [0, 1, 2, 2]] += step[:4]
            lens = center @ change @ torch.linalg.inv(center) @ device.lens
            device = Device(lens, exponential(step[None, 4:])[0] @ device.offset)
    return device


def _units(samples: PointSamples, K: Tensor) -> Tensor:
    """What each of the ten parameters' unit is, [10] float64: about a pixel."""
    focal = K[0, 0, 0]
    distance = samples.local[..., 2][samples.valid].median().double() / focal
    turn = 1 / focal
    return torch.stack((4 * turn, 4 * turn, turn * focal, turn * focal, turn, turn, turn, distance, distance, distance))


def _lens_jacobian(samples: PointSamples, size: tuple[int, int]) -> Tensor:
    """Derivative [V,4,K] of the value with respect to zooms around the image's center (x, y) and shifts (x, y)."""
    place = samples.pixel - samples.pixel.new_tensor(size) / 2
    return torch.cat((samples.gradient * place, samples.gradient), -1).mT


def _step(jacobian: Tensor, samples: PointSamples, points: Observations, now: Tensor) -> Tensor:
    """The Gauss-Newton step [10] float64 for derivatives [V,10,K], from where the parameters are `now` [10]."""
    residual, weight = residuals(samples.value, samples.valid, points, ROBUST_SCALE)
    means = [weighted_mean(row, weight, points)[0][points.point] for row in jacobian.unbind(1)]
    relative = jacobian - torch.stack(means, 1)
    weighted = relative * weight[:, None]
    matrix = (weighted @ relative.mT).double().sum(0)
    pulls = (ZOOM_PRIOR,) * 2 + (SHIFT_PRIOR,) * 2 + (TURN_PRIOR,) * 3 + (SIDEWAYS_PRIOR,) * 2 + (FORWARD_PRIOR,)
    prior = torch.diag(matrix.new_tensor(pulls))
    prior[:2, :2] += ASPECT_PRIOR * matrix.new_tensor([[1, -1], [-1, 1]])
    prior *= matrix[[2, 3], [2, 3]].mean() + 1e-12
    right = -(weighted @ residual[..., None]).double().sum(0)[:, 0] - prior @ now
    step: Tensor = torch.linalg.solve(matrix + prior, right)
    return step

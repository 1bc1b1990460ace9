"""Rigid camera poses from photoconsistency (Zhou & Koltun 2014, "Color Map Optimization", section 3).

Each view may move by a twist (rotation, translation) in its own camera frame; a Gauss-Newton step moves all at once
(`refine_solve`). The value compared is the luminance with its local mean and contrast removed, so that exposure and
white balance do not matter.
Parameters are scaled to about a pixel: a twist of (1/f, 1/f, 1/f, z/f, z/f, z/f), z the view's median depth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.refine.points import Observations
from advtex_engine.refine.solve import Anchor, residuals, solve_views
from advtex_engine.render.filtering import separable

# Shrink factor of the image, Gauss-Newton steps. All cameras around an object together find their way slowly.
LEVELS = {"scene": ((8, 6), (4, 6), (2, 5), (1, 4)), "object": ((8, 6), (4, 6), (2, 5), (1, 8))}
AT_ONCE = 16  # views whose local contrast is found at once
CONTRAST_RADIUS = 4  # pixels of the level around which local mean and contrast are taken
CONTRAST_FLOOR = 0.04  # of the range: what is flatter than that counts less
LEAST_SHARE = 1e-4  # of pixels that have a say, for there to be anything
ROBUST_SCALE = 0.3  # residual, in local contrasts, at which an observation loses half of its weight
ANCHOR = 0.1  # pull of each place towards where the given cameras show it on the average, relative to the evidence
PRIOR = 0.001  # pull towards the given pose, relative to the mean strength of the evidence
IMMOVABLE = 1e6
LARGEST_STEP = 4.0  # pixels of the level


@dataclass(frozen=True)
class PointSamples:
    """What V views see at their K points.

    value: [V,K]. gradient: [V,K,2] of the value per pixel of the working size. pixel: [V,K,2]. local: [V,K,3] metres in
    the camera's frame. valid: [V,K] bool, False where pad or outside of the image.
    """

    value: Tensor
    gradient: Tensor
    pixel: Tensor
    local: Tensor
    valid: Tensor


def local_contrast(luminance: Tensor, scale: int, known: Tensor | None = None) -> Tensor:
    """[V,h,w] in [0,1] -> [V,3,h/scale,w/scale]: normalized value and its gradient per pixel of the full image.

    known: [V,h,w] bool, the pixels that have a say, None for all. What stands behind an object moves against it when
    the camera moves, and in a small image it is within reach of all of the object's pixels.
    """
    size = (luminance.shape[1], luminance.shape[2])
    if scale > 1:
        size = (max(8, size[0] // scale), max(8, size[1] // scale))
    found = luminance.new_empty((len(luminance), 3, *size))
    # Of all views at once it would take four times the memory of what is found.
    for first in range(0, len(luminance), AT_ONCE):
        views = slice(first, first + AT_ONCE)
        found[views] = _local_contrast(luminance[views], size, None if known is None else known[views])
    return found


def _local_contrast(luminance: Tensor, size: tuple[int, int], known: Tensor | None) -> Tensor:
    image, share = luminance[:, None], None if known is None else known[:, None].to(luminance)
    height, width = image.shape[2:]
    if share is not None:
        image = image * share
    if size != (height, width):
        image = F.interpolate(image, size, mode="area")
        share = None if share is None else F.interpolate(share, size, mode="area")
    image = _blurred(image, 1)
    if share is not None:
        near = _blurred(share, 1)
        image = image / near.clamp(min=LEAST_SHARE)
    mean = _mean(image, share)
    deviation = (_mean(image.square(), share) - mean.square()).clamp(min=0).sqrt()
    value = (image - mean) / (deviation + CONTRAST_FLOOR)
    if share is not None:
        value = value * (near > LEAST_SHARE)
    padded = F.pad(value, (1, 1, 1, 1), mode="replicate")
    across = (padded[:, :, 1:-1, 2:] - padded[:, :, 1:-1, :-2]) * (0.5 * image.shape[3] / width)
    down = (padded[:, :, 2:, 1:-1] - padded[:, :, :-2, 1:-1]) * (0.5 * image.shape[2] / height)
    return torch.cat((value, across, down), 1)


def _mean(image: Tensor, share: Tensor | None) -> Tensor:
    """Local mean of images [V,1,h,w] within CONTRAST_RADIUS, of pixels that count by their `share`, None for all."""
    if share is None:
        return _blurred(image, CONTRAST_RADIUS)
    return _blurred(image * share, CONTRAST_RADIUS) / _blurred(share, CONTRAST_RADIUS).clamp(min=LEAST_SHARE)


def _blurred(image: Tensor, radius: int) -> Tensor:
    """[V,1,h,w] smoothed by a Gaussian that is cut off at two standard deviations, `radius` pixels."""
    offset = torch.arange(-radius, radius + 1, device=image.device, dtype=image.dtype)
    kernel = torch.exp(-2 * (offset / radius).square())
    kernel = kernel / kernel.sum()
    return separable(image[:, 0], kernel, border="replicate")[:, None]


def sample_points(
    features: Tensor, K: Tensor, world_to_camera: Tensor, points: Observations, size: tuple[int, int]
) -> PointSamples:
    """Samples `local_contrast` where the views see their points; K [V,3,3] is for images of `size` (width, height)."""
    world = points.position[points.point]
    local = world @ world_to_camera[:, :3, :3].mT + world_to_camera[:, None, :3, 3]
    z = local[..., 2].clamp(min=1e-6)
    homogeneous = local @ K.mT
    uv = (homogeneous[..., :2] / z[..., None]).float()
    value, gradient, inside = sample_features(features, uv, size)
    return PointSamples(value, gradient, uv, local.float(), points.seen & (local[..., 2] > 1e-6) & inside)


def sample_features(features: Tensor, pixel: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor]:
    """Value [V,K] and gradient [V,K,2] of `local_contrast` at pixels [V,K,2] of images of `size`; which are inside."""
    extent = pixel.new_tensor(size)
    inside = ((pixel > 1) & (pixel < extent - 1)).all(-1)
    found = F.grid_sample(features, (2 * pixel / extent - 1)[:, :, None], padding_mode="border", align_corners=False)
    return found[:, 0, :, 0], found[:, 1:, :, 0].mT, inside


def refine_poses(
    contrast: Callable[[int], Tensor],
    size: tuple[int, int],
    kind: str,
    K: Tensor,
    given: Tensor,
    points: Observations,
    spread: Observations | None = None,
) -> Tensor:
    """world_to_camera [V,4,4] float64 that make the views agree; coarse to fine.

    contrast: the views' `local_contrast` at a shrink factor of their `size` (width, height). kind: of the scan. K:
    [V,3,3] float64 for that size. points: those compared. spread: points all over the surface, whose content is to stay
    where it is on the average; the mean motion of all cameras is removed after each level but the finest: the mesh does
    not move with the cameras, so that they agree best where the mesh is, and what they have in common beyond the
    anchor's pull is what the photographs insist on. Without, the first view alone moves, and the others hold the gauge.
    """
    world_to_camera = given
    for scale, steps in LEVELS[kind]:
        features = contrast(scale)
        for _ in range(steps):
            samples = sample_points(features, K, world_to_camera, points, size)
            residual, weight = residuals(samples.value, samples.valid, points, ROBUST_SCALE)
            held = None if spread is None else sample_points(features, K, world_to_camera, spread, size)
            poses = PoseSteps(samples, weight, K, given, world_to_camera, points, held, spread)
            world_to_camera = poses.moved(poses.solve(residual), LARGEST_STEP * scale)
        if spread is not None and scale > 1:
            world_to_camera = keep_gauge(world_to_camera, given, points)
    return world_to_camera


class PoseSteps:
    """The Gauss-Newton step of all poses [V,4,4] from where their views see `samples`, weighted by `weight` [V,K].

    held: what they see at the points of `spread`; both None: all but the first view hold the gauge.
    """

    def __init__(
        self,
        samples: PointSamples,
        weight: Tensor,
        K: Tensor,
        given: Tensor,
        world_to_camera: Tensor,
        points: Observations,
        held: PointSamples | None,
        spread: Observations | None,
    ) -> None:
        self.weight, self.points, self.poses = weight, points, world_to_camera
        self.unit = _units(samples, K)
        self.jacobian = pose_jacobian(samples, K) * self.unit[..., None]
        strength = (self.jacobian.square() @ weight[..., None])[..., 0]
        # A view without any point gets a prior alone and, its right side being 0, does not move.
        self.prior = (PRIOR * strength.mean() + 1e-12).expand_as(strength).clone()
        self.anchor = None
        if spread is None or held is None:
            self.prior[1:] = IMMOVABLE * strength.max()
        else:
            self.anchor = _anchor(held, world_to_camera, self.unit, spread, float(strength.mean()))
        self.off = twist(world_to_camera @ torch.linalg.inv(given)).float() / self.unit

    def solve(self, residual: Tensor) -> Tensor:
        """The step [V,6], in units of about a pixel, for residuals [V,K] to the points' means."""
        return solve_views(self.jacobian, residual, self.weight, self.points, self.prior, self.off, self.anchor)

    def moved(self, step: Tensor, most: float) -> Tensor:
        """The poses [V,4,4] after a step [V,6], that of each view cut to `most` pixels."""
        longest = step.norm(dim=1).clamp(min=1e-12)
        step = step * (most / longest).clamp(max=1)[:, None]
        return exponential((step * self.unit).double()) @ self.poses


def _units(samples: PointSamples, K: Tensor) -> Tensor:
    """The twist [V,6] that each parameter stands for."""
    focal = K[:, 0, 0].float()
    depth = torch.where(samples.valid, samples.local[..., 2], torch.nan).nanmedian(1).values.nan_to_num(1.0)
    return torch.stack((1 / focal,) * 3 + (depth / focal,) * 3, 1)


def pose_jacobian(samples: PointSamples, K: Tensor) -> Tensor:
    """Derivative [V,6,K] of the value with respect to the twist (rotation, translation) in the camera's frame."""
    x, y, z = samples.local.unbind(-1)
    inverse = 1 / z.clamp(min=1e-6)
    a = samples.gradient[..., 0] * K[:, 0, 0, None].float() * inverse
    b = samples.gradient[..., 1] * K[:, 1, 1, None].float() * inverse
    c = -(a * x + b * y) * inverse
    return torch.stack((y * c - z * b, z * a - x * c, x * b - y * a, a, b, c), 1)


def _anchor(
    samples: PointSamples, world_to_camera: Tensor, unit: Tensor, points: Observations, strength: float
) -> Anchor:
    """Holds the content of the surface where the given cameras show it on the average.

    A camera's motion moves what it shows at a point by R^T (rotation x local + translation) in the world; across the
    ray and divided by the distance that is an angle, times the focal length pixels.
    """
    local = samples.local
    distance = local.norm(dim=-1, keepdim=True).clamp(min=1e-6)
    ray = local / distance
    # Rows of (I - ray ray^T) [-[local]x, I] / distance, turned into the world.
    identity = torch.eye(3, dtype=local.dtype, device=local.device)
    across = (identity - ray[..., :, None] * ray[..., None, :]) / distance[..., None]
    across = world_to_camera[:, None, :3, :3].mT.to(local.dtype) @ across
    focal = 1 / unit[:, 0, None]
    components = []
    for axis in range(3):
        row = across[:, :, axis]
        whole = torch.cat((torch.linalg.cross(local, row), row), -1) * focal[..., None] * unit[:, None]
        components.append(whole.mT.contiguous())
    evidence = strength / samples.valid.sum(1).clamp(min=1).to(local.dtype).mean()
    return Anchor(tuple(components), samples.valid * (ANCHOR * evidence), points)


def keep_gauge(found: Tensor, given: Tensor, points: Observations) -> Tensor:
    """Cameras [V,4,4] without their mean motion; those that see no points stay as they are.

    Removed is the rigid motion of the world that takes what the new cameras see to where the given ones see it
    (Kabsch), weighted by 1/z^2, so that it is pixels that count, and so that every camera counts the same.
    """
    world = points.position[points.point]
    local = world @ given[:, :3, :3].mT + given[:, None, :3, 3]
    moved = (local - found[:, None, :3, 3]) @ found[:, :3, :3]
    weight = points.seen / local[..., 2].clamp(min=1e-6).square()
    weight = weight / weight.sum(1, keepdim=True).clamp(min=1e-30)
    weight = (weight / weight.sum().clamp(min=1e-30)).flatten()[:, None]
    source, target = moved.flatten(0, 1), world.flatten(0, 1)
    from_center, to_center = (source * weight).sum(0), (target * weight).sum(0)
    u, _, vt = torch.linalg.svd((weight * (target - to_center)).T @ (source - from_center))
    sign = torch.ones(3, dtype=u.dtype, device=u.device)
    sign[2] = torch.linalg.det(u @ vt)
    rotation = (u * sign) @ vt
    back = torch.eye(4, dtype=u.dtype, device=u.device)
    back[:3, :3] = rotation.T
    back[:3, 3] = from_center - rotation.T @ to_center
    return torch.where(points.seen.any(1)[:, None, None], found @ back, found)


def exponential(twist: Tensor) -> Tensor:
    """Rigid motions [V,4,4] of twists [V,6] (rotation, translation); translation is applied after the rotation."""
    motion = torch.zeros((len(twist), 4, 4), dtype=twist.dtype, device=twist.device)
    x, y, z = twist[:, :3].unbind(1)
    zero = torch.zeros_like(x)
    skew = torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), 1).view(-1, 3, 3)
    motion[:, :3, :3] = torch.linalg.matrix_exp(skew)
    motion[:, :3, 3] = twist[:, 3:]
    motion[:, 3, 3] = 1
    return motion


def twist(motion: Tensor) -> Tensor:
    """Twists [V,6] of rigid motions [V,4,4] by less than a right angle; the inverse of `exponential`."""
    skew = 0.5 * (motion[:, :3, :3] - motion[:, :3, :3].mT)
    axis = torch.stack((skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]), 1)
    sine = axis.norm(dim=1, keepdim=True).clamp(min=1e-12)
    return torch.cat((axis * (sine.clamp(max=1).asin() / sine), motion[:, :3, 3]), 1)

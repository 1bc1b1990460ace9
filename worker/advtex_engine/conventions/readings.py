"""How the files of a scan may be read, and how well a reading agrees with itself.

A `Reading` is a sample of frames under some convention. Three measures need no truth: depth reprojected into a
neighboring view meets the depth there; depth meets the mesh rendered into the same view; and one surface has the same
colors in neighboring views (normalized cross-correlation over small windows, blind to exposure).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.core.scene import Camera, Mesh
from advtex_engine.render.rasterize import rasterize_views

AGREEMENT = 0.03
"""Share of the depth within which two depths agree."""
OCCLUSION = 0.05
"""Share of the depth beyond which a surface counts as hidden in a neighboring view."""
WINDOW = 9
"""Side of the windows that are correlated, pixels of the sample's grid."""
LEAST_CONTRAST = 4.0
"""Standard deviation in gray levels below which a window says nothing."""
LEAST_COMPARED = 0.02
"""Share of the pixels that must be comparable for a measure to say anything."""
NEAR = 0.01
"""Metres; nearer points have no projection."""
OUTSIDE = -1e6
"""Pixel coordinates of what has no projection."""


@dataclass(frozen=True)
class Reading:
    """N frames on one grid of H x W pixels under some convention.

    pairs: [P,2] indices of neighbors. camera_to_world: [N,4,4] float64 of the color cameras; depth_to_color: [4,4].
    color: [N,H,W] float32 gray levels. depth: [N,H,W] float32 metres along z, 0 = none; None without any.
    color_intrinsics, depth_intrinsics: [N,4] float64 fx, fy, cx, cy. mesh: in world coordinates, or None.
    """

    pairs: Tensor
    camera_to_world: Tensor
    color: Tensor
    color_intrinsics: Tensor
    depth: Tensor | None
    depth_intrinsics: Tensor
    depth_to_color: Tensor
    mesh: Mesh | None

    def __post_init__(self) -> None:
        frames = len(self.color)
        assert self.pairs.shape[1:] == (2,) and self.camera_to_world.shape == (frames, 4, 4)
        assert self.color_intrinsics.shape == self.depth_intrinsics.shape == (frames, 4)
        assert self.depth is None or self.depth.shape == self.color.shape

    @property
    def depth_poses(self) -> Tensor:
        """Camera-to-world [N,4,4] of the depth cameras."""
        return self.camera_to_world @ self.depth_to_color


@dataclass(frozen=True)
class Agreement:
    """How well depths agree: the share of those compared within AGREEMENT, and their median difference.

    compared: as a share of the pixels that have depth. metres, relative: None if too few were compared.
    """

    share: float
    compared: float
    metres: float | None = None
    relative: float | None = None


@dataclass(frozen=True)
class Surface:
    """What each pair's first view sees: points [P,H,W,3] in the world, and which pixels [P,H,W] both views see."""

    points: Tensor
    shared: Tensor


def depth_agreement(reading: Reading) -> Agreement:
    """Depth of each pair's first view, seen from its second one, against the depth there."""
    assert reading.depth is not None
    first, second = reading.pairs.unbind(1)
    poses = reading.depth_poses
    moved = _moved(
        _points(reading.depth[first], reading.depth_intrinsics[first]), inverse(poses[second]) @ poses[first]
    )
    met = _nearest(reading.depth[second], _project(moved, reading.depth_intrinsics[second]))
    return _agreement(moved[..., 2], met, reading.depth[first] > 0)


def mesh_agreement(reading: Reading, rendered: Tensor) -> Agreement:
    """Each view's depth against the mesh, `rendered` [N,H,W] into the depth cameras."""
    assert reading.depth is not None
    return _agreement(rendered, reading.depth, reading.depth > 0)


def render(reading: Reading, poses: Tensor, K: Tensor) -> Tensor:
    """Depth [N,H,W] of the mesh in cameras with intrinsics K [N,4] at `poses` [N,4,4], camera-to-world."""
    assert reading.mesh is not None
    height, width = reading.color.shape[1:]
    cameras = []
    for world_to_camera, (fx, fy, cx, cy) in zip(inverse(poses), K.tolist(), strict=True):
        matrix = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)
        cameras.append(Camera(matrix, world_to_camera, width, height))
    return torch.stack([fragments.depth for fragments in rasterize_views(reading.mesh, cameras)])


def surface(reading: Reading, *, of_mesh: bool = False) -> Surface:
    """What the depth cameras measured, or the mesh as the color cameras see it."""
    first, second = reading.pairs.unbind(1)
    if of_mesh or reading.depth is None:
        K, poses = reading.color_intrinsics, reading.camera_to_world
        depth = render(reading, poses, K)
    else:
        depth, K, poses = reading.depth, reading.depth_intrinsics, reading.depth_poses
    world = _moved(_points(depth[first], K[first]), poses[first])
    moved = _moved(world, inverse(poses[second]))
    met = _nearest(depth[second], _project(moved, K[second]))
    shared = (depth[first] > 0) & (met > 0) & ((moved[..., 2] - met).abs() < OCCLUSION * met)
    return Surface(world, shared)


def color_agreement(reading: Reading, seen: Surface) -> float | None:
    """Mean correlation, -1 to 1, of windows that show one surface in both views of a pair; None if too few tell."""
    images, inside = [], seen.shared
    for index in reading.pairs.unbind(1):
        moved = _moved(seen.points, inverse(reading.camera_to_world[index]))
        image, within = _bilinear(reading.color[index], _project(moved, reading.color_intrinsics[index]))
        images.append(image)
        inside = inside & within
    return _correlation(images[0], images[1], inside)


def inverse(poses: Tensor) -> Tensor:
    """Inverses of rigid [N,4,4]."""
    inverse = torch.eye(4, dtype=poses.dtype).repeat(len(poses), 1, 1)
    inverse[:, :3, :3] = poses[:, :3, :3].mT
    inverse[:, :3, 3:] = -poses[:, :3, :3].mT @ poses[:, :3, 3:]
    return inverse


def _points(depth: Tensor, K: Tensor) -> Tensor:
    """Camera-space points [P,H,W,3] float32 of depth images [P,H,W]."""
    height, width = depth.shape[1:]
    fx, fy, cx, cy = (K[:, k, None, None].float() for k in range(4))
    u = torch.arange(width) + 0.5
    v = torch.arange(height)[:, None] + 0.5
    return torch.stack(((u - cx) / fx * depth, (v - cy) / fy * depth, depth), -1)


def _moved(points: Tensor, transform: Tensor) -> Tensor:
    matrix = transform.float()
    return torch.einsum("pij,phwj->phwi", matrix[:, :3, :3], points) + matrix[:, None, None, :3, 3]


def _project(points: Tensor, K: Tensor) -> Tensor:
    """Pixels [P,H,W,2] of camera-space points; OUTSIDE where they are not in front of the camera."""
    z = points[..., 2]
    on_plane = points[..., :2] / z.clamp(min=NEAR)[..., None]
    pixels = on_plane * K[:, None, None, :2].float() + K[:, None, None, 2:].float()
    return torch.where((z > NEAR)[..., None], pixels, OUTSIDE)


def _nearest(images: Tensor, pixels: Tensor) -> Tensor:
    """Values [P,H,W] of images [P,H,W] at pixels [P,H,W,2]; 0 outside."""
    height, width = images.shape[1:]
    column, row = pixels[..., 0].floor(), pixels[..., 1].floor()
    inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
    index = torch.where(inside, row * width + column, 0).long()
    values = images.flatten(1).gather(1, index.flatten(1)).view_as(column)
    return torch.where(inside, values, 0)


def _bilinear(images: Tensor, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Values [P,H,W] of images [P,H,W] at pixels [P,H,W,2], and which of those are inside."""
    height, width = images.shape[1:]
    size = torch.tensor([width, height])
    inside = ((pixels >= 0.5) & (pixels <= size - 0.5)).all(-1)
    sampled = F.grid_sample(images[:, None], pixels / size * 2 - 1, padding_mode="border", align_corners=False)
    return sampled[:, 0], inside


def _agreement(one: Tensor, other: Tensor, valid: Tensor) -> Agreement:
    """one, other: [...] metres, 0 = none. valid: [...] where there could be a comparison."""
    both = valid & (one > NEAR) & (other > NEAR)
    compared = int(both.sum()) / max(int(valid.sum()), 1)
    if compared < LEAST_COMPARED:
        return Agreement(0.0, compared)
    error = (one[both] - other[both]).abs()
    relative = error / torch.minimum(one[both], other[both])
    share = float((relative < AGREEMENT).float().mean())
    return Agreement(share, compared, float(error.median()), float(relative.median()))


def _correlation(one: Tensor, other: Tensor, valid: Tensor) -> float | None:
    weight = valid.float()
    share = _box(weight)

    def mean(image: Tensor) -> Tensor:
        return _box(image * weight) / share.clamp(min=1e-6)

    mean_one, mean_other = mean(one), mean(other)
    variance_one = (mean(one * one) - mean_one**2).clamp(min=0)
    variance_other = (mean(other * other) - mean_other**2).clamp(min=0)
    telling = valid & (share > 0.5) & (torch.maximum(variance_one, variance_other) > LEAST_CONTRAST**2)
    if int(telling.sum()) < LEAST_COMPARED * valid[0].numel():
        return None
    covariance = mean(one * other) - mean_one * mean_other
    correlation = covariance / (variance_one * variance_other).sqrt().clamp(min=1.0)
    return float(correlation[telling].clamp(-1, 1).mean())


def _box(image: Tensor) -> Tensor:
    return F.avg_pool2d(image[:, None], WINDOW, 1, WINDOW // 2)[:, 0]

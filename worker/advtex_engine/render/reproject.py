"""Auxiliary view into source view (paper section 3.3, equation 5 and the visibility test below it).

p_A = d_A K_A^-1 P_A;  p_B = T_B^-1 T_A p_A;  P_B = K_B p_B.  Everything here is without gradient.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.render.texture import bilinear_footprint
from advtex_engine.render.view_maps import ViewMaps

MIN_DEPTH = 1e-6  # metres; nearer points have no projection
MIN_FOREGROUND_WEIGHT = 0.99  # share of the bilinear footprint that must be foreground in the auxiliary view


def unproject_pixels(xy: Tensor, depth: Tensor, intrinsics: Tensor) -> Tensor:
    """Camera-space points [P,3], metres, of pixel positions xy [P,2] with depth [P] along z.

    xy in pixels, first centre at (0.5, 0.5); intrinsics: [4] fx, fy, cx, cy.
    """
    on_plane = (xy - intrinsics[2:]) / intrinsics[:2]
    return torch.cat((on_plane * depth[:, None], depth[:, None]), 1)


def _project(points: Tensor, relative: Tensor, intrinsics: Tensor) -> tuple[Tensor, Tensor]:
    """Source-camera points [P,3] -> pixel positions [...,P,2] and depth [...,P] in auxiliary views.

    relative: [...,3,4]; intrinsics: [...,4].
    """
    moved = points @ relative[..., :3].mT + relative[..., None, :, 3]
    z = moved[..., 2:]
    on_plane = moved[..., :2] / torch.where(z > MIN_DEPTH, z, 1.0)
    return on_plane * intrinsics[..., None, :2] + intrinsics[..., None, 2:], z[..., 0]


def _visible(
    position: Tensor, z: Tensor, depth: Tensor, size: tuple[int, int], tolerance: float, first: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """The visibility test [P]; also the footprint [P,4] (indices, weights) of each position.

    position [P,2] pixels and z [P] metres in the view; depth [H*W] metres of the view; size: width, height. Where depth
    [V*H*W] is of several views, first [P,1] says where each position's view begins.
    """
    width, height = size
    x, y = position.unbind(1)
    inside = (z > MIN_DEPTH) & (x >= 0.5) & (x <= width - 0.5) & (y >= 0.5) & (y <= height - 0.5)
    indices, weights = bilinear_footprint(position, width, height)
    pixels = indices if first is None else indices + first
    around = depth.index_select(0, pixels.flatten()).view(indices.shape).to(torch.float32)
    foreground = around > 0
    # The nearest of the four neighbors decides: a single one would fail along every slanted surface and depth edge.
    difference = torch.where(foreground, (around - z[:, None]).abs(), torch.inf).amin(1)
    covered = (weights * foreground).sum(1) > MIN_FOREGROUND_WEIGHT
    return inside & covered & (difference < tolerance), indices, weights


def seen_share(points: Tensor, relative: Tensor, maps: ViewMaps, auxiliary: Tensor, tolerance: float) -> Tensor:
    """Share of source-camera points [P,3] (metres) that each of K auxiliary views sees -> [K].

    relative: [K,3,4] source camera to auxiliary cameras. auxiliary: [K] view indices. tolerance: theta_z, metres.
    """
    position, z = _project(points, relative, maps.intrinsics[auxiliary])
    first = (auxiliary * (maps.width * maps.height)).repeat_interleave(len(points))[:, None]
    size = (maps.width, maps.height)
    visible, _, _ = _visible(position.flatten(0, 1), z.flatten(), maps.depth.view(-1), size, tolerance, first)
    return visible.view(z.shape).to(torch.float32).mean(1)


def warped_difference(
    points: Tensor, colors: Tensor, relative: Tensor, maps: ViewMaps, auxiliary: Tensor, tolerance: float
) -> Tensor:
    """Mean absolute difference [K] between a source's colors and those of K auxiliary views at the same points.

    points: [P,3] metres in the source camera. colors: [P,3] in [0,255]. relative: [K,3,4] source camera to auxiliary
    cameras. auxiliary: [K] view indices. tolerance: theta_z, metres. Points count that the auxiliary view sees; inf
    where it sees none.
    """
    position, z = _project(points, relative, maps.intrinsics[auxiliary])
    first = (auxiliary * (maps.width * maps.height)).repeat_interleave(len(points))[:, None]
    size = (maps.width, maps.height)
    seen, indices, weights = _visible(position.flatten(0, 1), z.flatten(), maps.depth.view(-1), size, tolerance, first)
    around = maps.color.view(-1, 3)[indices + first].to(torch.float32)
    warped = (around * weights[..., None]).sum(1).view(len(auxiliary), len(points), 3)
    visible = seen.view(z.shape)
    count = visible.sum(1)
    total = ((warped - colors).abs().mean(2) * visible).sum(1)
    return torch.where(count > 0, total / count.clamp(min=1), torch.inf)


def reproject(
    points: Tensor, relative: Tensor, maps: ViewMaps, auxiliary: Tensor, tolerance: float
) -> tuple[Tensor, Tensor]:
    """The auxiliary image warped into the source view: colors [P,3] in [0,255] and visibility [P] bool.

    points: [P,3] metres in the source camera. relative: [3,4] source camera to auxiliary camera. auxiliary: 0-dim view
    index. tolerance: theta_z, metres. Colors are bicubic, since bilinear ones would teach their blur to the texture;
    bilinear where that would mix in background or reach beyond the image. Where invisible they mean nothing.
    """
    width, height = maps.width, maps.height
    position, z = _project(points, relative, maps.intrinsics.index_select(0, auxiliary.view(1))[0])
    depth = _depth_of(maps, auxiliary)
    visible, indices, weights = _visible(position, z, depth, (width, height), tolerance)
    image = maps.color.index_select(0, auxiliary.view(1))[0].to(torch.float32)
    bilinear = F.embedding_bag(indices, image, per_sample_weights=weights, mode="sum")
    planes = image.view(1, height, width, 3).permute(0, 3, 1, 2).contiguous()
    x, y = position.unbind(1)
    grid = torch.stack((x * (2 / width) - 1, y * (2 / height) - 1), 1)
    parts = math.gcd(len(grid), torch.get_num_threads())  # on a CPU one image has one thread
    planes, grid = planes.expand(parts, -1, -1, -1), grid.view(parts, 1, -1, 2)
    sampled = F.grid_sample(planes, grid, mode="bicubic", padding_mode="border", align_corners=False)
    bicubic = sampled[:, :, 0].transpose(1, 2).reshape(-1, 3).clamp(0, 255)
    whole = _whole_footprints(depth.view(height, width)).view(-1)[indices[:, 0]]
    return torch.where(whole[:, None], bicubic, bilinear), visible


def _whole_footprints(depth: Tensor) -> Tensor:
    """[H,W] bool: whether all 16 pixels of the bicubic footprint are foreground whose bilinear one starts here."""
    height, width = depth.shape
    whole = F.pad(depth > 0, (1, 2, 1, 2))
    whole = whole[:, :width] & whole[:, 1 : width + 1] & whole[:, 2 : width + 2] & whole[:, 3:]
    return whole[:height] & whole[1 : height + 1] & whole[2 : height + 2] & whole[3:]


def _depth_of(maps: ViewMaps, view: Tensor) -> Tensor:
    """[H*W] float32 of the view with this 0-dim index."""
    return maps.depth.index_select(0, view.view(1))[0].to(torch.float32)

"""Auxiliary view into source view (paper section 3.3, equation 5 and the visibility test below it).

p_A = d_A K_A^-1 P_A;  p_B = T_B^-1 T_A p_A;  P_B = K_B p_B.  Everything here is without gradient.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from advtex_engine.texture import bilinear_footprint

if TYPE_CHECKING:
    from advtex_engine.views import ViewMaps

MIN_FOREGROUND_WEIGHT = 0.99  # share of the bilinear footprint that must be foreground in the auxiliary view


def unproject_pixels(pixels: Tensor, depth: Tensor, intrinsics: Tensor, width: int) -> Tensor:
    """Camera-space points [P,3], metres, of flat pixel indices [P] with depth [P] along z; intrinsics [4] fx,fy,cx,cy."""
    x = (pixels % width).to(torch.float32) + 0.5
    y = torch.div(pixels, width, rounding_mode="floor").to(torch.float32) + 0.5
    fx, fy, cx, cy = intrinsics.unbind()
    return torch.stack(((x - cx) / fx * depth, (y - cy) / fy * depth, depth), 1)


def _project(points: Tensor, relative: Tensor, intrinsics: Tensor) -> tuple[Tensor, Tensor]:
    """Source-camera points [P,3] -> pixel positions [P,2] in the auxiliary view and depth [P] there."""
    moved = points @ relative[:, :3].T + relative[:, 3]
    z = moved[:, 2]
    safe = torch.where(z > 1e-6, z, 1.0)
    fx, fy, cx, cy = intrinsics.unbind()
    return torch.stack((fx * moved[:, 0] / safe + cx, fy * moved[:, 1] / safe + cy), 1), z


def _visible(
    position: Tensor, z: Tensor, maps: ViewMaps, auxiliary: Tensor, tolerance: float
) -> tuple[Tensor, Tensor, Tensor]:
    """The visibility test; also the footprint [P,4] (indices, weights) that samples the auxiliary view's color."""
    inside = (
        (z > 1e-6)
        & (position[:, 0] >= 0.5)
        & (position[:, 0] <= maps.width - 0.5)
        & (position[:, 1] >= 0.5)
        & (position[:, 1] <= maps.height - 0.5)
    )
    indices, weights = bilinear_footprint(torch.where(inside[:, None], position, 0.5), maps.width, maps.height)
    indices = indices + auxiliary * (maps.width * maps.height)
    depth = maps.depth.view(-1)[indices].to(torch.float32)
    foreground = depth > 0
    # The nearest of the four neighbors decides: a single one would fail along every slanted surface and depth edge.
    difference = torch.where(foreground, (depth - z[:, None]).abs(), torch.inf).amin(1)
    covered = (weights * foreground).sum(1) > MIN_FOREGROUND_WEIGHT
    return inside & covered & (difference < tolerance), indices, weights


def auxiliary_visibility(
    points: Tensor, relative: Tensor, maps: ViewMaps, auxiliary: Tensor, tolerance: float
) -> Tensor:
    """Which source-camera points [P,3] (metres) the auxiliary view sees -> [P] bool.

    relative: [3,4] source camera to auxiliary camera. auxiliary: 0-dim int64 view index. tolerance: theta_z, metres.
    """
    position, z = _project(points, relative, maps.intrinsics[auxiliary])
    return _visible(position, z, maps, auxiliary, tolerance)[0]


def reproject(
    points: Tensor, relative: Tensor, maps: ViewMaps, auxiliary: Tensor, tolerance: float
) -> tuple[Tensor, Tensor]:
    """The auxiliary image warped into the source view: colors [P,3] in [0,255] and visibility [P] bool.

    Arguments as in `auxiliary_visibility`. Colors are bilinear; where invisible they mean nothing.
    """
    position, z = _project(points, relative, maps.intrinsics[auxiliary])
    visible, indices, weights = _visible(position, z, maps, auxiliary, tolerance)
    corners = maps.color.view(-1, 3)[indices].to(torch.float32)
    return (corners * weights[:, :, None]).sum(1), visible

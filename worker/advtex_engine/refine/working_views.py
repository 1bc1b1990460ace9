"""What refinement looks at: images at its working size, and surface points to fit, to hold on to, and to check."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.core.cameras import stack_cameras
from advtex_engine.core.scene import Mesh, View
from advtex_engine.refine.points import (
    Observations,
    draw_candidates,
    observe,
    order_of_preference,
    surface_cells,
    surface_depths,
)
from advtex_engine.refine.pose import local_contrast

WORKING_WIDTH = 320  # pixels; finer images take longer and gain little
POINTS_PER_VIEW = 5000
CHECKED_SHARE = 0.2  # of the surface is set aside to judge the result
CHECKED_PER_VIEW = 1500
SPREAD_STRIDE = 16  # every so many of the points hold the content in place
MIN_CANDIDATES = 1000  # points of the drawn ones that two views must see, to refine anything
CONTRAST_SCALE = 0.5  # disagreements of `features` beyond twice that are occlusions or highlights
LUMINANCE = (0.299, 0.587, 0.114)


@dataclass(frozen=True)
class WorkingViews:
    """V views at the working size.

    color: [V,3,h,w] float32 in [0,1]. known: [V,h,w] bool, the pixels whose contrast is compared, None for all.
    features: `local_contrast` at full resolution. K [V,3,3], given [V,4,4]: float64. checked_cell: `surface_cells` of
    the points to check.
    """

    kind: str
    color: Tensor
    known: Tensor | None
    features: Tensor
    K: Tensor
    given: Tensor
    fitted: Observations
    spread: Observations
    checked: Observations
    checked_cell: Tensor

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.color.shape[3], self.color.shape[2]

    @property
    def luminance(self) -> Tensor:
        """[V,h,w] float32 in [0,1]."""
        return luminance(self.color)

    def contrast(self, scale: int) -> Tensor:
        """The views' `local_contrast` at a shrink factor."""
        return self.features if scale == 1 else local_contrast(self.luminance, scale, self.known)


def working_views(
    mesh: Mesh, views: tuple[View, ...], kind: str, device: torch.device, seed: int, like: WorkingViews | None = None
) -> WorkingViews | None:
    """None when hardly anything is seen by two views. like: of the same photographs, by other cameras."""
    generator = torch.Generator().manual_seed(seed)
    mesh = Mesh(mesh.v_pos.to(device), mesh.t_pos_idx.to(device))
    color = working_color(views, device) if like is None else like.color
    size = (color.shape[3], color.shape[2])
    cameras, depths, shown = surface_depths(mesh, views, size, kind)
    if like is None:
        known = known_pixels(shown, kind)
        features = local_contrast(luminance(color), 1, known)
    else:
        known, features = like.known, like.features
    K, given = stack_cameras(cameras, device)
    candidates = draw_candidates(mesh, cameras, depths, torch.hypot(*features[:, 1:].unbind(1)), generator)
    if len(candidates.position) < MIN_CANDIDATES:
        return None
    order = order_of_preference(candidates, generator)
    cell = surface_cells(candidates, cameras, depths, kind)[order]
    aside = (torch.rand(int(cell.max()) + 1, generator=generator) < CHECKED_SHARE).to(device)[cell]
    checked = observe(candidates.chosen(order[aside]), CHECKED_PER_VIEW)
    fitted = observe(candidates.chosen(order[~aside]), POINTS_PER_VIEW)
    spread = observe(candidates.chosen(order[::SPREAD_STRIDE]), POINTS_PER_VIEW // 4)
    return WorkingViews(kind, color, known, features, K, given, fitted, spread, checked, cell[aside])


def working_color(views: Sequence[View], device: torch.device) -> Tensor:
    """The views' photographs at the working size, [V,3,h,w] float32 in [0,1]."""
    camera = views[0].camera
    width = min(WORKING_WIDTH, camera.width)
    size = (width, max(1, round(camera.height * width / camera.width)))
    return torch.cat([_shrunk(view.color.to(device), size) for view in views])


def known_pixels(shown: Tensor, kind: str) -> Tensor | None:
    """Pixels that `local_contrast` looks at, [V,h,w] bool, None for all; shown: of `surface_depths`.

    A room is all around; its mesh lacks what depth could not measure, which stands still all the same.
    """
    return shown if kind == "object" else None


def luminance(color: Tensor) -> Tensor:
    """[V,3,h,w] -> [V,h,w]."""
    red, green, blue = LUMINANCE
    return (red * color[:, 0]).add_(color[:, 1], alpha=green).add_(color[:, 2], alpha=blue)


def motion(found: Tensor, working: WorkingViews) -> Tensor:
    """[V,3] float64 on the CPU: millimetres and degrees that each camera moved from the given pose to `found` [V,4,4].

    And the median pixels of the working size that its content did.
    """
    given, K, points = working.given, working.K, working.fitted
    change = found @ torch.linalg.inv(given)
    centers = [-(pose[:, :3, :3].mT @ pose[:, :3, 3:])[..., 0] for pose in (found, given)]
    # The angle's sine and cosine, since a small angle's cosine alone has lost it.
    rotation = change[:, :3, :3]
    skew = rotation - rotation.mT
    sine = 0.5 * torch.stack((skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]), 1).norm(dim=1)
    cosine = 0.5 * (rotation.diagonal(dim1=1, dim2=2).sum(1) - 1)
    world = points.position[points.point]
    pixels = []
    for pose in (found, given):
        homogeneous = (world @ pose[:, :3, :3].mT + pose[:, None, :3, 3]) @ K.mT
        pixels.append(homogeneous[..., :2] / homogeneous[..., 2:])
    shift = torch.where(points.seen, (pixels[0] - pixels[1]).norm(dim=-1), torch.nan).nanmedian(1).values
    millimetres = 1000 * (centers[0] - centers[1]).norm(dim=1)
    return torch.stack((millimetres, torch.atan2(sine, cosine).rad2deg(), shift), 1).cpu()


def _shrunk(color: Tensor, size: tuple[int, int]) -> Tensor:
    """[H,W,3] uint8 -> [1,3,h,w] float32 in [0,1], averaged over areas."""
    image = color.permute(2, 0, 1)[None].to(torch.float32) / 255
    return F.interpolate(image, (size[1], size[0]), mode="area")

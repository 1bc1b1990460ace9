"""Smooth corrections of photographs, for what cameras cannot explain (Zhou & Koltun 2014, "Color Map Optimization").

Errors of the geometry and distortion are left to a grid of nodes over each image, with an offset at each of them: where
the camera sees a point at x, the photograph is looked at x + the offsets interpolated there. As in the paper's section
4, two steps take turns: every surface point gets the robust mean of what its views see, then the offsets of every view
make a Gauss-Newton step towards these means. Cameras stay as they are. The value compared is that of `refine_pose`, so
that exposure does not matter.

Nothing is taken on trust: points that were set aside say per view whether it agrees better with the others through its
offsets; a view that does not is left as it came.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.core.rows import distinct_rows
from advtex_engine.core.scene import Mesh, View
from advtex_engine.refine.check import MARGIN, better, disagreement, improved, rounded
from advtex_engine.refine.points import Observations
from advtex_engine.refine.pose import ROBUST_SCALE, local_contrast, sample_features, sample_points
from advtex_engine.refine.solve import residuals
from advtex_engine.refine.working_views import CHECKED_SHARE, CONTRAST_SCALE, WorkingViews, working_views
from advtex_engine.render.texture import bilinear_footprint

COLUMNS = 17  # of nodes; the first and the last lie on the image's edges
LEVELS = ((4, 4), (2, 4), (1, 4))  # shrink factor of the image, Gauss-Newton steps
# Pulls relative to the mean evidence for an offset: towards 0 (the paper's regularizer), and towards the neighbors'
# offsets, which also fills in where there are no points.
SMALL, SMOOTH = 0.02, 0.1
LARGEST_STEP = 1.0  # pixels of the level
CELL_SIZE = 0.02  # of the median depth, about 6 of 320 pixels: what of the surface is set aside to be checked
CERTAIN = 2.0  # standard errors of a view's improvement: an unrelated photograph seems to help a little, too
VIEWS_AT_ONCE = 32  # whose normal equations are in memory


def warp_views(
    mesh: Mesh, views: tuple[View, ...], kind: str, device: torch.device, seed: int
) -> tuple[tuple[View, ...], dict[str, Any]]:
    """The views with corrected photographs and masks, and the report about it; cameras and depth are as they came.

    The report has the median and the largest offset in pixels of the views, over the points where they were found, and
    the names of those that stay as they are. Not differentiable. On a CPU the same input and seed give the same result.
    """
    working = working_views(mesh, views, kind, device, seed)
    if working is None:
        return views, {"unwarped": [view.name for view in views]}
    points, aside, cell = _points(working, seed)
    seen = sample_points(working.features, working.K, working.given, points, working.size)
    offsets = fit_offsets(working.luminance, seen.pixel, replace(points, seen=seen.valid & ~aside))
    good, report = _approved(working, offsets, replace(points, seen=aside), cell)
    scale = offsets.new_tensor((views[0].camera.width / working.size[0], views[0].camera.height / working.size[1]))
    offsets = offsets * good[:, None, None, None] * scale
    moved = _interpolated(offsets, *_footprints(seen.pixel, working.size, offsets.shape[1])).norm(dim=-1)
    moved = torch.where(seen.valid, moved, torch.nan)
    report |= {"median_pixels": rounded(moved.nanmedian()), "largest_pixels": rounded(moved.nan_to_num().max())}
    kept = good.tolist()
    report["unwarped"] = [view.name for view, warped in zip(views, kept, strict=True) if not warped]
    pairs = zip(views, offsets, kept, strict=True)
    return tuple(warp_view(view, offset) if warped else view for view, offset, warped in pairs), report


def warp_view(view: View, offsets: Tensor) -> View:
    """The view looked at through offsets [rows,columns,2], (x, y) in its pixels; on the CPU.

    What comes from outside of the image or of its mask is masked. Bicubic: bilinear sampling would blur more than what
    the correction sharpens.
    """
    width, height = view.camera.width, view.camera.height
    x, y = (torch.arange(side, device=offsets.device) + 0.5 for side in (width, height))
    pixel = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)
    size = pixel.new_tensor((width, height))
    moved = F.grid_sample(offsets.permute(2, 0, 1)[None], (2 * pixel / size - 1)[None], align_corners=True)
    grid = (2 * (pixel + moved[0].permute(1, 2, 0)) / size - 1)[None]
    image = view.color.permute(2, 0, 1)[None].to(offsets)
    color = F.grid_sample(image, grid, mode="bicubic", padding_mode="border", align_corners=False)
    used = image.new_ones((height, width)) if view.mask is None else view.mask.to(image)
    mask = F.grid_sample(used[None, None], grid, align_corners=False)[0, 0] > 0.5
    return replace(view, color=color[0].permute(1, 2, 0).round().clamp(0, 255).to(torch.uint8).cpu(), mask=mask.cpu())


def fit_offsets(luminance: Tensor, pixel: Tensor, points: Observations) -> Tensor:
    """Offsets [V,rows,COLUMNS,2] in pixels with which the views agree; coarse to fine.

    luminance: [V,h,w] float32 in [0,1]. pixel: [V,K,2], where the cameras see the points.
    """
    height, width = luminance.shape[1:]
    rows = max(2, round((COLUMNS - 1) * height / width) + 1)
    nodes, share = _footprints(pixel, (width, height), rows)
    offsets = pixel.new_zeros((len(pixel), rows, COLUMNS, 2))
    for scale, steps in LEVELS:
        features = local_contrast(luminance, scale)
        for _ in range(steps):
            place = pixel + _interpolated(offsets, nodes, share)
            value, gradient, inside = sample_features(features, place, (width, height))
            residual, weight = residuals(value, points.seen & inside, points, ROBUST_SCALE)
            step = solve_offsets(gradient, residual, weight, nodes, share, offsets)
            offsets = offsets + step.clamp(-LARGEST_STEP * scale, LARGEST_STEP * scale)
    return offsets


def solve_offsets(
    gradient: Tensor, residual: Tensor, weight: Tensor, nodes: Tensor, share: Tensor, offsets: Tensor
) -> Tensor:
    """The step [V,rows,columns,2] that minimizes, with e the mean of weight * gradient^2 that an offset gets,

        sum weight (residual + gradient . step)^2 + e (SMALL |offsets + step|^2 + SMOOTH |its differences|^2)

    gradient: [V,K,2]; residual and weight: [V,K]. nodes, share: [V,K,4], the nodes around each point and their shares
    of the step there. The differences are those of offsets + step between neighboring nodes.
    """
    rows, columns = offsets.shape[1:3]
    evidence = (weight[..., None] * gradient.square()).sum() / offsets.numel()
    # Without any evidence nothing moves, and there is still something to divide by.
    pull = (evidence + 1e-12) * _pull(rows, columns).to(offsets)
    pulls = torch.kron(torch.eye(2, dtype=pull.dtype, device=pull.device), pull)
    steps = []
    for view in range(0, len(offsets), VIEWS_AT_ONCE):
        part = slice(view, view + VIEWS_AT_ONCE)
        matrix, right = _equations(gradient[part], residual[part], weight[part], nodes[part], share[part], len(pull))
        right = right - offsets[part].flatten(1, 2).mT.flatten(1) @ pulls
        found = torch.cholesky_solve(right[..., None], torch.linalg.cholesky(matrix + pulls))
        steps.append(found.view(-1, 2, rows, columns).permute(0, 2, 3, 1))
    return torch.cat(steps)


def _equations(
    gradient: Tensor, residual: Tensor, weight: Tensor, nodes: Tensor, share: Tensor, count: int
) -> tuple[Tensor, Tensor]:
    """Normal matrix [V,2N,2N] and right side [V,2N] of the data, N = `count` nodes: the x of all nodes, then the y."""
    first = torch.arange(len(nodes), device=nodes.device)[:, None, None] * count
    place = ((first + nodes)[..., :, None] * count + nodes[..., None, :]).flatten()
    shares = weight[..., None, None] * share[..., :, None] * share[..., None, :]

    def block(a: int, b: int) -> Tensor:
        values = shares * (gradient[..., a] * gradient[..., b])[..., None, None]
        return gradient.new_zeros(len(nodes) * count**2).index_add_(0, place, values.flatten()).view(-1, count, count)

    def side(a: int) -> Tensor:
        values = (weight * residual * gradient[..., a])[..., None] * share
        return gradient.new_zeros(len(nodes) * count).index_add_(0, (first + nodes).flatten(), values.flatten())

    xx, xy, yy = block(0, 0), block(0, 1), block(1, 1)
    matrix = torch.cat((torch.cat((xx, xy), 2), torch.cat((xy, yy), 2)), 1)
    return matrix, -torch.stack((side(0), side(1))).view(2, -1, count).transpose(0, 1).flatten(1)


def _pull(rows: int, columns: int) -> Tensor:
    """[N,N] for N = rows * columns nodes: SMALL times the identity and SMOOTH times the grid's Laplacian."""
    node = torch.arange(rows * columns).view(rows, columns)
    one = torch.cat((node[:, :-1].flatten(), node[:-1].flatten()))
    other = torch.cat((node[:, 1:].flatten(), node[1:].flatten()))
    identity = torch.eye(rows * columns)
    difference = identity[one] - identity[other]
    return SMALL * identity + SMOOTH * difference.T @ difference


def _footprints(pixel: Tensor, size: tuple[int, int], rows: int) -> tuple[Tensor, Tensor]:
    """Nodes [V,K,4] int64 around pixels [V,K,2] of images of `size` (width, height), and their shares [V,K,4]."""
    last = pixel.new_tensor((COLUMNS - 1, rows - 1))
    place = pixel / pixel.new_tensor(size) * last + 0.5  # of a grid whose nodes are pixel centers
    nodes, share = bilinear_footprint(place.flatten(0, 1), COLUMNS, rows)
    return nodes.view(*pixel.shape[:2], 4), share.view(*pixel.shape[:2], 4)


def _interpolated(offsets: Tensor, nodes: Tensor, share: Tensor) -> Tensor:
    """Offsets [V,K,2] at the points, from those of the grid [V,rows,columns,2]."""
    view = torch.arange(len(nodes), device=nodes.device)[:, None, None]
    return (offsets.flatten(1, 2)[view, nodes] * share[..., None]).sum(2)


def _points(working: WorkingViews, seed: int) -> tuple[Observations, Tensor, Tensor]:
    """All points that refinement has, which observations [V,K] are not to be fitted but to be checked, and cells [P].

    Offsets are there for what lies between the points that they were fitted to, so the cells are smaller than a square
    of nodes; those of `surface_cells` would say how offsets do far from all points.
    """
    one, other = working.fitted, working.checked
    position = torch.cat((one.position, other.position))
    point = torch.cat((one.point, other.point + len(one.position)), 1)
    points = Observations(position, point, torch.cat((one.seen, other.seen), 1))
    depth = (
        sample_points(working.features, working.K, working.given, points, working.size)
        .local[..., 2][points.seen]
        .median()
    )
    cell = distinct_rows((position / (CELL_SIZE * depth)).floor().long())[1]
    drawn = torch.rand(int(cell.max()) + 1, generator=torch.Generator().manual_seed(seed)) < CHECKED_SHARE
    return points, points.seen & drawn.to(cell.device)[cell][point], cell


def _approved(
    working: WorkingViews, offsets: Tensor, checked: Observations, cell: Tensor
) -> tuple[Tensor, dict[str, Any]]:
    """[V] bool, views that the checked points say agree better through their offsets, and the disagreement by then."""
    seen = sample_points(working.features, working.K, working.given, checked, working.size)
    place = seen.pixel + _interpolated(offsets, *_footprints(seen.pixel, working.size, offsets.shape[1]))
    value, _, inside = sample_features(working.features, place, working.size)
    valid, old = seen.valid & inside, seen.value[..., None]
    good = torch.ones(len(offsets), dtype=torch.bool, device=offsets.device)
    before = disagreement(old, valid, checked, CONTRAST_SCALE)
    # One view's return to its photograph changes what the others are compared with.
    while True:
        new = torch.where(good[:, None, None], value[..., None], old)
        after = disagreement(new, valid, checked, CONTRAST_SCALE)
        approved = improved(old, new, valid, checked, cell, CONTRAST_SCALE, CERTAIN) & (after < MARGIN * before)
        if approved[good].all():
            break
        good &= approved
    if not better(old, new, valid, checked, cell, CONTRAST_SCALE):
        good, after = torch.zeros_like(good), before
    return good, {"residual_before": rounded(before.nanmean()), "residual_after": rounded(after.nanmean())}

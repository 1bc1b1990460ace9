"""Which views are shown together: the pairs that the loader draws from (paper section 3.3)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from advtex_engine.render.reproject import seen_share, unproject_pixels, warped_difference
from advtex_engine.render.view_maps import DEPTH_TOLERANCE, TOGETHER, ViewMaps, foregrounds

OVERLAP_STRIDE = 8  # pixels; overlaps are estimated on a coarser grid
WIDEST_PAIR = 60.0  # degrees between the optical axes, for views that have no nearer neighbor


@dataclass(frozen=True)
class Pairs:
    """Source views and their auxiliary views, padded to K candidates per source.

    auxiliary: [V,K] int64 view indices, the view itself first. count: [V] int64, how many are real; a source without
    any foreground has 0 and is never drawn. sources: [S] int64, the views that can be drawn.
    relative: [V,K,3,4] float32, source camera to auxiliary camera.
    """

    auxiliary: Tensor
    count: Tensor
    sources: Tensor
    relative: Tensor


def overlaps(maps: ViewMaps, kind: str, max_angle: float, sources: Iterable[int]) -> Tensor:
    """Share [V,V] of each source's foreground that the auxiliary view sees too; 0 beyond max_angle (degrees).

    The angle is that between the optical axes. Estimated on every OVERLAP_STRIDE-th pixel, for the given sources only.
    """
    device = maps.device
    axes = maps.world_to_camera[:, 2, :3]
    near = (axes @ axes.T).clamp(-1, 1) >= math.cos(math.radians(max_angle))
    share = torch.zeros((maps.count, maps.count), device=device)
    points = {source: points for source, (points, _) in _seen_points(maps, sources).items()}
    for first, block in _blocks(maps):
        for source in points:
            for some, relative in _together(maps, near, source, first, len(block.depth)):
                seen_by = seen_share(points[source], relative, block, some, DEPTH_TOLERANCE[kind])
                share[source, first + some] = seen_by
    return share


def example_differences(maps: ViewMaps, kind: str, related: Tensor) -> Tensor:
    """Mean absolute difference [V,V], of 255, between each source and its related views [V,V] bool warped into it.

    inf for all others. Estimated on every OVERLAP_STRIDE-th pixel, of those that both see.
    """
    difference = torch.full((maps.count, maps.count), torch.inf, device=maps.device)
    seen = _seen_points(maps, range(maps.count))
    for first, block in _blocks(maps, with_color=True):
        for source, (points, pixels) in seen.items():
            colors = maps.color[source, pixels].to(maps.device, torch.float32)
            for some, relative in _together(maps, related, source, first, len(block.depth)):
                found = warped_difference(points, colors, relative, block, some, DEPTH_TOLERANCE[kind])
                difference[source, first + some] = found
    return difference


def _seen_points(maps: ViewMaps, sources: Iterable[int]) -> dict[int, tuple[Tensor, Tensor]]:
    """Per source with foreground its points [P,3], metres in its camera, and their pixels [P] where views are kept."""
    ys = torch.arange(OVERLAP_STRIDE // 2, maps.height, OVERLAP_STRIDE)
    xs = torch.arange(OVERLAP_STRIDE // 2, maps.width, OVERLAP_STRIDE)
    pixels = (ys[:, None] * maps.width + xs).flatten().to(maps.depth.device)
    xy = (torch.stack((xs.repeat(len(ys)), ys.repeat_interleave(len(xs))), 1) + 0.5).to(maps.device)
    found = dict[int, tuple[Tensor, Tensor]]()
    for source in sources:
        depth = maps.depth[source, pixels].to(maps.device, torch.float32)
        seen = depth > 0
        if bool(seen.any()):
            points = unproject_pixels(xy[seen], depth[seen], maps.intrinsics[source])
            found[source] = points, pixels[seen.to(pixels.device)]
    return found


def _together(maps: ViewMaps, wanted: Tensor, source: int, first: int, count: int) -> Iterator[tuple[Tensor, Tensor]]:
    """The source's wanted views [V,V] bool among the `count` from `first` on, TOGETHER at a time.

    Yields their numbers from `first` on, [K], and the poses [K,3,4] from the source's camera to theirs.
    """
    inverse = torch.linalg.inv(maps.world_to_camera[source])
    auxiliary = wanted[source, first : first + count].nonzero().flatten()
    for start in range(0, len(auxiliary), TOGETHER):
        some = auxiliary[start : start + TOGETHER]
        yield some, (maps.world_to_camera[first + some] @ inverse)[:, :3].to(torch.float32)


def _blocks(maps: ViewMaps, *, with_color: bool = False) -> Iterator[tuple[int, ViewMaps]]:
    """The maps with only some views' depth, color and intrinsics, and the first of these views; all on the device.

    All at once where they are there already, else TOGETHER at a time, so that each view is copied once. Color stays
    where it is unless it is asked for.
    """
    together = maps.count if maps.depth.device == maps.device else TOGETHER
    for first in range(0, maps.count, together):
        part = slice(first, first + together)
        block = replace(maps, depth=maps.depth[part].to(maps.device), intrinsics=maps.intrinsics[part])
        yield first, replace(block, color=maps.color[part].to(maps.device)) if with_color else block


def without(pairs: Pairs, left_out: Tensor) -> Pairs:
    """The pairs in which none of the views [V] bool takes part; tables keep their size, sources become fewer.

    The candidates that remain keep their order. The order of a source's candidates that do not count may change.
    """
    columns = torch.arange(pairs.auxiliary.shape[1], device=pairs.auxiliary.device)
    remain = (columns < pairs.count[:, None]) & ~left_out[pairs.auxiliary] & ~left_out[:, None]
    order = (~remain).to(torch.int8).argsort(dim=1, stable=True)
    relative = pairs.relative.gather(1, order[..., None, None].expand_as(pairs.relative))
    sources = pairs.sources[~left_out[pairs.sources]]
    return Pairs(pairs.auxiliary.gather(1, order), remain.sum(1), sources, relative)


def own_pairs(maps: ViewMaps) -> Pairs:
    """Every view with itself alone: the ablation without auxiliary views (paper section 4)."""
    views = torch.arange(maps.count, device=maps.device)
    has_foreground = foregrounds(maps)
    relative = torch.eye(4, device=maps.device)[:3].repeat(maps.count, 1, 1, 1)
    return Pairs(views[:, None], has_foreground.long(), has_foreground.nonzero().flatten(), relative)


def related_pairs(maps: ViewMaps, kind: str, max_angle: float, min_overlap: float, nearest_share: float = 1.0) -> Pairs:
    """Auxiliary candidates per source: optical axes within max_angle (degrees) and overlap above min_overlap.

    The view itself is a candidate once (released code). Of the others the nearest_share stays, rounded up, whose
    warped images differ least from the source. A view without any other candidate gets the view that overlaps it most,
    whatever the angle, so that sparse scans still learn from misaligned pairs.
    """
    count, device = maps.count, maps.device
    share = overlaps(maps, kind, max_angle, range(count))
    related = (share > min_overlap).fill_diagonal_(False)
    lonely = (~related.any(1)).nonzero().flatten().tolist()
    if lonely:
        wide = overlaps(maps, kind, WIDEST_PAIR, lonely).fill_diagonal_(0.0)
        for source in lonely:
            best = int(wide[source].argmax())
            related[source, best] = bool(wide[source, best] > min_overlap)
    if nearest_share < 1:
        related &= _nearest(example_differences(maps, kind, related), related.sum(1), nearest_share)
    candidates = [[source, *related[source].nonzero().flatten().tolist()] for source in range(count)]
    width = max(len(row) for row in candidates)
    auxiliary = torch.tensor([row + [row[0]] * (width - len(row)) for row in candidates], device=device)
    has_foreground = foregrounds(maps)
    number = torch.tensor([len(row) for row in candidates], device=device) * has_foreground
    relative = maps.world_to_camera[auxiliary] @ torch.linalg.inv(maps.world_to_camera)[:, None]
    return Pairs(
        auxiliary, number, has_foreground.nonzero().flatten(), relative[:, :, :3].to(torch.float32).contiguous()
    )


def _nearest(difference: Tensor, count: Tensor, share: float) -> Tensor:
    """[V,V] bool: per row of differences, of `count` [V] candidates the share with the least, rounded up."""
    rank = difference.argsort(1).argsort(1)
    return rank < (share * count).ceil()[:, None]

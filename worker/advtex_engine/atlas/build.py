"""The parameterization: uv of the scan if they can be textured, else charts from xatlas, and the texture's size."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import torch

from advtex_engine.atlas.chart_cache import ChartMaker
from advtex_engine.atlas.charting import PADDING, Charts, Floats, Integers, make_charts, pack_charts
from advtex_engine.atlas.density import pixel_density
from advtex_engine.core.config import TextureConfig
from advtex_engine.core.errors import OptionError, Problem, ScanError
from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import Atlas, Camera, Mesh, View, face_areas
from advtex_engine.render.sharpness import FINE, photographs_fineness

# The texture's sides are multiples of this, so that coarse levels of a pyramid divide them.
SIZE_STEP = 64
MIN_SIZE = 256
# Viewers and phones take images up to this side. A larger texture is made of PAGES x PAGES pages, one image each.
MAX_PAGE = 8192
PAGES = 2
# Texel density of what no camera sees, and the least of what one does, relative to the scan's mean density.
UNSEEN_DENSITY = 0.05
# Of config.texels_per_pixel, where photographs show nothing that is as small as a pixel.
BLURRED_DENSITY = 1 / 1.2
# Each round of packing shrinks the charts by what they overshot the cap, and a little more.
PACKING_ROUNDS = 8
SHRINK_MARGIN = 0.99
# In average faces. Charts below are not packed: scaled up to the size they want, they would leave the texture.
MIN_CHART_AREA = 1e-12

# Rows of triangles that texel_coverage holds at a time; each takes about 150 bytes.
ROWS_AT_A_TIME = 1_000_000

# A scan's own uv are kept if, measured at UV_TEST_SIZE:
UV_TEST_SIZE = 1024
MAX_OVERLAP = 0.02  # share of the covered texels that two faces claim
MAX_OUTSIDE = 0.001  # share of the surface whose uv leave [0, 1]
MAX_COLLAPSED = 0.02  # share of the surface whose uv triangles have no area
MIN_USED = 0.1  # share of the texture that is covered at all


ChartFunction = Callable[[npt.NDArray[np.float32], Integers, Monitor], Charts]


def for_photographs(config: TextureConfig, views: Sequence[View]) -> TextureConfig:
    """With fewer texels per pixel where the photographs are blurred by more than their pixels: see `BLURRED_DENSITY`.

    Textures of two thirds the texels are as near to photographs that are left out, and optimized ones a little nearer.
    """
    if photographs_fineness(views) >= FINE:
        return config
    return replace(config, texels_per_pixel=BLURRED_DENSITY * config.texels_per_pixel)


def build_atlas(
    mesh: Mesh, cameras: Sequence[Camera], config: TextureConfig, monitor: Monitor, charts: ChartMaker | None = None
) -> Atlas:
    """Give every face its own texels: about config.texels_per_pixel per pixel (along an edge) where it is seen best.

    mesh: cleaned. cameras: those of the views, at the working size. The texture is square, its side a multiple of
    SIZE_STEP and at most config.max_texture_size; new charts that need more than MAX_PAGE are laid out in pages. Same
    input, same atlas. Not differentiable. Raises Stopped when the monitor asks for it. charts: where they may have been
    begun or kept.
    """
    wanted = _wanted_texels(mesh, cameras, config.texels_per_pixel)
    if mesh.v_uv is not None:
        reason = why_not_kept(mesh)
        if reason is None:
            return _keep_uv(mesh, wanted, config)
        monitor.warning(
            Problem(
                "uv_replaced",
                "mesh",
                f"the mesh's texture coordinates are not kept: {reason}",
                "none needed; upload a mesh whose uv do not overlap to keep them",
            )
        )
    return new_atlas(mesh, wanted, _cap(config), monitor, make_charts if charts is None else charts.make)


def begin_charts(mesh: Mesh, charts: ChartMaker) -> None:
    """Begins with the charts that `build_atlas` will want for this mesh, unless it brings uv that may be kept."""
    if mesh.v_uv is None:
        charts.begin(_at_xatlas_scale(mesh), mesh.t_pos_idx.numpy())


def _wanted_texels(mesh: Mesh, cameras: Sequence[Camera], texels_per_pixel: float) -> Floats:
    """[T] area of each face in texels; what is barely seen gets UNSEEN_DENSITY of the mean."""
    density, area = pixel_density(mesh, cameras).double(), face_areas(mesh)
    if not (density > 0).any():
        raise ScanError(
            Problem(
                "mesh_not_seen", "mesh", "no frame sees the mesh", "check that poses and mesh share one world frame"
            )
        )
    mean = (density * area).sum() / area[density > 0].sum()
    texels: Floats = (texels_per_pixel**2 * area * density.clamp(min=float(UNSEEN_DENSITY * mean))).numpy()
    return texels


# The scan's own uv ----------------------------------------------------------------------------------------------------


def why_not_kept(mesh: Mesh) -> str | None:
    """What keeps the mesh's uv from being textured, in words; None if they are injective enough."""
    corners, area = _uv_corners(mesh), face_areas(mesh).numpy()
    outside = area[((corners < 0) | (corners > 1) | ~np.isfinite(corners)).any(axis=(1, 2))].sum() / area.sum()
    if outside > MAX_OUTSIDE:
        return f"those of {outside:.1%} of the surface lie outside [0, 1]"
    uv_area = _uv_areas(corners)
    collapsed = area[uv_area <= 1e-12].sum() / area.sum()
    if collapsed > MAX_COLLAPSED:
        return f"those of {collapsed:.1%} of the surface have no area"
    counts = texel_coverage(corners * UV_TEST_SIZE, UV_TEST_SIZE, UV_TEST_SIZE, reach=0.0)
    used = (counts > 0).mean()
    overlap = (counts > 1).sum() / max((counts > 0).sum(), 1)
    if overlap > MAX_OVERLAP:
        return f"{overlap:.1%} of the texture they use is claimed by more than one face"
    if used < MIN_USED:
        return f"they use only {used:.1%} of the texture"
    return None


def _keep_uv(mesh: Mesh, wanted: Floats, config: TextureConfig) -> Atlas:
    side = math.sqrt(wanted.sum() / _uv_areas(_uv_corners(mesh)).sum())
    size = min(_round_up(side), _cap(config))
    assert mesh.t_uv_idx is not None
    return Atlas(mesh, size, size, "scan", int(uv_islands(mesh.t_uv_idx.numpy()).max()) + 1)


def uv_islands(t_uv_idx: Integers) -> Integers:
    """[T] numbers from 0 on of the connected pieces in uv that faces belong to: they share a uv index."""
    label = np.arange(int(t_uv_idx.max()) + 1)
    while True:
        least = label[t_uv_idx].min(axis=1)
        new = label.copy()
        np.minimum.at(new, t_uv_idx.reshape(-1), np.repeat(least, 3))
        new = new[new]
        if np.array_equal(new, label):
            return np.unique(label[t_uv_idx[:, 0]], return_inverse=True)[1].reshape(-1)
        label = new


# New charts -----------------------------------------------------------------------------------------------------------


def new_atlas(mesh: Mesh, wanted: Floats, cap: int, monitor: Monitor, make: ChartFunction = make_charts) -> Atlas:
    """An atlas of new charts of a cleaned mesh. wanted: [T] texels of each face; all get fewer where the texture's side
    would be more than `cap`, a multiple of SIZE_STEP.
    """
    charts = make(_at_xatlas_scale(mesh), mesh.t_pos_idx.numpy(), monitor)
    charts = replace(charts, uv=_scale_charts(charts, wanted))
    pages = 1
    for _ in range(PACKING_ROUNDS):
        texel, page, side = _lay_out(charts, pages, monitor)
        if side > MAX_PAGE and pages < PAGES and cap > MAX_PAGE:
            pages = PAGES
            continue
        limit = min(cap // pages, MAX_PAGE) // SIZE_STEP * SIZE_STEP
        if _round_up(side) <= limit:
            step = _round_up(side)
            corner = np.stack([page % pages, page // pages], axis=1) * step
            packed = replace(
                mesh,
                v_uv=torch.from_numpy(((texel + corner) / (step * pages)).astype(np.float32)),
                t_uv_idx=torch.from_numpy(charts.faces),
            )
            return Atlas(packed, step * pages, step * pages, "xatlas", int(charts.chart.max()) + 1, pages)
        charts = replace(charts, uv=charts.uv * (limit / side * SHRINK_MARGIN))
    raise OptionError(
        f"the mesh's {charts.chart.max() + 1:,} charts do not fit a texture of {cap} texels; raise the maximal texture "
        "size, lower the face budget, or remove small loose pieces from the mesh"
    )


def _at_xatlas_scale(mesh: Mesh) -> npt.NDArray[np.float32]:
    """Positions about their center with an average face of one unit: xatlas compares lengths with fixed tolerances."""
    unit = math.sqrt(face_areas(mesh).mean().item())
    return ((mesh.v_pos.double() - mesh.v_pos.double().mean(dim=0)) / unit).float().numpy()


def _scale_charts(charts: Charts, wanted: Floats) -> Floats:
    """uv in texels: each chart as large as its faces want to be together, one without area at the origin."""
    count = int(charts.chart.max()) + 1
    placed = charts.chart >= 0
    have = np.bincount(charts.chart[placed], _uv_areas(charts.uv[charts.faces])[placed], count)
    want = np.bincount(charts.chart[placed], wanted[placed], count)
    scale = np.where(have > MIN_CHART_AREA, np.sqrt(want / np.maximum(have, MIN_CHART_AREA)), 0.0)
    per_vertex = np.ones(len(charts.uv))
    per_vertex[charts.faces[placed]] = scale[charts.chart[placed], None]
    return charts.uv * per_vertex[:, None]


def _lay_out(charts: Charts, pages: int, monitor: Monitor) -> tuple[Floats, Integers, int]:
    """Pack charts into pages x pages pages: texel coordinates within the page [U,2], page [U], side of a page.

    Charts follow each other in space, and pages take equal shares of their area in that order. Where pages meet,
    charts keep their distance to the border.
    """
    if pages == 1:
        ((texel, side),) = pack_charts([(charts.uv, charts.faces)], monitor)
        return texel, np.zeros(len(texel), dtype=np.int64), side
    size = np.bincount(charts.chart + 1, _uv_areas(charts.uv[charts.faces]))
    page_of_chart = ((np.cumsum(size) - size / 2) / size.sum() * pages**2).astype(np.int64)
    face_page = page_of_chart[charts.chart + 1]
    shares = [np.flatnonzero(face_page == page) for page in np.unique(face_page)]
    used = [np.unique(charts.faces[share]) for share in shares]
    packed = pack_charts(
        [
            (charts.uv[mine], np.searchsorted(mine, charts.faces[share]))
            for share, mine in zip(shares, used, strict=True)
        ],
        monitor,
    )
    texel, page = np.zeros_like(charts.uv), np.zeros(len(charts.uv), dtype=np.int64)
    for share, mine, (placed, _) in zip(shares, used, packed, strict=True):
        texel[mine], page[mine] = placed + PADDING, face_page[share[0]]
    assert (page[charts.faces] == face_page[:, None]).all()
    return texel, page, max(side for _, side in packed) + 2 * PADDING


def _round_up(side: float) -> int:
    return max(MIN_SIZE, math.ceil(side / SIZE_STEP) * SIZE_STEP)


def _cap(config: TextureConfig) -> int:
    return config.max_texture_size // SIZE_STEP * SIZE_STEP


# Texture space --------------------------------------------------------------------------------------------------------


def _uv_corners(mesh: Mesh) -> Floats:
    """[T,3,2] uv of each face's corners."""
    assert mesh.v_uv is not None
    assert mesh.t_uv_idx is not None
    corners: Floats = mesh.v_uv.double()[mesh.t_uv_idx].numpy()
    return corners


def _uv_areas(corners: Floats) -> Floats:
    """[T] areas of triangles [T,3,2]."""
    edge = corners[:, 1:] - corners[:, :1]
    area: Floats = np.abs(edge[:, 0, 0] * edge[:, 1, 1] - edge[:, 0, 1] * edge[:, 1, 0]) / 2
    return area


def texel_coverage(corners: Floats, width: int, height: int, reach: float) -> npt.NDArray[np.int32]:
    """[H,W] how many triangles [T,3,2] (texels) meet the square of half-side `reach` around each texel's center.

    reach 0 counts centers. For each triangle and row the columns form one interval: an edge with inward normal n
    admits the square around c while n . c + reach (|nx| + |ny|) >= n . edge, and the bounding box caps the rest
    (separating axes). Intervals are summed as +1 at their start and -1 after their end.
    """
    corners = corners[_uv_areas(corners) > 0]
    first = _pixel_bound(corners[:, :, 1].min(axis=1) - reach, height)
    rows = np.maximum(_pixel_bound(corners[:, :, 1].max(axis=1) + reach, height) - first, 0)
    steps = np.zeros((height, width + 1), dtype=np.int32)
    chunks = np.flatnonzero(np.diff(np.cumsum(rows) // ROWS_AT_A_TIME)) + 1
    for part in np.split(np.arange(len(corners)), chunks):
        triangle = np.repeat(part, rows[part])
        step = np.arange(len(triangle)) - np.repeat(np.cumsum(rows[part]) - rows[part], rows[part])
        row = step + first[triangle]
        start, end = (_pixel_bound(bound, width) for bound in _intervals(corners, triangle, row + 0.5, reach))
        filled = end > start
        np.add.at(steps, (row[filled], start[filled]), 1)
        np.add.at(steps, (row[filled], end[filled]), -1)
    counts: npt.NDArray[np.int32] = steps.cumsum(axis=1, dtype=np.int32)[:, :width]
    return counts


def _intervals(corners: Floats, triangle: Integers, y: Floats, reach: float) -> tuple[Floats, Floats]:
    """[N] least and greatest x of the square centers at height y that meet each triangle; empty if greatest < least."""
    left, right = corners[:, :, 0].min(axis=1)[triangle] - reach, corners[:, :, 0].max(axis=1)[triangle] + reach
    turn = np.sign(np.linalg.det(corners[:, 1:] - corners[:, :1]))
    for k in range(3):
        start, edge = corners[:, k], corners[:, (k + 1) % 3] - corners[:, k]
        normal = np.stack([-edge[:, 1], edge[:, 0]], axis=1) * turn[:, None]
        offset = (normal * start).sum(axis=1) - reach * np.abs(normal).sum(axis=1)
        nx, rest = normal[triangle, 0], offset[triangle] - normal[triangle, 1] * y
        with np.errstate(divide="ignore", invalid="ignore"):
            bound = rest / nx
        left = np.where(nx > 0, np.maximum(left, bound), left)
        right = np.where(nx < 0, np.minimum(right, bound), right)
        right = np.where((nx == 0) & (rest > 0), -np.inf, right)
    return left, right


def _pixel_bound(coordinate: Floats, size: int) -> Integers:
    """The first of `size` texels whose center is at or beyond the coordinate."""
    return np.clip(np.ceil(coordinate - 0.5), 0, size).astype(np.int64)


def covered_share(mesh: Mesh) -> float:
    """Share of the texture that the faces cover, each counted for itself."""
    assert mesh.v_uv is not None and mesh.t_uv_idx is not None
    corners = mesh.v_uv[mesh.t_uv_idx].double()
    one, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return float((one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]).abs().sum() / 2)

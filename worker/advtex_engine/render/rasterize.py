"""Mesh and camera -> `Fragments`: which face each pixel centre sees, where on it, and how far away.

Homogeneous rasterization (Olano & Greer 1997, "Triangle Scan Conversion using 2D Homogeneous Coordinates"): with the
corners p0, p1, p2 = K (x, y, z) left undivided, a pixel d = (u, v, 1) sees the triangle iff d is a non-negative
combination of the corners, iff the edge functions (p1 x p2).d, (p2 x p0).d, (p0 x p1).d all have the sign of
det(p0, p1, p2). That also holds for corners beside or behind the camera, so nothing is clipped: the near plane is one
more half-plane in the image, because 1/z is linear there: 1/z = n.d / det, n = (p1 - p0) x (p2 - p0).

Faces are cut into rows and rows into pixels: a half-plane bounds a row from the left or from the right, so the pixels
enumerated are exactly those covered. Edges are inclusive and widened by `_WIDEN` of a pixel, more than the rounding of
float64 and far less than that of float32 positions, so meshes are watertight. A pixel goes to the face of least depth;
where depths round to the same float32, to the lowest face index. Both sides of a face are visible.

Tables are one tensor per quantity: a gather from a vector is several times cheaper than one from rows or columns.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import torch
from torch import Tensor

from advtex_engine.core.scene import Camera, Fragments, Mesh
from advtex_engine.runtime.threads import in_threads

NEAR = 0.01  # metres
MAX_BYTES = 256 << 20

_WIDEN = 1e-9  # pixels
_TINY = 1e-30  # stands for a zero divisor: the bound that it gives lies far outside of the image, on the right side

_FACE_BITS = 29  # the mantissa of float64 is that much longer than the one of float32: room for a face index
_FACE_MASK = (1 << _FACE_BITS) - 1
_HALF = 1 << (_FACE_BITS - 1)
_EMPTY = (1 << 63) - 1

_ITEM_BYTES = 600  # peak of all temporaries per face, span or pixel of a block
# Blocks below torch's grain for threads (32,768): their temporaries stay in a core's second-level cache, and no kernel
# waits for a second thread, which takes a time slice per kernel where cores are shared with other processes.
_CPU_BLOCK = 32_000

_PIXEL_BYTES = 60  # of what is kept per pixel of a picture in the making, its result included

_Point = tuple[Tensor, Tensor, Tensor]  # (column u, row v, 1) times z; or the coefficients of a u + b v + c


def rasterize(mesh: Mesh, camera: Camera, *, near: float = NEAR, max_bytes: int = MAX_BYTES) -> Fragments:
    """What `camera` sees of `mesh` at its pixel centres, on the device of the mesh.

    near: metres; nothing nearer along z is seen. max_bytes: bound on temporary memory, apart from about 50 bytes
    per vertex and face, 100 per visible face and 30 per pixel. Not differentiable. Faces without area or with corners
    that are not finite are not seen.
    """
    return next(rasterize_views(mesh, (camera,), near=near, max_bytes=max_bytes))


def rasterize_views(
    mesh: Mesh, cameras: Iterable[Camera], *, near: float = NEAR, max_bytes: int = MAX_BYTES
) -> Iterator[Fragments]:
    """`rasterize` for each camera in turn; the same result, with the work on the mesh done once.

    On a CPU some cameras are looked through at once, in as many threads as torch uses: a block is too small to share.
    """
    assert near > 0
    assert max_bytes > 0
    assert len(mesh.t_pos_idx) < _FACE_MASK
    on_cpu = mesh.v_pos.device.type == "cpu"
    block = max(1, max_bytes // _ITEM_BYTES)
    if on_cpu:
        block = min(block, _CPU_BLOCK)
    positions = _columns(mesh.v_pos, torch.float64, block)
    corners = _columns(mesh.t_pos_idx, torch.int64, block)

    def seen_by(camera: Camera) -> Fragments:
        points, beyond = _image_points(positions, camera, near, block)
        seen = _in_frustum(beyond, corners, block)
        nearest = _full(camera.height * camera.width, _EMPTY, torch.int64, positions.device, block)
        for part in _blocks(len(seen), block):
            _draw_faces(nearest, points, corners, seen[part], camera, near, block)
        return _resolve(nearest, points, corners, camera, block)

    cameras = tuple(cameras)
    largest = max((camera.width * camera.height for camera in cameras), default=1)
    at_once = min(torch.get_num_threads(), len(cameras), max_bytes // (_PIXEL_BYTES * largest)) if on_cpu else 1
    yield from in_threads(seen_by, cameras, max(1, at_once))


def _image_points(positions: Tensor, camera: Camera, near: float, block: int) -> tuple[Tensor, Tensor]:
    """World positions [3,V] -> image points [3,V], and [V] uint8: a bit per plane of the frustum that they lie beyond.

    Image points are (column, row, 1) times z; whole columns and rows are pixel centres, and the frustum is theirs.
    """
    K = camera.K.to(positions.device, torch.float64, copy=True)
    K[:2] -= 0.5 * K[2]
    projection = K @ camera.world_to_camera.to(K)[:3]
    points = torch.empty_like(positions)
    beyond = torch.empty(points.shape[1], dtype=torch.uint8, device=points.device)
    for part in _blocks(points.shape[1], block):
        x, y, z = positions[:, part]
        for axis, (px, py, pz, p1) in enumerate(projection):
            points[axis, part] = (x * px).add_(y * py).add_(z * pz).add_(p1)
        u, v, z = points[:, part]
        tests = (u < 0, v < 0, u > z * (camera.width - 1), v > z * (camera.height - 1), z < near)
        beyond[part] = sum(test.view(torch.uint8) << plane for plane, test in enumerate(tests))
    return points, beyond


def _in_frustum(beyond: Tensor, corners: Tensor, block: int) -> Tensor:
    """Indices of the faces whose corners do not all lie beyond one plane of the frustum."""
    found = []
    for part in _blocks(corners.shape[1], block):
        first, second, third = (beyond.index_select(0, corner) for corner in corners[:, part])
        found.append((first & second & third == 0).nonzero()[:, 0] + part.start)
    return torch.cat(found) if found else corners.new_empty(0)


def _face_points(points: Tensor, corners: Tensor, index: Tensor) -> list[_Point]:
    """The three corners' image points, [F] per coordinate, of the faces `index` [F]."""
    u, v, z = points
    vertices = (corner.index_select(0, index) for corner in corners)
    return [(u.index_select(0, i), v.index_select(0, i), z.index_select(0, i)) for i in vertices]


def _cross(p: _Point, q: _Point) -> _Point:
    """Exactly antisymmetric in float arithmetic, so that two faces agree on the edge that they share."""
    return (p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0])


def _minus(p: _Point, q: _Point) -> _Point:
    return (p[0] - q[0], p[1] - q[1], p[2] - q[2])


def _times(p: _Point, factor: Tensor) -> _Point:
    return (p[0] * factor, p[1] * factor, p[2] * factor)


def _dot(p: _Point, q: _Point) -> Tensor:
    return p[0] * q[0] + p[1] * q[1] + p[2] * q[2]


def _planes(p: list[_Point]) -> tuple[list[_Point], _Point, Tensor]:
    """Corners -> linear functions of the pixel: barycentric / z per corner, 1/z; and which faces have any [F]."""
    side, other = _minus(p[1], p[0]), _minus(p[2], p[0])
    normal = _cross(side, other)
    det = _dot(p[0], normal)
    valid = (det != 0) & det.isfinite()
    inverse = det.reciprocal()
    edges = (_cross(p[1], p[2]), _cross(p[2], p[0]), _cross(p[0], p[1]))
    return [_times(edge, inverse) for edge in edges], _times(normal, inverse), valid


def _rows(p: list[_Point], camera: Camera, near: float) -> tuple[Tensor, Tensor]:
    """First row and number of rows, [F] int64, of each face's bounding box; 0 rows if it holds no pixel centre."""
    ahead = torch.minimum(torch.minimum(p[0][2], p[1][2]), p[2][2]) >= near
    boxes = []
    for axis, size in ((0, camera.width), (1, camera.height)):
        first, second, third = (corner[axis] / corner[2] for corner in p)
        low = torch.minimum(torch.minimum(first, second), third).sub_(_WIDEN)
        high = torch.maximum(torch.maximum(first, second), third).add_(_WIDEN)
        # A face that crosses the near plane may reach anywhere; its half-planes decide row by row.
        boxes.append(_centers(torch.where(ahead, low, 0.0), torch.where(ahead, high, size), size))
    (_, columns), (top, rows) = boxes
    return top, rows.mul_(columns > 0)


def _centers(low: Tensor, high: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """First and number of the integers within [low, high] and [0, size), as int64."""
    first = size - (size - low.clamp(0, size)).long()
    return first, (high.clamp(-1, size - 1) + 1).long().sub_(first).clamp_(min=0)


def _draw_faces(
    nearest: Tensor, points: Tensor, corners: Tensor, index: Tensor, camera: Camera, near: float, block: int
) -> None:
    """The faces `index` [F] into the keys `nearest` [H * W]."""
    p = _face_points(points, corners, index)
    top, rows = _rows(p, camera, near)
    edges, (du, dv, constant), valid = _planes(p)
    kept = (valid & (rows > 0)).nonzero()[:, 0]
    least, most = (bound.index_select(0, kept) for bound in _depth_range(p, near))
    near_plane = (-du, -dv, 1 / near - constant)
    bounds = [_row_bound(_select(half_plane, kept)) for half_plane in (*edges, near_plane)]
    du, dv, constant = _select((du, dv, constant), kept)
    index, top, rows = _select((index, top, rows), kept)
    for part in _parts(rows, block):
        face, row = _expand(rows[part], top[part])
        face += part.start
        y = row.double()
        low, high = torch.zeros_like(y), torch.full_like(y, camera.width - 1)
        for slope, offset, side in bounds:
            x = slope.index_select(0, face).mul_(y).add_(offset.index_select(0, face))
            limit = side.index_select(0, face)
            torch.maximum(low, torch.minimum(x, limit), out=low)
            torch.minimum(high, torch.maximum(x, limit), out=high)
        left, count = _centers(low, high, camera.width)
        step = du.index_select(0, face)
        start = step * left + dv.index_select(0, face).mul_(y).add_(constant.index_select(0, face))
        # A face seen edge-on is so steep that 1/z runs off within the breadth by which edges are widened.
        last, low, high = count - 1, least.index_select(0, face), most.index_select(0, face)
        end = torch.minimum(torch.maximum(step.mul_(last).add_(start), low), high)
        start = torch.minimum(torch.maximum(start, low), high)
        step = end.sub_(start).div_(last.clamp_(min=1))
        pixel = row.mul_(camera.width).add_(left)
        _draw_spans(nearest, pixel, count, start, step, index.index_select(0, face), block)


def _depth_range(p: list[_Point], near: float) -> tuple[Tensor, Tensor]:
    """Least and most 1/z [F] that a pixel can see of each face."""
    first, second, third = (corner[2].clamp(min=near).reciprocal_() for corner in p)
    most = torch.maximum(torch.maximum(first, second), third)
    ahead = torch.minimum(torch.minimum(p[0][2], p[1][2]), p[2][2]) >= near
    return torch.where(ahead, torch.minimum(torch.minimum(first, second), third), _TINY), most


def _select(tensors: _Point, index: Tensor) -> _Point:
    return (tensors[0].index_select(0, index), tensors[1].index_select(0, index), tensors[2].index_select(0, index))


def _row_bound(half_plane: _Point) -> _Point:
    """a u + b v + c >= 0, widened, as a bound u = slope v + offset; and inf where it bounds u from below, else -inf."""
    a, b, c = half_plane
    widened = c + _WIDEN * (a.abs() + b.abs())
    over = torch.where(a == 0, _TINY, a).reciprocal_().neg_()
    return b * over, widened * over, torch.where(over < 0, torch.inf, -torch.inf)


def _draw_spans(
    nearest: Tensor, pixel: Tensor, count: Tensor, start: Tensor, step: Tensor, index: Tensor, block: int
) -> None:
    """Spans of `count` pixels, the k-th at `pixel` + k with 1/z = `start` + k `step`, into the keys `nearest`."""
    for part in _parts(count, block):
        span, k = _expand(count[part], None)
        span += part.start
        depth = step.index_select(0, span).mul_(k).add_(start.index_select(0, span)).reciprocal_()
        key = depth.view(torch.int64).add_(_HALF).bitwise_and_(~_FACE_MASK).bitwise_or_(index.index_select(0, span))
        nearest.scatter_reduce_(0, k.add_(pixel.index_select(0, span)), key, "amin")


def _expand(count: Tensor, first: Tensor | None) -> tuple[Tensor, Tensor]:
    """Counts [N] -> for each of the sum(count) elements its item, and its place among the item's, from `first` on."""
    end = count.cumsum(0)
    total = int(end[-1])
    # torch.repeat_interleave(count), without the threads that it starts for the smallest of counts.
    item = end.new_zeros(total + 1).scatter_add_(0, end, torch.ones_like(end)).cumsum(0)[:total]
    before = count - end
    if first is not None:
        before += first
    return item, torch.arange(total, device=count.device).add_(before.index_select(0, item))


def _columns(table: Tensor, dtype: torch.dtype, block: int) -> Tensor:
    """[N,3] -> [3,N] contiguous."""
    columns = torch.empty((3, len(table)), dtype=dtype, device=table.device)
    for part in _blocks(len(table), block):
        for axis in range(3):
            columns[axis, part] = table[part, axis]
    return columns


def _full(size: int, value: int, dtype: torch.dtype, device: torch.device, block: int) -> Tensor:
    filled = torch.empty(size, dtype=dtype, device=device)
    for part in _blocks(size, block):
        filled[part].fill_(value)
    return filled


def _blocks(total: int, size: int) -> Iterator[slice]:
    return (slice(start, min(start + size, total)) for start in range(0, total, size))


def _parts(count: Tensor, limit: int) -> Iterator[slice]:
    """Slices of `count` [N] that sum to at most `limit` each, or hold one item."""
    total = count.cumsum(0)
    start = 0
    while start < len(count):
        done = total[start - 1] if start else 0
        end = max(int(torch.searchsorted(total, done + limit, right=True)), start + 1)
        yield slice(start, end)
        start = end


def _resolve(nearest: Tensor, points: Tensor, corners: Tensor, camera: Camera, block: int) -> Fragments:
    """Keys [H * W] -> `Fragments`; depth and barycentrics of the pixels' faces are computed afresh from float64."""
    height, width, device = camera.height, camera.width, nearest.device
    none = corners.shape[1]
    visible = _full(none + 1, False, torch.bool, device, block)
    visible[none] = True
    for part in _blocks(len(nearest), block):
        visible.index_fill_(0, nearest[part].bitwise_and_(_FACE_MASK).clamp_(max=none), True)
    index = torch.cat([visible[part].nonzero()[:, 0] + part.start for part in _blocks(none + 1, block)])
    place = torch.empty(none + 1, dtype=torch.int64, device=device)
    place.index_copy_(0, index, torch.arange(len(index), device=device))
    names = index.int()
    names[-1] = -1
    # The last column stays 0, for pixels that see nothing: depth and barycentrics come out as 0.
    tables = torch.zeros((12, len(index)), dtype=torch.float64, device=device)
    for part in _blocks(len(index) - 1, block):
        p = _face_points(points, corners, index[part])
        edges, _, _ = _planes(p)
        for table, values in zip(tables, (*edges[0], *edges[1], *edges[2], *(corner[2] for corner in p)), strict=True):
            table[part] = values

    face_index = torch.empty(height * width, dtype=torch.int32, device=device)
    barycentric = torch.empty((height * width, 3), device=device)
    depth = torch.empty(height * width, device=device)
    rows_at_once = max(1, block // width)
    column = torch.arange(width, dtype=torch.float64, device=device).repeat(rows_at_once)
    for rows in _blocks(height, rows_at_once):
        part = slice(rows.start * width, rows.stop * width)
        row = (
            torch.arange(rows.start, rows.stop, dtype=torch.float64, device=device)[:, None].expand(-1, width).flatten()
        )
        pixel = (column[: len(row)], row)
        which = place.index_select(0, nearest[part])
        face_index[part] = names.index_select(0, which)
        weights = [_linear(tables[k : k + 3], which, pixel).clamp_(min=0) for k in (0, 3, 6)]
        over = (weights[0] + weights[1] + weights[2]).clamp_(min=_TINY).reciprocal_()
        z = torch.zeros_like(over)
        for corner, weight in enumerate(weights):
            barycentric[part, corner] = weight.mul_(over)
            z += weight.mul_(tables[9 + corner].index_select(0, which))
        depth[part] = z
    return Fragments(face_index.view(height, width), barycentric.view(height, width, 3), depth.view(height, width))


def _linear(coefficients: Tensor, which: Tensor, pixel: tuple[Tensor, Tensor]) -> Tensor:
    """a u + b v + c at the pixels (u, v), [N] each, with each pixel's column `which` [N] of the coefficients [3,F]."""
    value, slope, constant = (table.index_select(0, which) for table in coefficients.unbind())
    return value.mul_(pixel[0]).add_(slope.mul_(pixel[1])).add_(constant)

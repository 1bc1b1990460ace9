"""Mesh and camera -> `Fragments`: which face each pixel centre sees, where on it, and how far away.

Homogeneous rasterization (Olano & Greer 1997, "Triangle Scan Conversion using 2D Homogeneous Coordinates"): with the
corners p0, p1, p2 = K (x, y, z) left undivided, a pixel d = (u, v, 1) sees the triangle iff d is a non-negative
combination of the corners, iff the edge functions (p1 x p2).d, (p2 x p0).d, (p0 x p1).d all have the sign of
det(p0, p1, p2). That also holds for corners beside or behind the camera, so nothing is clipped: the near plane is one
more half-plane in the image, because 1/z is linear there: 1/z = n.d / det, n = (p1 - p0) x (p2 - p0).

Faces are cut into rows and rows into pixels: a half-plane bounds a row from the left or from the right, so the pixels
enumerated are exactly those covered. Edges are inclusive and widened by `_EDGE` of a pixel, more than the rounding of
float64 and far less than that of float32 positions, so meshes are watertight. A pixel goes to the face of least depth;
where depths agree in their first 24 bits, to the lowest face index. Both sides of a face are visible.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from advtex_engine.scene import Camera, Fragments, Mesh

NEAR = 0.01  # metres
MAX_BYTES = 256 << 20

_EDGE = 1e-9  # pixels
_EDGE_ON = 1e-12  # |det| below this share of the lengths that make it: the plane holds the camera's centre
_TINY = 1e-30  # stands for a zero divisor: the bound it gives lies far outside of the image, on the right side

_FACE_BITS = 29  # float64 has 29 mantissa bits more than float32; a key keeps a face index there
_EMPTY = (1 << 63) - 1

# Peak bytes per item of each enumeration, temporaries included.
_FACE_BYTES, _SPAN_BYTES, _PIXEL_BYTES = 1200, 400, 80


class _Planes(NamedTuple):
    """Linear functions a u + b v + c of the pixel, per face, float64; u and v are column and row index.

    edges: [3,F,3] (a, b, c) of the edge functions over det: barycentric / z of each corner, >= 0 inside.
    inverse_depth: [3,F] (a, b, c) of 1/z.
    """

    edges: Tensor
    inverse_depth: Tensor
    valid: Tensor


def rasterize(mesh: Mesh, camera: Camera, *, near: float = NEAR, max_bytes: int = MAX_BYTES) -> Fragments:
    """What `camera` sees of `mesh` at its pixel centres, on the device of the mesh.

    near: metres; nothing nearer along z is seen. max_bytes: bound on temporary memory, apart from a few words per
    vertex and per pixel. Not differentiable. Faces without area or with corners that are not finite are not seen.
    """
    return next(rasterize_views(mesh, [camera], near=near, max_bytes=max_bytes))


def rasterize_views(
    mesh: Mesh, cameras: Iterable[Camera], *, near: float = NEAR, max_bytes: int = MAX_BYTES
) -> Iterator[Fragments]:
    """`rasterize` for each camera in turn; the same result, with the work on the mesh done once."""
    assert near > 0
    assert max_bytes > 0
    assert mesh.t_pos_idx.shape[0] < 1 << _FACE_BITS
    v_pos = mesh.v_pos.double()
    for camera in cameras:
        yield _rasterize(v_pos, mesh.t_pos_idx, camera, near, max_bytes)


def _rasterize(v_pos: Tensor, t_pos_idx: Tensor, camera: Camera, near: float, max_bytes: int) -> Fragments:
    corners = _homogeneous(v_pos, camera)
    outside = _outside(corners, camera, near)
    nearest = torch.full((camera.height * camera.width,), _EMPTY, dtype=torch.int64, device=v_pos.device)
    step = max(1, max_bytes // _FACE_BYTES)
    for first in range(0, len(t_pos_idx), step):
        faces = t_pos_idx[first : first + step]
        inside = (outside[faces[:, 0]] & outside[faces[:, 1]] & outside[faces[:, 2]]) == 0
        index = inside.nonzero()[:, 0]
        _draw(nearest, corners[faces[index]], index + first, camera, near, max_bytes)
    return _resolve(nearest, corners, t_pos_idx, camera)


def _homogeneous(v_pos: Tensor, camera: Camera) -> Tensor:
    """[V,3] world -> [V,3] undivided image points, column and row index times z, and z."""
    K = camera.K.to(v_pos.device, torch.float64, copy=True)
    K[:2] -= 0.5 * K[2]  # from pixel coordinates to indices: integers are centres
    projection = K @ camera.world_to_camera.to(K)[:3]
    return v_pos @ projection[:, :3].T + projection[:, 3]


def _outside(corners: Tensor, camera: Camera, near: float) -> Tensor:
    """[V] uint8, one bit per frustum plane that has the corner outside."""
    u, v, z = corners.unbind(1)
    tests = (u < 0, v < 0, u > z * (camera.width - 1), v > z * (camera.height - 1), z < near, ~(z.abs() < torch.inf))
    code = torch.zeros(len(corners), dtype=torch.uint8, device=corners.device)
    for bit, test in enumerate(tests):
        code |= test.to(torch.uint8) << bit
    return code


def _planes(corners: Tensor) -> _Planes:
    """Corners [F,3,3], undivided -> their `_Planes`, `valid` False for those that cannot be seen."""
    p = corners.permute(2, 0, 1)  # [3,F,3]: coordinate, face, corner
    following, last = p[:, :, [1, 2, 0]], p[:, :, [2, 0, 1]]
    # Exactly antisymmetric in its arguments, so two faces agree on the edge that they share.
    edges = _cross(following, last)
    sides = p[:, :, 1:] - p[:, :, :1]
    normal = _cross(sides[:, :, 0], sides[:, :, 1])
    det = (p[:, :, 0] * normal).sum(0)
    scale = p[:, :, 0].norm(dim=0) * sides[:, :, 0].norm(dim=0) * sides[:, :, 1].norm(dim=0)
    return _Planes(edges / det[None, :, None], normal / det, det.abs() > _EDGE_ON * scale)


def _cross(p: Tensor, q: Tensor) -> Tensor:
    return torch.stack([p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]])


def _rows(corners: Tensor, camera: Camera, near: float) -> tuple[Tensor, Tensor]:
    """First row and number of rows, each [F] int64, of each face's bounding box; 0 if it holds no pixel centre."""
    z = corners[:, :, 2]
    ahead = z.amin(1) >= near
    # A face that crosses the near plane may reach anywhere; its half-planes decide row by row.
    low, high = (corners[:, :, :2] / z[:, :, None]).aminmax(dim=1)
    low = torch.where(ahead[:, None], torch.ceil(low - _EDGE), 0.0).clamp_(min=0)
    limit = low.new_tensor([camera.width - 1, camera.height - 1])
    high = torch.minimum(torch.where(ahead[:, None], torch.floor(high + _EDGE), limit), limit)
    rows = torch.where(high[:, 0] >= low[:, 0], high[:, 1] - low[:, 1] + 1, 0.0).clamp_(min=0)
    return low[:, 1].long(), rows.long()


def _draw(nearest: Tensor, corners: Tensor, index: Tensor, camera: Camera, near: float, max_bytes: int) -> None:
    """Faces with corners [F,3,3] and indices [F] into the keys `nearest` [H * W]."""
    planes = _planes(corners)
    first_row, rows = _rows(corners, camera, near)
    kept = (planes.valid & (rows > 0)).nonzero()[:, 0]
    index, first_row, rows = index[kept], first_row[kept], rows[kept]
    inverse_depth = planes.inverse_depth[:, kept]
    a, b, c = planes.edges[:, kept]
    c = c + _EDGE * (a.abs() + b.abs())
    near_plane = -inverse_depth
    near_plane[2] += 1 / near
    a, b, c = torch.cat([torch.stack([a, b, c]), near_plane[:, :, None]], dim=2).permute(0, 2, 1)  # [4,F] each
    a = torch.where(a == 0, _TINY, a)
    slope, offset, is_left = -b / a, -c / a, a > 0

    for part in _parts(rows, max_bytes // _SPAN_BYTES):
        face, step = _expand(rows[part])
        face += part.start
        row = step + first_row[face]
        bound = slope[:, face] * row + offset[:, face]
        left = is_left[:, face]
        low = torch.where(left, bound, -torch.inf).amax(0).ceil_().clamp_(0, camera.width)
        high = torch.where(left, torch.inf, bound).amin(0).floor_().clamp_(-1, camera.width - 1)
        count = (high - low + 1).clamp_(min=0).long()
        spans = count.nonzero()[:, 0]
        face, row, low, count = face[spans], row[spans], low[spans], count[spans]
        grow = inverse_depth[0, face]
        start = grow * low + (inverse_depth[1, face] * row + inverse_depth[2, face])
        pixel = row * camera.width + low.long()
        _draw_spans(nearest, start, grow, pixel, index[face], count, max_bytes)


def _draw_spans(
    nearest: Tensor, start: Tensor, grow: Tensor, pixel: Tensor, index: Tensor, count: Tensor, max_bytes: int
) -> None:
    """Spans of `count` pixels from `pixel` on, 1/z = start + k grow at the k-th, into the keys `nearest`."""
    for part in _parts(count, max_bytes // _PIXEL_BYTES):
        span, step = _expand(count[part])
        span += part.start
        depth = (start[span] + grow[span] * step).clamp_(min=_TINY).reciprocal_()
        key = (depth.view(torch.int64) >> _FACE_BITS << _FACE_BITS) | index[span]
        nearest.scatter_reduce_(0, pixel[span] + step, key, "amin")


def _expand(count: Tensor) -> tuple[Tensor, Tensor]:
    """For counts [N]: the item [sum] that each element belongs to, and its place [sum] within the item."""
    item = torch.repeat_interleave(count)
    start = count.cumsum(0) - count
    return item, torch.arange(len(item), device=count.device) - start[item]


def _parts(count: Tensor, limit: int) -> Iterator[slice]:
    """Slices of `count` [N] that sum to at most `limit` each, or hold one item."""
    total = count.cumsum(0)
    start = 0
    while start < len(count):
        done = total[start - 1] if start else 0
        end = int(torch.searchsorted(total, done + limit, right=True))
        end = max(end, start + 1)
        yield slice(start, end)
        start = end


def _resolve(nearest: Tensor, corners: Tensor, t_pos_idx: Tensor, camera: Camera) -> Fragments:
    """Keys [H * W] -> `Fragments`, with depth and barycentrics of each pixel's face computed afresh."""
    shape = (camera.height, camera.width)
    hit = (nearest != _EMPTY).nonzero()[:, 0]
    face = nearest[hit] & ((1 << _FACE_BITS) - 1)
    visible = torch.zeros(len(t_pos_idx), dtype=torch.bool, device=nearest.device)
    visible[face] = True
    order = visible.cumsum(0) - 1
    planes = _planes(corners[t_pos_idx[visible]])
    which = order[face]
    column, row = (hit % camera.width).double(), (hit // camera.width).double()
    a, b, c = planes.edges[:, which]
    weights = (a * column[:, None] + b * row[:, None] + c).clamp_(min=0)
    total = weights.sum(1)
    a, b, c = planes.inverse_depth[:, which]
    inverse_depth = a * column + b * row + c

    face_index = torch.full((len(nearest),), -1, dtype=torch.int32, device=nearest.device)
    barycentric = torch.zeros((len(nearest), 3), device=nearest.device)
    depth = torch.zeros(len(nearest), device=nearest.device)
    face_index[hit] = face.int()
    barycentric[hit] = (weights / total[:, None]).float()
    depth[hit] = inverse_depth.reciprocal().float()
    return Fragments(face_index.view(shape), barycentric.view(*shape, 3), depth.view(shape))

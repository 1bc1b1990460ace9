"""Closest points on a mesh: what a decimated surface lies over. Positions in world metres; not differentiable.

Faces are listed in the cells of a grid that they pass within reach of, so that a point is compared with the few of its
own cell. Every face is cut into pieces no larger than a cell first: the box of a long face would fill the grid.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from advtex_engine.core.scene import Mesh
from advtex_engine.runtime.threads import in_threads, one_thread_each

MAX_CELLS = 30_000_000
MAX_CUTS = 256
REACH = 0.35
"""In cells: how far from a point at least every face is found. Cells begin as large as a face of average area."""
AWAY = 4.0
"""In cells: a face whose back is turned to the point counts as farther by so much."""
LEVELS = 24  # grids, each of twice the cells, for points that lie far away
BLOCK = 16_384  # points at once in a thread


@dataclass(frozen=True)
class OnSurface:
    """Points of a mesh. face: [N] int64. barycentric: [N,3] float32 of its corners, in [0,1].

    distance: [N] float32 metres, from the points that were asked for.
    """

    face: Tensor
    barycentric: Tensor
    distance: Tensor

    def mix(self, values: Tensor, corners: Tensor) -> Tensor:
        """[N,C]: values [V,C] at the points; corners: [T,3] indices into them, as t_pos_idx or t_uv_idx."""
        mixed = values[corners[self.face, 0]] * self.barycentric[:, :1]
        for corner in (1, 2):
            mixed += values[corners[self.face, corner]] * self.barycentric[:, corner : corner + 1]
        return mixed


class ClosestPoints:
    """Finds the points of a mesh [on the CPU] that are closest to others."""

    def __init__(self, mesh: Mesh) -> None:
        self._mesh = mesh
        self._table = _face_table(mesh)
        corners = mesh.v_pos[mesh.t_pos_idx]
        side, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        area = float(torch.linalg.vector_norm(torch.linalg.cross(side, other), dim=1).double().mean() / 2)
        self._grids = [_Grid.of(corners, (2 * area) ** 0.5)]

    def find(self, points: Tensor, normals: Tensor, *, within: float = math.inf) -> OnSurface:
        """The closest points of faces that look the same way, to points [N,3] with normals [N,3] of any length.

        Of two sides of a thin thing the one is found whose normal agrees. Beside a face the point of it is the one that
        has its barycentrics without what is negative, which is nearly the closest. within: metres; where nothing is as
        near, the distance may be infinite, and the point any.
        """
        key = torch.full((len(points),), _NONE)
        left = torch.arange(len(points))
        for level in range(LEVELS if len(points) else 0):
            grid = self._grid(level)
            with one_thread_each():
                search = partial(self._search, grid, points, normals)
                found = torch.cat(list(in_threads(search, torch.split(left, BLOCK))))
            key[left] = found
            left = left[found == _NONE]
            if len(left) == 0 or REACH * grid.size >= within:
                break
        face = torch.where(key == _NONE, 0, key & _FACE)
        second, third, distance2, _ = self._nearest(face, points, normals)
        weights = torch.stack((1 - second - third, second, third), 1)
        return OnSurface(face, weights, torch.where(key == _NONE, math.inf, distance2.sqrt()))

    def _grid(self, level: int) -> _Grid:
        """Each has twice the cells' size of the one before it, for points that lie farther away."""
        while len(self._grids) <= level:
            self._grids.append(_Grid.of(self._mesh.v_pos[self._mesh.t_pos_idx], 2 * self._grids[-1].size))
        return self._grids[level]

    def _search(self, grid: _Grid, points: Tensor, normals: Tensor, which: Tensor) -> Tensor:
        """Keys [N] int64 of the points `which` [N]: bits of the nearest face's squared distance, and its index.

        _NONE where no face is listed.
        """
        points, normals = points[which], normals[which]
        start, count = grid.listed(points)
        end = count.cumsum(0)
        total = int(end[-1])
        point = torch.repeat_interleave(torch.arange(len(points)), count, output_size=total)
        place = torch.arange(total) + (start - end + count)[point]
        face = grid.faces[place].long()
        *_, score, agrees = self._nearest(face, points.index_select(0, point), normals.index_select(0, point))
        score += torch.where(agrees >= 0, 0.0, (AWAY * grid.size) ** 2)
        # Bits of floats that are not negative are in their order.
        packed = (score.view(torch.int32).long() << 32).bitwise_or_(face)
        return torch.full((len(points),), _NONE).scatter_reduce_(0, point, packed, "amin")

    def _nearest(self, face: Tensor, points: Tensor, normals: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Of faces [N] at their points nearest to points [N,3]: barycentrics of the second and the third corner,
        squared distance, and the dot product of the face's normal and the given one.
        """
        column = iter(self._table)

        def gathered() -> Tensor:
            return next(column).index_select(0, face)

        x, y, z = points.unbind(1)
        u = gathered().mul_(x).add_(gathered().mul_(y)).add_(gathered().mul_(z)).add_(gathered())
        v = gathered().mul_(x).add_(gathered().mul_(y)).add_(gathered().mul_(z)).add_(gathered())
        nx, ny, nz = gathered(), gathered(), gathered()
        agrees = (nx * normals[:, 0]).add_(ny * normals[:, 1]).add_(nz * normals[:, 2])
        height = nx.mul_(x).add_(ny.mul_(y)).add_(nz.mul_(z)).add_(gathered())
        inner_u, inner_v = u.clamp(min=0), v.clamp(min=0)
        over = (1 - u).sub_(v).clamp_(min=0).add_(inner_u).add_(inner_v).reciprocal_()
        inner_u.mul_(over)
        inner_v.mul_(over)
        du, dv = u.sub_(inner_u), v.sub_(inner_v)
        aside = gathered().mul_(du).add_(gathered().mul_(dv)).mul_(du).add_(gathered().mul_(dv).mul_(dv))
        return inner_u, inner_v, height.mul_(height).add_(aside).clamp_(min=0), agrees


_NONE = (1 << 63) - 1
_FACE = (1 << 32) - 1


def _face_table(mesh: Mesh) -> list[Tensor]:
    """15 columns [T]: barycentrics of the second and third corner and height over the plane, as four coefficients each
    of x, y, z and 1; and the dot products of the sides at the first corner, the mixed one twice.
    """
    a, b, c = mesh.v_pos.double()[mesh.t_pos_idx].unbind(1)
    side, other = b - a, c - a
    normal = torch.linalg.cross(side, other)
    area2 = (normal**2).sum(1, keepdim=True).clamp(min=1e-30)
    columns = list[Tensor]()
    for gradient in (
        torch.linalg.cross(other, normal) / area2,
        torch.linalg.cross(normal, side) / area2,
        normal / area2.sqrt(),
    ):
        columns += [*gradient.unbind(1), -(gradient * a).sum(1)]
    columns += [(side**2).sum(1), 2 * (side * other).sum(1), (other**2).sum(1)]
    return [column.float() for column in columns]


@dataclass(frozen=True)
class _Grid:
    """Faces listed by cell: those of cell i are faces[first[i] : first[i + 1]]. size: metres."""

    low: Tensor
    shape: tuple[int, int, int]
    size: float
    first: Tensor
    faces: Tensor

    @staticmethod
    def of(corners: Tensor, size: float) -> _Grid:
        """corners: [T,3,3] of the faces."""
        low, high = corners.amin((0, 1)), corners.amax((0, 1))
        size = max(size, float((high - low).double().clamp(min=size).prod() / MAX_CELLS) ** (1 / 3))
        reach = REACH * size
        low = low - reach
        counts = ((high + reach - low) / size).floor().long() + 1
        shape = (int(counts[0]), int(counts[1]), int(counts[2]))
        face, piece = _pieces(corners, size)
        lowest = ((piece.amin(1) - reach - low) / size).floor().long().clamp(min=0)
        spans = torch.minimum(((piece.amax(1) + reach - low) / size).floor().long(), counts - 1) - lowest + 1
        total = spans.prod(1)
        entry = torch.repeat_interleave(torch.arange(len(piece)), total)
        place = torch.arange(len(entry)).sub_((total.cumsum(0) - total).index_select(0, entry)).int()
        across, deep = (spans[:, axis].int().index_select(0, entry) for axis in (1, 2))
        row = place // deep
        first = row // across
        step = (first, row - first * across, place - row * deep)
        # A cell that the face's plane does not reach is within the box only.
        normal = torch.nn.functional.normalize(
            torch.linalg.cross(piece[:, 1] - piece[:, 0], piece[:, 2] - piece[:, 0]), dim=1
        )
        center = low + (lowest + 0.5) * size  # of each piece's lowest cell
        off = ((center - piece[:, 0]) * normal).sum(1).index_select(0, entry)
        for axis in range(3):
            off += (size * normal[:, axis]).index_select(0, entry).mul_(step[axis])
        kept = off.abs_() <= (reach + size / 2 * normal.abs().sum(1)).index_select(0, entry)
        lowest = (lowest[:, 0] * shape[1] + lowest[:, 1]) * shape[2] + lowest[:, 2]
        inside = (step[0][kept] * shape[1] + step[1][kept]) * shape[2] + step[2][kept]
        entry = entry[kept]
        index = lowest.index_select(0, entry).add_(inside)
        pairs = torch.unique(index * len(corners) + face.index_select(0, entry))
        index = pairs // len(corners)
        cells = shape[0] * shape[1] * shape[2]
        first = torch.searchsorted(index, torch.arange(cells + 1))
        return _Grid(low, shape, size, first, (pairs % len(corners)).int())

    def listed(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Where the faces of the points' cells [N] begin, and how many there are; none outside of the grid."""
        cell = ((points - self.low) / self.size).floor().long()
        inside = ((cell >= 0) & (cell < torch.tensor(self.shape))).all(1)
        index = torch.where(inside, (cell[:, 0] * self.shape[1] + cell[:, 1]) * self.shape[2] + cell[:, 2], 0)
        start = self.first[index]
        return start, torch.where(inside, self.first[index + 1] - start, 0)


def _pieces(corners: Tensor, size: float) -> tuple[Tensor, Tensor]:
    """Faces [T,3,3] cut into pieces whose sides are at most `size`: the face of each [P], and corners [P,3,3]."""
    longest = (corners - corners.roll(1, 1)).norm(dim=2).amax(1)
    cuts = (longest / size).ceil().clamp(1, MAX_CUTS).long()
    faces, pieces = list[Tensor](), list[Tensor]()
    for k in torch.unique(cuts).tolist():
        which = (cuts == k).nonzero()[:, 0]
        i, j = torch.meshgrid(torch.arange(k), torch.arange(k), indexing="ij")
        at = torch.stack((i, j), 2).view(-1, 1, 2).float()
        upright, inverted = at[(i + j < k).flatten()], at[(i + j < k - 1).flatten()]
        local = (
            torch.cat(
                (
                    upright + torch.tensor([[0.0, 0], [1, 0], [0, 1]]),
                    inverted + torch.tensor([[1.0, 0], [1, 1], [0, 1]]),
                )
            )
            / k
        )
        weight = torch.cat((1 - local.sum(2, keepdim=True), local), 2)
        pieces.append((weight.view(-1, 3) @ corners[which]).view(-1, 3, 3))
        faces.append(which.repeat_interleave(k * k))
    return torch.cat(faces), torch.cat(pieces)

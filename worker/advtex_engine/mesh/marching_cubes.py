"""Marching cubes on sparse blocks (Lorensen & Cline 1987): signed distances -> triangles that share their vertices.

The table is made, not copied: on each side of a cell the negative corners are cut off run by run, the contours of the
six sides join to loops, and each loop becomes a fan. Two cells treat the side that they share alike, so that the
surface has no cracks, also where a side's signs alternate.

Corner k of a cell lies at (k & 1, k >> 1 & 1, k >> 2); an edge belongs to the voxel at its lower end.
"""

from __future__ import annotations

from functools import cache

import torch
from torch import Tensor

from advtex_engine.core.scene import Mesh
from advtex_engine.mesh.tsdf import BLOCK, TRUNCATION_VOXELS, VOXELS, VoxelBlocks

# Blocks at a time: about 40 MB of temporaries.
_CHUNK = 2_048
_CORNERS = tuple((k & 1, k >> 1 & 1, k >> 2) for k in range(8))
# (lower corner, axis), and the pair of corners.
_EDGES = tuple((k, axis) for axis in range(3) for k in range(8) if not _CORNERS[k][axis])
_EDGE_OF = {frozenset((k, k | 1 << axis)): number for number, (k, axis) in enumerate(_EDGES)}
# Corners of each side, counter-clockwise seen from outside the cell.
_SIDES = ((0, 4, 6, 2), (1, 3, 7, 5), (0, 1, 5, 4), (2, 6, 7, 3), (0, 2, 3, 1), (4, 5, 7, 6))
_SIDES_OF = [{number for number, side in enumerate(_SIDES) if {k, k | 1 << axis} <= set(side)} for k, axis in _EDGES]


def extract_surface(blocks: VoxelBlocks) -> Mesh:
    """The zero level of the blocks' distances, on their device; faces are counter-clockwise seen from outside (+).

    A cell gives triangles where all its eight corners were observed; so the surface is open where nothing was seen. Nor
    does it where the distance falls from the truncation to below zero: that is the rim of a shadow, not a surface.
    Vertices are shared, in the order of the blocks; some are of no face. Not differentiable.
    """
    device = blocks.keys.device
    neighbors = blocks.neighbors()
    counts, table = (part.to(device) for part in _triangles())
    corner_offsets = torch.tensor(_CORNERS, device=device)
    lower, axes = (torch.tensor(column, device=device) for column in zip(*_EDGES, strict=True))
    keys, points, faces = list[Tensor](), list[Tensor](), list[Tensor]()
    for start in range(0, len(blocks.keys), _CHUNK):
        chunk = torch.arange(start, min(start + _CHUNK, len(blocks.keys)), device=device)
        values = _padded(blocks, neighbors[chunk])
        chunk_keys, chunk_points = _vertices(blocks, values, chunk)
        keys.append(chunk_keys)
        points.append(chunk_points)
        block, cell, case = _active_cells(values, TRUNCATION_VOXELS * blocks.voxel_size)
        owner, triangle = _expand(counts[case])
        edge = table[case[owner], triangle]
        voxel = cell[owner, None, :] + corner_offsets[lower[edge]]
        faces.append(_edge_keys(neighbors, chunk[block[owner]], voxel, axes[edge]))
    every, edges = torch.cat(keys), torch.cat(faces)
    # Blocks, their voxels and the axes were visited in order: the keys are sorted.
    return Mesh(torch.cat(points), torch.searchsorted(every, edges.view(-1)).view(-1, 3))


def _padded(blocks: VoxelBlocks, neighbors: Tensor) -> Tensor:
    """Distances [N,9,9,9] with the first layers of the blocks after; NaN = not observed."""
    size = BLOCK + 1
    values = blocks.distance.new_full((len(neighbors), size, size, size), torch.nan)
    for number, (x, y, z) in enumerate(_CORNERS):
        index = neighbors[:, number]
        there = (index >= 0).nonzero()[:, 0]
        taken = blocks.distance[index[there]].view(-1, BLOCK, BLOCK, BLOCK)
        spans = [slice(BLOCK, size) if after else slice(0, BLOCK) for after in (x, y, z)]
        counts = [1 if after else BLOCK for after in (x, y, z)]
        values[there, spans[0], spans[1], spans[2]] = taken[:, : counts[0], : counts[1], : counts[2]]
    return values


def _vertices(blocks: VoxelBlocks, values: Tensor, chunk: Tensor) -> tuple[Tensor, Tensor]:
    """Keys [V], ascending, and world positions [V,3] of the crossings on the edges that the chunk's voxels own."""
    here = values[:, :BLOCK, :BLOCK, :BLOCK]
    after = torch.stack(
        (values[:, 1:, :BLOCK, :BLOCK], values[:, :BLOCK, 1:, :BLOCK], values[:, :BLOCK, :BLOCK, 1:]), -1
    )
    before = here[..., None].expand_as(after)
    crossing = ((before < 0) & (after >= 0)) | ((before >= 0) & (after < 0))
    block, x, y, z, axis = crossing.nonzero(as_tuple=True)
    first, second = before[block, x, y, z, axis], after[block, x, y, z, axis]
    position = torch.stack((x, y, z), 1).double()
    position[torch.arange(len(axis), device=axis.device), axis] += (first / (first - second)).double()
    position = (position + blocks.corners()[chunk][block]) * blocks.voxel_size
    keys = ((chunk[block] * VOXELS) + (x * BLOCK + y) * BLOCK + z) * 3 + axis
    return keys, position.float()


def _active_cells(values: Tensor, truncation: float) -> tuple[Tensor, Tensor, Tensor]:
    """Block [C], place in it [C,3] and sign pattern [C] of the cells that the surface passes, all corners observed."""
    case = torch.zeros_like(values[:, :BLOCK, :BLOCK, :BLOCK], dtype=torch.uint8)
    most = torch.full_like(values[:, :BLOCK, :BLOCK, :BLOCK], -torch.inf)
    for number, (x, y, z) in enumerate(_CORNERS):
        corner = values[:, x : x + BLOCK, y : y + BLOCK, z : z + BLOCK]
        torch.maximum(most, corner, out=most)  # NaN stays
        case += (corner < 0).to(torch.uint8) << number
    cells = ((most < truncation) & (case > 0) & (case < 255)).nonzero()
    return cells[:, 0], cells[:, 1:], case[tuple(cells.T)].long()


def _edge_keys(neighbors: Tensor, block: Tensor, voxel: Tensor, axis: Tensor) -> Tensor:
    """Keys [F,3] of edges by block [F], owning voxel [F,3,3] counted in that block (8 = in the next), axis [F,3]."""
    beyond = voxel == BLOCK
    number = (beyond * torch.tensor([1, 2, 4], device=voxel.device)).sum(-1)
    owner = neighbors[block[:, None], number].long()
    x, y, z = torch.where(beyond, 0, voxel).unbind(-1)
    return (owner * VOXELS + (x * BLOCK + y) * BLOCK + z) * 3 + axis


def _expand(count: Tensor) -> tuple[Tensor, Tensor]:
    """Counts [N] -> for each of the sum(count) elements its item, and its place among the item's."""
    item = torch.repeat_interleave(count)
    first = count.cumsum(0) - count
    return item, torch.arange(len(item), device=count.device) - first[item]


@cache
def _triangles() -> tuple[Tensor, Tensor]:
    """Per sign pattern (bit k: corner k is negative) the number of triangles [256] and their edges [256,T,3]."""
    fans = [_fans(case) for case in range(256)]
    counts = torch.tensor([len(fan) for fan in fans])
    table = torch.zeros((256, int(counts.max()), 3), dtype=torch.int64)
    for case, fan in enumerate(fans):
        if fan:
            table[case, : len(fan)] = torch.tensor(fan)
    return counts, table


def _fans(case: int) -> list[tuple[int, int, int]]:
    """The triangles of one sign pattern, as numbers of edges."""
    after = _contours(case)
    triangles = []
    while after:
        first, edge = after.popitem()
        loop = [first]
        while edge != first:
            loop.append(edge)
            edge = after.pop(edge)
        triangles += _fan(loop)
    return triangles


def _fan(loop: list[int]) -> list[tuple[int, int, int]]:
    """Triangles of a loop around the first of its points from which no diagonal lies in a side of the cell.

    There the neighboring cell may have the same diagonal, and four faces would meet in it.
    """
    turns = (loop[k:] + loop[:k] for k in range(len(loop)))
    fan = next(turn for turn in turns if not any(_SIDES_OF[turn[0]] & _SIDES_OF[other] for other in turn[2:-1]))
    return [(fan[0], fan[k], fan[k + 1]) for k in range(1, len(fan) - 1)]


def _contours(case: int) -> dict[int, int]:
    """The contours on the sides: from each crossed edge to the one that follows it, negative corners on the left."""
    after = {}
    for side in _SIDES:
        inside = [bool(case >> corner & 1) for corner in side]
        edges = [_EDGE_OF[frozenset((side[k], side[(k + 1) % 4]))] for k in range(4)]
        for k in range(4):
            if inside[k] and not inside[(k + 1) % 4]:
                run = k
                while inside[run - 1]:
                    run -= 1
                after[edges[run - 1]] = edges[k]
    return after

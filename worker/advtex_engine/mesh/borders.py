"""Mending the open borders of a scanned mesh. Positions in world metres; nothing here is differentiable.

Scanners leave pinholes where their blocks meet, and borders that run in teeth along their grid; decimation cuts corners
off what is left: black specks in every picture of the model. Only for meshes with more faces than needed: an opening of
a few edges is a pinhole there, and a window in a mesh that somebody drew.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import torch

from advtex_engine.core.cameras import project
from advtex_engine.core.scene import DepthFrame, Mesh

PINHOLE_EDGES = 12  # larger holes are what the scanner did not see
NOTCH_WIDTH = 2.0  # of the mesh's median edge
NOTCH_PASSES = 4  # each halves what is left
MIN_COSINE = 0.5  # between a notch's triangle and the faces beside it
# What collapsing along a border cuts off. A thousandth of a kitchen's pixels were missed for want of it, each a black
# speck; grown everywhere, a rendered room's open edges stuck out by a pixel, as they did where notches were filled.
GROWTH, SURE_GROWTH = 0.15, 0.5
DEPTH_ACCURACY = 0.012  # of the distance
MIN_LOOKS = 2
LOOKS = 128  # frames that are asked, of a long scan every so many: neighbors see the same

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]


def median_edge(mesh: Mesh) -> float:
    """Metres; every edge counts once per face."""
    corners = mesh.v_pos.numpy().astype(np.float64)[mesh.t_pos_idx.numpy()]
    return float(np.median(np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)))


def mend_borders(mesh: Mesh, frames: Sequence[DepthFrame]) -> Mesh:
    """A clean mesh with notches filled and pinholes closed, without uv."""
    bare = Mesh(mesh.v_pos, mesh.t_pos_idx)
    return close_pinholes(fill_notches(bare, frames))


def fill_notches(mesh: Mesh, frames: Sequence[DepthFrame]) -> Mesh:
    """A triangle into every concave corner of the border that is at most NOTCH_WIDTH wide, narrow ones first.

    Only where no more frames look past it than have a reading there.
    """
    position, faces = mesh.v_pos.numpy().astype(np.float64), mesh.t_pos_idx.numpy()
    widest = NOTCH_WIDTH * median_edge(mesh)
    for _ in range(NOTCH_PASSES):
        added = _notches(position, faces, widest)
        there, behind = _readings(position[added].mean(axis=1), frames)
        added = added[there >= behind]
        if len(added) == 0:
            break
        faces = np.concatenate((faces, added))
    return mesh if len(faces) == len(mesh.t_pos_idx) else Mesh(mesh.v_pos, torch.from_numpy(faces))


def close_pinholes(mesh: Mesh) -> Mesh:
    """Fans of triangles over holes with at most PINHOLE_EDGES edges, around a new vertex at their middle.

    mesh: clean. The border of a small separate piece is no hole: its fan would face the other way than its faces.
    """
    position, faces = mesh.v_pos.numpy(), mesh.t_pos_idx.numpy()
    edges, normals = border(position, faces)
    after = only_successor(edges, len(position))
    added: list[Integers] = []
    centers: list[Floats] = []
    for loop in _short_loops(edges, after):
        corners = position[edges[loop, 0]].astype(np.float64)
        center = corners.mean(axis=0)
        fan_normal = np.cross(np.roll(corners, -1, axis=0) - center, corners - center).sum(axis=0)
        if float(fan_normal @ normals[loop].sum(axis=0)) <= 0:
            continue
        # Opposite to the border's direction, so that both sides of each edge agree.
        middle = np.full(len(loop), len(position) + len(centers))
        added.append(np.stack((edges[loop, 1], edges[loop, 0], middle), axis=1))
        centers.append(center)
    if not added:
        return mesh
    return Mesh(
        torch.from_numpy(np.concatenate((position, np.array(centers, dtype=np.float32)))),
        torch.from_numpy(np.concatenate((faces, *added))),
    )


def grow_borders(mesh: Mesh, scanned_edge: float, frames: Sequence[DepthFrame]) -> Mesh:
    """A decimated mesh's border moved outward in its faces' plane, less at sharp corners, where the surface goes on.

    scanned_edge: median edge of the mesh before it was decimated, metres. A vertex moves by GROWTH of it unless more
    frames look past the place than have a reading there: by itself the edge of a thing looks as the end of what was
    scanned. By SURE_GROWTH where MIN_LOOKS have a reading, and more than look past it. On the CPU.
    """
    position = mesh.v_pos.numpy().astype(np.float64)
    edges, normals = border(mesh.v_pos.numpy(), mesh.t_pos_idx.numpy())
    along = position[edges[:, 1]] - position[edges[:, 0]]
    outward, length, share = np.cross(along, _unit(normals)), np.linalg.norm(along, axis=1), np.zeros(len(position))
    offset = np.zeros_like(position)
    for corner in edges.T:
        np.add.at(offset, corner, outward)
        np.add.at(share, corner, length)
    on_border = np.flatnonzero(share)
    offset = offset[on_border] * scanned_edge / share[on_border, None]
    grown = position.copy()
    for growth, least, ahead in ((GROWTH, 0, 0), (SURE_GROWTH, MIN_LOOKS, 1)):
        place = position[on_border] + growth * offset
        there, behind = _readings(place, frames)
        moves = (there >= least) & (there >= behind + ahead)
        grown[on_border[moves]] = place[moves]
    return Mesh(torch.from_numpy(grown.astype(np.float32)), mesh.t_pos_idx)


def _readings(place: Floats, frames: Sequence[DepthFrame]) -> tuple[Integers, Integers]:
    """How many frames have a reading at each place, and how many one behind it, [N] each."""
    points = torch.from_numpy(place)
    there, behind = torch.zeros(len(points), dtype=torch.int64), torch.zeros(len(points), dtype=torch.int64)
    for frame in frames:
        pixel, z = project(frame.camera, points)
        height, width = frame.depth.shape
        inside = (z > 0) & (pixel >= 0).all(1) & (pixel < pixel.new_tensor((width, height))).all(1)
        x, y = pixel[inside].long().unbind(1)
        measured = frame.depth[y, x].double()
        read, further = measured > 0, measured - z[inside]
        if frame.confidence is not None:
            read &= frame.confidence[y, x] > 0
        there[inside] += read & (further.abs() < DEPTH_ACCURACY * z[inside])
        behind[inside] += read & (further > DEPTH_ACCURACY * z[inside])
    return there.numpy(), behind.numpy()


def _notches(position: Floats, faces: Integers, widest: float) -> Integers:
    """Triangles [N,3] over pairs of successive border edges a-b-c, each edge in one at most; a-c is the new border."""
    edges, normals = border(position, faces)
    after = only_successor(edges, len(position))
    first = np.flatnonzero(after >= 0)
    second = after[first]
    a, b, c = edges[first, 0], edges[first, 1], edges[second, 1]
    normal = np.cross(position[a] - position[b], position[c] - position[b])
    beside = _unit(normals[first]) + _unit(normals[second])
    cosine = (_unit(normal) * _unit(beside)).sum(axis=1)
    width = np.linalg.norm(position[a] - position[c], axis=1)
    good = np.flatnonzero((cosine > MIN_COSINE) & (width < widest) & (a != c))
    taken = np.zeros(len(edges), dtype=bool)
    chosen = []
    for index in good[np.argsort(width[good], kind="stable")]:
        if not (taken[first[index]] or taken[second[index]]):
            taken[first[index]] = taken[second[index]] = True
            chosen.append(index)
    return np.stack((b[chosen], a[chosen], c[chosen]), axis=1)


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-30))


def border(position: npt.NDArray[np.floating], faces: Integers) -> tuple[Integers, Floats]:
    """Directed edges [B,2] that only one face has, and that face's normal (of twice its area's length) [B,3]."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    key = np.minimum(*edges.T) * len(position) + np.maximum(*edges.T)
    inorder, order = (part.numpy() for part in torch.sort(torch.from_numpy(key)))  # NumPy's takes three times as long
    differs = np.diff(inorder, prepend=-1, append=-1) != 0
    single = np.sort(order[differs[:-1] & differs[1:]])
    a, b, c = position.astype(np.float64)[faces[single // 3]].swapaxes(0, 1)
    return edges[single], np.cross(b - a, c - a)


def only_successor(edges: Integers, vertices: int) -> Integers:
    """The border edge that begins where each border edge ends [B]; -1 where there are none or several."""
    starts = np.bincount(edges[:, 0], minlength=vertices)
    at = np.full(vertices, -1)
    at[edges[:, 0]] = np.arange(len(edges))
    return np.where(starts[edges[:, 1]] == 1, at[edges[:, 1]], -1)


def _short_loops(edges: Integers, after: Integers) -> list[Integers]:
    """Closed walks of 3 to PINHOLE_EDGES border edges, each as indices in walking order, every edge in one at most."""
    first = np.arange(len(edges))
    here, steps = first, [first]
    for _ in range(PINHOLE_EDGES - 1):
        here = np.where(here >= 0, after[here], -1)
        steps.append(here)
    walk = np.stack(steps, axis=1)
    closing = np.where(walk >= 0, after[walk], -1) == first[:, None]
    length = np.where(closing.any(axis=1), closing.argmax(axis=1) + 1, 0)
    loops = []
    for index in np.flatnonzero(length >= 3):
        loop = walk[index, : length[index]]
        if index == loop.min():
            loops.append(loop)
    return loops

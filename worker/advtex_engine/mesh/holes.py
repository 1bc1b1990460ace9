"""Closing the holes of a mesh. Positions in world metres; nothing here is differentiable."""

from __future__ import annotations

import numpy as np
import torch

from advtex_engine.core.scene import Mesh
from advtex_engine.mesh.borders import Floats, Integers, border, only_successor
from advtex_engine.mesh.clean import has_area

MAX_EDGES = 300  # of a border; the work grows with their cube
OPPOSITE = -0.5
"""Least cosine between what closes a hole and the faces around it: the outer border of a sheet has -1, and the end of a
tube 0."""


def close_holes(mesh: Mesh, perimeter: float) -> tuple[Mesh, int]:
    """The mesh with its holes closed whose border is at most `perimeter` metres long, and how many they were.

    mesh: clean. What closes them comes after all other faces, with their winding, and has the least area that triangles
    between the border's vertices can have (Barequet & Sharir 1995). Holes that touch themselves stay, and so do the
    outer borders of sheets. uv are dropped where anything is closed.
    """
    position, faces = mesh.v_pos.numpy(), mesh.t_pos_idx.numpy()
    edges, normals = border(position, faces)
    added = list[Integers]()
    for loop in _loops(edges, only_successor(edges, len(position))):
        corners = edges[loop, 0]
        place = position[corners].astype(np.float64)
        if len(loop) > MAX_EDGES or np.linalg.norm(place - np.roll(place, -1, axis=0), axis=1).sum() > perimeter:
            continue
        # Against the border's direction, so that both sides of each edge agree.
        patch = least_area(place)[:, ::-1]
        a, b, c = np.moveaxis(place[patch], 1, 0)
        facing, around = np.cross(b - a, c - a).sum(axis=0), normals[loop].sum(axis=0)
        if facing @ around >= OPPOSITE * np.linalg.norm(facing) * np.linalg.norm(around):
            added.append(corners[patch][has_area(position, corners[patch])])
    if not added:
        return mesh, 0
    return Mesh(mesh.v_pos, torch.from_numpy(np.concatenate((faces, *added)))), len(added)


def least_area(place: Floats) -> Integers:
    """Triangles [N-2,3] over a closed polygon [N,3] in space, of the least area together, wound as it is."""
    count = len(place)
    cost = np.zeros((count, count))
    middle = np.zeros((count, count), dtype=np.int64)
    for gap in range(2, count):
        first = np.arange(count - gap)
        last = first + gap
        between = first[:, None] + np.arange(1, gap)
        a, b, c = place[first][:, None], place[between], place[last][:, None]
        area = np.linalg.norm(np.cross(b - a, c - a), axis=2) / 2
        total = cost[first[:, None], between] + cost[between, last[:, None]] + area
        best = total.argmin(axis=1)
        cost[first, last], middle[first, last] = total[first, best], between[first, best]
    triangles, waiting = list[tuple[int, int, int]](), [(0, count - 1)]
    while waiting:
        start, end = waiting.pop()
        if end - start > 1:
            between_them = int(middle[start, end])
            triangles.append((start, between_them, end))
            waiting += [(start, between_them), (between_them, end)]
    return np.array(triangles)


def _loops(edges: Integers, after: Integers) -> list[Integers]:
    """Closed walks of border edges, each as indices in walking order, every edge in one at most."""
    loops, done = list[Integers](), np.zeros(len(edges), dtype=bool)
    for first in range(len(edges)):
        walk, here = list[int](), first
        while here >= 0 and not done[here]:
            done[here] = True
            walk.append(here)
            here = int(after[here])
        if here == first and len(walk) >= 3:
            loops.append(np.array(walk))
    return loops

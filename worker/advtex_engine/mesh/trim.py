"""What of a mesh is left out before it is textured: all outside of a box, and floaters."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from advtex_engine.core.errors import Problem, ScanError
from advtex_engine.core.scene import TO_Y_UP, Mesh
from advtex_engine.mesh.faces import keep_faces
from advtex_engine.mesh.pieces import pieces
from advtex_options.box import Box

# Real pieces of five scans have .7 % of the surface and 1,500 faces at least. What is smaller than this share of it is
# a floater if it has few faces and is short, or if nothing larger is near it: a mesh that was drawn, or has as few
# faces as a phone's, has longer things of few faces, such as the rails of a chair.
FLOATER_AREA = 0.001
FLOATER_FACES = 100
FLOATER_LENGTH = 0.2  # metres
FLOATER_DISTANCE = 0.3  # metres
MOST_PLACES = 500  # along a side, where a drawn mesh has faces of hundreds of metres
SAMPLES = 16  # vertices of a piece whose distances are looked at
AT_A_TIME = 1 << 24  # distances


def in_box(points: Tensor, box: Box, up_axis: str) -> Tensor:
    """[N] bool, which points [N,3] of the world lie in the box. up_axis: a key of TO_Y_UP, which it is turned about."""
    sign, axis = (1 if up_axis[0] == "+" else -1), "xyz".index(up_axis[1])
    right, ahead = (axis + 1) % 3, (axis + 2) % 3  # right-handed about the axis
    offset = points.double() - torch.tensor(box.center, dtype=torch.float64)
    angle = math.radians(box.yaw) * sign
    turned = offset.clone()
    turned[:, right] = math.cos(angle) * offset[:, right] + math.sin(angle) * offset[:, ahead]
    turned[:, ahead] = math.cos(angle) * offset[:, ahead] - math.sin(angle) * offset[:, right]
    return (turned.abs() <= torch.tensor(box.size, dtype=torch.float64) / 2).all(1)


def crop(mesh: Mesh, box: Box, up_axis: str) -> Mesh:
    """The faces whose middle lies in the box. Raises ScanError where there are none."""
    assert up_axis in TO_Y_UP
    kept = in_box(mesh.v_pos[mesh.t_pos_idx].double().mean(1), box, up_axis)
    if not bool(kept.any()):
        low, high = (", ".join(f"{value:.2f}" for value in bound) for bound in (mesh.v_pos.amin(0), mesh.v_pos.amax(0)))
        raise ScanError(
            Problem(
                "empty_box",
                "box",
                f"nothing of the mesh lies in it; the mesh reaches from ({low}) to ({high}) metres",
                "move or widen the box, or leave it out",
            )
        )
    return keep_faces(mesh, kept)


def drop_floaters(mesh: Mesh) -> tuple[Mesh, int]:
    """The mesh without small pieces that are crumbs or far from all else, and how many went.

    Without any, the mesh is returned as it is.
    """
    piece = pieces(mesh)[mesh.t_pos_idx[:, 0]]
    names, piece, faces = torch.unique(piece, return_inverse=True, return_counts=True)
    if len(names) == 1:
        return mesh, 0
    a, b, c = mesh.v_pos[mesh.t_pos_idx].double().unbind(1)
    area = torch.zeros(len(names), dtype=torch.float64)
    area.index_add_(0, piece, torch.linalg.cross(b - a, c - a).norm(dim=1) / 2)
    small = area < FLOATER_AREA * area.sum()
    length = (_extremes(mesh, piece, "amax") - _extremes(mesh, piece, "amin")).norm(dim=1)
    floats = small & (faces < FLOATER_FACES) & (length < FLOATER_LENGTH)
    unsure = (small & ~floats).nonzero()[:, 0].tolist()
    body = _places(mesh, ~small[piece]) if unsure else mesh.v_pos[:0]
    for number in unsure:
        corners = torch.unique(mesh.t_pos_idx[piece == number])
        floats[number] = _distance(mesh.v_pos[corners[:: -(-len(corners) // SAMPLES)]], body) > FLOATER_DISTANCE
    return keep_faces(mesh, ~floats[piece]), int(floats.sum())


def _extremes(mesh: Mesh, piece: Tensor, which: str) -> Tensor:
    """[N,3]: the highest or lowest coordinates of the pieces of its faces [T]."""
    corners, of_corner = mesh.v_pos[mesh.t_pos_idx].view(-1, 3), piece.repeat_interleave(3)[:, None].expand(-1, 3)
    empty = corners.new_zeros((int(piece.max()) + 1, 3))
    return empty.scatter_reduce(0, of_corner, corners, which, include_self=False)


def _places(mesh: Mesh, kept: Tensor) -> Tensor:
    """Points [P,3] on the faces `kept` [T], such that none of their surface is far from one."""
    corners = mesh.v_pos[mesh.t_pos_idx[kept]]
    extent = float((mesh.v_pos.amax(0) - mesh.v_pos.amin(0)).max())
    spacing = max(FLOATER_DISTANCE / 2, extent / MOST_PLACES)
    places = [corners.view(-1, 3)]
    while len(corners):
        longest = (corners - corners.roll(-1, 1)).norm(dim=2).amax(1)
        corners = corners[longest > spacing]
        middles = (corners + corners.roll(-1, 1)) / 2
        places.append(middles.view(-1, 3))
        outer = [torch.stack((corners[:, k], middles[:, k], middles[:, k - 1]), 1) for k in range(3)]
        corners = torch.cat((middles, *outer))
    distinct: Tensor = torch.unique(torch.cat(places), dim=0)
    return distinct


def _distance(points: Tensor, places: Tensor) -> float:
    """Metres between the two that are nearest."""
    rows = max(1, AT_A_TIME // len(points))
    return min((float(torch.cdist(points, part).amin()) for part in torch.split(places, rows)), default=math.inf)

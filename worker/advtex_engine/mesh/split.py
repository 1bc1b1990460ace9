"""Faces cut into smaller ones where they are large in the texture. Positions in world metres; not differentiable.

Decimation makes a door of two faces, and who draws a room by hand a wall. What is decided face by face, as which
photograph shows it, would be decided for all of a door at once, by photographs from afar that see all of it.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from advtex_engine.core.rows import distinct_rows
from advtex_engine.core.scene import Atlas, Mesh

# The longest side, in texels, of the faces that photographs are chosen for, over the photographs' width. On five scans
# with meshes of 10,000 faces view selection's LPIPS is 3.2 % lower than uncut; twice as much wins less, and half makes
# thrice the faces.
LONGEST_SIDE = 1 / 20
# What a face becomes whose first sides are cut (1 and 2 of them) or all: 0 to 2 its corners, 3 to 5 the middles of the
# sides 0-1, 1-2 and 2-0.
_PIECES = {
    1: ((0, 3, 2), (3, 1, 2)),
    2: ((3, 1, 4), (0, 3, 4), (0, 4, 2)),
    3: ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5)),
}


def split_long_sides(atlas: Atlas, longest: float) -> Atlas:
    """The same surface with the same texture in faces without sides of more than `longest` texels.

    Sides are halved, for both of their faces, until none is longer; neighbors stay neighbors. Faces that are not cut
    come first, in their order; the atlas itself where none is.
    """
    while (cut := _long_sides(atlas, longest)).any():
        atlas = replace(atlas, mesh=_halved(atlas.mesh, cut))
    return atlas


def _long_sides(atlas: Atlas, longest: float) -> Tensor:
    """[T,3] bool, the sides 0-1, 1-2 and 2-0 that are too long in either of their faces."""
    mesh = atlas.mesh
    assert mesh.v_uv is not None
    assert mesh.t_uv_idx is not None
    corners = (mesh.v_uv * mesh.v_uv.new_tensor((atlas.width, atlas.height)))[mesh.t_uv_idx]
    long = (corners.roll(-1, 1) - corners).norm(dim=2) > longest
    edge = distinct_rows(_ends(mesh.t_pos_idx))[1].view_as(long)
    cut = torch.zeros(long.numel(), dtype=torch.bool, device=long.device)
    cut[edge[long]] = True
    return cut[edge]


def _halved(mesh: Mesh, cut: Tensor) -> Mesh:
    """A mesh with a new vertex in the middle of all sides that are cut, [T,3] bool, in both of their faces or none."""
    assert mesh.v_uv is not None
    assert mesh.t_uv_idx is not None
    count = cut.sum(1)
    # Cut sides first.
    first = torch.where(count == 2, cut.byte().argmin(1) + 1, cut.byte().argmax(1))
    turned = (first[:, None] + torch.arange(3, device=cut.device)) % 3
    turned = torch.cat((turned, turned + 3), 1)
    v_pos, positions = _with_middles(mesh.v_pos, mesh.t_pos_idx, cut)
    v_uv, uvs = _with_middles(mesh.v_uv, mesh.t_uv_idx, cut)

    def pieces(corners: Tensor, whole: Tensor) -> Tensor:
        corners = corners.gather(1, turned)
        parts = [corners[count == sides][:, list(piece)].flatten(0, 1) for sides, piece in _PIECES.items()]
        return torch.cat((whole[count == 0], *parts))

    return Mesh(v_pos, pieces(positions, mesh.t_pos_idx), v_uv, pieces(uvs, mesh.t_uv_idx))


def _with_middles(values: Tensor, corners: Tensor, cut: Tensor) -> tuple[Tensor, Tensor]:
    """Values [V,C] and the middles of all cut sides; and of each face [T,6] its corners and its sides' middles."""
    sides, cut = _ends(corners), cut.flatten()
    edges, which = distinct_rows(sides[cut])
    middle = torch.zeros_like(sides[:, 0])
    middle[cut] = len(values) + which
    return torch.cat((values, values[edges].mean(1))), torch.cat((corners, middle.view_as(corners)), 1)


def _ends(corners: Tensor) -> Tensor:
    """[3 T,2] the ends of all sides of faces [T,3], the lower index first."""
    return torch.stack((corners, corners.roll(-1, 1)), 2).view(-1, 2).sort(1).values

"""Tangent frames as viewers make them of a mesh that brings none: glTF's default, MikkTSpace (Mikkelsen 2008).

A face's tangent points to where u grows on its surface. Faces that share a position, a uv and an orientation share a
tangent there: the mean of theirs, each laid into the plane across the vertex's normal and weighted by the face's angle.
Between vertices normal and tangent are interpolated; the bitangent is their cross product, the other way round where
the texture is mirrored, so that it points to the image's first row. On a crumpled sheet of mirrored charts the
tangents are within .03 degrees of those of the authors' code (mikktspace of npm).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.core.scene import Mesh
from advtex_engine.mesh.normals import vertex_normals


@dataclass(frozen=True)
class TangentFrames:
    """Of a mesh with uv. normals: [V,3] float32 unit. tangents: [T,3,3] float32 unit, of each face's corners.

    mirrored: [T] bool, faces whose texture is.
    """

    mesh: Mesh
    normals: Tensor
    tangents: Tensor
    mirrored: Tensor

    @staticmethod
    def of(mesh: Mesh) -> TangentFrames:
        """mesh: with uv as in `core/scene.py`."""
        normals = vertex_normals(mesh)
        along, mirrored = _along_u(mesh)
        return TangentFrames(mesh, normals, _shared(mesh, normals, along, mirrored), mirrored)

    def at(self, face: Tensor, barycentric: Tensor) -> Tensor:
        """[N,3,3] float32: rows are the unit tangent, bitangent and normal at points of faces [N], weights [N,3]."""
        corners = self.mesh.t_pos_idx.index_select(0, face)
        normal = F.normalize(_mixed(self.normals[corners], barycentric), dim=1)
        tangent = _across(_mixed(self.tangents.index_select(0, face), barycentric), normal)
        bitangent = torch.linalg.cross(normal, tangent)
        bitangent = torch.where(self.mirrored.index_select(0, face)[:, None], -bitangent, bitangent)
        return torch.stack((tangent, bitangent, normal), 1)


def _along_u(mesh: Mesh) -> tuple[Tensor, Tensor]:
    """Per face the unit direction [T,3] in which u grows, 0 where uv have no area, and whether it is mirrored [T]."""
    assert mesh.v_uv is not None and mesh.t_uv_idx is not None
    a, b, c = mesh.v_pos[mesh.t_pos_idx].double().unbind(1)
    first, second, third = mesh.v_uv[mesh.t_uv_idx].double().unbind(1)
    (side, other), (su, sv), (ou, ov) = (b - a, c - a), (second - first).unbind(1), (third - first).unbind(1)
    area = sv * ou - su * ov  # v counts downwards here, and upwards in the paper
    along = torch.sign(area)[:, None] * (sv[:, None] * other - ov[:, None] * side)
    return F.normalize(along, dim=1), area < 0


def _shared(mesh: Mesh, normals: Tensor, along: Tensor, mirrored: Tensor) -> Tensor:
    assert mesh.v_uv is not None and mesh.t_uv_idx is not None
    corners = mesh.t_pos_idx
    normal = normals[corners].double()
    place = mesh.v_pos[corners].double()
    ahead, behind = (_across(place.roll(shift, 1) - place, normal) for shift in (-1, 1))
    angle = torch.acos((ahead * behind).sum(2).clamp(-1, 1))
    own = _across(along[:, None].expand(-1, 3, -1), normal) * angle[..., None]
    key = (corners * len(mesh.v_uv) + mesh.t_uv_idx) * 2 + mirrored[:, None]
    groups, group = torch.unique(key, return_inverse=True)
    total = own.new_zeros((len(groups), 3)).index_add_(0, group.flatten(), own.view(-1, 3))
    return F.normalize(total, dim=1).float()[group]


def _across(vectors: Tensor, normals: Tensor) -> Tensor:
    """Unit vectors [...,3] of what of the vectors is perpendicular to unit normals; 0 of those along them."""
    return F.normalize(vectors - (vectors * normals).sum(-1, keepdim=True) * normals, dim=-1)


def _mixed(values: Tensor, weights: Tensor) -> Tensor:
    """[N,C] of corners' values [N,3,C]."""
    mixed = values[:, 0] * weights[:, :1]
    for corner in (1, 2):
        mixed += values[:, corner] * weights[:, corner : corner + 1]
    return mixed

"""Levels of detail of a model, and the cells of space that their faces lie in."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from advtex_engine.core.scene import Mesh, face_areas
from advtex_engine.mesh.normals import vertex_normals
from advtex_engine.results.baking import TexturedModel

FACE_BYTES, TEXEL_BYTES = 30, 0.35
"""What they take in a GLB on the average, its image a JPEG."""


@dataclass(frozen=True)
class Level:
    """A model of the whole. error: [T] metres that its faces are away from the full model, 0 for that itself."""

    model: TexturedModel
    error: Tensor

    @property
    def mesh(self) -> Mesh:
        return self.model.atlas.mesh

    @cached_property
    def normals(self) -> Tensor:
        return vertex_normals(self.mesh)

    @cached_property
    def centers(self) -> Tensor:
        """[T,3] of the faces."""
        return self.mesh.v_pos[self.mesh.t_pos_idx].mean(1)

    @cached_property
    def areas(self) -> Tensor:
        return face_areas(self.mesh)

    @cached_property
    def weight(self) -> Tensor:
        """[T] float64: about the bytes of each face."""
        return self.model.density * self.areas * TEXEL_BYTES + FACE_BYTES

    def error_of(self, faces: Tensor) -> float:
        """Metres, of these faces [N]: their distance from the full model, or the side of their texels, the larger."""
        texel = float(self.areas[faces].sum()) / max(self.model.texels_of(faces), 1)
        return max(float(self.error[faces].max()), math.sqrt(texel))


@dataclass(frozen=True)
class Cell:
    """A box of space, made by halving another one, `depth` times.

    faces: [N] of each level, the finest first, that have their centers in it; there are some of the finest.
    """

    depth: int
    faces: tuple[Tensor, ...]

    def halves(self, levels: Sequence[Level]) -> tuple[Cell, ...]:
        """Cut across its longest side; as many bytes of the finest level on both sides. None of one face."""
        finest = levels[0]
        place = finest.centers[self.faces[0]]
        axis = int((place.amax(0) - place.amin(0)).argmax())
        along, order = place[:, axis].sort(stable=True)
        bytes_up_to = finest.weight[self.faces[0]][order].cumsum(0)
        if along[0] == along[-1]:
            return ()
        middle = int(torch.searchsorted(bytes_up_to, bytes_up_to[-1] / 2))
        plane = along[max(middle, int((along == along[0]).sum()))]
        beyond = [level.centers[faces, axis] >= plane for level, faces in zip(levels, self.faces, strict=True)]
        return tuple(
            Cell(self.depth + 1, tuple(faces[side == far] for faces, side in zip(self.faces, beyond, strict=True)))
            for far in (False, True)
        )

    def parts(self, depth: int, levels: Sequence[Level]) -> list[Cell]:
        """The cells of that depth within it; itself where it is as deep, or cannot be cut."""
        halves = self.halves(levels) if self.depth < depth else ()
        return [part for half in halves for part in half.parts(depth, levels)] or [self]


def distance_of_faces(model: TexturedModel, full: TexturedModel) -> Tensor:
    """[T] float32 metres: how far each face of a model is from the full one, and what is closest to it there from it.

    Measured at corners and centers of the faces of both, towards faces that look the same way.
    """
    points, normals = _samples(model.atlas.mesh)
    away = full.closest.find(points, normals).distance
    vertices = len(model.atlas.mesh.v_pos)
    worst = torch.maximum(away[vertices:], away[:vertices][model.atlas.mesh.t_pos_idx].amax(1))
    found = model.closest.find(*_samples(full.atlas.mesh))
    return worst.scatter_reduce(0, found.face, found.distance, "amax")


def _samples(mesh: Mesh) -> tuple[Tensor, Tensor]:
    """Vertices and centers of faces, and the normals there: [V+T,3] each."""
    corners = mesh.v_pos[mesh.t_pos_idx]
    of_face = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return torch.cat((mesh.v_pos, corners.mean(1))), torch.cat((vertex_normals(mesh), of_face))

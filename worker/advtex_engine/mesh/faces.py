"""Faces that are left out of a mesh."""

from __future__ import annotations

import torch
from torch import Tensor

from advtex_engine.core.scene import Mesh


def keep_faces(mesh: Mesh, kept: Tensor) -> Mesh:
    """The mesh of the faces `kept` [T] bool, in their order, without vertices and uv that no face names.

    A mesh that keeps all of its faces is returned as it is.
    """
    assert kept.shape == mesh.t_pos_idx.shape[:1]
    if bool(kept.all()):
        return mesh
    v_pos, t_pos_idx = _referenced(mesh.v_pos, mesh.t_pos_idx[kept])
    if mesh.v_uv is None or mesh.t_uv_idx is None:
        return Mesh(v_pos, t_pos_idx)
    return Mesh(v_pos, t_pos_idx, *_referenced(mesh.v_uv, mesh.t_uv_idx[kept]))


def _referenced(rows: Tensor, indices: Tensor) -> tuple[Tensor, Tensor]:
    used = torch.zeros(len(rows), dtype=torch.bool, device=rows.device)
    used[indices.flatten()] = True
    return rows[used], (used.cumsum(0) - 1)[indices]

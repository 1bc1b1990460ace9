"""Normals of a mesh's vertices."""

from __future__ import annotations

import torch
from torch import Tensor

from advtex_engine.core.scene import Mesh


def vertex_normals(mesh: Mesh) -> Tensor:
    """Smooth unit normals [V,3] float32: face normals weighted by area; +z where a vertex has no area around it."""
    v_pos = mesh.v_pos.double()
    a, b, c = (v_pos[mesh.t_pos_idx[:, corner]] for corner in range(3))
    twice_area = torch.linalg.cross(b - a, c - a)
    total = torch.zeros_like(v_pos)
    for corner in range(3):
        total.index_add_(0, mesh.t_pos_idx[:, corner], twice_area)
    length = total.norm(dim=1, keepdim=True)
    upwards = total.new_tensor([0.0, 0.0, 1.0])
    return torch.where(length > 0, total / length.clamp(min=torch.finfo(torch.float64).tiny), upwards).float()

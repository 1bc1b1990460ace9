"""Connected pieces."""

from __future__ import annotations

import torch
from torch import Tensor

from advtex_engine.core.scene import Mesh


def pieces(mesh: Mesh) -> Tensor:
    """[V] the least index of a vertex that each vertex is connected to by faces."""
    label = torch.arange(len(mesh.v_pos), device=mesh.v_pos.device)
    while True:
        least = label[mesh.t_pos_idx].amin(1)
        lower = label.clone()
        for corner in mesh.t_pos_idx.T:
            lower.scatter_reduce_(0, corner, least, "amin")
            lower.scatter_reduce_(0, label[corner], least, "amin")
        lower = lower[lower]
        if torch.equal(lower, label):
            return label
        label = lower

"""Connected pieces."""

from __future__ import annotations

import torch
from torch import Tensor

from advtex_engine.core.scene import Mesh


def pieces(mesh: Mesh) -> Tensor:
    """[V] the least index of a vertex that each vertex is connected to by faces."""
    label = torch.arange(len(mesh.v_pos), device=mesh.v_pos.device)
    one, other = mesh.t_pos_idx[:, [0, 1, 1, 2]].view(-1, 2).T
    while len(one):
        # Every label that meets a lower one takes the lowest of these, and then what that one has taken.
        label.scatter_reduce_(0, one.maximum(other), one.minimum(other), "amin")
        while not torch.equal(lower := label[label], label):
            label = lower
        one, other = label[one], label[other]
        apart = one != other
        one, other = one[apart], other[apart]
    return label

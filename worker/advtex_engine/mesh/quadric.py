"""Quadric edge collapse (Garland & Heckbert 1997), one mesh at a time in a process."""

from __future__ import annotations

import threading

import fast_simplification
import numpy as np
import torch

from advtex_engine.core.scene import Mesh

# The library keeps the mesh it works on in variables of the process: two threads would mix up their meshes.
_LOCK = threading.Lock()


def collapse_edges(mesh: Mesh, faces: int, *, aggression: float = 7.0, preserve_border: bool = False) -> Mesh:
    """The mesh with about that many faces, without uv; deterministic.

    It stops short where it runs out of cheap edges, later with more aggression. May leave degenerate faces.
    """
    with _LOCK:
        position, corners = fast_simplification.simplify(
            np.ascontiguousarray(mesh.v_pos.numpy(), np.float32),
            np.ascontiguousarray(mesh.t_pos_idx.numpy(), np.int32),
            target_count=faces,
            agg=aggression,
            preserve_border=preserve_border,
        )
    return Mesh(torch.from_numpy(position.astype(np.float32)), torch.from_numpy(corners.astype(np.int64)))

"""Mesh files -> Mesh: the grammar and the checks are `advtex_scan.mesh`; here are its arithmetic with numpy, and uv.

trimesh is the independent twin in the tests. scene.py counts v from the image's top row: it is flipped here, once,
where the file counts from the bottom.
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from advtex_engine.core.scene import Mesh
from advtex_scan.manifest import Matrix4
from advtex_scan.mesh import MeshPart, MeshSurface, Vector


class NumpyArithmetic:
    """What `advtex_scan.mesh.PlainArithmetic` does, with numpy."""

    def compose(self, parent: Any, local: Matrix4) -> npt.NDArray[np.float64]:
        composed: npt.NDArray[np.float64] = np.asarray(parent, np.float64) @ np.asarray(local, np.float64)
        return composed

    def placed(self, parts: Sequence[MeshPart]) -> memoryview:
        if len(parts) == 1 and parts[0].transform is None:
            return memoryview(parts[0].positions)
        placed = list[npt.NDArray[np.float32]]()
        with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is found afterwards
            for part in parts:
                positions = np.asarray(part.positions).reshape(-1, 3).astype(np.float64)
                transform = np.asarray(part.transform, np.float64)
                placed.append((positions @ transform[:3, :3].T + transform[:3, 3]).astype(np.float32))
        return np.concatenate([np.empty((0, 3), np.float32), *placed]).reshape(-1).data

    def joined(self, parts: Sequence[MeshPart]) -> memoryview:
        return _joined([part.triangles for part in parts], [len(part.positions) // 3 for part in parts])

    def extremes(self, indices: array[int]) -> tuple[int, int]:
        values = np.asarray(indices)
        return int(values.min()), int(values.max())

    def count_not_finite(self, positions: memoryview) -> int:
        return int(np.count_nonzero(~np.isfinite(np.asarray(positions))))

    def bounds(self, positions: memoryview) -> tuple[Vector, Vector]:
        values = np.asarray(positions).reshape(-1, 3)
        (a, b, c), (d, e, f) = values.min(0).tolist(), values.max(0).tolist()
        return (a, b, c), (d, e, f)


NUMPY = NumpyArithmetic()


def to_mesh(surface: MeshSurface) -> Mesh:
    """The mesh of a file that was read: its own arrays, not copies, with v counted from the image's top row.

    uv are kept if every triangle has them.
    """
    v_pos = torch.from_numpy(np.frombuffer(surface.positions, np.float32)).view(-1, 3)
    t_pos_idx = torch.from_numpy(np.frombuffer(surface.triangles, np.int64)).view(-1, 3)
    if not surface.facts.has_uv:
        return Mesh(v_pos, t_pos_idx)
    uv = [_uv(part) for part in surface.parts]
    triangles = [part.triangles if part.uv_triangles is None else part.uv_triangles for part in surface.parts]
    t_uv_idx = torch.from_numpy(np.frombuffer(_joined(triangles, [len(each) for each in uv]), np.int64)).view(-1, 3)
    return Mesh(v_pos, t_pos_idx, torch.from_numpy(np.concatenate(uv).astype(np.float32)), t_uv_idx)


def _joined(indices: Sequence[array[int]], counts: Sequence[int]) -> memoryview:
    """Indices into lists of `counts` entries each, as indices into all of these lists."""
    if len(indices) == 1:
        return memoryview(indices[0])
    first = np.cumsum([0, *counts])
    joined = [np.asarray(each, np.int64) + base for each, base in zip(indices, first, strict=False)]
    return np.concatenate([np.empty(0, np.int64), *joined]).data.cast("B").cast("q")


def _uv(part: MeshPart) -> npt.NDArray[np.float64]:
    """[U,2]"""
    uv = np.asarray(part.uv).reshape(-1, 2).astype(np.float64)
    if part.v_up:
        uv[:, 1] = 1.0 - uv[:, 1]
    return uv

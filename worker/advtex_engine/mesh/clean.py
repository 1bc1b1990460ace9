"""Mesh cleaning and decimation. Positions in world metres; nothing here is differentiable."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import torch

from advtex_engine.core.errors import Problem, ScanError
from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import DepthFrame, Mesh
from advtex_engine.mesh.borders import grow_borders, median_edge, mend_borders
from advtex_engine.mesh.quadric import collapse

# Twice the triangle's area over its longest edge squared (its relative height); below this a face has no texels.
MIN_RELATIVE_HEIGHT = 1e-7
# Quadric decimation stops short of its target when it runs out of cheap edges; every further round presses harder. The
# less, the nearer to the cheapest edge first: outlines stay where they are.
AGGRESSIONS = (2.0, 3.0, 5.0, 6.0, 7.0, 8.0)
# Collapsing across a border eats the surface there: 0.45 % of a kitchen's pixels were missed, now 0.1 %.
ROUNDS = tuple((aggression, aggression < AGGRESSIONS[-1]) for aggression in AGGRESSIONS)


def clean(mesh: Mesh) -> Mesh:
    """Remove what no stage can texture; small separate pieces stay.

    Vertices with identical coordinates are merged, and uv likewise (seams live on in t_uv_idx). Then non-finite,
    degenerate, zero-area and duplicate faces (same vertices in any order: the first one stays) and unreferenced
    vertices and uv are dropped. The order of the faces that stay is kept.

    Raises ScanError when no face is left.
    """
    position, inverse = _unique_rows(mesh.v_pos.numpy())
    faces = inverse[mesh.t_pos_idx.numpy()]
    keep = np.flatnonzero(has_area(position, faces))
    keep = keep[_first_of_each(np.sort(faces[keep], axis=1))]
    if len(keep) == 0:
        raise ScanError(
            Problem(
                "mesh_without_area",
                "mesh",
                "no face of the mesh has an area",
                "export the mesh again as triangles, in metres",
            )
        )
    position, faces = _referenced(position, faces[keep])
    if mesh.v_uv is None or mesh.t_uv_idx is None:
        return Mesh(torch.from_numpy(position), torch.from_numpy(faces))
    uv, uv_inverse = _unique_rows(mesh.v_uv.numpy())
    uv, uv_faces = _referenced(uv, uv_inverse[mesh.t_uv_idx.numpy()[keep]])
    return Mesh(torch.from_numpy(position), torch.from_numpy(faces), torch.from_numpy(uv), torch.from_numpy(uv_faces))


def decimate(mesh: Mesh, face_budget: int, monitor: Monitor, frames: Sequence[DepthFrame] = ()) -> Mesh:
    """At most `face_budget` faces of a clean mesh, by quadric edge collapse; deterministic.

    A mesh within the budget is returned as it is, uv included. Else its borders are mended before, and what collapsing
    cuts off of them is given back after, unless the frames, in the mesh's world, look past it.
    Decimation moves vertices across uv seams, so that uv are dropped, which the monitor is told. Raises as `collapse`
    does.
    """
    if len(mesh.t_pos_idx) <= face_budget:
        return mesh
    if mesh.v_uv is not None:
        monitor.warning(
            Problem(
                "uv_dropped",
                "mesh",
                f"the mesh's texture coordinates are not kept: it has {len(mesh.t_pos_idx):,} faces, more than the "
                f"budget of {face_budget:,}, and decimation invalidates them",
                "raise the face budget, or accept the new atlas",
            )
        )
    collapsed = collapse_edges(mend_borders(mesh, frames), face_budget, monitor, ROUNDS)
    decimated = grow_borders(clean(collapsed), median_edge(mesh), frames)
    if len(decimated.t_pos_idx) > face_budget:
        monitor.warning(
            Problem(
                "face_budget_missed",
                "mesh",
                f"decimation stopped at {len(decimated.t_pos_idx):,} faces, above the budget of {face_budget:,}",
                "simplify the mesh before upload, or raise the face budget",
            )
        )
    return decimated


def collapse_edges(
    mesh: Mesh, faces: int, monitor: Monitor, rounds: Sequence[tuple[float, bool]] = ((7.0, False),)
) -> Mesh:
    """What `collapse` leaves of the mesh, without uv."""
    position, corners = collapse(mesh.v_pos.numpy(), mesh.t_pos_idx.numpy().astype(np.int32), faces, rounds, monitor)
    return Mesh(torch.from_numpy(position), torch.from_numpy(corners))


def has_area(position: npt.NDArray[np.float32], faces: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    corners = position.astype(np.float64)[faces]
    finite = np.isfinite(corners).all(axis=(1, 2))
    corners[~finite] = 0.0
    a, b, c = corners.swapaxes(0, 1)
    sides = b - a, c - b, a - c
    double_area = np.sqrt(_squares(np.cross(sides[0], sides[2])))
    longest = np.maximum.reduce([_squares(side) for side in sides])
    return np.asarray(finite & (double_area > MIN_RELATIVE_HEIGHT * longest), dtype=np.bool_)


def _squares(vectors: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    return np.asarray(np.einsum("nk,nk->n", vectors, vectors))


def _unique_rows(rows: npt.NDArray[np.float32]) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int64]]:
    """Distinct rows in order of first appearance, and for every row the index of its distinct one."""
    keys = np.ascontiguousarray(rows + np.float32(0.0))  # -0.0 and 0.0 are one place
    as_bytes = keys.view(np.dtype((np.void, keys.dtype.itemsize * keys.shape[1]))).reshape(-1)
    _, first, inverse = np.unique(as_bytes, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return rows[first[order]], rank[inverse.reshape(-1)]


def _first_of_each(rows: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    """True where a row of [N,3], numbers from 0 to 2**31, appears for the first time."""
    first, second, third = torch.from_numpy(rows).T
    pair = (first << 31) + second
    order = third.argsort(stable=True)
    order = order[pair[order].argsort(stable=True)]
    pair, third = pair[order], third[order]
    keep = torch.ones(len(rows), dtype=torch.bool)
    keep[order[1:]] = (pair[1:] != pair[:-1]) | (third[1:] != third[:-1])
    return keep.numpy()


def _referenced(
    values: npt.NDArray[np.float32], indices: npt.NDArray[np.int64]
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int64]]:
    """Drop the rows of `values` that no index names, keeping their order."""
    used = np.zeros(len(values), dtype=bool)
    used[indices] = True
    renumber = np.cumsum(used) - 1
    return np.ascontiguousarray(values[used]), renumber[indices]

"""What the mesh readers hand over, and its way to a `Mesh`: checks, and polygons cut into triangles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from advtex_engine.core.scene import Mesh

MAX_FACES = 10_000_000

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]


class MeshFormatError(ValueError):
    """The bytes are not what the format says; the message completes "the mesh ..."."""


@dataclass(frozen=True)
class Polygons:
    """What a mesh file holds, unchecked.

    position   [V,3] world
    corners    [C] indices into position, the corners of all faces one after the other
    sizes      [F] corners per face
    uv         [U,2] in scene.py's convention, or None
    uv_corners [C] indices into uv, or None
    material   [F] indices into materials, the names that the file gives them ("" for none); None where it has none
    """

    position: Floats
    corners: Integers
    sizes: Integers
    uv: Floats | None = None
    uv_corners: Integers | None = None
    material: Integers | None = None
    materials: tuple[str, ...] = ()


def triangulate(polygons: Polygons) -> Mesh:
    """Check counts, indices and coordinates, and split every polygon into the fan around its first corner.

    Faces keep their order; those of fewer than three corners are left out. Raises MeshFormatError.
    """
    position, corners, sizes = polygons.position, polygons.corners, polygons.sizes
    triangles = np.maximum(sizes - 2, 0)
    total = int(triangles.sum())
    if total == 0:
        raise MeshFormatError("has no faces")
    if total > MAX_FACES:
        raise MeshFormatError(f"has {total:,} faces, more than {MAX_FACES:,}")
    _check_indices("face", corners, len(position))
    start = np.repeat(np.cumsum(sizes) - sizes, triangles)
    step = np.arange(total) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    picks = np.stack([start, start + step + 1, start + step + 2], axis=1)
    faces = corners[picks]
    with np.errstate(over="ignore"):
        v_pos = position.astype(np.float32)
    if not np.isfinite(v_pos[faces]).all():
        raise MeshFormatError("has coordinates that are no finite numbers in single precision")
    if polygons.uv is None or polygons.uv_corners is None:
        return Mesh(torch.from_numpy(v_pos), torch.from_numpy(faces))
    _check_indices("texture coordinate", polygons.uv_corners, len(polygons.uv))
    return Mesh(
        torch.from_numpy(v_pos),
        torch.from_numpy(faces),
        torch.from_numpy(polygons.uv.astype(np.float32)),
        torch.from_numpy(polygons.uv_corners[picks]),
    )


def flip_v(uv: Floats) -> Floats:
    """uv with v counted from the image's other end."""
    return np.stack([uv[:, 0], 1.0 - uv[:, 1]], axis=1)


def _check_indices(what: str, indices: Integers, count: int) -> None:
    if len(indices) and not (indices.min() >= 0 and indices.max() < count):
        raise MeshFormatError(
            f"has {what} indices out of range: they run from {indices.min()} to {indices.max()}, for {count} entries"
        )

"""What every reader gives: parts of triangles in arrays; and the limits that hold for all of them."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, BinaryIO

from advtex_scan.errors import Finding, MeshError

MAX_BYTES = 2 << 30  # of a mesh's file, and of all files beside it that it names together
MAX_ELEMENTS = 10_000_000  # vertices, and triangles; ScanNet's finest meshes hold about 5 million
DAMAGED = "copy the file again in full"


@dataclass(frozen=True, slots=True)
class MeshSource:
    """A mesh file that is open.

    path: what messages call it; its ending says what kind of file it is
    stream: stands at its first byte
    size: bytes
    fetch: the bytes of another file, by its path; at most so many are accepted
    """

    path: str
    stream: BinaryIO
    size: int
    fetch: Callable[[str, int], bytes]


@dataclass(slots=True)
class MeshPart:
    """Triangles with vertices of their own, as the file has them; polygons become fans around their first corner.

    positions: x, y, z of each vertex in turn, "f" or "d"; in metres once they are transformed
    triangles: three indices into the vertices each, "q", unchecked
    uv: u, v of each texture coordinate in turn, "f" or "d"; None unless all corners have one
    uv_triangles: three indices into the texture coordinates each, "q", unchecked; None if they are the vertices' own
    v_up: whether v counts from the image's last row, as it does but for glTF
    transform: to world coordinates, 4x4, rows first; None if they are in them
    materials: the first triangle and the material's name of each run of triangles of one material
    """

    positions: array[float] = field(default_factory=lambda: array("f"))
    triangles: array[int] = field(default_factory=lambda: array("q"))
    uv: array[float] | None = None
    uv_triangles: array[int] | None = None
    v_up: bool = True
    transform: Any = None
    materials: list[tuple[int, str]] = field(default_factory=list)


def broken(path: str, message: str, remedy: str = "write the mesh again with a common tool", code: str = "") -> Finding:
    """The finding for a mesh that cannot be used."""
    return Finding("error", code or "bad_mesh", path, message, remedy)


def check_counts(path: str, vertices: int, faces: int) -> None:
    """Refuse counts beyond what is read at all. Raises MeshError."""
    if vertices > MAX_ELEMENTS or faces > MAX_ELEMENTS:
        message = f"claims {vertices} vertices and {faces} faces; at most {MAX_ELEMENTS} of each are accepted"
        raise MeshError(broken(path, message, "decimate the mesh", "mesh_too_large"))


def check_size(path: str, size: int) -> None:
    """Refuse more bytes than are read at all. Raises MeshError."""
    if size > MAX_BYTES:
        message = f"is {size} bytes long; at most {MAX_BYTES} are accepted"
        raise MeshError(broken(path, message, "decimate the mesh", "mesh_too_large"))


def add_fans(triangles: array[int], corners: Sequence[int], sides: int | Sequence[int]) -> None:
    """Append polygons, split into fans around their first corners; those of fewer than three corners are left out.

    corners: of all polygons, one after the other; sides: how many each of them has, one number if all have as many
    """
    if not isinstance(sides, int):
        named, fans, first = list(corners), list[int](), 0
        for count in sides:
            if count == 3:
                fans += named[first : first + 3]
            for k in range(first + 1, first + count - 1 if count > 3 else 0):
                fans += (named[first], named[k], named[k + 1])
            first += count
        triangles.extend(fans)
    elif sides == 3:
        triangles.extend(corners)
    elif sides > 3:
        every, step = array("q", corners), 3 * (sides - 2)
        fan = array("q", bytes(8 * step * (len(every) // sides)))
        for k in range(sides - 2):
            fan[3 * k :: step] = every[0::sides]
            fan[3 * k + 1 :: step] = every[k + 1 :: sides]
            fan[3 * k + 2 :: step] = every[k + 2 :: sides]
        triangles.extend(fan)

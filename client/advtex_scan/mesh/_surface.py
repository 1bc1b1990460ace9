"""What reading a mesh gives, and the checks that do not depend on the file's kind."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from advtex_scan.errors import Finding, MeshError
from advtex_scan.mesh._arithmetic import Arithmetic, Vector
from advtex_scan.mesh._part import MeshPart, broken, check_counts


@dataclass(frozen=True, slots=True)
class MeshFacts:
    """Counts of a mesh and its bounding box in metres; polygons are counted as the triangles they split into."""

    path: str
    vertices: int
    faces: int
    has_uv: bool
    bounds: tuple[Vector, Vector]

    def describe(self) -> str:
        """One line for people."""
        sides = " x ".join(f"{high - low:.2f}" for low, high in zip(*self.bounds, strict=True))
        uv = "with UVs" if self.has_uv else "without UVs"
        return f"{self.path}: {self.vertices} vertices, {self.faces} triangles, {uv}, {sides} m"


@dataclass(frozen=True, slots=True)
class MeshSurface:
    """A checked mesh in world coordinates.

    positions: x, y, z of each vertex in turn, metres (float32, format "f")
    triangles: three vertex indices each (int64, format "q")
    parts: what the file holds, uv and materials too; uv of some parts alone are to be passed over (`facts.has_uv`)
    files: other files of the scan that it refers to
    """

    positions: memoryview
    triangles: memoryview
    facts: MeshFacts
    parts: tuple[MeshPart, ...]
    files: tuple[str, ...] = ()

    def corner(self, index: int) -> Vector:
        """Position of the vertex that the `index`-th entry of `triangles` names."""
        at = 3 * self.triangles[index]
        return self.positions[at], self.positions[at + 1], self.positions[at + 2]

    def area(self, triangle: int) -> float:
        """Area of a triangle in square metres."""
        return triangle_area(*(self.corner(3 * triangle + k) for k in range(3)))


def triangle_area(a: Vector, b: Vector, c: Vector) -> float:
    """Half the length of the cross product of two edges."""
    ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    return 0.5 * math.hypot(uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx)


def finish(parts: Sequence[MeshPart], path: str, files: Sequence[str], arithmetic: Arithmetic) -> MeshSurface:
    """Join and check what a file holds. Raises MeshError with everything that is wrong."""
    vertices = sum(len(part.positions) for part in parts) // 3
    faces = sum(len(part.triangles) for part in parts) // 3
    check_counts(path, vertices, faces)
    findings = [finding for part in parts for finding in _out_of_range(part, path, arithmetic)][:1]
    if faces == 0:
        findings.append(broken(path, "has no faces", "give a triangle mesh, not a point cloud", "mesh_no_faces"))
    positions = arithmetic.placed(parts)
    if bad := arithmetic.count_not_finite(positions):
        message = f"{bad} vertex coordinates are NaN or infinite"
        findings.append(broken(path, message, "remove those vertices", "mesh_nan"))
    if findings:
        raise MeshError(*findings)
    has_uv = all(part.uv is not None for part in parts)
    facts = MeshFacts(path, vertices, faces, has_uv, arithmetic.bounds(positions))
    surface = MeshSurface(positions, arithmetic.joined(parts), facts, tuple(parts), tuple(files))
    if not any(surface.area(triangle) > 0 for triangle in range(faces)):
        message = "all faces have zero area"
        raise MeshError(broken(path, message, "check how the mesh was written", "mesh_zero_area"))
    return surface


def _out_of_range(part: MeshPart, path: str, arithmetic: Arithmetic) -> list[Finding]:
    findings = []
    for what, indices, values, width in (
        ("vertex", part.triangles, part.positions, 3),
        ("texture coordinate", part.uv_triangles, part.uv, 2),
    ):
        if indices and values is not None:
            low, high = arithmetic.extremes(indices)
            count = len(values) // width
            if low < 0 or high >= count:
                message = f"a face names {what} {low if low < 0 else high}, but there are {count}, counted from 0"
                findings.append(broken(path, message, code="mesh_index"))
    return findings

"""What all mesh readers return, and the checks that do not depend on the file's kind."""

from __future__ import annotations

import math
from array import array
from dataclasses import dataclass, field

from advtex_scan.errors import Finding, MeshError

MAX_ELEMENTS = 10_000_000  # vertices, and triangles; ScanNet's finest meshes hold about 5 million
Vector = tuple[float, float, float]


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


@dataclass(slots=True)
class RawMesh:
    """positions: x, y, z of each vertex in turn (float32); triangles: three vertex indices each."""

    positions: array[float] = field(default_factory=lambda: array("f"))
    triangles: array[int] = field(default_factory=lambda: array("q"))
    has_uv: bool = False
    files: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class MeshSurface:
    """A checked mesh. `files`: other files of the scan that it refers to."""

    positions: array[float]
    triangles: array[int]
    facts: MeshFacts
    files: tuple[str, ...] = ()

    def corner(self, index: int) -> Vector:
        """Position of the vertex that the `index`-th entry of `triangles` names."""
        at = 3 * self.triangles[index]
        return self.positions[at], self.positions[at + 1], self.positions[at + 2]

    def area(self, triangle: int) -> float:
        """Area of a triangle in square metres."""
        return triangle_area(*(self.corner(3 * triangle + k) for k in range(3)))


def broken(path: str, message: str, remedy: str = "write the mesh again with a common tool", code: str = "") -> Finding:
    """The finding for a mesh that cannot be used."""
    return Finding("error", code or "bad_mesh", path, message, remedy)


def check_counts(path: str, vertices: int, faces: int) -> None:
    """Refuse counts beyond what is read at all."""
    if vertices > MAX_ELEMENTS or faces > MAX_ELEMENTS:
        message = f"claims {vertices} vertices and {faces} faces; at most {MAX_ELEMENTS} of each are accepted"
        raise MeshError(broken(path, message, "decimate the mesh", "mesh_too_large"))


def triangle_area(a: Vector, b: Vector, c: Vector) -> float:
    """Half the length of the cross product of two edges."""
    ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    return 0.5 * math.hypot(uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx)


def finish(raw: RawMesh, path: str) -> MeshSurface:
    """Check a mesh's content; MeshError with everything that is wrong."""
    vertices, faces = len(raw.positions) // 3, len(raw.triangles) // 3
    findings: list[Finding] = []
    if faces == 0:
        findings.append(broken(path, "has no faces", "give a triangle mesh, not a point cloud", "mesh_no_faces"))
    if faces and not (min(raw.triangles) >= 0 and max(raw.triangles) < vertices):
        worst = min(raw.triangles) if min(raw.triangles) < 0 else max(raw.triangles)
        message = f"a face names vertex {worst}, but there are {vertices}, counted from 0"
        findings.append(broken(path, message, code="mesh_index"))
    if not all(map(math.isfinite, raw.positions)):
        bad = sum(not math.isfinite(value) for value in raw.positions)
        message = f"{bad} vertex coordinates are NaN or infinite"
        findings.append(broken(path, message, "remove those vertices", "mesh_nan"))
    if findings:
        raise MeshError(*findings)
    axes = [raw.positions[axis::3] for axis in range(3)]
    low, high = (min(axes[0]), min(axes[1]), min(axes[2])), (max(axes[0]), max(axes[1]), max(axes[2]))
    surface = MeshSurface(
        raw.positions, raw.triangles, MeshFacts(path, vertices, faces, raw.has_uv, (low, high)), raw.files
    )
    if not any(surface.area(triangle) > 0 for triangle in range(faces)):
        message = "all faces have zero area"
        raise MeshError(broken(path, message, "check how the mesh was written", "mesh_zero_area"))
    return surface

"""Wavefront OBJ: `v` and `f` lines; polygons are split into fans, negative indices count from the last vertex."""

from __future__ import annotations

from array import array

from advtex_scan.archive import ScanArchive
from advtex_scan.errors import MeshError
from advtex_scan.mesh._surface import RawMesh, broken, check_counts

MAX_LINE = 1 << 16


def read_obj(archive: ScanArchive, path: str) -> RawMesh:
    """Vertices and fan-split faces of an OBJ file, its groups and objects joined. Raises MeshError."""
    mesh = RawMesh()
    number = 0
    with archive.open(path) as stream:
        while line := stream.readline(MAX_LINE):
            number += 1
            if len(line) == MAX_LINE:
                raise MeshError(broken(path, f"line {number} is longer than {MAX_LINE} bytes"))
            words = line.split()
            if not words or words[0] not in (b"v", b"f"):
                continue
            try:
                if words[0] == b"v":
                    mesh.positions.extend((float(words[1]), float(words[2]), float(words[3])))
                else:
                    _face(words, mesh, mesh.triangles)
            except (ValueError, IndexError, OverflowError) as error:
                shown = line[:60].decode("ascii", "replace").strip()
                raise MeshError(broken(path, f"line {number} is not understood: {shown!r}")) from error
            if number % 1024 == 0:
                check_counts(path, len(mesh.positions) // 3, len(mesh.triangles) // 3)
    return mesh


def _face(words: list[bytes], mesh: RawMesh, triangles: array[int]) -> None:
    vertices = len(mesh.positions) // 3
    corners = []
    for word in words[1:]:
        index = int(word.partition(b"/")[0])
        corners.append(index - 1 if index > 0 else vertices + index if index < 0 else -1)
    if len(corners) < 3:
        raise ValueError("a face with fewer than three corners")
    mesh.has_uv = mesh.has_uv or words[1].partition(b"/")[2].partition(b"/")[0] != b""
    for k in range(1, len(corners) - 1):
        triangles.extend((corners[0], corners[k], corners[k + 1]))

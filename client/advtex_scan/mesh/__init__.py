"""Structural reading of mesh files: counts, indices, bounds; enough to refuse what cannot be textured.

Counts are checked against the file's size before anything is allocated for them.
"""

from __future__ import annotations

from advtex_scan.archive import ScanArchive
from advtex_scan.errors import MeshError
from advtex_scan.mesh._gltf import read_gltf
from advtex_scan.mesh._obj import read_obj
from advtex_scan.mesh._ply import read_ply
from advtex_scan.mesh._surface import MeshFacts, MeshSurface, broken, finish

MAX_BYTES = 2 << 30
READERS = {"ply": read_ply, "obj": read_obj, "glb": read_gltf, "gltf": read_gltf}

__all__ = ["MeshFacts", "MeshSurface", "read_mesh"]


def read_mesh(archive: ScanArchive, path: str) -> MeshSurface:
    """Positions and triangles of a `.ply`, `.obj`, `.glb` or `.gltf`.

    Raises MeshError with every problem: no faces, indices out of range, NaN or infinite vertices, no face with an area,
    counts that disagree with the file's size, unsupported compression.
    """
    suffix = path.lower().rsplit(".", 1)[-1]
    if archive.size(path) > MAX_BYTES:
        message = f"is {archive.size(path)} bytes long; at most {MAX_BYTES} are accepted"
        raise MeshError(broken(path, message, "decimate the mesh", "mesh_too_large"))
    if suffix in READERS:
        return finish(READERS[suffix](archive, path), path)
    raise MeshError(broken(path, "is of no known kind", "convert it to PLY, OBJ or GLB"))

"""Mesh files, read into arrays and checked: enough to refuse what cannot be textured, and all that the engine needs.

Files are hostile or odd: counts are checked against the bytes that are there before anything is allocated for them.
One grammar serves all; who has numpy gives `Arithmetic` that does the same with it, faster.
"""

from __future__ import annotations

from advtex_scan.archive import ScanArchive
from advtex_scan.errors import MeshError
from advtex_scan.mesh._arithmetic import Arithmetic, PlainArithmetic, Vector
from advtex_scan.mesh._gltf import open_gltf, read_gltf
from advtex_scan.mesh._obj import read_obj
from advtex_scan.mesh._part import MAX_BYTES, MAX_ELEMENTS, MeshPart, MeshSource, broken, check_size
from advtex_scan.mesh._ply import read_ply
from advtex_scan.mesh._surface import MeshFacts, MeshSurface, finish
from advtex_scan.mesh._text import BLOCK

__all__ = [
    "MAX_BYTES",
    "MAX_ELEMENTS",
    "PLAIN",
    "Arithmetic",
    "MeshFacts",
    "MeshPart",
    "MeshSource",
    "MeshSurface",
    "PlainArithmetic",
    "Vector",
    "open_gltf",
    "parse_mesh",
    "read_mesh",
]

PLAIN = PlainArithmetic()


def read_mesh(archive: ScanArchive, path: str, arithmetic: Arithmetic = PLAIN) -> MeshSurface:
    """Positions and triangles of a `.ply`, `.obj`, `.glb` or `.gltf` of a scan.

    Raises MeshError with every problem: no faces, indices out of range, NaN or infinite vertices, no face with an area,
    counts that disagree with the file's size, unsupported compression. ArchiveError if the file itself is damaged.
    """

    def fetch(name: str, limit: int) -> bytes:
        if name not in archive:
            message = f"refers to {name[:100]!r}, which is not in the scan"
            raise MeshError(broken(path, message, "add the file, or export a GLB", "missing_file"))
        return archive.read(name, limit)

    size = archive.size(path)
    with archive.open(path) as stream:
        surface = parse_mesh(MeshSource(path, stream, size, fetch), arithmetic)
        while stream.read(BLOCK):
            pass  # a zip's member tells at its end whether it is sound
    return surface


def parse_mesh(source: MeshSource, arithmetic: Arithmetic = PLAIN) -> MeshSurface:
    """`read_mesh` of a file from anywhere."""
    check_size(source.path, source.size)
    files: tuple[str, ...] = ()
    match source.path.lower().rsplit(".", 1)[-1]:
        case "ply":
            parts = [read_ply(source)]
        case "obj":
            parts = [read_obj(source)]
        case "glb" | "gltf":
            parts, files = read_gltf(source, arithmetic)
        case _:
            raise MeshError(broken(source.path, "is of no known kind", "convert it to PLY, OBJ or GLB"))
    return finish(parts, source.path, files, arithmetic)

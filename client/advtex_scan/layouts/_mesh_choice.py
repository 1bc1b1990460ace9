"""Which of several mesh files is the scan's."""

from __future__ import annotations

from advtex_scan.layouts._reader import ScanReader
from advtex_scan.manifest import MeshEntry

MESH_SUFFIXES = (".ply", ".obj", ".glb", ".gltf")


def choose_mesh(reader: ScanReader, documented: tuple[str, ...]) -> MeshEntry | None:
    """The first of the layout's documented names that exists, else the one `mesh.*`, else the only mesh file.

    Several that are equally good are an error that lists them; none is left to the check to report.
    """
    meshes = [name for name in reader.archive.names() if name.lower().endswith(MESH_SUFFIXES)]
    named = [name for name in meshes if name.lower().startswith("mesh.")]
    for candidates in ([name for name in documented if name in meshes][:1], named, meshes):
        if len(candidates) == 1:
            reader.used.add(candidates[0])
            return MeshEntry(candidates[0])
        if candidates:
            message = f"several files could be the mesh: {', '.join(candidates[:5])}"
            reader.mesh_reported = True
            reader.findings.error("ambiguous_mesh", candidates[0], message, "name the right one mesh.ply")
            return None
    return None

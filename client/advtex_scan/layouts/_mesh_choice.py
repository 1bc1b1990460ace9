"""Which of several mesh files is the scan's."""

from __future__ import annotations

import re

from advtex_scan.archive import ScanArchive
from advtex_scan.errors import ScanFormatError
from advtex_scan.layouts._reader import ScanReader
from advtex_scan.manifest import MeshEntry

MESH_SUFFIXES = (".ply", ".obj", ".glb", ".gltf")
PLY_HEAD = 4096
FACES = re.compile(rb"^element face +0*[1-9]", re.MULTILINE)


def choose_mesh(reader: ScanReader, documented: tuple[str, ...]) -> MeshEntry | None:
    """Choose the first of the layout's documented names that exists, else the one `mesh.*`, else the only mesh file.

    Several that are equally good are an error that lists them; none is left to the check to report. A PLY without
    faces is a point cloud and no mesh.
    """
    found = [name for name in reader.archive.names() if name.lower().endswith(MESH_SUFFIXES)]
    meshes = [name for name in found if not _only_points(reader.archive, name)]
    for name in sorted(set(found) - set(meshes)):
        reader.used.add(name)
        reader.findings.info("point_cloud", name, "holds points without faces; it is not the mesh")
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


def _only_points(archive: ScanArchive, name: str) -> bool:
    """Tell whether a file starts with a whole PLY header without faces; broken ones are left to the mesh's reader."""
    if not name.lower().endswith(".ply"):
        return False
    try:
        head = archive.head(name, PLY_HEAD)
    except ScanFormatError:
        return False
    header, end, _ = head.partition(b"end_header")
    return bool(end) and header.startswith(b"ply") and not FACES.search(header)

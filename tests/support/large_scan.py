"""A valid scan whose mesh takes seconds to check."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from tiny_scan import write_scan, write_zip


def grid(faces: int) -> Iterator[str]:
    """Lines of an OBJ file: a square before the cameras, cut into at least so many triangles."""
    side = 1
    while 2 * side * side < faces:
        side += 1
    for y in range(side + 1):
        for x in range(side + 1):
            yield f"v {x / side - 0.5:.6f} {y / side - 0.5:.6f} 2\n"
    for y in range(side):
        for x in range(side):
            a = y * (side + 1) + x + 1
            b = a + side + 1
            yield f"f {a} {b} {a + 1}\nf {a + 1} {b} {b + 1}\n"


def write_large_zip(path: Path, faces: int = 1_000_000) -> Path:
    """-> the zip"""
    folder = write_scan(path.with_suffix(""))
    (folder / "mesh.ply").unlink()
    with (folder / "mesh.obj").open("w") as file:
        file.writelines(grid(faces))
    scan = folder / "scan.json"
    scan.write_text(scan.read_text().replace("mesh.ply", "mesh.obj"))
    return write_zip(path, folder)

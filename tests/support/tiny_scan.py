"""A valid scan made with the standard library alone: three views of a square, 96x72 pixels, in the native layout."""

from __future__ import annotations

import json
import struct
import zipfile
import zlib
from pathlib import Path

WIDTH, HEIGHT, FOCAL = 96, 72, 90.0
PLY = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
element face 2
property list uchar int vertex_indices
end_header
-0.5 -0.5 2
0.5 -0.5 2
0.5 0.5 2
-0.5 0.5 2
3 0 2 1
3 0 3 2
"""


def png(width: int, height: int, shade: int) -> bytes:
    """An 8-bit RGB image with a gradient."""
    colors = ((x, y, c) for y in range(height) for x in range(width) for c in range(3))
    pixels = bytes((2 * x + shade + c * y) % 256 for x, y, c in colors)
    rows = b"".join(b"\0" + pixels[3 * width * y : 3 * width * (y + 1)] for y in range(height))

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def write_scan(folder: Path, frames: int = 3) -> Path:
    """The scan as a folder. -> that folder."""
    (folder / "color").mkdir(parents=True)
    entries = []
    for i in range(frames):
        (folder / "color" / f"{i}.png").write_bytes(png(WIDTH, HEIGHT, 40 * i))
        pose = [[1, 0, 0, 0.1 * (i - 1)], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
        entries.append({"color": f"color/{i}.png", "camera_to_world": pose})
    intrinsics = {"fx": FOCAL, "fy": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2, "width": WIDTH, "height": HEIGHT}
    scan = {"version": 1, "kind": "object", "color_intrinsics": intrinsics, "mesh": "mesh.ply", "frames": entries}
    (folder / "scan.json").write_text(json.dumps(scan))
    (folder / "mesh.ply").write_text(PLY)
    return folder


def write_zip(path: Path, folder: Path) -> Path:
    """The folder's files as a zip. -> the zip."""
    with zipfile.ZipFile(path, "w") as archive:
        for file in sorted(folder.rglob("*")):
            if file.is_file():
                archive.write(file, file.relative_to(folder).as_posix())
    return path

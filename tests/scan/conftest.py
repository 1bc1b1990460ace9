"""Scans made by the tests: a camera that circles a box, in the native layout, as a folder or a zip."""

from __future__ import annotations

import json
import math
import os
import struct
import sys
import zipfile
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

WIDTH, HEIGHT = 32, 24
INTRINSICS = {"fx": 30.0, "fy": 30.0, "cx": 16.0, "cy": 12.0, "width": WIDTH, "height": HEIGHT}
CORNERS = [(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
TRIANGLES = [(q[0], q[k], q[k + 1]) for q in QUADS for k in (1, 2)]


def png(width: int = WIDTH, height: int = HEIGHT, bits: int = 8, color_type: int = 2) -> bytes:
    """A whole PNG, black."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    samples = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}[color_type]
    row = b"\0" + bytes(width * samples * bits // 8)
    header = struct.pack(">IIBBBBB", width, height, bits, color_type, 0, 0, 0)
    rows = row * min(height, 100)  # enough for what reads headers only
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def depth_png(width: int = WIDTH, height: int = HEIGHT) -> bytes:
    """A 16-bit gray PNG without a reading."""
    return png(width, height, 16, 0)


def jpeg(width: int = WIDTH, height: int = HEIGHT, before: bytes = b"") -> bytes:
    """The segments of a JPEG with an empty scan; `before` is the payload of application segments ahead of the size."""
    segments = b"\xff\xd8\xff\xe0" + struct.pack(">H", 16) + b"JFIF\0" + bytes(9)
    for start in range(0, len(before), 65533):
        piece = before[start : start + 65533]
        segments += b"\xff\xe2" + struct.pack(">H", len(piece) + 2) + piece
    frame = struct.pack(">BHHB", 8, height, width, 3) + bytes([1, 0x22, 0, 2, 0x11, 1, 3, 0x11, 1])
    return segments + b"\xff\xc0" + struct.pack(">H", len(frame) + 2) + frame + b"\xff\xda\xff\xd9"


def ply(vertices: Any = CORNERS, faces: Any = TRIANGLES, order: str = "<", index: str = "int") -> bytes:
    """A PLY file; `order` is "<", ">" or "" for ascii."""
    name = {"<": "binary_little_endian", ">": "binary_big_endian", "": "ascii"}[order]
    head = (
        f"ply\nformat {name} 1.0\ncomment made by a test\nelement vertex {len(vertices)}\nproperty float x\n"
        f"property float y\nproperty float z\nelement face {len(faces)}\nproperty list uchar {index} vertex_indices\n"
        "end_header\n"
    ).encode()
    if order == "":
        lines = [" ".join(map(str, v)) for v in vertices] + [" ".join(map(str, (len(f), *f))) for f in faces]
        return head + "\n".join(lines).encode() + b"\n"
    body = b"".join(struct.pack(f"{order}3f", *v) for v in vertices)
    code = {"int": "i", "uint": "I", "ushort": "H", "uchar": "B"}[index]
    return head + body + b"".join(struct.pack(f"{order}B{len(f)}{code}", len(f), *f) for f in faces)


def look_at(angle: float, distance: float = 2.0) -> list[list[float]]:
    """Camera-to-world of a camera on a circle in the xy plane that looks at the origin, z up, OpenCV axes."""
    forward = (-math.cos(angle), -math.sin(angle), 0.0)
    right = (-math.sin(angle), math.cos(angle), 0.0)
    down = (0.0, 0.0, -1.0)
    place = (-distance * forward[0], -distance * forward[1], 0.0)
    rows = [[right[i], down[i], forward[i], place[i]] for i in range(3)]
    return [*rows, [0.0, 0.0, 0.0, 1.0]]


@dataclass
class ScanMaker:
    """Files and the parts of `scan.json`; change either, then write a folder or a zip."""

    root: Path
    files: dict[str, bytes] = field(default_factory=dict)
    scan: dict[str, Any] | None = None

    def native(self, count: int = 5) -> ScanMaker:
        self.files = {"mesh.ply": ply()}
        frames = []
        for i in range(count):
            self.files[f"color/{i}.png"] = png()
            self.files[f"depth/{i}.png"] = depth_png()
            pose = look_at(2 * math.pi * i / count)
            frames.append({"color": f"color/{i}.png", "depth": f"depth/{i}.png", "camera_to_world": pose})
        self.scan = {
            "version": 1,
            "kind": "object",
            "up_axis": "+z",
            "color_intrinsics": dict(INTRINSICS),
            "depth_intrinsics": dict(INTRINSICS),
            "mesh": "mesh.ply",
            "frames": frames,
        }
        return self

    def all_files(self) -> dict[str, bytes]:
        described = {} if self.scan is None else {"scan.json": json.dumps(self.scan).encode()}
        return {**described, **self.files}

    def folder(self, name: str = "scan") -> Path:
        for path, data in self.all_files().items():
            target = self.root / name / path
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(data)
        return self.root / name

    def zip(self, name: str = "scan.zip", prefix: str = "", method: int = zipfile.ZIP_DEFLATED) -> Path:
        with zipfile.ZipFile(self.root / name, "w", method) as archive:
            for path, data in self.all_files().items():
                archive.writestr(prefix + path, data)
        return self.root / name


class Bytes:
    """The makers above, for tests (which cannot import this file)."""

    png, depth_png, jpeg, ply, look_at = (staticmethod(maker) for maker in (png, depth_png, jpeg, ply, look_at))
    corners, triangles, quads, intrinsics = CORNERS, TRIANGLES, QUADS, INTRINSICS


@pytest.fixture
def maker(tmp_path: Path) -> ScanMaker:
    return ScanMaker(tmp_path)


@pytest.fixture(scope="session")
def make() -> type[Bytes]:
    return Bytes


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of sample scans."""
    beside = Path(__file__).parents[2].parent / "shared" / "data"
    root = Path(os.environ.get("ADVTEX_DATA", beside))
    if not (root / "scans").is_dir():
        pytest.skip("the sample scans are not there; point ADVTEX_DATA at them")
    return root

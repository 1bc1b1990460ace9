"""What a scan of thousands of frames costs before it is textured: decoding and the choice of views.

    python tests/benchmarks/long_scan.py [--frames N] [--max-views N] [--folder PATH]

Makes a stream as ScanNet has it (.sens; 1296x968 JPEG, 640x480 depth, a mesh) of a room, unless the folder holds one
from before. A few places are rendered, and each stands for many frames, whose poses differ by a centimetre; every tenth
frame is blurred. A process of its own then goes as far as the scene with the chosen views. Its peak is that of its
resident memory, libraries included.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import struct
import tempfile
import time
import zlib
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import trimesh
from harness import markdown_table

from advtex_engine.core.config import TextureConfig
from advtex_engine.core.monitor import Monitor
from advtex_engine.ingest.frames import FrameStore
from advtex_engine.ingest.read import read_capture
from advtex_engine.mesh.clean import clean, decimate
from advtex_engine.synthetic.patches import look_at

COLOR, DEPTH = (1296, 968), (640, 480)
FOCAL = 1170.0  # of the color camera; both see the same
ROOM = np.array([5.0, 4.0, 2.6])
PLACES = 60
GRAIN = 60  # random colors per metre
HEADER = ["frames", "decoding s", "choice s", "scene s", "views", "blurred", "peak MB"]

Floats = npt.NDArray[np.float64]


def make_scan(folder: Path, frames: int) -> None:
    """room.sens and room_vh_clean_2.ply."""
    mesh = trimesh.creation.box(ROOM)
    for _ in range(5):
        mesh = mesh.subdivide()
    mesh.invert()
    mesh.export(folder / "room_vh_clean_2.ply")
    places = [_place(number) for number in range(PLACES)]
    random = np.random.default_rng(0)
    with (folder / "room.sens").open("wb") as file:
        file.write(struct.pack("<IQ", 4, 4) + b"room")
        for width, height in (COLOR, DEPTH):
            file.write(_K(width, height).astype("<f4").tobytes() + np.eye(4, dtype="<f4").tobytes())
        file.write(struct.pack("<2i4IfQ", 2, 1, *COLOR, *DEPTH, 1000.0, frames))
        for frame in range(frames):
            camera_to_world, sharp, blurred, depth = places[frame * PLACES // frames]
            moved = camera_to_world.copy()
            moved[:3, 3] += random.uniform(-0.01, 0.01, 3)
            color = blurred if frame % 10 == 0 else sharp
            file.write(moved.astype("<f4").tobytes())
            file.write(struct.pack("<4Q", frame, frame, len(color), len(depth)) + color + depth)


def _K(width: int, height: int) -> Floats:
    """4x4, the first pixel's centre at (0, 0)."""
    K = np.eye(4)
    K[0, 0], K[1, 1] = FOCAL * width / COLOR[0], FOCAL * height / COLOR[1]
    K[0, 2], K[1, 2] = (width - 1) / 2, (height - 1) / 2
    return K


def _place(number: int) -> tuple[Floats, bytes, bytes, bytes]:
    """A pose that looks at a wall, and what is seen: color, color of a moved camera, depth, as they are stored."""
    angle = 2 * np.pi * number / PLACES
    eye = np.array([1.2 * np.cos(angle), 0.9 * np.sin(angle), 0.2 * np.sin(5 * angle)])
    towards = np.array([np.cos(angle), np.sin(angle), 0.5 * np.sin(7 * angle)])
    camera_to_world = np.linalg.inv(look_at(eye, eye + towards))
    points, _ = _seen(camera_to_world, COLOR[0] // 2, COLOR[1] // 2)
    table = np.random.default_rng(1).integers(40, 200, (128, 128, 128, 3)).astype(np.uint8)
    x, y, z = ((points * GRAIN).astype(np.int64) % 128).transpose(2, 0, 1)
    image = cv2.resize(table[x, y, z], COLOR, interpolation=cv2.INTER_CUBIC)
    _, depth = _seen(camera_to_world, *DEPTH)
    sharp, blurred = (cv2.imencode(".jpg", shown)[1].tobytes() for shown in (image, cv2.blur(image, (31, 3))))
    return camera_to_world, sharp, blurred, zlib.compress((depth * 1000).round().astype("<u2").tobytes(), 1)


def _seen(camera_to_world: Floats, width: int, height: int) -> tuple[Floats, Floats]:
    """The walls' points [H,W,3] that a camera inside the room sees, and their depth [H,W]."""
    K = _K(width, height)
    x, y = np.meshgrid((np.arange(width) - K[0, 2]) / K[0, 0], (np.arange(height) - K[1, 2]) / K[1, 1])
    rays = np.stack((x, y, np.ones_like(x)), 2) @ camera_to_world[:3, :3].T
    eye = camera_to_world[:3, 3]
    depth = ((np.sign(rays) * ROOM / 2 - eye) / np.where(rays == 0, 1e-9, rays)).min(2)
    return eye + rays * depth[..., None], depth


def measure(folder: Path, max_views: int) -> list[str]:
    """One row of the table."""
    config, monitor = TextureConfig(max_views=max_views), Monitor()
    started = time.monotonic()
    with FrameStore(folder) as store:
        capture = read_capture(folder, config, store, monitor)
        decoded = time.monotonic()
        assert capture.mesh is not None
        mesh = decimate(clean(capture.mesh), config.face_budget, monitor)
        capture, report = capture.choose(mesh, config.max_views, monitor)
        chosen = time.monotonic()
        scene = capture.scene(mesh, monitor)
    finished = time.monotonic()
    assert report is not None, "the scan is within the budget: give more frames"
    seconds = (decoded - started, chosen - decoded, finished - chosen)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6
    left_out = report["left_out"]
    return [
        str(report["frames"]),
        *(f"{value:.1f}" for value in seconds),
        str(len(scene.views)),
        str(len(left_out.get("blurred", ()))),
        f"{peak:.0f}",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=2_500)
    parser.add_argument("--max-views", type=int, default=TextureConfig.max_views)
    parser.add_argument("--folder", type=Path, help="where the scan lies or is to lie; room for 5 MB per frame more")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        if not (folder / "room.sens").exists():
            make_scan(folder, arguments.frames)
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
            print(markdown_table(HEADER, [pool.submit(measure, folder, arguments.max_views).result()]))


if __name__ == "__main__":
    main()

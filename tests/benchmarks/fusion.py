"""Meshes fused from depth against meshes that are known, and what the fusion costs.

    python tests/benchmarks/fusion.py [--scan PATH] [--frames N] [--surfaces NAME ...]

Three surfaces, on one thread: a scan with a mesh and depth (by default the sample scan apt0_kitchen), fused from its
own depth images; a synthesized scan without camera errors; a room of 20 square metres that is seen from everywhere.
The distances are from 2,000 points spread over one surface to the other: `to given` says whether what was fused is
true, over points within the given mesh's box; `to fused` whether all that is given was found. Seconds are the
processor's, of the whole fusion per frame; memory is the process's peak, libraries and frames included.
"""

from __future__ import annotations

import argparse
import gc
import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from harness import markdown_table
from torch import Tensor

from advtex_engine.core.config import TextureConfig
from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import Camera, DepthFrame, Mesh
from advtex_engine.ingest.read import ingest
from advtex_engine.mesh.fusion import fuse
from advtex_engine.mesh.models import load_model
from advtex_engine.render.rasterize import rasterize
from advtex_engine.runtime.stage_records import peak_memory_bytes, reset_peak_memory
from advtex_engine.synthetic.patches import look_at
from advtex_engine.synthetic.scan import synthesize

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
from surfaces import distances, spread_points

CPU = torch.device("cpu")
DATA = Path(os.environ.get("ADVTEX_DATA", Path(__file__).parents[3] / "shared" / "data"))
POINTS = 2_000
SURFACES = ("scan-640x480", "scan-320x240", "object", "room")
ROOM = (5.0, 4.0, 2.6)
HEADER = ["surface", "frames", "voxel mm", "blocks", "faces", "to given mm", "to fused mm", "CPU s/frame", "peak MB"]


def of_scan(path: Path, size: tuple[int, int] | None) -> tuple[list[DepthFrame], Mesh]:
    """The depth frames of a scan, and its mesh."""
    scene = ingest(path, TextureConfig(size=size), Monitor())
    return [DepthFrame(view.camera, view.depth) for view in scene.views if view.depth is not None], scene.mesh


def of_object(folder: Path) -> tuple[list[DepthFrame], Mesh]:
    """A synthesized scan without camera errors, and the true object."""
    synthesize(folder, views=60, camera_error=0.0, geometry_error=0.0)
    frames, _ = of_scan(folder, None)
    atlas, _ = load_model(folder / "truth" / "object.obj")
    return frames, atlas.mesh


def of_room(count: int) -> tuple[list[DepthFrame], Mesh]:
    """A room with boxes in it, seen from cameras that walk around and look everywhere."""
    room = _box((0, 0, ROOM[2] / 2), ROOM, 24)
    furniture = [_box((-1.5, -1, 0.4), (1.2, 0.8, 0.8), 6), _box((1.6, 1.2, 0.9), (0.6, 1.0, 1.8), 6)]
    mesh = _together([room, *furniture])
    K = torch.tensor([[525.0, 0, 320], [0, 525, 240], [0, 0, 1]], dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    frames = []
    for index in range(count):
        angle = 2 * np.pi * index / count
        eye = np.array([1.0 * np.cos(angle), 0.8 * np.sin(angle), 1.4])
        towards = np.array([np.cos(7 * angle), np.sin(7 * angle), 0.9 * np.sin(11 * angle)])
        camera = Camera(K, torch.from_numpy(look_at(eye, eye + towards)), 640, 480)
        depth = rasterize(mesh, camera).depth
        noise = 0.0012 + 0.0019 * (depth - 0.4).clamp(min=0).square()  # Nguyen et al. 2012, axial noise of Kinect
        frames.append(DepthFrame(camera, depth + (depth > 0) * noise * torch.randn(depth.shape, generator=generator)))
    return frames, mesh


def _box(center: tuple[float, float, float], size: tuple[float, float, float], cells: int) -> Mesh:
    """A box whose sides are grids of cells x cells squares; seen from inside as from outside."""
    line = torch.linspace(-0.5, 0.5, cells + 1)
    s, t = torch.meshgrid(line, line, indexing="ij")
    first = (torch.arange(cells)[:, None] * (cells + 1) + torch.arange(cells)).view(-1, 1)
    faces = torch.cat((first + torch.tensor([[0, cells + 1, cells + 2]]), first + torch.tensor([[0, cells + 2, 1]])))
    sides = []
    for axis in range(3):
        for end in (-0.5, 0.5):
            columns = [s, t]
            columns.insert(axis, torch.full_like(s, end))
            sides.append(Mesh(torch.stack(columns, -1).view(-1, 3) * torch.tensor(size) + torch.tensor(center), faces))
    return _together(sides)


def _together(meshes: list[Mesh]) -> Mesh:
    starts = np.cumsum([0, *(len(mesh.v_pos) for mesh in meshes[:-1])])
    faces = [mesh.t_pos_idx + int(start) for mesh, start in zip(meshes, starts, strict=True)]
    return Mesh(torch.cat([mesh.v_pos for mesh in meshes]), torch.cat(faces))


def row(name: str, frames: list[DepthFrame], given: Mesh) -> list[str | float | int]:
    """Fuses the frames and compares the result with the given mesh."""
    gc.collect()
    reset_peak_memory(CPU)
    started = time.process_time()
    fused, report = fuse(frames, CPU, Monitor())
    seconds = round((time.process_time() - started) / len(frames), 3)
    peak = peak_memory_bytes() >> 20
    found = [_described(off) for off in apart(fused, given, POINTS)]
    cells = [name, len(frames), report["voxel_size_mm"], report["blocks"], report["faces"], *found]
    return [*cells, seconds, peak]


def apart(fused: Mesh, given: Mesh, points: int) -> tuple[Tensor, Tensor]:
    """Metres from points on the fused mesh to the given one, within its box, and from points on that to the fused."""
    spread = spread_points(fused, points)
    low, high = given.v_pos.amin(0) - 0.02, given.v_pos.amax(0) + 0.02
    inside = ((spread > low) & (spread < high)).all(1)
    return distances(spread[inside], given), distances(spread_points(given, points), fused)


def _described(off: Tensor) -> str:
    median, most = (1000 * float(off.quantile(share)) for share in (0.5, 0.9))
    return f"{median:.1f} (90 %: {most:.1f})"


def thinned(frames: list[DepthFrame], count: int) -> list[DepthFrame]:
    return frames[:: max(1, len(frames) // count)] if count else frames


def surface(name: str, arguments: argparse.Namespace) -> tuple[list[DepthFrame], Mesh]:
    """The frames and the known mesh of one of SURFACES."""
    if name == "room":
        return of_room(arguments.frames or 100)
    if name == "object":
        with tempfile.TemporaryDirectory() as folder:
            return of_object(Path(folder) / "scan")
    width, height = name.removeprefix("scan-").split("x")
    return of_scan(arguments.scan, (int(width), int(height)))


def main(line: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scan", type=Path, default=DATA / "scans" / "apt0_kitchen")
    parser.add_argument("--frames", type=int, default=0, help="about how many of each to use; all without it")
    parser.add_argument("--surfaces", nargs="+", default=SURFACES, choices=SURFACES)
    arguments = parser.parse_args(line)
    torch.set_num_threads(1)
    rows = []
    for name in arguments.surfaces:
        frames, given = surface(name, arguments)
        rows.append(row(name, thinned(frames, arguments.frames), given))
    print(markdown_table(HEADER, rows))


if __name__ == "__main__":
    main()

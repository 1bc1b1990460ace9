"""How long the atlas of a large mesh takes, and in how much memory.

    python tests/benchmarks/atlas.py [--faces N ...] [--mesh PATH]

Two surfaces of about N faces each: a bumpy sheet of 8 x 8 metres, as rough as a scan, with boxes on it; and a given
mesh (by default that of the sample scan apt0_kitchen), its faces cut into four until there are enough and its vertices
moved by a millimetre. Seconds are of the whole atlas: by the clock, and of all processors together, which tells
on a busy machine what an idle one would take. Memory is the largest of this process and of any child.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import resource
import threading
import time
from pathlib import Path

import numpy as np
import psutil
import torch
from harness import markdown_table

from advtex_engine.atlas.build import build_atlas
from advtex_engine.core.config import TextureConfig
from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import Camera, Mesh
from advtex_engine.mesh.clean import clean
from advtex_engine.mesh.models import load_reference
from advtex_engine.runtime.stage_records import peak_memory_bytes
from advtex_engine.synthetic.patches import look_at

DATA = Path(os.environ.get("ADVTEX_DATA", Path(__file__).parents[3] / "shared" / "data"))
SIDE = 8192
HEADER = ["surface", "faces", "charts", "seconds", "processor s", "side", "MB", "child MB"]


def sheet_with_boxes(faces: int) -> Mesh:
    """A height field that is as rough as a fused scan; its boxes are steps with steep sides."""
    side = int((faces / 2) ** 0.5)
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(np.linspace(0, 8, side + 1), np.linspace(0, 8, side + 1))
    z = 0.3 * np.sin(3 * x) * np.cos(2 * y) + 0.15 * (8 / side) * rng.standard_normal(x.shape)
    for _ in range(60):
        east, south, width, height = *rng.uniform(0, 7, 2), *rng.uniform(0.2, 1, 2)
        z[(x > east) & (x < east + width) & (y > south) & (y < south + width)] += height
    position = np.stack([x, y, z], axis=2).reshape(-1, 3)
    first = np.arange(side * (side + 1)).reshape(side, side + 1)[:, :-1].reshape(-1)
    lower, upper = [first, first + 1, first + side + 2], [first, first + side + 2, first + side + 1]
    corners = np.concatenate([np.stack(lower, 1), np.stack(upper, 1)])
    return Mesh(torch.from_numpy(position).float(), torch.from_numpy(corners))


def refined(mesh: Mesh, faces: int) -> Mesh:
    """The mesh with each face cut into four until it has at least half of `faces`, and a millimetre of noise."""
    while len(mesh.t_pos_idx) * 2 < faces:
        t = mesh.t_pos_idx
        edges, index = torch.unique(
            torch.cat([t[:, [0, 1]], t[:, [1, 2]], t[:, [2, 0]]]).sort(dim=1).values, dim=0, return_inverse=True
        )
        ab, bc, ca = (index + len(mesh.v_pos)).view(3, -1)
        a, b, c = t.unbind(1)
        four = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        mesh = Mesh(
            torch.cat([mesh.v_pos, mesh.v_pos[edges].mean(dim=1)]), torch.cat([torch.stack(face, 1) for face in four])
        )
    noise = 0.001 * torch.randn(mesh.v_pos.shape, generator=torch.Generator().manual_seed(0))
    return Mesh(mesh.v_pos + noise, mesh.t_pos_idx)


def cameras_about(mesh: Mesh, count: int = 24) -> list[Camera]:
    """Cameras on a circle above the mesh that look at its middle."""
    low, high = mesh.v_pos.double().amin(dim=0).numpy(), mesh.v_pos.double().amax(dim=0).numpy()
    middle, reach = (low + high) / 2, float(np.linalg.norm(high - low))
    K = torch.tensor([[1000.0, 0, 640], [0, 1000, 480], [0, 0, 1]], dtype=torch.float64)
    cameras = []
    for angle in np.arange(count) * 2 * np.pi / count:
        eye = middle + reach * np.array([0.3 * np.cos(angle), 0.3 * np.sin(angle), 0.5])
        cameras.append(Camera(K, torch.from_numpy(look_at(eye, middle)), 1280, 960))
    return cameras


def processor_seconds() -> float:
    usage = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in usage)


class ChildrenWatch(threading.Thread):
    """The largest resident set of any child meanwhile; the kernel's own figure counts the parent's before exec."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.peak, self._over = 0, threading.Event()

    def run(self) -> None:
        this = psutil.Process()
        while not self._over.wait(0.1):
            for child in this.children():
                with contextlib.suppress(psutil.Error):
                    self.peak = max(self.peak, child.memory_info().rss)

    def __enter__(self) -> ChildrenWatch:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self.join()


def row(name: str, mesh: Mesh) -> list[str | float | int]:
    cameras = cameras_about(mesh)
    with ChildrenWatch() as children:
        began, used = time.monotonic(), processor_seconds()
        atlas = build_atlas(mesh, cameras, TextureConfig(max_texture_size=SIDE), Monitor())
        seconds = [round(time.monotonic() - began, 1), round(processor_seconds() - used, 1)]
    peaks = [peak >> 20 for peak in (peak_memory_bytes(), children.peak)]
    return [name, len(mesh.t_pos_idx), atlas.charts, *seconds, atlas.width, *peaks]


def main(line: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--faces", type=int, nargs="+", default=[500_000])
    parser.add_argument("--mesh", type=Path, default=DATA / "scans" / "apt0_kitchen" / "mesh.ply")
    arguments = parser.parse_args(line)
    torch.set_num_threads(1)
    rows = []
    for faces in arguments.faces:
        rows.append(row("sheet with boxes", sheet_with_boxes(faces)))
        print(rows[-1], flush=True)
        if arguments.mesh.is_file():
            rows.append(row(arguments.mesh.parent.name, clean(refined(load_reference(arguments.mesh), faces))))
            print(rows[-1], flush=True)
    print(markdown_table(HEADER, rows))


if __name__ == "__main__":
    main()

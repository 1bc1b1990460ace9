"""`rasterize` beside Embree's rays on one 80k-face mesh at 640x480: `python tests/benchmarks/rasterize_vs_embree.py`.

Protocol: one process, default threads, five cameras inside a room. Repetitions alternate, camera by camera: Embree for
the face index alone, Embree for all that `Fragments` holds (face, barycentrics, depth), `rasterize`. Processor time
counts, and of each camera the least, so that what else the machine does is charged to neither. Embree is not charged
for building its tree nor for making its rays; `rasterize` is charged for all that it does. embreex casts on one thread,
and so does `rasterize` on a CPU.

The mesh is that of the sample scan apt0_kitchen, decimated, with cameras of its frames; where that is absent, a room
with bumpy walls.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import fast_simplification
import numpy as np
import torch
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from advtex_engine.core.cameras import camera_center, pixel_centers, unproject
from advtex_engine.core.scene import Camera, Mesh
from advtex_engine.render.rasterize import rasterize

WIDTH, HEIGHT, FACES = 640, 480, 80_000
DATA = Path(os.environ.get("ADVTEX_DATA", Path(__file__).parents[3] / "shared" / "data"))
KITCHEN = DATA / "scans" / "apt0_kitchen"


def camera_from(rotation: torch.Tensor, translation: torch.Tensor) -> Camera:
    world_to_camera = torch.eye(4, dtype=torch.float64)
    world_to_camera[:3, :3], world_to_camera[:3, 3] = rotation, translation
    K = torch.tensor([[583.0, 0, WIDTH / 2], [0, 583.0, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64)
    return Camera(K, world_to_camera, WIDTH, HEIGHT)


def kitchen() -> tuple[Mesh, list[Camera]]:
    scan = trimesh.load_mesh(KITCHEN / "mesh.ply", process=False)
    v_pos, faces = fast_simplification.simplify(np.float32(scan.vertices), scan.faces, target_count=FACES)
    cameras = []
    for frame in (30, 45, 60, 75, 90):
        line = (KITCHEN / f"color_{frame}.cam").read_text().splitlines()[0]
        numbers = torch.tensor([float(x) for x in line.split()], dtype=torch.float64)
        cameras.append(camera_from(numbers[3:].view(3, 3), numbers[:3]))
    return Mesh(torch.tensor(v_pos), torch.tensor(faces, dtype=torch.int64)), cameras


def bumpy_room() -> tuple[Mesh, list[Camera]]:
    """A box with walls of 5 m that are cut into FACES faces and bent by some centimetres, seen from inside."""
    ball = trimesh.creation.icosphere(subdivisions=6)
    v_pos = ball.vertices / np.abs(ball.vertices).max(axis=1, keepdims=True) * 2.5
    v_pos += 0.05 * np.sin(7 * v_pos[:, [1, 2, 0]])
    v_pos, faces = fast_simplification.simplify(np.float32(v_pos), ball.faces, target_count=FACES)
    cameras = []
    for angle in torch.linspace(0.1, 5.0, 5, dtype=torch.float64):
        right = torch.stack([angle.cos(), torch.zeros_like(angle), -angle.sin()])
        forward = torch.stack([angle.sin(), torch.zeros_like(angle), angle.cos()])
        down = torch.tensor([0.0, 1, 0], dtype=torch.float64)
        cameras.append(camera_from(torch.stack([right, down, forward]), torch.tensor([0.3, -0.2, 0.4])))
    return mesh_of(v_pos, faces), cameras


def mesh_of(v_pos: np.ndarray, faces: np.ndarray) -> Mesh:
    return Mesh(torch.tensor(v_pos, dtype=torch.float32), torch.tensor(faces, dtype=torch.int64))


def rays(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    center, pixels = camera_center(camera), pixel_centers(camera).reshape(-1, 2)
    directions = (unproject(camera, pixels, torch.ones(len(pixels))) - center).float().numpy()
    return np.ascontiguousarray(np.broadcast_to(center.float().numpy(), directions.shape)), directions


def milliseconds(work: Callable[[], object]) -> float:
    start = time.process_time()
    work()
    return 1e3 * (time.process_time() - start)


def measure(mesh: Mesh, cameras: list[Camera], repetitions: int) -> dict[str, float]:
    scene = EmbreeScene()
    TriangleMesh(scene, mesh.v_pos[mesh.t_pos_idx].numpy())
    cast = [rays(camera) for camera in cameras]
    same = []
    for camera, ray in zip(cameras, cast, strict=True):  # warms both, and builds Embree's tree
        face_index = torch.from_numpy(scene.run(*ray, query="INTERSECT"))
        same.append(float((rasterize(mesh, camera).face_index.flatten() == face_index).double().mean()))
    times: dict[str, list[float]] = {"face_only_ms": [], "all_ms": [], "rasterize_ms": []}
    for camera, ray in zip(cameras, cast, strict=True):
        rounds = [
            (
                milliseconds(partial(scene.run, *ray, query="INTERSECT")),
                milliseconds(partial(scene.run, *ray, query="INTERSECT", output=1)),
                milliseconds(partial(rasterize, mesh, camera)),
            )
            for _ in range(repetitions)
        ]
        for values, least in zip(times.values(), np.min(rounds, axis=0), strict=True):
            values.append(float(least))
    report = {name: statistics.mean(values) for name, values in times.items()}
    report["ratio_to_face_only"] = report["rasterize_ms"] / report["face_only_ms"]
    report["ratio_to_all"] = report["rasterize_ms"] / report["all_ms"]
    return report | {"faces": len(mesh.t_pos_idx), "same_face": statistics.mean(same)}


def main() -> None:
    parser = argparse.ArgumentParser(description="rasterize beside Embree's rays, in one run")
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--synthetic", action="store_true", help="the bumpy room, even where the sample scan is there")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    real = KITCHEN.is_dir() and not options.synthetic
    report = measure(*(kitchen() if real else bumpy_room()), options.repetitions)
    if options.json:
        print(json.dumps(report))
        return
    name = "apt0_kitchen" if real else "bumpy room"
    print(f"{name}, {report['faces']} faces, {WIDTH}x{HEIGHT}, same face in {report['same_face']:.4%} of the pixels")
    print(f"Embree, face index alone           {report['face_only_ms']:7.1f} ms")
    print(f"Embree, face, barycentrics, depth  {report['all_ms']:7.1f} ms")
    print(f"rasterize                          {report['rasterize_ms']:7.1f} ms")
    print(f"ratio {report['ratio_to_face_only']:.2f} to the first, {report['ratio_to_all']:.2f} to the second")


if __name__ == "__main__":
    main()

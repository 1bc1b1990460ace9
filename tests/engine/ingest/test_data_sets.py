"""Ingest of data sets that store depth in their own way, or none: a wall at z = 2 m in each."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from advtex_engine.core.config import TextureConfig
from advtex_engine.core.errors import Problem
from advtex_engine.core.monitor import Monitor
from advtex_engine.ingest.read import ingest

WIDTH, HEIGHT, FOCAL = 64, 48, 60.0
FRAMES = 4
MATRIX = f"{FOCAL} 0 {WIDTH / 2 - 0.5}\n0 {FOCAL} {HEIGHT / 2 - 0.5}\n0 0 1\n"


class Listener(Monitor):
    def __init__(self) -> None:
        self.warnings: list[Problem] = []

    def warning(self, problem: Problem) -> None:
        self.warnings.append(problem)


def write(path: Path, content: str | np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(content, str):
        path.write_text(content)
    else:
        cv2.imwrite(str(path), content)


def picture(index: int) -> np.ndarray:
    return np.full((HEIGHT, WIDTH, 3), 40 * index, np.uint8)


def depth(units_per_metre: float) -> np.ndarray:
    return np.full((HEIGHT, WIDTH), round(2 * units_per_metre), np.uint16)


def pose(index: int) -> np.ndarray:
    camera_to_world = np.eye(4)
    camera_to_world[0, 3] = 0.01 * index
    return camera_to_world


def tum(folder: Path) -> None:
    times = [f"{100 + index / 10:.6f}" for index in range(FRAMES)]
    for index, time in enumerate(times):
        write(folder / f"rgb/{time}.png", picture(index))
        write(folder / f"depth/{time}.png", depth(5000))
    write(folder / "rgb.txt", "".join(f"{time} rgb/{time}.png\n" for time in times))
    write(folder / "depth.txt", "".join(f"{time} depth/{time}.png\n" for time in times))
    write(folder / "groundtruth.txt", "".join(f"{t} {0.01 * i} 0 0 0 0 0 1\n" for i, t in enumerate(times)))
    write(folder / "camera-intrinsics.txt", MATRIX)


def sun3d(folder: Path) -> None:
    units = depth(1000)
    for index in range(FRAMES):
        write(folder / f"image/{index + 1:07d}-{index * 33000:012d}.png", picture(index))
        write(folder / f"depth/{index + 1:07d}-{index * 33000:012d}.png", (units << 3) | (units >> 13))
    write(folder / "extrinsics/20130512130736.txt", "".join(matrix_text(pose(index)[:3]) for index in range(FRAMES)))
    write(folder / "intrinsics.txt", MATRIX)


def replica(folder: Path) -> None:
    for index in range(FRAMES):
        write(folder / f"results/frame{index:06d}.png", picture(index))
        write(folder / f"results/depth{index:06d}.png", depth(6553.5))
    lines = (" ".join(map(str, pose(index).ravel())) for index in range(FRAMES))
    write(folder / "traj.txt", "\n".join(lines))
    camera = {"w": WIDTH, "h": HEIGHT, "fx": FOCAL, "fy": FOCAL, "cx": WIDTH / 2 - 0.5, "cy": HEIGHT / 2 - 0.5}
    write(folder / "cam_params.json", json.dumps({"camera": {**camera, "scale": 6553.5}}))


def colmap(folder: Path) -> None:
    lines = []
    for index in range(FRAMES):
        write(folder / f"images/{index}.png", picture(index))
        lines += [f"{index + 1} 1 0 0 0 {-0.01 * index} 0 0 1 {index}.png", ""]
    write(folder / "sparse/0/images.txt", "\n".join(lines) + "\n")
    camera = f"1 PINHOLE {WIDTH} {HEIGHT} {FOCAL} {FOCAL} {WIDTH / 2} {HEIGHT / 2}\n"
    write(folder / "sparse/0/cameras.txt", camera)


def matrix_text(matrix: np.ndarray) -> str:
    return "\n".join(" ".join(map(str, row)) for row in matrix) + "\n"


@pytest.mark.parametrize("writer", [tum, sun3d, replica, colmap], ids=lambda writer: writer.__name__)
def test_a_wall_is_where_it_was(tmp_path: Path, writer: Callable[[Path], None]) -> None:
    writer(tmp_path)
    corners = "\n".join(f"v {x} {y} 2" for x, y in ((-4, -4), (4, -4), (4, 4), (-4, 4)))
    (tmp_path / "mesh.obj").write_text(corners + "\nf 1 2 3 4\n")
    listener = Listener()
    scene = ingest(tmp_path, TextureConfig(), listener)
    assert listener.warnings == []
    assert len(scene.views) == FRAMES
    for index, view in enumerate(scene.views):
        assert view.camera.K.tolist() == [[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]]
        np.testing.assert_allclose(torch.linalg.inv(view.camera.world_to_camera), pose(index), atol=1e-9)
        assert view.color.numpy().tolist() == picture(index).tolist()
        if writer is colmap:
            assert view.depth is None
        else:
            assert view.depth is not None
            np.testing.assert_allclose(view.depth, 2, atol=1e-3)

"""A root as ScanNet's: `scans/scene0000_00` and so on, tiny scenes drawn by the engine, each with frames of its own.

Scenes of one number (`scene0003_*`) are scans of the same place, as there. Two of them are broken in ways that no check
before the work can find.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from advtex_engine.core.monitor import Monitor
from advtex_engine.mesh.clean import clean, decimate
from advtex_engine.mesh.read import NUMPY, to_mesh
from advtex_engine.synthetic.files import write_ply
from advtex_engine.synthetic.scan import synthesize
from advtex_scan.mesh import MeshSource, parse_mesh

SCANS_OF_A_PLACE = 25
PHOTOGRAPHS = 64  # of a place; each scan of it has other ones, in a light of its own
FRAMES = 8
WIDTH, HEIGHT = 96, 72
FACES = 3000
LIGHT_SPREAD = 0.12  # of the logarithm of each channel
UNREADABLE, MISPLACED = 4, 9
"""Numbers of the broken scenes: no photograph can be decoded; frames have the poses of others."""


def scene_name(number: int) -> str:
    return f"scene{number // SCANS_OF_A_PLACE:04}_{number % SCANS_OF_A_PLACE:02}"


def write_root(root: Path, scenes: int) -> list[str]:
    """Write `scenes` of them below `root/scans`, but for those that are there already. -> their names"""
    names = [scene_name(number) for number in range(scenes)]
    for first in range(0, scenes, SCANS_OF_A_PLACE):
        if not all((root / "scans" / name).is_dir() for name in names[first : first + SCANS_OF_A_PLACE]):
            _write_place(root, range(first, min(first + SCANS_OF_A_PLACE, scenes)))
    return names


def _write_place(root: Path, numbers: range) -> None:
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "place"
        synthesize(place, views=PHOTOGRAPHS, width=WIDTH, height=HEIGHT, seed=numbers[0])
        told = json.loads((place / "scan.json").read_text())
        source = place / "mesh.ply"
        with source.open("rb") as file:
            mesh = to_mesh(parse_mesh(MeshSource("mesh.ply", file, source.stat().st_size, _nothing), NUMPY))
        mesh = decimate(clean(mesh), FACES, Monitor())
        for number in numbers:
            scene = root / "scans" / scene_name(number)
            _write_scene(scene, place, told, np.random.default_rng(number))
            write_ply(scene / f"{scene.name}_vh_clean_2.ply", mesh)
            if number == UNREADABLE:
                _spoil(scene)
            if number == MISPLACED:
                _misplace(scene)


def _write_scene(scene: Path, place: Path, told: dict[str, Any], rng: np.random.Generator) -> None:
    """Frames from all around, as SensReader exports them."""
    for name in ("color", "depth", "pose", "intrinsic"):
        (scene / name).mkdir(parents=True, exist_ok=True)
    K = np.eye(4)
    camera = told["color_intrinsics"]
    K[0, 0], K[1, 1], K[0, 2], K[1, 2] = camera["fx"], camera["fy"], camera["cx"] - 0.5, camera["cy"] - 0.5
    for name in ("color", "depth"):
        np.savetxt(scene / "intrinsic" / f"intrinsic_{name}.txt", K, fmt="%.6f")
        np.savetxt(scene / "intrinsic" / f"extrinsic_{name}.txt", np.eye(4), fmt="%.6f")
    light = np.exp(rng.normal(0, LIGHT_SPREAD, 3))
    every = PHOTOGRAPHS // FRAMES
    for number in range(FRAMES):
        frame = told["frames"][every * number + rng.integers(every)]
        image = np.clip(cv2.imread(str(place / frame["color"]), cv2.IMREAD_COLOR) * light, 0, 255)
        cv2.imwrite(str(scene / "color" / f"{number}.jpg"), image.astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 95])
        (scene / "depth" / f"{number}.png").write_bytes((place / frame["depth"]).read_bytes())
        np.savetxt(scene / "pose" / f"{number}.txt", np.array(frame["camera_to_world"]), fmt="%.9f")


def _spoil(scene: Path) -> None:
    """PNGs with bytes in their middle that a bad disk has changed: head and end are whole."""
    for path in scene.glob("color/*.jpg"):
        done, data = cv2.imencode(".png", cv2.imread(str(path), cv2.IMREAD_COLOR))
        assert done
        data[len(data) // 3 : len(data) // 2] = 0
        path.with_suffix(".png").write_bytes(data.tobytes())
        path.unlink()


def _misplace(scene: Path) -> None:
    """Each frame with the pose of the one on the other side."""
    poses = [scene / "pose" / f"{number}.txt" for number in range(FRAMES)]
    texts = [path.read_text() for path in poses]
    for number, path in enumerate(poses):
        path.write_text(texts[(number + FRAMES // 2) % FRAMES])


def _nothing(name: str, _limit: int) -> bytes:
    raise FileNotFoundError(name)

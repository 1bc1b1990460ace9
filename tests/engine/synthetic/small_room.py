"""A room of four surfaces, and a camera that moves evenly past a wall: enough for every error."""

from __future__ import annotations

from functools import partial

import numpy as np
import torch

from advtex_engine.core.scene import Atlas, Camera, Mesh
from advtex_engine.synthetic import room
from advtex_engine.synthetic import room_print as prints
from advtex_engine.synthetic.patches import DrawnScene, Sky, assemble
from advtex_engine.synthetic.trajectory import Path

WALL = 2.0
"""Metres from the moving camera to the striped wall."""


def small_room() -> DrawnScene:
    """Two walls, a floor and a box, where the room's path looks."""
    rng = np.random.default_rng(0)
    patches = [
        room._panel((0, 3000, 0), (3600, 0, 0), (0, -3000, 0), prints.floor, rng, 0.05),
        room._panel((0, 3000, 2500), (3600, 0, 0), (0, 0, -2500), prints.tiles, rng, 0.05),
        room._panel((0, 0, 2500), (0, 3000, 0), (0, 0, -2500), prints.tiles, rng, 0.05),
        *room._box(620, 2350, 0, (660, 640, 1750), partial(prints.plain, color=prints.WHITE), rng, 0.05),
    ]
    return assemble(patches, 512, Sky(center=(1.8, 1.5, 1.0), reach=2.6, distance=30.0, size=64, slack=0.1))


def striped_wall(edges: int = 1) -> DrawnScene:
    """A wall at y = WALL, 8 m wide: dark on the left of x = 0 and light on the right, or more stripes."""
    cells = 41
    x, z = np.meshgrid(np.linspace(-4, 4, cells), np.linspace(-3, 3, cells), indexing="ij")
    points = np.stack([x, np.full_like(x, WALL), z], -1).reshape(-1, 3)
    uv = np.stack([(x + 4) / 8, (3 - z) / 6], -1).reshape(-1, 2)
    first = (np.arange(cells - 1)[:, None] * cells + np.arange(cells - 1)).reshape(-1, 1)
    faces = np.concatenate([first + np.array(corners) for corners in ([0, cells, cells + 1], [0, cells + 1, 1])])
    pos, index, coordinates = torch.from_numpy(points).float(), torch.from_numpy(faces), torch.from_numpy(uv).float()
    side = 2048
    columns = (np.arange(side) + 0.5) / side
    light = np.where((columns * 2 * edges).astype(int) % 2 == 1, 0.8, 0.2)
    radiance = torch.from_numpy(np.broadcast_to(light[None, :, None], (side, side, 3)).astype(np.float32).copy())
    infrared = torch.zeros((side // 4, side // 4, 3))
    infrared[..., 0] = 0.5
    return DrawnScene(Atlas(Mesh(pos, index, coordinates, index), side, side, "scan", 1), radiance, infrared)


def passing(speed: float) -> Path:
    """A camera at the origin at second 0 that looks along +y and moves along +x with `speed` in m/s."""
    seconds = np.linspace(-2, 2, 401)
    places = np.stack([speed * seconds, 0 * seconds, 0 * seconds], -1)
    return Path(seconds, places, places + np.array([0.0, 1.0, 0.0]), np.zeros_like(places), 1.0)


def pinhole(width: int = 96, height: int = 72, focal: float = 100.0) -> Camera:
    """A camera whose axis goes through the middle of the picture."""
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float64)
    return Camera(K, torch.eye(4, dtype=torch.float64), width, height)

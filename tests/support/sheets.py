"""A textured sheet of many charts, and a camera above it."""

from __future__ import annotations

import numpy as np
import torch

from advtex_engine.core.scene import Atlas, Camera, Mesh
from advtex_engine.results.baking import TexturedModel

FROM_ABOVE = Camera(
    torch.tensor([[110.0, 0, 64], [0, 110, 64], [0, 0, 1]], dtype=torch.float64),
    torch.tensor([[1.0, 0, 0, -0.5], [0, -1, 0, 0.5], [0, 0, -1, 1.3], [0, 0, 0, 1]], dtype=torch.float64),
    128,
    128,
)


def many_charts(cells: int = 48, side: int = 512) -> TexturedModel:
    """A wavy sheet facing +z in strips, each a chart of its own that lies upside down beside the one before."""
    at = np.linspace(0, 1, cells + 1)
    y, x = np.meshgrid(at, at, indexing="ij")
    index = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.stack((np.stack((a, b, c), -1), np.stack((a, c, d), -1)), 2).reshape(-1, 3)
    points = np.stack((x, y, 0.05 * np.sin(7 * x + 3 * y)), -1).reshape(-1, 3)
    strips = cells // 4
    strip = np.repeat(np.arange(cells) // 4, 2 * cells)[:, None]
    place = strips - 1 - strip  # of the strip in the texture
    across = points[faces, 1] * strips - strip
    v = (place + 0.1 + 0.8 * np.where(strip % 2, across, 1 - across)) / strips
    uv = np.stack((points[faces, 0] * 0.96 + 0.02, v), -1).reshape(-1, 2)
    rows, columns = (np.mgrid[:side, :side] + 0.5) / side
    there = np.floor(rows * strips)
    within = np.clip((rows * strips - there - 0.1) / 0.8, 0, 1)
    number = strips - 1 - there
    height = (number + np.where(number % 2, within, 1 - within)) / strips
    texture = painted((columns - 0.02) / 0.96, height)
    mesh = Mesh(
        torch.from_numpy(points.astype(np.float32)),
        torch.from_numpy(faces),
        torch.from_numpy(uv.astype(np.float32)),
        torch.arange(len(uv)).view(-1, 3),
    )
    return TexturedModel(Atlas(mesh, side, side, "xatlas", strips), torch.from_numpy(texture))


def painted(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Smooth colors [...,3] uint8 of the sheet's points."""
    waves = (np.sin(9 * x + 2 * y), np.sin(8 * y - 3 * x), np.cos(11 * x * y))
    return np.stack([np.rint(127 + 100 * wave).astype(np.uint8) for wave in waves], -1)

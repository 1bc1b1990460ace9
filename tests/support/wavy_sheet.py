"""A hilly sheet painted with waves, and cameras over it: what camera refinement is tried on."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from advtex_engine.core.scene import Camera, Mesh

WIDTH, HEIGHT, FOCAL = 160, 120, 150.0


def sheet(side: float, squares: int, hills: tuple[float, float, float, float]) -> Mesh:
    """side x side metres about the origin in the plane z = 0, uv as it lies. hills: height in metres, radians per metre
    along x and y, and the phase along x."""
    height, along_x, along_y, phase = hills
    line = torch.linspace(-side / 2, side / 2, squares + 1)
    y, x = torch.meshgrid(line, line, indexing="ij")
    z = height * torch.sin(along_x * x + phase) * torch.cos(along_y * y)
    a = (torch.arange(squares)[:, None] * (squares + 1) + torch.arange(squares)).flatten()
    b, c, d = a + 1, a + squares + 2, a + squares + 1
    faces = torch.cat((torch.stack((a, b, c), 1), torch.stack((a, c, d), 1)))
    position = torch.stack((x, y, z), -1).reshape(-1, 3)
    return Mesh(position, faces, (position[:, :2] + side / 2) / side, faces)


def paint(points: Tensor) -> Tensor:
    """Colors [...,3] in [0.1,0.8] of surface points by their x and y: waves of 6 to 60 cm in all directions."""
    generator = torch.Generator().manual_seed(5)
    waves = torch.rand(40, 2, generator=generator) * 2 - 1
    waves = waves / waves.norm(dim=1, keepdim=True) * torch.logspace(1, 2, 40)[:, None]
    phase = 2 * math.pi * torch.rand(3, 40, generator=generator)
    angles = (points[..., :2].float() @ waves.T)[..., None, :] + phase
    return 0.45 + 0.35 * torch.tanh(angles.sin().mean(-1) * 4)


def camera_over(index: int, views: int) -> Camera:
    """One of `views` cameras on a circle 1.6 m above the sheet, looking at places around its middle."""
    turn = 2 * math.pi * index / views
    center = torch.tensor([0.7 * math.cos(turn), 0.7 * math.sin(turn), 1.6], dtype=torch.float64)
    forward = torch.tensor([0.2 * math.sin(3 * turn), 0.2 * math.cos(2 * turn), 0.0], dtype=torch.float64) - center
    forward = forward / forward.norm()
    right = torch.linalg.cross(forward, torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))
    right = right / right.norm()
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.stack((right, torch.linalg.cross(forward, right), forward))
    pose[:3, 3] = -pose[:3, :3] @ center
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64)
    return Camera(K, pose, WIDTH, HEIGHT)

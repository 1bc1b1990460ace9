"""A scan that the bench makes by itself: a bumpy ball of about a metre with a texture of noise, and cameras around it.

Its size is that of the job to which the project's times are promised, an object of 80,000 faces. It comes with texture
coordinates, the six sides of a cube beside each other, so that nothing but torch is needed to texture it.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.core.rows import distinct_rows
from advtex_engine.core.scene import Atlas, Camera, Mesh, Scene, View
from advtex_engine.render.rasterize import rasterize_views
from advtex_engine.render.texture import sample_image

KIND = "object"
RADIUS, BUMPS = 0.5, 0.03  # metres
DISTANCE = 1.5  # of the cameras from the center
STATION = 8  # cameras that stand STEP apart, as the frames of a video do
STEP = 3.0  # degrees
ELEVATIONS = (10.0, 35.0, -15.0)  # degrees, of one station after the other
FILLED = 0.85  # of the image's shorter side
TEXELS = 3.2  # of the texture's side, per pixel of a view's width: 2048 at 640
MARGIN = 0.02  # of a side of the cube in the texture, on each edge


def made_scene(faces: int, views: int, width: int, height: int) -> tuple[Scene, Atlas]:
    """The scene and its atlas, on the CPU. faces: about so many. The same arguments make the same scene."""
    mesh = _ball(max(2, round(math.sqrt(faces / 12))))
    side = max(64, round(width * TEXELS / 64) * 64)
    atlas = Atlas(mesh, side, side, "scan", 6)
    cameras = [_camera(index, views, width, height) for index in range(views)]
    texture = _noise(side // 4)
    made = tuple(_photographs(mesh, cameras, texture))
    return Scene(mesh, made, (), KIND), atlas


def _ball(cuts: int) -> Mesh:
    """A cube of cuts x cuts squares a side, blown up to a ball: 12 cuts² faces, each side a chart of its own."""
    steps = torch.arange(cuts + 1)
    row, column = (grid.flatten() for grid in torch.meshgrid(steps, steps, indexing="ij"))
    lattice, uv = [], []
    for side in range(6):
        axis, far = side // 2, side % 2
        corner = torch.empty((len(row), 3), dtype=torch.int64)
        corner[:, axis] = far * cuts
        corner[:, (axis + 1) % 3], corner[:, (axis + 2) % 3] = (column, row) if far else (row, column)
        lattice.append(corner)
        place = torch.tensor([side % 3, side // 3])
        inner = torch.stack((column, row), 1) / cuts * (1 - 2 * MARGIN) + MARGIN
        uv.append((inner + place) / 3)
    points, vertex = distinct_rows(torch.cat(lattice))
    direction = F.normalize(points.double() / cuts - 0.5, dim=1)
    bumps = 1 + BUMPS * (torch.sin(9 * direction) * torch.sin(7 * direction.roll(1, 1))).sum(1, keepdim=True)
    first = (row * (cuts + 1) + column)[(row < cuts) & (column < cuts)]
    right, below = first + 1, first + cuts + 1
    one_side = torch.cat((torch.stack((first, right, below), 1), torch.stack((right, below + 1, below), 1)))
    t_uv_idx = torch.cat([one_side + side * len(row) for side in range(6)])
    return Mesh((RADIUS * bumps * direction).float(), vertex[t_uv_idx], torch.cat(uv).float(), t_uv_idx)


def _camera(index: int, views: int, width: int, height: int) -> Camera:
    """Looks at the center. Stations are spread all around the ball."""
    stations = -(-views // STATION)
    station, place = divmod(index, STATION)
    azimuth = math.radians(360 * station / stations + STEP * place)
    elevation = math.radians(ELEVATIONS[station % len(ELEVATIONS)])
    level = math.cos(elevation)
    position = DISTANCE * torch.tensor(
        [level * math.cos(azimuth), level * math.sin(azimuth), math.sin(elevation)], dtype=torch.float64
    )
    forward = -position / DISTANCE
    right = F.normalize(torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)), dim=0)
    world_to_camera = torch.eye(4, dtype=torch.float64)
    world_to_camera[:3, :3] = torch.stack((right, torch.linalg.cross(forward, right), forward))
    world_to_camera[:3, 3] = -world_to_camera[:3, :3] @ position
    focal = FILLED * min(width, height) / 2 * math.sqrt(DISTANCE**2 - RADIUS**2) / RADIUS
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float64)
    return Camera(K, world_to_camera, width, height)


def _noise(side: int) -> Tensor:
    """[side,side,3] float32 in [0,1]: blobs of several sizes."""
    generator = torch.Generator().manual_seed(0)
    layers = [
        F.interpolate(torch.rand((1, 3, cells, cells), generator=generator), (side, side), mode="bilinear")
        for cells in (8, side // 16 + 1, side // 4 + 1)
    ]
    return torch.stack(layers).mean(0)[0].permute(1, 2, 0).contiguous()


def _photographs(mesh: Mesh, cameras: list[Camera], texture: Tensor) -> list[View]:
    """What the cameras see of the ball before gray, with the depth that they measure."""
    assert mesh.v_uv is not None and mesh.t_uv_idx is not None
    views = []
    for index, fragments in enumerate(rasterize_views(mesh, cameras)):
        hit = fragments.face_index >= 0
        corners = mesh.v_uv[mesh.t_uv_idx[fragments.face_index[hit].long()]]
        uv = (corners * fragments.barycentric[hit][..., None]).sum(1)
        color = torch.full((*hit.shape, 3), 0.5)
        color[hit] = sample_image(texture, uv * texture.shape[0])
        views.append(View(f"{index:05d}", cameras[index], (color * 255).to(torch.uint8), fragments.depth))
    return views

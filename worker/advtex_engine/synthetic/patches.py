"""Scenes put together from patches: their atlas, their mesh, and the light on them.

A patch is a surface over the unit square (s to the right, t downwards, seen from outside), the (s, t) of its vertices
on a grid, and a drawing that covers the square: its chart in the atlas. Lengths of patches are millimetres, of meshes
metres, +z up.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from advtex_engine.core.scene import Atlas, Camera, Mesh
from advtex_engine.render.rasterize import rasterize
from advtex_engine.synthetic import print as prints

Array = NDArray[np.float64]
Surface = Callable[[Array], Array]

GAP = 3
"""Texels between charts; each drawing is continued into half of it."""
LIGHTS = 48
"""Directions that light the scene; each casts a shadow, together they are soft."""
SHADE_STEP = 4
"""Light is worked out for every so many texels and interpolated."""
INFRARED_STEP = 4
"""Texels of the radiance for each of what infrared light meets."""
GAMMA = 2.2
"""sRGB values are about this root of light."""


@dataclass(frozen=True)
class Patch:
    """surface: (s, t) [..., 2] -> millimetres [..., 3]; grid: [R,C,2] (s, t) of the vertices; drawing: [H,W,3].

    glow: its light over that of the drawing. gloss, clear: shares of a depth sensor's light that are mirrored and let
    through.
    """

    surface: Surface
    grid: Array
    drawing: prints.Image
    glow: float = 1.0
    gloss: float = 0.0
    clear: float = 0.0


@dataclass(frozen=True)
class DrawnScene:
    """A scene as it is, lit.

    radiance: [S,S,3] float32, proportional to light, 1 for white paper where the light is full; a lamp has more.
    infrared: [S/4,S/4,3] float32, what a depth sensor's light meets: reflectivity, gloss, clearness, each in [0,1].
    """

    atlas: Atlas
    radiance: torch.Tensor
    infrared: torch.Tensor


@dataclass(frozen=True)
class Sky:
    """The ball that light falls on: its center and radius in metres, and the shadows' resolution.

    size: pixels of a direction's depth image. slack: metres by which a surface may lie behind what casts a shadow.
    """

    center: tuple[float, float, float] = (0.0, 0.0, 0.09)
    reach: float = 0.22
    distance: float = 4.0
    size: int = 480
    slack: float = 0.0015


def square_grid(columns: int, rows: int) -> Array:
    """(s, t) [rows+1,columns+1,2] of evenly spaced vertices over the unit square."""
    t, s = np.meshgrid(np.linspace(0, 1, rows + 1), np.linspace(0, 1, columns + 1), indexing="ij")
    return np.stack([s, t], -1)


def look_at(eye: Array, target: Array) -> Array:
    """world_to_camera [4,4] of a camera at `eye` that looks at `target`, upright in a world whose up is +z."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, -rotation @ eye
    return matrix


def assemble(patches: Sequence[Patch], side: int, sky: Sky) -> DrawnScene:
    """Patches as a scene with one texture of side x side texels."""
    corners = pack([patch.drawing.shape[:2] for patch in patches], side)
    mesh = join(patches, corners, side)
    lit = [shaded(patch.drawing, shade) for patch, shade in zip(patches, light(mesh, patches, sky), strict=True)]
    radiance = (torch.from_numpy(paint(lit, corners, side)).float() / 255) ** GAMMA
    albedo = cv2.resize(
        paint([patch.drawing for patch in patches], corners, side),
        None,
        fx=1 / INFRARED_STEP,
        fy=1 / INFRARED_STEP,
        interpolation=cv2.INTER_AREA,
    )
    infrared = np.zeros((*albedo.shape[:2], 3), np.float32)
    infrared[..., 0] = (albedo.mean(-1) / 255) ** GAMMA
    for patch, (row, column) in zip(patches, corners, strict=True):
        height, width = patch.drawing.shape[:2]
        radiance[row - 1 : row + height + 1, column - 1 : column + width + 1] *= patch.glow
        rows, columns = (
            slice(first // INFRARED_STEP, (first + size) // INFRARED_STEP + 1)
            for first, size in ((row, height), (column, width))
        )
        if patch.gloss or patch.clear:
            infrared[rows, columns, 1:] = patch.gloss, patch.clear
    return DrawnScene(Atlas(mesh, side, side, "scan", len(patches)), radiance, torch.from_numpy(infrared))


def pack(shapes: Sequence[tuple[int, int]], side: int) -> list[tuple[int, int]]:
    """Top left texel (row, column) of each chart in a square of `side` texels.

    Highest first, each as high up as the charts above it let it.
    """
    corners: dict[int, tuple[int, int]] = {}
    filled = np.full(side - GAP, GAP)
    for index in sorted(range(len(shapes)), key=lambda i: -shapes[i][0]):
        height, width = shapes[index]
        rows = np.lib.stride_tricks.sliding_window_view(filled[GAP:], width + GAP).max(1)
        column = GAP + int(rows.argmin())
        row = int(rows.min())
        assert row + height + GAP <= side, "the charts do not fit; lower their density"
        filled[column : column + width + GAP] = row + height + GAP
        corners[index] = (row, column)
    return [corners[index] for index in range(len(shapes))]


def join(patches: Sequence[Patch], corners: Sequence[tuple[int, int]], side: int) -> Mesh:
    """One mesh: positions shared wherever two patches or a patch's own edges meet, uv per patch."""
    positions, uvs, faces, offset = [], [], [], 0
    for patch, (row, column) in zip(patches, corners, strict=True):
        rows, columns = patch.grid.shape[:2]
        size = np.array(patch.drawing.shape[1::-1], np.float64)
        positions.append(patch.surface(patch.grid).reshape(-1, 3) / 1000)
        uvs.append((np.array([column, row]) + patch.grid.reshape(-1, 2) * size) / side)
        index = offset + np.arange(rows * columns).reshape(rows, columns)
        a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
        faces += [np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)]
        offset += rows * columns
    _, first, shared = np.unique(
        np.rint(np.concatenate(positions) * 1e5).astype(np.int64), axis=0, return_index=True, return_inverse=True
    )
    corners_uv = np.concatenate(faces)
    corners_pos = shared.reshape(-1)[corners_uv]
    p = np.concatenate(positions)[first]
    area = np.linalg.norm(
        np.cross(p[corners_pos[:, 1]] - p[corners_pos[:, 0]], p[corners_pos[:, 2]] - p[corners_pos[:, 0]]), axis=1
    )
    solid = area > 1e-9
    return Mesh(
        v_pos=torch.from_numpy(p.astype(np.float32)),
        t_pos_idx=torch.from_numpy(corners_pos[solid].astype(np.int64)),
        v_uv=torch.from_numpy(np.concatenate(uvs).astype(np.float32)),
        t_uv_idx=torch.from_numpy(corners_uv[solid].astype(np.int64)),
    )


def paint(drawings: Sequence[prints.Image], corners: Sequence[tuple[int, int]], side: int) -> prints.Image:
    """The texture [side,side,3] of drawings that lie at their corners; gray in between."""
    texture = np.full((side, side, 3), 128, np.uint8)
    for drawing, (row, column) in zip(drawings, corners, strict=True):
        height, width = drawing.shape[:2]
        framed = cv2.copyMakeBorder(drawing, 1, 1, 1, 1, cv2.BORDER_REPLICATE)
        texture[row - 1 : row + height + 1, column - 1 : column + width + 1] = framed
    return texture


def light(mesh: Mesh, patches: Sequence[Patch], sky: Sky) -> list[NDArray[np.float32]]:
    """Diffuse light with soft shadows on each patch, as images of a factor per SHADE_STEP texels.

    LIGHTS directions over the upper hemisphere, brighter around one side: each adds cosine times visibility, which
    its own depth image tells.
    """
    points, normals, shapes = [], [], []
    for patch in patches:
        high, wide = (max(2, side // SHADE_STEP) for side in patch.drawing.shape[:2])
        t, s = np.meshgrid((np.arange(high) + 0.5) / high, (np.arange(wide) + 0.5) / wide, indexing="ij")
        st = np.stack([s, t], -1)
        at = patch.surface(st)
        right, down = (np.array(step) for step in ((2e-3, 0.0), (0.0, 2e-3)))
        across = patch.surface(np.clip(st + right, 0, 1)) - patch.surface(np.clip(st - right, 0, 1))
        along = patch.surface(np.clip(st + down, 0, 1)) - patch.surface(np.clip(st - down, 0, 1))
        normal = np.cross(along, across)
        normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
        points.append(at.reshape(-1, 3) / 1000)
        normals.append(normal.reshape(-1, 3))
        shapes.append((high, wide))
    factors = _irradiance(mesh, np.concatenate(points), np.concatenate(normals), sky)
    bounds = np.cumsum([high * wide for high, wide in shapes])[:-1]
    return [part.reshape(shape) for part, shape in zip(np.split(factors, bounds), shapes, strict=True)]


def _irradiance(mesh: Mesh, points: Array, normals: Array, sky: Sky) -> NDArray[np.float32]:
    """Light on points [N,3] (metres) with normals [N,3]: 1 where the brightest unshadowed level surface is."""
    key = np.array([-0.45, -0.55, 0.7]) / np.linalg.norm([-0.45, -0.55, 0.7])
    total = np.zeros(len(points), np.float32)
    level = 0.0
    size, center = sky.size, np.array(sky.center)
    focal = size / 2 * sky.distance / sky.reach
    K = torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]], dtype=torch.float64)
    for index in range(LIGHTS):
        z = 0.04 + 0.94 * (index + 0.5) / LIGHTS
        angle = index * np.pi * (3 - np.sqrt(5))
        towards = np.array([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z])
        power = 0.45 + 2.4 * max(0.0, float(towards @ key)) ** 6
        world_to_camera = look_at(center + sky.distance * towards, center)
        camera = Camera(K, torch.from_numpy(world_to_camera), size, size)
        depth = rasterize(mesh, camera).depth.numpy()
        depth = np.where(depth > 0, depth, np.inf)
        raised = points + sky.slack * normals
        seen = raised @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
        pixel = np.clip((seen[:, :2] / seen[:, 2:] * focal + size / 2).astype(np.int64), 0, size - 1)
        clear = seen[:, 2] <= depth[pixel[:, 1], pixel[:, 0]] + sky.slack
        total += (power * np.clip(normals @ towards, 0, None) * clear).astype(np.float32)
        level += power * towards[2]
    return total / np.float32(level)


def shaded(drawing: prints.Image, factor: NDArray[np.float32]) -> prints.Image:
    """The drawing under the light: multiplied where numbers are proportional to light, then back to sRGB."""
    size = (drawing.shape[1], drawing.shape[0])
    smooth = cv2.resize(cv2.GaussianBlur(factor, (0, 0), 1.2), size, interpolation=cv2.INTER_LINEAR)
    # A floor stands for light that bounces between the parts.
    smooth = (0.16 + 0.84 * smooth)[..., None]
    return np.asarray(np.rint(np.clip(drawing * smooth ** (1 / GAMMA), 0, 255)), np.uint8)

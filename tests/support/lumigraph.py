"""What the page's `lumigraph.js` draws, in torch on the engine's rasterizer; a small scene with photographs of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
import trimesh
from atlases import camera, of_trimesh
from torch import Tensor

from advtex_engine.core.cameras import camera_center, pixel_centers, project, scaled_camera, unproject
from advtex_engine.core.scene import Atlas, Camera, Mesh, Scene, View
from advtex_engine.render.rasterize import rasterize, rasterize_views
from advtex_engine.render.render_view import render_view
from advtex_engine.render.texture import sample_image

LIMIT, FADE, COARSE, BORDER = 0.7, 0.35, 0.5, 0.06
RELATIVE_TOLERANCE, TOLERANCE = 0.05, 0.02
DEPTH_WIDTH, NEAR = 320, 0.05


@dataclass(frozen=True)
class Photograph:
    """color: [h,w,3] uint8. depth: [h',w'] metres of the mesh, infinite where there is none."""

    camera: Camera
    color: Tensor
    depth: Tensor


def photographs(mesh: Mesh, cameras: Sequence[Camera], colors: Sequence[Tensor]) -> list[Photograph]:
    small = [_with_width(place, min(DEPTH_WIDTH, place.width)) for place in cameras]
    depths = (torch.where(seen.depth > 0, seen.depth, torch.inf) for seen in rasterize_views(mesh, small))
    return [Photograph(*found) for found in zip(cameras, colors, depths, strict=True)]


def blended(mesh: Mesh, given: Sequence[Photograph], place: Camera) -> tuple[Tensor, Tensor]:
    """What a camera sees of the photographs: color [H,W,3] in [0,1] and how far it hides the model, [H,W] in [0,1]."""
    seen = rasterize(mesh, place)
    hit = seen.face_index >= 0
    points = unproject(place, pixel_centers(place)[hit], seen.depth[hit])
    matches = [_penalty(photograph, points, camera_center(place)) for photograph in given]
    penalties = torch.stack([penalty for penalty, _ in matches]).clamp(1e-3, LIMIT)
    best, which = penalties.topk(2, dim=0, largest=False)
    third = penalties.topk(3, dim=0, largest=False).values[2] if len(given) > 2 else torch.full_like(best[0], LIMIT)
    weights = 1 / best - 1 / third + torch.tensor([[1e-9], [0.0]])
    mixed = points.new_zeros((len(points), 3))
    for number, (photograph, (_, pixels)) in enumerate(zip(given, matches, strict=True)):
        mine = torch.where(which == number, weights, 0.0).sum(0)
        used = mine > 0
        mixed[used] += mine[used, None] * sample_image(photograph.color.float() / 255, pixels[used].float())
    color, share = torch.zeros((place.height, place.width, 3)), torch.zeros((place.height, place.width))
    color[hit] = (mixed / weights.sum(0)[:, None]).float()
    share[hit] = ((LIMIT - best[0]) / FADE).clamp(0, 1).float()
    return color, share


def _penalty(photograph: Photograph, points: Tensor, eye: Tensor) -> tuple[Tensor, Tensor]:
    """How much worse than the best one a photograph is for points [P,3], in radians, and their pixels [P,2] in it."""
    camera = photograph.camera
    pixels, depth = project(camera, points)
    at = pixels / pixels.new_tensor([camera.width, camera.height])
    inside = torch.minimum(at, 1 - at).min(1).values
    here, there = eye - points, camera_center(camera) - points
    farther = there.norm(dim=1) / here.norm(dim=1)
    angle = torch.acos(F.cosine_similarity(here, there).clamp(-1, 1))
    penalty = angle + COARSE * (farther - 1).clamp(min=0) + LIMIT * (1 - inside / BORDER).clamp(min=0)
    height, width = photograph.depth.shape
    column, row = (at * at.new_tensor([width, height])).long().unbind(1)
    surface = photograph.depth[row.clamp(0, height - 1), column.clamp(0, width - 1)]
    used = (depth > NEAR) & (inside > 0) & (depth <= surface * (1 + RELATIVE_TOLERANCE) + TOLERANCE)
    return torch.where(used, penalty, LIMIT), pixels


def _with_width(place: Camera, width: int) -> Camera:
    return scaled_camera(place, width, round(place.height * width / place.width))


def photographed_scene() -> tuple[Scene, Atlas, Tensor]:
    """A box above a floor, of which one photograph in three is of another color, so that it shows which ones are taken.

    Returns the scene, its atlas, and the texture [H,W,3] in [0,1], which is gray.
    """
    floor = trimesh.creation.box((4.0, 4.0, 0.1))
    floor.apply_translation((0, 0, -0.6))
    whole = trimesh.util.concatenate([trimesh.creation.box((1.0, 0.8, 0.6)), floor])
    assert isinstance(whole, trimesh.Trimesh)
    mesh = of_trimesh(whole)
    v_uv = torch.tensor([[0.1, 0.1], [0.9, 0.1], [0.1, 0.9]])
    t_uv_idx = torch.arange(3).expand(len(mesh.t_pos_idx), 3).contiguous()
    atlas = Atlas(Mesh(mesh.v_pos, mesh.t_pos_idx, v_uv, t_uv_idx), 64, 64, "scan", 1)
    texture = torch.full((64, 64, 3), 0.5)
    angles = np.linspace(-0.9, 0.9, 7)
    cameras = [camera((3 * np.cos(angle), 3 * np.sin(angle), 1.6), 160, 120, 150.0) for angle in angles]
    views = tuple(_view(atlas, place, number) for number, place in enumerate(cameras))
    return Scene(mesh, views, kind="object"), atlas, texture


def _view(atlas: Atlas, place: Camera, number: int) -> View:
    """Stripes about the texture's tone, so that toning leaves them, in a color of few views."""
    row, column = (torch.arange(length)[:, None] for length in (place.height, place.width))
    stripes = torch.sin(0.3 * row + 0.05 * number * column.T)[..., None] * torch.eye(3)[number % 3]
    shown = render_view(atlas, 0.5 * torch.ones((64, 64, 3)), place, supersample=1)
    return View(f"{number}.png", place, ((shown + 0.15 * stripes).clamp(0, 1) * 255).to(torch.uint8))

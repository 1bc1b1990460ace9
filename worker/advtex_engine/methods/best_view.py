"""One view per face, each face for itself: the view that shows it largest. Sharp, with seams wherever views disagree.

Large faces are cut as view selection cuts them, or a door would be painted from afar by whoever sees all of it.

Also what every such method shares: `label_faces` with a score of its own, and `paint` from the labels.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from advtex_engine.core.scene import Atlas
from advtex_engine.mesh.split import LONGEST_SIDE, split_long_sides
from advtex_engine.methods.inputs import LossPoint, MethodInput
from advtex_engine.render.reproject import reproject
from advtex_engine.render.texels import TexelMap, map_texels, surface_points
from advtex_engine.render.texture import decode_uv, fill_holes
from advtex_engine.render.view_maps import DEPTH_TOLERANCE, ViewMaps

MIN_SEEN = 0.5
"""Share of a face's projected area that a view must see: a face that is mostly hidden is painted by another view."""

Score = Callable[[int, Tensor], Tensor]
"""(view index, visible areas in pixels [F]) -> how good the view is for each face [F]."""


def best_view(given: MethodInput) -> tuple[Tensor, list[LossPoint]]:
    """Every face from the view with its largest projected area -> [H,W,3] float32 in [0,1], no losses."""
    return one_view_texture(given, lambda _view, area: area), []


def one_view_texture(given: MethodInput, score: Score) -> Tensor:
    """Every face from the view that `score` puts highest; what no view shows keeps the mean -> [H,W,3] in [0,1]."""
    maps = given.maps[1]
    atlas = split_long_sides(given.atlas, LONGEST_SIDE * maps.width)
    texels = map_texels(atlas)
    labels = label_faces(maps, atlas, texels, score)
    return paint(given, atlas, texels, labels)


def label_faces(maps: ViewMaps, atlas: Atlas, texels: TexelMap, score: Score) -> Tensor:
    """The view of highest score for each face [T] int64; -1 where no view sees enough of the face.

    A face's visible area is counted in the pixels whose texture coordinates fall into it, so what hides a face and what
    the device's depth contradicts is left out.
    """
    mesh = atlas.mesh
    corners = mesh.v_pos[mesh.t_pos_idx]
    count = len(corners)
    face_of = torch.full((atlas.height * atlas.width,), -1, device=corners.device)
    face_of[texels.texel] = texels.face
    best = torch.zeros(count, device=corners.device)
    labels = torch.full((count,), -1, device=corners.device)
    for view in range(maps.count):
        seen = _visible_pixels(maps, view, face_of, count)
        faces = (seen > 0).nonzero()[:, 0]
        area = _projected_area(maps, view, corners[faces])
        visible = torch.minimum(seen[faces], area)
        value = score(view, visible) * (visible >= MIN_SEEN * area)
        better = value > best[faces]
        best[faces[better]], labels[faces[better]] = value[better], view
    return labels


def paint(given: MethodInput, atlas: Atlas, texels: TexelMap, labels: Tensor) -> Tensor:
    """Each texel's color from its face's view, bicubic -> [H,W,3] in [0,1]; the mean where that view does not see it.

    atlas, texels: with the faces that labels [T] int64 tell the views of, -1 = none.
    """
    maps, tolerance = given.maps[1], DEPTH_TOLERANCE[given.scene.kind]
    points = surface_points(atlas.mesh, texels)
    label = labels[texels.face]
    texture = given.means[1].clone()
    flat = texture.view(-1, 3)
    first = torch.tensor(0, device=labels.device)
    for view in range(maps.count):
        chosen = (label == view).nonzero()[:, 0]
        to_camera = maps.world_to_camera[view, :3].to(torch.float32)
        color, visible = reproject(points[chosen], to_camera, maps.only(view), first, tolerance)
        flat[texels.texel[chosen[visible]]] = color[visible] / 255
    known = torch.zeros(texture.shape[:2], dtype=torch.bool, device=texture.device)
    known.view(-1)[texels.texel] = True
    return fill_holes(texture, known)


def _visible_pixels(maps: ViewMaps, view: int, face_of: Tensor, count: int) -> Tensor:
    """How many pixels of a view show each face [count]."""
    height, width = maps.slot_map.shape
    seen = maps.only(view)
    uv = decode_uv(seen.uv[0][seen.depth[0] > 0])
    column = (uv[:, 0] * width).long().clamp(max=width - 1)
    row = (uv[:, 1] * height).long().clamp(max=height - 1)
    face = face_of[row * width + column]
    return torch.bincount(face[face >= 0], minlength=count)


def _projected_area(maps: ViewMaps, view: int, corners: Tensor) -> Tensor:
    """Areas in pixels [F] of faces [F,3,3]; 0 for faces that reach behind the camera."""
    pose = maps.world_to_camera[view].to(torch.float32)
    points = corners @ pose[:3, :3].T + pose[:3, 3]
    z = points[..., 2:]
    front = (z > 0).all(1)[:, 0]
    pixels = points[..., :2] / torch.where(z > 0, z, 1.0) * maps.intrinsics[view, :2] + maps.intrinsics[view, 2:]
    one, other = pixels[:, 1] - pixels[:, 0], pixels[:, 2] - pixels[:, 0]
    area = (one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]).abs() / 2
    return area * front

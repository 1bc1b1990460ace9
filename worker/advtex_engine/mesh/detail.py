"""What decimation takes of a mesh, and whether that is shape or the noise of a scan. Not differentiable.

Under light from any direction a surface changes its brightness by the root mean square of |m - n| / sqrt(3) where its
unit normals change from n to m. So the change of a picture, over all lights, is that of the normals from the decimated
mesh to the fine one, at points spread evenly over the surface.

Noise is everywhere, also where there is nothing to see: walls, tables and floors. Shape that decimation takes lies
where there is shape, about edges and folds, and next to nothing of it on what is flat. So the noise is the change on
what is flat: of patches a few faces wide, FLAT_SHARE of the surface are those whose normals agree best in the decimated
mesh, and NOISY_SHARE of these change by less. It needs no depth images, which meshes from elsewhere do not bring, and
finds noise of any size along the surface: in fused meshes it is as smooth as their shapes, so that no filter tells it.
What cannot be told from noise is relief that is as strong all over; it is left out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.core.scene import Mesh
from advtex_engine.mesh.borders import median_edge
from advtex_engine.mesh.closest import ClosestPoints
from advtex_engine.mesh.normals import vertex_normals

PATCHES, SAMPLES = 2_500, 40_000  # cubes of a grid that are looked at, and points in them
PATCH_EDGES = 6  # of the fine mesh, along a side of a cube
PATCH_SAMPLES = 6  # in a patch that has a say, at least
FLAT_SHARE, NOISY_SHARE = 0.4, 0.75
LEAST_CHANGE = 1.0
"""Degrees, root mean square: 2.6 of 255 gray levels of a white surface."""
LEAST_RATIO = 3.5
"""Of change to noise, between scans whose map carves noise (five, 1.3 to 2.4) and those whose map mends shape (a living
room without noise, 9; drawn meshes, 5 and more). `tests/benchmarks/normal_maps.py` tells which is which."""
ERROR_SHARE = 0.999


@dataclass(frozen=True)
class Detail:
    """A mesh before its decimation, what is needed to bake its normals.

    fine: the mesh, without uv. v_pos: [V,3] float32, the decimated mesh's vertices, before anything moved them. error:
    metres that the surfaces are apart, of nearly all of it.
    """

    fine: Mesh
    v_pos: Tensor
    error: float


def find_detail(fine: Mesh, decimated: Mesh) -> tuple[Detail | None, dict[str, Any]]:
    """The detail that is worth a normal map, or None; and the report about it.

    fine, decimated: cleaned, on the CPU; the same mesh where nothing was decimated.
    """
    if decimated is fine:
        return None, {"made": False, "why": "the mesh was not decimated"}
    change, noise, error = _measured(fine, decimated)
    figures = {
        "faces": len(fine.t_pos_idx),
        "change_degrees": round(math.degrees(change), 3),
        "noise_degrees": round(math.degrees(noise), 3),
        "error_mm": round(1000 * error, 3),
    }
    if change < math.radians(LEAST_CHANGE):
        return None, {"made": False, "why": "decimation hardly changed how light falls", **figures}
    if change < LEAST_RATIO * noise:
        return None, {"made": False, "why": "it would carve the noise of the mesh into flat surfaces", **figures}
    detail = Detail(Mesh(fine.v_pos, fine.t_pos_idx), decimated.v_pos, error)
    return detail, {"made": True, "why": "decimation took shape, and next to nothing from flat surfaces", **figures}


def _measured(fine: Mesh, decimated: Mesh) -> tuple[float, float, float]:
    """Root mean square change of the normals (chords of unit vectors), the same on what is flat, and the error."""
    side = PATCH_EDGES * median_edge(fine)
    face, weight = _samples(fine, side)
    corners = fine.t_pos_idx[face]
    points = (fine.v_pos[corners] * weight[..., None]).sum(1)
    normals = F.normalize((vertex_normals(fine)[corners] * weight[..., None]).sum(1), dim=1)
    found = ClosestPoints(decimated).find(points, normals)
    smooth = F.normalize(found.mix(vertex_normals(decimated), decimated.t_pos_idx), dim=1)
    change = (normals - smooth).double().square().sum(1)
    noise = _noise(points, smooth, change, side)
    return float(change.mean()) ** 0.5, noise**0.5, float(torch.quantile(found.distance, ERROR_SHARE))


def _samples(mesh: Mesh, side: float) -> tuple[Tensor, Tensor]:
    """Points within PATCHES cubes drawn at random, the same ones each time: faces [N], barycentrics [N,3].

    Their density is even there; in a large mesh points all over the surface would hardly be two in a cube.
    """
    generator = torch.Generator().manual_seed(0)
    a, b, c = mesh.v_pos[mesh.t_pos_idx].unbind(1)
    cubes, cube = torch.unique(_cubes((a + b + c) / 3, side), return_inverse=True)
    drawn = torch.zeros(len(cubes), dtype=torch.bool)
    drawn[torch.randperm(len(cubes), generator=generator)[:PATCHES]] = True
    among = drawn[cube].nonzero()[:, 0]
    a, b, c = a[among], b[among], c[among]
    area = torch.linalg.cross(b - a, c - a).norm(dim=1).double().cumsum(0)
    place = torch.rand(SAMPLES, generator=generator, dtype=torch.float64) * area[-1]
    face = among[torch.searchsorted(area, place).clamp(max=len(area) - 1)]
    root, other = torch.rand((SAMPLES, 2), generator=generator).unbind(1)
    root = root.sqrt()
    return face, torch.stack((1 - root, root * (1 - other), root * other), 1)


def _cubes(points: Tensor, side: float) -> Tensor:
    """[N] int64: a number for each cube of a grid over the world."""
    cell = (points.double() / side).floor().long() & 0xFFFFF
    return (cell[:, 0] << 40) | (cell[:, 1] << 20) | cell[:, 2]


def _noise(points: Tensor, normals: Tensor, change: Tensor, side: float) -> float:
    """What NOISY_SHARE of the flattest patches [N points] have less of, of the mean square change in them [N].

    Patches lie in cubes of a grid; what looks to different sides of a box is told apart.
    """
    main = normals.abs().argmax(1, keepdim=True)
    facing = (2 * main + (normals.gather(1, main) > 0))[:, 0]
    key = _cubes(points, side) | facing << 60
    _, patch, count = torch.unique(key, return_inverse=True, return_counts=True)
    total = torch.zeros((len(count), 3), dtype=torch.float64).index_add_(0, patch, normals.double())
    agreement = total.norm(dim=1) / count
    mean = torch.zeros(len(count), dtype=torch.float64).index_add_(0, patch, change) / count
    usable = count >= PATCH_SAMPLES
    agreement, mean, count = agreement[usable], mean[usable], count[usable]
    flat = _first(agreement, count, FLAT_SHARE, descending=True)
    return float(mean[flat][_first(mean[flat], count[flat], NOISY_SHARE)].max()) if len(flat) else math.inf


def _first(values: Tensor, weights: Tensor, share: float, *, descending: bool = False) -> Tensor:
    """Indices of the least values, or of the greatest, that have this share of the weights; of one at least."""
    order = torch.argsort(values, descending=descending)
    before = weights[order].cumsum(0) - weights[order]
    return order[before <= share * weights.sum()]

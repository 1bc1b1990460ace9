"""Plane sweep along the normals: how far out or in a surface lies, by where the photographs agree best.

A descent from where the mesh is finds what is next to it. A phone's mesh of an object is off by pixels where print is a
pixel wide, and smooth where the object is not: there all offsets have to be looked at. Every vertex is tried at LAYERS
of them along its normal (Collins 1996, "A Space-Sweep Approach to True Multi-Image Matching"). A patch of its tangent
plane is looked up in each view that sees it, and the normalized cross-correlation of these patches, the mean over all
pairs of views, tells how well the photographs agree.

Where nothing is printed, or where it repeats, the best offset is anybody's; so neighbors have a say. Smooth offsets
follow the best ones, the more so the clearer these are. Then in turn every vertex takes the offset that is best and
near the smooth one, and the smooth ones follow, in the end wherever they are led (the coupling of Newcombe et al. 2011,
"DTAM"). It is offsets that are smooth, not the surface: what is an edge stays one.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.core.cameras import stack_cameras
from advtex_engine.core.scene import Camera, Mesh
from advtex_engine.mesh.normals import vertex_normals
from advtex_engine.refine.points import SURFACE_TOLERANCE
from advtex_engine.refine.solve import conjugate_gradients
from advtex_engine.runtime.threads import fit_threads

LAYERS = 17  # offsets, in the middle of which the mesh is
STEP = 0.5  # pixels that a layer is from the next, at the middle depth
RADIUS = 2  # pixels to each side, of a patch
BORDER = 8.0  # pixels from the image's edge, so that no patch leaves it
NOISE = 0.02  # of luminance: patches of less than that show nothing
MIN_COSINE = 0.3  # between normal and ray: beyond 73 degrees a patch is a line
MOST_VIEWS = 12  # that a vertex is looked at from, those it faces most
SMOOTH, SMALL = 4.0, 1e-3  # pulls to the neighbors' offsets and to 0, relative to the mean clearness
COUPLINGS, ROUNDS = (-1.0, 1.0), 8
"""Powers of ten of the correlation that an offset costs which is a pixel off the smooth one, first and last."""
SOLVER_STEPS = 60
AT_ONCE = 5000  # vertices: bounds the memory, some 10 KB each


def sweep_offsets(
    mesh: Mesh, edges: Tensor, cameras: list[Camera], depths: Tensor, luminance: Tensor, depth: float
) -> Tensor:
    """Offsets [M] in metres along the mesh's `vertex_normals`, by the photographs of V views.

    edges: [E,2] int64, pairs of vertices that are neighbors. depths: [V,h,w] metres, of `surface_depths`. luminance:
    [V,h,w] in [0,1]. cameras: of that size. depth: metres, at which a pixel's width on the surface is taken. On a CPU
    the same input gives the same result. Not differentiable.
    """
    pixel = depth / float(cameras[0].K[0, 0])
    layers = torch.arange(LAYERS, device=mesh.v_pos.device) - LAYERS // 2
    offsets = STEP * pixel * layers.to(mesh.v_pos)
    return smooth_offsets(agreement(mesh, cameras, depths, luminance, offsets, pixel), offsets, edges, pixel)


def agreement(
    mesh: Mesh, cameras: list[Camera], depths: Tensor, luminance: Tensor, offsets: Tensor, pixel: float
) -> Tensor:
    """[M,L] in [-1,1]: the mean correlation of views at each vertex, moved by offsets [L] metres along its normal.

    0 where fewer than two views see it. pixel: metres, between the points of a patch. Other arguments as for
    `sweep_offsets`.
    """
    normal = vertex_normals(mesh)
    axes = _axes(normal)
    K, poses = (part.to(normal.dtype) for part in stack_cameras(cameras, normal.device))
    weight = _facing(mesh.v_pos, normal, K, poses, depths)
    side = torch.arange(-RADIUS, RADIUS + 1, device=normal.device).to(normal)
    patch = pixel * torch.cartesian_prod(side, side)
    size = normal.new_tensor([depths.shape[2], depths.shape[1]])
    found = normal.new_zeros(len(normal), len(offsets))
    for first in range(0, len(normal), AT_ONCE):
        rows = slice(first, first + AT_ONCE)
        fit_threads()
        total = normal.new_zeros(*found[rows].shape, len(patch))
        squares = torch.zeros_like(found[rows])
        for view in range(len(cameras)):
            seen = weight[view, rows].nonzero()[:, 0]
            share = weight[view, rows][seen, None]
            place = seen + first
            where = _patches(mesh.v_pos[place], axes[place], offsets, patch, K[view], poses[view])
            grid = (2 * where / size - 1).flatten(0, 1)[None]
            value = F.grid_sample(luminance[view, None, None], grid, align_corners=False)
            value = value.view(len(seen), len(offsets), len(patch))
            value = value - value.mean(2, keepdim=True)
            energy = value.square().sum(2)
            total[seen] += share[..., None] * value / (energy + len(patch) * NOISE**2).sqrt()[..., None]
            squares[seen] += share.square() * energy / (energy + len(patch) * NOISE**2)
        weights = weight[:, rows].sum(0)[:, None]
        # Of all pairs with itself included, less those of a view with itself.
        pairs = weights.square() - weight[:, rows].square().sum(0)[:, None]
        found[rows] = torch.where(pairs > 1e-6, (total.square().sum(2) - squares) / pairs.clamp(min=1e-6), 0.0)
    return found


def smooth_offsets(agreed: Tensor, offsets: Tensor, edges: Tensor, pixel: float) -> Tensor:
    """[M] metres: what vertices that agree by agreed [M,L] at offsets [L] take, smooth between neighbors.

    Minimizes the sum over vertices of -agreed and over edges of SMOOTH times the mean clearness times the difference's
    square in pixels, where what is taken and what is smooth are two, and drawn together by the coupling.
    """
    clear = agreed.amax(1) - agreed.median(1).values
    mean = clear.mean() + 1e-12
    a, b = edges.unbind(1)
    degree = torch.bincount(edges.flatten(), minlength=len(agreed)).to(clear)

    def followed(taken: Tensor, weight: Tensor) -> Tensor:
        def product(d: Tensor) -> Tensor:
            slope = d[a] - d[b]
            smooth = torch.zeros_like(d).index_add_(0, a, slope).index_add_(0, b, -slope)
            return weight * d + mean * (SMOOTH * smooth + SMALL * d)

        return conjugate_gradients(product, weight * taken, weight + mean * (SMOOTH * degree + SMALL), SOLVER_STEPS)

    found = followed(_lowest(-agreed, offsets), clear)
    for coupling in torch.logspace(*COUPLINGS, ROUNDS).tolist():
        away = ((offsets - found[:, None]) / pixel).square()
        found = followed(_lowest(coupling * away - agreed, offsets), torch.full_like(clear, coupling))
    return found


def _facing(position: Tensor, normal: Tensor, K: Tensor, poses: Tensor, depths: Tensor) -> Tensor:
    """[V,M]: the cosine by which vertices face views that see them, 0 for others and beyond MOST_VIEWS."""
    height, width = depths.shape[1:]
    weight = normal.new_zeros(len(poses), len(position))
    for view, pose in enumerate(poses):
        local = position @ pose[:3, :3].T + pose[:3, 3]
        homogeneous = local @ K[view].T
        x, y = (homogeneous[:, :2] / homogeneous[:, 2:]).unbind(1)
        z = local[:, 2]
        inside = (z > 0) & (x > BORDER) & (x < width - BORDER) & (y > BORDER) & (y < height - BORDER)
        column, row = (torch.where(inside, part, 0.0).long() for part in (x, y))
        surface = depths[view][row, column]
        cosine = -((normal @ pose[:3, :3].T) * F.normalize(local, dim=1)).sum(1)
        seen = inside & (surface > 0) & (z < surface * (1 + SURFACE_TOLERANCE)) & (cosine > MIN_COSINE)
        weight[view] = torch.where(seen, cosine, 0.0)
    if len(weight) > MOST_VIEWS:
        least = weight.topk(MOST_VIEWS, dim=0).values[-1]
        weight = torch.where(weight >= least, weight, 0.0)
    return weight


def _axes(normal: Tensor) -> Tensor:
    """[M,3,3] rows: two directions of the tangent plane, and the normal."""
    other = torch.eye(3, device=normal.device, dtype=normal.dtype)[normal.abs().argmin(1)]
    across = F.normalize(torch.linalg.cross(normal, other), dim=1)
    return torch.stack((across, torch.linalg.cross(normal, across), normal), 1)


def _patches(position: Tensor, axes: Tensor, offsets: Tensor, patch: Tensor, K: Tensor, pose: Tensor) -> Tensor:
    """Pixels [N,L,Q,2] of points patch [Q,2] (metres) of the tangent planes of vertices [N,3] moved by offsets [L].

    axes: of `_axes`. To first order about the patch's middle: what is a few pixels wide has no perspective.
    """
    local = position @ pose[:3, :3].T + pose[:3, 3]
    across, along, out = (axes @ pose[:3, :3].T).unbind(1)
    moved = local[:, None] + offsets[:, None] * out[:, None]
    z = moved[..., 2:]
    flat = moved[..., :2] / z
    slopes = [(way[:, None, :2] - flat * way[:, None, 2:]) / z for way in (across, along)]
    points = flat[:, :, None] + sum(patch[:, [k]] * slope[:, :, None] for k, slope in enumerate(slopes))
    return points @ K[:2, :2].T + K[:2, 2]


def _lowest(energy: Tensor, offsets: Tensor) -> Tensor:
    """[M]: where among offsets [L], evenly spaced, energy [M,L] is lowest, between them by a parabola."""
    best = energy.argmin(1)
    middle = best.clamp(1, len(offsets) - 2)
    before, at, after = (energy.gather(1, middle[:, None] + k)[:, 0] for k in (-1, 0, 1))
    bend = before + after - 2 * at
    shift = (0.5 * (before - after) / bend.clamp(min=1e-9)).clamp(-0.5, 0.5)
    inside = (best == middle) & (bend > 1e-9)
    return offsets[best] + torch.where(inside, shift, 0.0) * (offsets[1] - offsets[0])

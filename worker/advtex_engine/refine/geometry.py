"""Geometry refinement: vertices move along their normals to where the photographs agree and the depth was measured.

Photographs from several sides show a surface that lies too far in or out in different places (the parallax; Vu et al.
2012, "High Accuracy and Visibility-Consistent Dense Multiview Stereo"), and the depth images of all frames together
know it better than a mesh that was made of few of them, or came from elsewhere. Both are linear in how far a surface
point moves along its normal, which is the mean of the offsets d of its face's corners:
    sum over points (a d^2 - 2 b d) + smoothness of d between neighboring vertices
is minimized by conjugate gradients, again and again as the images get finer. It is the offsets that are smooth, not the
surface: what is an edge stays one.

Nothing is taken on trust: the photographs have no say in cells of the surface that were set aside, and the mesh stays
as it came unless they agree better there afterwards.

Depth may be the wrong thing to go by: what a phone makes up between few readings is smooth where an object is not, and
structured light is off by millimetres all around it. If that does not help an object, its photographs are tried alone:
offsets along the normals that are far from what is there are looked at as well (`sweep`), and then vertices descend to
what is finest. Within a cell nothing but smoothness would speak here, so that it is whole views that are set aside, and
what they see tells. Offsets of the descent are vectors, smooth in space, since those along normals tear corners apart.
Where the surface turns away from a view, photographs say little of it, and whoever moved it would open gaps to what is
behind: vertices there are held then, but for the direction towards that view. Rooms are not tried: half of what they
show are outlines before surfaces that no view has seen behind them, and gaps cost them more (icl_livingroom's LPIPS
doubles) than all else gains; where they are swept, views that were set aside refuse it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.core.cameras import stack_cameras
from advtex_engine.core.rows import distinct_rows
from advtex_engine.core.scene import Mesh, Scene
from advtex_engine.mesh.normals import vertex_normals
from advtex_engine.refine.check import MARGIN, better, disagreement
from advtex_engine.refine.points import (
    CELL_SIZE,
    EDGE_STEP,
    Candidates,
    Observations,
    draw_candidates,
    grid_cells,
    observe,
    order_of_preference,
    surface_depths,
)
from advtex_engine.refine.pose import ROBUST_SCALE, local_contrast, sample_points
from advtex_engine.refine.solve import conjugate_gradients, residuals, weighted_mean
from advtex_engine.refine.sweep import sweep_offsets
from advtex_engine.refine.working_views import CHECKED_SHARE, CONTRAST_SCALE, known_pixels, luminance, working_color
from advtex_engine.render.filtering import greatest
from advtex_engine.render.rasterize import rasterize_views
from advtex_engine.runtime.threads import fit_threads

LEVELS = ((4, 3), (2, 3), (1, 3))  # shrink factor of the image, Gauss-Newton steps
POINTS_PER_VIEW = 20_000
LOOKS = 2_000_000  # of all views together: bounds the memory, some 200 bytes each
MIN_POINTS = 1000  # that two views must see, to move anything
SMOOTH, SMALL = 0.3, 0.01  # pulls to the neighbors' offsets and to 0, relative to the mean evidence for a vertex
# Readings of one place err together, so that many are hardly more evidence than a few.
DEPTH_WEIGHT = 0.2
LEAST_DEVIATION = 0.001  # metres, of the depth's readings
LARGEST_STEP = 3.0  # pixels of the level
MOST = 0.04  # of the median depth
ALONE_STEPS = 2  # of descent by photographs alone, at the finest level, once they were swept
ASIDE = 4  # one view of so many is set aside
OUTLINE, OUTLINE_REACH = 2.0, 2
"""Pull to where vertices at outlines were, across the rays of the views that see them so, relative to the mean evidence
and shared by all views; and how many pixels beside an outline they lie."""
ONE_SIDED = 0.9  # share of the looks at the outside from which on a mesh is taken to have one
SOLVER_STEPS = 60
MEDIAN_OF = 1_000_000  # readings at least, of which the middle depth is told


@dataclass(frozen=True)
class GeometryRefinement:
    """v_pos [V,3] float32, None to leave the mesh as it came; and the report about it.

    alone: the photographs moved it alone.
    """

    v_pos: Tensor | None
    report: dict[str, Any]
    alone: bool = False


@dataclass(frozen=True)
class Seen:
    """Points of the surface and the views that look at them. measured: [V,K] metres along z, 0 = no reading."""

    surface: Candidates
    points: Observations
    measured: Tensor


def refine_geometry(scene: Scene, device: torch.device, seed: int, alone: bool = False) -> GeometryRefinement:
    """Vertices along their normals, from the training views' photographs and depth; held-out views are not read.

    alone: photographs alone have moved this mesh before, by other cameras; they do it again.

    The report's residuals are mean disagreements of the views, in local contrasts, at points where the photographs had
    no say; None where too few views share such points. On a CPU the same input and seed give the same result. Not
    differentiable.
    """
    generator = torch.Generator().manual_seed(seed)
    color = working_color(scene.views, device)
    given = Surface(Mesh(scene.mesh.v_pos.to(device), scene.mesh.t_pos_idx.to(device)), scene, color, generator)
    offsets = torch.zeros(len(given.mesh.v_pos), device=device)
    taken, report = False, dict[str, Any]()
    first = given.look(given.mesh)
    if alone and first is not None:
        return swept_again(given, first)
    for scale, steps in LEVELS:
        seen = given.look(given.moved(offsets)) if report else first
        if first is None or seen is None:
            break
        features = given.contrast(scale)
        for _ in range(steps):
            fit_threads()
            offsets = given.step(offsets, features, seen, scale)
        untouched = first.points.seen & given.aside[first.surface.face][first.points.point]
        taken, report = given.judged(given.moved(offsets), first, untouched)
        before, after = report["residual_before"], report["residual_after"]
        if before is None or after > MARGIN * before:  # what begins like that comes to nothing
            break
    report = {"refined": taken, **report}
    if not taken:
        found = by_photographs(given, first) if scene.kind == "object" and first is not None else None
        return found or GeometryRefinement(None, report)
    report["moved_mm"] = round(1000 * float(offsets.abs().mean()), 3)
    return GeometryRefinement(given.moved(offsets).v_pos.cpu(), report)


class Surface:
    """The mesh as it came, what its photographs show, and what moves it."""

    def __init__(self, mesh: Mesh, scene: Scene, color: Tensor, generator: torch.Generator) -> None:
        self.mesh, self._scene, self._generator = mesh, scene, generator
        self.normal = vertex_normals(mesh)
        self._size = (color.shape[3], color.shape[2])
        cameras, depths, shown = surface_depths(mesh, scene.views, self._size, scene.kind)
        self.cameras, self._depths = cameras, depths
        self._color, self._known = color, known_pixels(shown, scene.kind)
        self.features = local_contrast(luminance(color), 1, self._known)
        self.K, self.poses = stack_cameras(cameras, mesh.v_pos.device)
        some = depths.flatten()[:: max(1, depths.numel() // MEDIAN_OF)]  # to sort all takes four times their memory
        self.depth = float(some[some > 0].median()) if bool((some > 0).any()) else 1.0
        sides = torch.cat([mesh.t_pos_idx[:, [a, b]] for a, b in ((0, 1), (1, 2), (2, 0))]).sort(1).values
        self.edges, _ = distinct_rows(sides)
        self.cell = grid_cells(mesh.v_pos[mesh.t_pos_idx].double().mean(1), CELL_SIZE * self.depth)
        share = torch.rand(int(self.cell.max()) + 1, generator=generator)
        self.aside = (share < CHECKED_SHARE).to(self.cell.device)[self.cell]

    def moved(self, offsets: Tensor) -> Mesh:
        """The mesh with its vertices moved by offsets [V] metres along their normals."""
        return Mesh(self.mesh.v_pos + offsets[:, None] * self.normal, self.mesh.t_pos_idx)

    def contrast(self, scale: int) -> Tensor:
        """The views' `local_contrast` at a shrink factor."""
        return self.features if scale == 1 else local_contrast(luminance(self._color), scale, self._known)

    def look(self, mesh: Mesh) -> Seen | None:
        """Points of the mesh and who sees them; None where hardly anything is seen by two views."""
        cameras, depths = self.cameras, self._depths
        if mesh is not self.mesh:
            _, depths, _ = surface_depths(mesh, self._scene.views, self._size, self._scene.kind)
        detail = torch.hypot(*self.features[:, 1:].unbind(1))
        surface = draw_candidates(mesh, cameras, depths, detail, self._generator)
        if len(surface.position) < MIN_POINTS:
            return None
        surface = surface.chosen(order_of_preference(surface, self._generator))
        points = observe(surface, min(POINTS_PER_VIEW, max(1, LOOKS // len(cameras))))
        samples = sample_points(self.features, self.K, self.poses, points, self._size)
        normal = surface.normal[points.point].float() @ self.poses[:, :3, :3].mT.float()
        facing = (normal * samples.local).sum(-1) < 0
        # Of a mesh with an outside, what a view sees from behind is the far side of something thin, through errors.
        if facing[points.seen].float().mean() > ONE_SIDED:
            points = replace(points, seen=points.seen & facing)
        measured = torch.zeros(points.point.shape, device=depths.device)
        where = samples.pixel
        grid = (2 * where / where.new_tensor(self._size) - 1)[:, None]
        for row, view in enumerate(self._scene.views):
            if view.depth is not None:
                depth = view.depth[None, None].to(where)
                measured[row] = F.grid_sample(depth, grid[row : row + 1], mode="nearest", align_corners=False)[0, 0, 0]
        return Seen(surface, points, measured)

    def step(self, offsets: Tensor, features: Tensor, seen: Seen, scale: int) -> Tensor:
        """The offsets [V] after a Gauss-Newton step. features: `local_contrast` at this shrink factor."""
        mesh, corners = self.moved(offsets), self.mesh.t_pos_idx[seen.surface.face]
        weights = seen.surface.weights.float()
        points = replace(seen.points, position=seen.surface.on(mesh))
        normal = F.normalize((self.normal[corners] * weights[..., None]).sum(1), dim=1)
        counted = ~self.aside[seen.surface.face][points.point]
        evidence, pull = self.evidence(features, seen, points, normal, counted, DEPTH_WEIGHT)

        def to_vertices(value: Tensor) -> Tensor:
            spread = (value[:, None] * weights).flatten()
            return torch.zeros_like(offsets).index_add_(0, corners.flatten(), spread)

        a, b = self.edges.unbind(1)
        mean = to_vertices(evidence)
        mean = mean.sum() / (mean > 0).sum().clamp(min=1) + 1e-12

        def smoothness(d: Tensor) -> Tensor:
            slope = d[a] - d[b]
            smooth = torch.zeros_like(d).index_add_(0, a, slope).index_add_(0, b, -slope)
            return mean * (SMOOTH * smooth + SMALL * d)

        def product(d: Tensor) -> Tensor:
            return to_vertices(evidence * (d[corners] * weights).sum(1)) + smoothness(d)

        squares = (evidence[:, None] * weights.square()).flatten()
        degree = torch.bincount(self.edges.flatten(), minlength=len(offsets)).to(offsets)
        diagonal = torch.zeros_like(offsets).index_add_(0, corners.flatten(), squares)
        diagonal = diagonal + mean * (SMOOTH * degree + SMALL)
        rest = to_vertices(pull) - smoothness(offsets)
        change = conjugate_gradients(product, rest, diagonal, SOLVER_STEPS)
        longest = LARGEST_STEP * scale * self.depth / float(self.K[0, 0, 0])
        most = MOST * self.depth
        return (offsets + change.clamp(-longest, longest)).clamp(-most, most)

    def vector_step(self, offsets: Tensor, seen: Seen, counted: Tensor, held: Tensor) -> Tensor:
        """The offsets [V,3] after a Gauss-Newton step at the finest level, by photographs alone.

        counted: as for `evidence`. held: of `held_at_outlines`.
        """
        mesh, corners = Mesh(self.mesh.v_pos + offsets, self.mesh.t_pos_idx), self.mesh.t_pos_idx[seen.surface.face]
        weights = seen.surface.weights.float()
        points = replace(seen.points, position=seen.surface.on(mesh))
        normal = F.normalize((self.normal[corners] * weights[..., None]).sum(1), dim=1)
        evidence, pull = self.evidence(self.features, seen, points, normal, counted, 0.0)
        lever = (weights[..., None] * normal[:, None]).flatten(0, 1)  # of each corner's offset on its point's

        def to_vertices(value: Tensor) -> Tensor:
            spread = value.repeat_interleave(3)[:, None] * lever
            return torch.zeros_like(offsets).index_add_(0, corners.flatten(), spread)

        a, b = self.edges.unbind(1)
        reaching = (evidence[:, None] * weights).flatten()
        reached = torch.zeros_like(offsets[:, 0]).index_add_(0, corners.flatten(), reaching)
        mean = reached.sum() / (reached > 0).sum().clamp(min=1) + 1e-12

        def smoothness(d: Tensor) -> Tensor:
            slope = d[a] - d[b]
            smooth = torch.zeros_like(d).index_add_(0, a, slope).index_add_(0, b, -slope)
            return mean * (SMOOTH * smooth + SMALL * d + (held @ d[..., None])[..., 0])

        def product(d: Tensor) -> Tensor:
            moved = (d[corners].flatten(0, 1) * lever).sum(1).view(-1, 3).sum(1)
            return to_vertices(evidence * moved) + smoothness(d)

        squares = evidence.repeat_interleave(3)[:, None] * lever.square()
        degree = torch.bincount(self.edges.flatten(), minlength=len(offsets)).to(offsets)[:, None]
        diagonal = torch.zeros_like(offsets).index_add_(0, corners.flatten(), squares)
        diagonal = diagonal + mean * (SMOOTH * degree + SMALL + held.diagonal(dim1=1, dim2=2))
        right = to_vertices(pull) - smoothness(offsets)
        change = conjugate_gradients(product, right, diagonal, SOLVER_STEPS)
        longest = LARGEST_STEP * self.depth / float(self.K[0, 0, 0])
        return _at_most(offsets + _at_most(change, longest), MOST * self.depth)

    def swept(self, used: Tensor) -> Mesh:
        """The mesh by the photographs of views `used` ([V] bool) alone: swept, and then ALONE_STEPS of descent."""
        rows = used.nonzero()[:, 0]
        cameras = [self.cameras[row] for row in rows.tolist()]
        gray = luminance(self._color)[rows]
        mesh = self.moved(sweep_offsets(self.mesh, self.edges, cameras, self._depths[rows], gray, self.depth))
        there = Surface(mesh, self._scene, self._color, self._generator)
        seen = there.look(mesh)
        if seen is None:
            return mesh
        held, offsets = there.held_at_outlines(), torch.zeros_like(mesh.v_pos)
        for _ in range(ALONE_STEPS):
            fit_threads()
            offsets = there.vector_step(offsets, seen, used[:, None], held)
        return Mesh(mesh.v_pos + offsets, mesh.t_pos_idx)

    def held_at_outlines(self) -> Tensor:
        """[V,3,3]: what pulls a vertex's offset back, the sum over the views that see it at an outline, of OUTLINE
        across their rays, shared by all views."""
        held = torch.zeros((len(self.mesh.v_pos), 3, 3), device=self.mesh.v_pos.device)
        for fragments, pose in zip(rasterize_views(self.mesh, self.cameras), self.poses.float(), strict=True):
            hit = fragments.face_index >= 0
            depth = torch.where(hit, fragments.depth, torch.inf)
            faces = fragments.face_index[hit & (greatest(depth, OUTLINE_REACH) > (1 + EDGE_STEP) * depth)].long()
            beside = torch.zeros(len(held), dtype=torch.bool, device=held.device)
            beside[self.mesh.t_pos_idx[faces]] = True
            vertices = beside.nonzero()[:, 0]
            center = -(pose[:3, :3].T @ pose[:3, 3])
            ray = F.normalize(self.mesh.v_pos[vertices] - center, dim=1)
            held[vertices] += torch.eye(3, device=ray.device) - ray[:, :, None] * ray[:, None]
        return OUTLINE / len(self.poses) * held

    def evidence(
        self,
        features: Tensor,
        seen: Seen,
        points: Observations,
        normal: Tensor,
        counted: Tensor,
        depth_weight: float,
    ) -> tuple[Tensor, Tensor]:
        """a and b [P] of each point: how sure it is where it should lie along its normal [P,3], times how far off.

        counted: [V,K] bool or what becomes it, the looks at photographs that have a say.
        """
        samples = sample_points(features, self.K, self.poses, points, self._size)
        residual, weight = residuals(samples.value, samples.valid & counted, points, ROBUST_SCALE)
        local = normal[points.point] @ self.poses[:, :3, :3].mT.float()
        z = samples.local[..., 2].clamp(min=1e-6)
        across = samples.gradient * self.K.diagonal(dim1=1, dim2=2)[:, None, :2].float() / z[..., None]
        along = -(across * samples.local[..., :2]).sum(-1) / z
        jacobian = (across * local[..., :2]).sum(-1) + along * local[..., 2]
        relative = jacobian - weighted_mean(jacobian, weight, points)[0][points.point]
        photo = weight / ROBUST_SCALE**2
        # How far a reading lies from the point's plane.
        off = (seen.measured - samples.local[..., 2]) * (local * samples.local).sum(-1) / z
        read = samples.valid & (seen.measured > 0)
        deviation = 1.4826 * off[read].abs().median().nan_to_num(0.0).clamp(min=LEAST_DEVIATION)
        depth = depth_weight * read / (1 + (off / (2 * deviation)).square()) / deviation.square()
        zero, point = off.new_zeros(len(points.position)), points.point.flatten()
        sure = (photo * relative.square() + depth).flatten()
        pull = (depth * off - photo * relative * residual).flatten()
        return zero.index_add(0, point, sure), zero.index_add(0, point, pull)

    def judged(
        self, found: Mesh, seen: Seen, valid: Tensor, asked: Tensor | None = None
    ) -> tuple[bool, dict[str, Any]]:
        """Whether the photographs agree better on the found mesh where they had no say, and the report about it.

        valid: [V,K] bool, the looks that are compared. asked: as for `check.disagreement`.
        """
        points, values = seen.points, list[Tensor]()
        for mesh in (self.mesh, found):
            placed = replace(points, position=seen.surface.on(mesh), seen=valid)
            samples = sample_points(self.features, self.K, self.poses, placed, self._size)
            values.append(samples.value[..., None])
            valid = samples.valid
        taken = better(values[0], values[1], valid, points, self.cell[seen.surface.face], CONTRAST_SCALE, asked)
        residual = [float(disagreement(value, valid, points, CONTRAST_SCALE, asked).nanmean()) for value in values]
        before, after = (None if math.isnan(mean) else round(mean, 4) for mean in residual)
        return taken, {"residual_before": before, "residual_after": after}


def by_photographs(given: Surface, seen: Seen) -> GeometryRefinement | None:
    """The vertices by photographs alone; None unless views that were set aside agree better with the others."""
    asked = torch.arange(len(given.poses), device=given.poses.device) % ASIDE == ASIDE // 2
    taken, report = given.judged(given.swept(~asked), seen, seen.points.seen, asked)
    return _moved_alone(given, given.swept(torch.ones_like(asked)), report) if taken else None


def swept_again(given: Surface, seen: Seen) -> GeometryRefinement:
    """The vertices by photographs alone, which have been approved of: no view could judge what it has made itself."""
    found = given.swept(torch.ones_like(given.poses[:, 0, 0], dtype=torch.bool))
    return _moved_alone(given, found, given.judged(found, seen, seen.points.seen)[1])


def _moved_alone(given: Surface, found: Mesh, report: dict[str, Any]) -> GeometryRefinement:
    moved = round(1000 * float((found.v_pos - given.mesh.v_pos).norm(dim=1).mean()), 3)
    return GeometryRefinement(found.v_pos.cpu(), {"refined": True, **report, "moved_mm": moved}, alone=True)


def _at_most(vectors: Tensor, length: float) -> Tensor:
    """Vectors [N,3] cut to a length."""
    factor: Tensor = length / vectors.norm(dim=1, keepdim=True).clamp(min=1e-12)
    return vectors * factor.clamp(max=1)

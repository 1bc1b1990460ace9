"""Photographs that are smeared in one region, on a plane whose print is known."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.core.scene import Atlas, Camera, Mesh, View
from advtex_engine.render.render_view import render_view
from advtex_engine.render.view_maps import build_view_maps
from advtex_engine.selection.candidates import NO_VIEW, Candidates, find_candidates
from advtex_engine.selection.detail import BLOCK, LEVELS, MOST, WEIGHT, blur_cost, gradient_tensors, image_metric

SIDE, CELLS = 160, 12
WIDTH, HEIGHT = 160, 128
PLACES = [(-0.1, 0.0, 1.0), (0.1, 0.05, 1.0), (0.0, -0.1, 1.05), (0.05, 0.1, 1.1), (0.0, 0.0, 0.95)]
NEAR = len(PLACES) - 1


@pytest.fixture(scope="module")
def atlas() -> Atlas:
    """A square of .9 m about the origin at z = 0."""
    line = torch.linspace(0, 1, CELLS + 1)
    y, x = torch.meshgrid(line, line, indexing="ij")
    position = torch.stack((x - 0.5, y - 0.5, torch.zeros_like(x)), 2).view(-1, 3) * 0.9
    corner = (torch.arange(CELLS)[:, None] * (CELLS + 1) + torch.arange(CELLS)).flatten()
    a, b, c, d = corner, corner + 1, corner + CELLS + 2, corner + CELLS + 1
    faces = torch.cat((torch.stack((a, b, c), 1), torch.stack((a, c, d), 1)))
    return Atlas(Mesh(position, faces, position[:, :2] / 0.9 * 0.98 + 0.5, faces), SIDE, SIDE, "scan", 1)


def camera(x: float, y: float, distance: float) -> Camera:
    """Looks along +z at the plane from the side where z < 0."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([-x, -y, distance])
    K = torch.tensor([[125.0, 0, WIDTH / 2], [0, 125.0, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64)
    return Camera(K, pose, WIDTH, HEIGHT)


def printed(contrast: float = 0.6) -> Tensor:
    """Noise of about three texels' grain."""
    noise = (torch.rand((1, 3, 54, 54), generator=torch.Generator().manual_seed(2)) - 0.5) * contrast + 0.5
    return F.interpolate(noise, (SIDE, SIDE), mode="bilinear")[0].permute(1, 2, 0)


def patches() -> Tensor:
    """Squares of eight texels, black or white: edges, and nothing finer."""
    squares = torch.rand((1, 1, 20, 20), generator=torch.Generator().manual_seed(3)).round() * 0.6 + 0.2
    return F.interpolate(squares, (SIDE, SIDE)).expand(1, 3, -1, -1)[0].permute(1, 2, 0).contiguous()


def ramp(slope: float) -> Tensor:
    """Luminance that rises along x by `slope` per metre, .5 in the middle."""
    x = ((torch.arange(SIDE) + 0.5) / SIDE - 0.5) / 0.98 * 0.9
    return (0.5 + slope * x)[None, :, None].expand(SIDE, SIDE, 3).contiguous()


def photographs(atlas: Atlas, texture: Tensor, places: list[tuple[float, float, float]]) -> list[View]:
    shots = [camera(*place) for place in places]
    images = [(render_view(atlas, texture, shot, supersample=3) * 255).round().to(torch.uint8) for shot in shots]
    return [View(f"{i}", shot, image) for i, (shot, image) in enumerate(zip(shots, images, strict=True))]


def smeared(image: Tensor, pixels: int = 9) -> Tensor:
    """By a motion to the right."""
    rolled = [image.roll(step - pixels // 2, 1).float() for step in range(pixels)]
    return torch.stack(rolled).mean(0).round().to(torch.uint8)


def costs(atlas: Atlas, views: list[View]) -> tuple[Candidates, Tensor]:
    maps = build_view_maps(atlas, tuple(views), "object")
    candidates = find_candidates(atlas.mesh, maps, 0.01)
    return candidates, blur_cost(atlas.mesh, candidates, maps)


def of_view(values: Tensor, candidates: Candidates, view: int) -> Tensor:
    """[T], nan where the view is no candidate."""
    return torch.where(candidates.view == view, values, torch.nan).nanmean(1)


def test_a_photograph_that_is_smeared_on_the_left_loses_the_left(atlas: Atlas) -> None:
    views = photographs(atlas, printed(), PLACES)
    spoiled = views[NEAR].color.clone()
    spoiled[:, : WIDTH // 2] = smeared(spoiled)[:, : WIDTH // 2]
    views[NEAR] = replace(views[NEAR], color=spoiled)
    candidates, cost = costs(atlas, views)
    x = atlas.mesh.v_pos[atlas.mesh.t_pos_idx].mean(1)[:, 0]
    inner = x.abs() < 0.35
    near = of_view(cost, candidates, NEAR)
    left, right = near[inner & (x < -0.12)], near[inner & (x > 0.12)]
    assert float(left.nanmedian()) > 0.5
    assert float(right.nanmedian()) < 0.1
    others = torch.stack([of_view(cost, candidates, view)[inner] for view in range(NEAR)])
    assert float(others.nanmedian()) < 0.1
    # It is the nearest, and was the best everywhere.
    for total, share in ((candidates.cost, 0.8), (candidates.cost + cost, 0.1)):
        best = candidates.view.gather(1, total.argmin(1)[:, None])[:, 0]
        chosen = (best[inner & (x < -0.12)] == NEAR).float().mean()
        assert (chosen > 0.8) if share == 0.8 else (chosen < share)
        assert (best[inner & (x > 0.12)] == NEAR).float().mean() > 0.5


def test_distance_is_not_blur(atlas: Atlas) -> None:
    """What a view lacks in resolution is in the data term already: an edge is as wide as a pixel is."""
    views = photographs(atlas, patches(), [*PLACES[:NEAR], (0.0, 0.0, 1.9)])
    candidates, cost = costs(atlas, views)
    assert float(of_view(cost, candidates, NEAR).nanmedian()) < 0.2


def test_grain_gains_nothing(atlas: Atlas) -> None:
    views = photographs(atlas, printed(0.1), PLACES)
    plain = costs(atlas, views)
    noise = torch.randn(views[NEAR].color.shape, generator=torch.Generator().manual_seed(1)) * 12
    views[NEAR] = replace(views[NEAR], color=(views[NEAR].color + noise).clamp(0, 255).round().to(torch.uint8))
    candidates, cost = costs(atlas, views)
    assert bool((cost >= 0).all())
    worse = [
        float((of_view(cost, candidates, view) - of_view(plain[1], plain[0], view)).nanmean()) for view in range(4)
    ]
    assert max(worse) < 0.15, "with five candidates the median is moved a little by one"
    assert float(of_view(cost, candidates, NEAR).nanmean()) == pytest.approx(0, abs=1e-3)


def test_nothing_is_said_of_empty_places_and_flat_surfaces(atlas: Atlas) -> None:
    candidates, cost = costs(atlas, photographs(atlas, torch.full((SIDE, SIDE, 3), 0.5), PLACES[:2]))
    assert bool((candidates.view < 0).any()) and bool((candidates.cost[candidates.view < 0] == NO_VIEW).all())
    assert float(cost.abs().max()) < 0.02
    assert bool((cost[candidates.view < 0] == 0).all())


def test_exposure_is_not_blur(atlas: Atlas) -> None:
    views = photographs(atlas, printed(), PLACES)
    usual = costs(atlas, views)
    views[NEAR] = replace(views[NEAR], color=(128 + (views[NEAR].color.float() - 128) / 2).round().to(torch.uint8))
    candidates, cost = costs(atlas, views)
    change = of_view(cost, candidates, NEAR) - of_view(usual[1], usual[0], NEAR)
    assert float(change.nanmean().abs()) < 0.05


def test_a_smeared_photograph_is_told_though_cameras_are_off(atlas: Atlas) -> None:
    """Each shows another piece of the print, one of them smeared."""
    views = photographs(atlas, printed(), PLACES)
    views = [replace(view, color=view.color.roll((4 * i, -5 * i), (0, 1))) for i, view in enumerate(views)]
    usual = costs(atlas, views)
    views[NEAR] = replace(views[NEAR], color=smeared(views[NEAR].color))
    candidates, cost = costs(atlas, views)
    inner = (atlas.mesh.v_pos[atlas.mesh.t_pos_idx].mean(1)[:, :2].abs() < 0.2).all(1)
    assert float(of_view(usual[1], usual[0], NEAR)[inner].nanmedian()) < 0.15
    assert float(of_view(cost, candidates, NEAR)[inner].nanmedian()) > 0.4
    assert float(cost.max()) <= WEIGHT * MOST


def test_a_ramp_is_as_steep_per_metre_from_everywhere(atlas: Atlas) -> None:
    """At every level of the pyramid, and from the side as from the front: .8 per metre along x, none along y."""
    places = [(0.0, 0.0, 0.95), (0.2, -0.1, 1.1), (0.0, 0.1, 1.6)]
    views = photographs(atlas, ramp(0.8), places)
    turn = torch.eye(4, dtype=torch.float64)
    angle = math.radians(30)
    turn[0, 0] = turn[2, 2] = math.cos(angle)
    turn[0, 2], turn[2, 0] = math.sin(angle), -math.sin(angle)
    aside = camera(0.0, 0.0, 1.2)
    aside = replace(aside, world_to_camera=aside.world_to_camera @ turn)
    image = (render_view(atlas, ramp(0.8), aside, supersample=3) * 255).round().to(torch.uint8)
    maps = build_view_maps(atlas, (*views, View("aside", aside, image)), "object")
    center = atlas.mesh.v_pos[atlas.mesh.t_pos_idx].mean(1)
    face = (center[:, :2].abs() < 0.2).all(1).nonzero()[:, 0]
    for view in range(maps.count):
        metric, pixel = image_metric(atlas.mesh, face, maps, view)
        tensors = gradient_tensors(maps, view)
        column, row = (pixel / BLOCK).long().unbind(1)
        xx, xy, yy = tensors[:, :, row, column].unbind(1)
        energy = xx * metric[0] + 2 * xy * metric[1] + yy * metric[2]
        assert energy.shape == (LEVELS, len(face))
        # Rounding to 255 levels adds to the finest; blocks at the borders of the coarsest reach beyond the surface.
        for level in range(1, LEVELS - 1):
            assert float(energy[level].median()) == pytest.approx(0.8**2, rel=0.1), (view, level)

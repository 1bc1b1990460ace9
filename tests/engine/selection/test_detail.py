"""Photographs that are smeared in one region, on a plane whose print is known."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.core.scene import Atlas, Camera, Mesh, View
from advtex_engine.methods.mean import mean_texture
from advtex_engine.render.render_view import render_view
from advtex_engine.render.view_maps import build_view_maps
from advtex_engine.selection.candidates import NO_VIEW, Candidates, find_candidates
from advtex_engine.selection.detail import MOST, blur_cost, compare_detail

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
    return candidates, blur_cost(atlas.mesh, candidates, maps, mean_texture(maps))


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
    """What a view lacks in resolution is in the data term already."""
    views = photographs(atlas, printed(), [*PLACES[:NEAR], (0.0, 0.0, 1.9)])
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


def test_the_ratio_is_that_of_the_amplitudes(atlas: Atlas) -> None:
    """But for grain, which counts as detail on both sides: faint print is a little less far off."""
    strong, faint = printed(0.6), printed(0.3)
    maps = build_view_maps(atlas, tuple(photographs(atlas, strong, PLACES[NEAR:])), "object")
    (beside_strong, same), (beside_faint, fainter) = (compare_detail(maps, texture, 0) for texture in (strong, faint))
    inner = (slice(10, -10), slice(12, -12))
    assert float(beside_strong[inner].abs().median()) < 0.1, "but for what sampling a texture softens"
    assert math.log(2) - 0.2 < float(beside_faint[inner].median()) < math.log(2)
    assert float(beside_faint.abs().max()) <= MOST
    assert min(float(same[inner].min()), float(fainter[inner].min())) > 0.9, "contrast is no matter of likeness"


def test_another_print_is_not_alike(atlas: Atlas) -> None:
    maps = build_view_maps(atlas, tuple(photographs(atlas, printed(), PLACES[NEAR:])), "object")
    likeness = compare_detail(maps, printed().flip(0), 0)[1]
    assert abs(float(likeness[10:-10, 12:-12].mean())) < 0.2
    assert float(likeness.abs().max()) <= 1 + 1e-4


def test_where_views_show_different_things_less_detail_is_no_blur(atlas: Atlas) -> None:
    """Cameras that are off: each photograph shows another piece of print, one of them smeared."""
    views = photographs(atlas, printed(), PLACES)
    views[NEAR] = replace(views[NEAR], color=smeared(views[NEAR].color))
    right = costs(atlas, views)
    wrong = [replace(view, color=view.color.roll((23 * i, 31 * i), (0, 1))) for i, view in enumerate(views)]
    off = costs(atlas, wrong)
    shares = [float(of_view(cost, candidates, NEAR).nanmean()) for candidates, cost in (off, right)]
    assert shares[0] < 0.4 * shares[1], "five views: a fifth of the mean is each one itself"

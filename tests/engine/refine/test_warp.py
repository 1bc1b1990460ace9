"""Smooth corrections of photographs: known warps are found, exact images stay, and the solver against a plain twin."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor
from wavy_sheet import HEIGHT, WIDTH, camera_over, paint, sheet

from advtex_engine.core.config import PRESETS, TextureConfig
from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import Atlas, Camera, Mesh, Scene, View
from advtex_engine.methods import MethodInput, texture_function
from advtex_engine.methods.mean import mean_texture
from advtex_engine.previews.live import Live
from advtex_engine.refine.points import Observations
from advtex_engine.refine.pose import sample_points
from advtex_engine.refine.run import apply_refinement, refine_cameras
from advtex_engine.refine.warp import COLUMNS, SMALL, SMOOTH, fit_offsets, solve_offsets, warp_view, warp_views
from advtex_engine.refine.working_views import working_views
from advtex_engine.render.rasterize import rasterize
from advtex_engine.render.texture import bilinear_footprint
from advtex_engine.render.view_maps import build_view_maps
from advtex_engine.runtime.checkpoint import WorkFolder

VIEWS = 8
WARPED = 2  # one view alone: the place that all agree on is that of the others
SIDE = 400  # texels, of a centimetre
CPU = torch.device("cpu")


def pixels() -> Tensor:
    """Centers [HEIGHT,WIDTH,2]."""
    x, y = torch.meshgrid(torch.arange(WIDTH) + 0.5, torch.arange(HEIGHT) + 0.5, indexing="xy")
    return torch.stack((x, y), -1)


def field(pixel: Tensor) -> Tensor:
    """Smooth offsets [...,2] of up to 2.4 pixels."""
    x, y = pixel.unbind(-1)
    return torch.stack((1.7 * torch.sin(x / 22) * torch.cos(y / 30), 1.7 * torch.cos(x / 28 + y / 35)), -1)


def photograph(mesh: Mesh, camera: Camera, name: str, *, warped: bool = False) -> View:
    """What the camera sees; if warped, what it should show at x is at x + field(x)."""
    fragments = rasterize(mesh, camera)
    corners = mesh.v_pos[mesh.t_pos_idx[fragments.face_index.clamp(min=0).long()]]
    place = (corners * fragments.barycentric[..., None]).sum(2)
    assert (fragments.face_index >= 0).all()
    if warped:
        source = pixels()
        for _ in range(20):  # the inverse of x -> x + field(x)
            source = pixels() - field(source)
        grid = 2 * source / torch.tensor([WIDTH, HEIGHT]) - 1
        image = place.permute(2, 0, 1)[None]
        place = F.grid_sample(image, grid[None], padding_mode="border", align_corners=False)[0].permute(1, 2, 0)
    return View(name, camera, (paint(place) * 255).round().to(torch.uint8))


@pytest.fixture(scope="module")
def exact() -> Scene:
    mesh = sheet(4.0, 60, (0.1, 5, 4, 1))
    return Scene(mesh, tuple(photograph(mesh, camera_over(i, VIEWS), f"view{i}") for i in range(VIEWS)))


@pytest.fixture(scope="module")
def bent(exact: Scene) -> Scene:
    """The scene with one photograph that is warped."""
    other = photograph(exact.mesh, camera_over(WARPED, VIEWS), f"view{WARPED}", warped=True)
    return replace(exact, views=(*exact.views[:WARPED], other, *exact.views[WARPED + 1 :]))


Corrected = tuple[tuple[View, ...], dict[str, Any]]


@pytest.fixture(scope="module")
def untouched(exact: Scene) -> Corrected:
    return warp_views(exact.mesh, exact.views, exact.kind, CPU, 0)


@pytest.fixture(scope="module")
def corrected(bent: Scene) -> Corrected:
    return warp_views(bent.mesh, bent.views, bent.kind, CPU, 0)


def noise() -> Tensor:
    blocks = torch.randint(60, 190, (15, 20, 3), generator=torch.Generator().manual_seed(9), dtype=torch.uint8)
    return blocks.repeat_interleave(8, 0).repeat_interleave(8, 1)


def test_a_known_warp_is_taken_back(exact: Scene, bent: Scene, untouched: Corrected, corrected: Corrected) -> None:
    views, report = corrected
    before, after = (report[key] - untouched[1]["residual_before"] for key in ("residual_before", "residual_after"))
    assert after < 0.2 * before
    assert 1.5 < report["largest_pixels"] < 3.5
    inner = slice(10, -10)
    wrong = [
        [(view.color.float() - true.color.float())[inner, inner].abs().mean() for view in (old, new)]
        for old, new, true in zip(bent.views, views, exact.views, strict=True)
    ]
    assert wrong[WARPED][1] < 0.3 * wrong[WARPED][0]
    assert max(after for _, after in wrong) < 0.3 * wrong[WARPED][0], "the others stay about where they are"
    assert all(new.camera is old.camera for new, old in zip(views, bent.views, strict=True))
    json.dumps(report, allow_nan=False)


def test_the_offsets_are_those_of_the_warp(bent: Scene) -> None:
    working = working_views(bent.mesh, bent.views, bent.kind, CPU, 0)
    assert working is not None
    seen = sample_points(working.features, working.K, working.given, working.fitted, working.size)
    offsets = fit_offsets(working.luminance, seen.pixel, replace(working.fitted, seen=seen.valid))
    grid = 2 * pixels() / torch.tensor([WIDTH, HEIGHT]) - 1
    dense = F.grid_sample(offsets[WARPED].permute(2, 0, 1)[None], grid[None], align_corners=True)[0].permute(1, 2, 0)
    inner = slice(10, -10)
    wrong, true = ((part[inner, inner].norm(dim=-1)).mean() for part in (dense - field(pixels()), field(pixels())))
    assert wrong < 0.3 * true


def test_exact_images_stay(exact: Scene, untouched: Corrected) -> None:
    views, report = untouched
    assert report["median_pixels"] < 0.05
    assert report["largest_pixels"] < 0.3
    for new, old in zip(views, exact.views, strict=True):
        assert new is old or (new.color.float() - old.color.float()).abs().mean() < 2


def test_the_same_input_gives_the_same_views(bent: Scene, corrected: Corrected) -> None:
    views, report = warp_views(bent.mesh, bent.views, bent.kind, CPU, 0)
    assert report == corrected[1]
    assert all(torch.equal(a.color, b.color) for a, b in zip(views, corrected[0], strict=True))


def test_what_shares_nothing_with_the_others_is_left_as_it_is(bent: Scene) -> None:
    """A photograph of something else, and a camera that samples elsewhere."""
    something = replace(bent.views[3], name="something", color=noise())
    away = replace(bent.views[0].camera, world_to_camera=torch.eye(4, dtype=torch.float64))
    lost = replace(bent.views[0], name="lost", camera=away)
    given = (*bent.views[:3], something, *bent.views[4:], lost)
    views, report = warp_views(bent.mesh, given, bent.kind, CPU, 0)
    assert views[3] is something
    assert views[-1] is lost
    assert {"something", "lost"} <= set(report["unwarped"])
    assert views[WARPED] is not given[WARPED], "the others are none the worse for it"
    alone, report = warp_views(bent.mesh, bent.views[:1], bent.kind, CPU, 0)
    assert alone[0] is bent.views[0]
    assert report == {"unwarped": ["view0"]}


def test_a_view_is_moved_by_its_offsets_and_its_mask_with_it(exact: Scene) -> None:
    """By whole pixels, so that nothing is interpolated."""
    offsets = torch.tensor([3.0, -2.0]).expand(13, COLUMNS, 2)
    mask = torch.ones((HEIGHT, WIDTH), dtype=torch.bool)
    mask[40:50, 70:90] = False
    view = exact.views[0]
    moved = warp_view(replace(view, mask=mask), offsets)
    assert torch.equal(moved.color[2:, :-3], view.color[:-2, 3:])
    expected = torch.zeros_like(mask)
    expected[2:, :-3] = mask[:-2, 3:]
    assert moved.mask is not None
    assert torch.equal(moved.mask, expected)
    still = warp_view(view, torch.zeros((13, COLUMNS, 2)))
    assert torch.equal(still.color, view.color)
    assert still.mask is not None
    assert still.mask.all()


def test_the_step_is_the_least_of_what_it_minimizes() -> None:
    """Against autograd and torch's own bilinear interpolation, for 3 views of 40 points and 5 x 4 nodes."""
    generator = torch.Generator().manual_seed(0)

    def drawn(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    place = torch.rand((3, 40, 2), generator=generator, dtype=torch.float64)
    gradient, residual, weight, offsets = drawn(3, 40, 2), drawn(3, 40), drawn(3, 40).square(), drawn(3, 4, 5, 2)
    nodes, share = bilinear_footprint((place * torch.tensor([4.0, 3.0]) + 0.5).flatten(0, 1), 5, 4)
    found = solve_offsets(gradient, residual, weight, nodes.view(3, 40, 4), share.view(3, 40, 4), offsets)
    evidence = (weight[..., None] * gradient.square()).sum() / offsets.numel()

    def energy(step: Tensor) -> Tensor:
        at = F.grid_sample(step.permute(0, 3, 1, 2), (2 * place - 1)[:, :, None], align_corners=True)[..., 0].mT
        data = (weight * (residual + (gradient * at).sum(-1)).square()).sum()
        new = offsets + step
        smooth = new.diff(dim=1).square().sum() + new.diff(dim=2).square().sum()
        return data + evidence * (SMALL * new.square().sum() + SMOOTH * smooth)

    slopes = []
    for step in (torch.zeros_like(found), found):
        step.requires_grad_(True)
        slopes.append(torch.autograd.grad(energy(step), step)[0].abs().max())
    assert slopes[1] < 1e-7 * slopes[0]


def test_the_fit_without_evidence_does_not_move() -> None:
    point = torch.zeros((2, 5), dtype=torch.int64)
    points = Observations(torch.zeros((1, 3), dtype=torch.float64), point, torch.zeros_like(point, dtype=torch.bool))
    offsets = fit_offsets(torch.rand(2, HEIGHT, WIDTH), torch.full((2, 5, 2), 50.0), points)
    assert torch.equal(offsets, torch.zeros((2, 13, COLUMNS, 2)))


def test_with_wrong_geometry_colormap_is_closer_to_the_truth_than_the_mean(exact: Scene, tmp_path: Path) -> None:
    """The hills are taken for a plane: what is 10 cm off moves in the views by several pixels."""
    scene = replace(exact, mesh=sheet(4.0, 60, (0.0, 5, 4, 1)))
    scene = apply_refinement(scene, refine_cameras(scene, CPU, 0))
    atlas = Atlas(scene.mesh, SIDE, SIDE, "scan", 1)
    maps = build_view_maps(atlas, scene.views, scene.kind)
    monitor = Monitor()
    given = MethodInput(
        scene,
        atlas,
        {1: maps},
        {1: mean_texture(maps)},
        PRESETS["preview"],
        TextureConfig(method="colormap"),
        monitor,
        WorkFolder(tmp_path, "", monitor),
        Live(scene, atlas, monitor),
    )
    texture, _ = texture_function("colormap")(given)
    side = (torch.arange(SIDE) + 0.5) / SIDE * 4 - 2
    truth = paint(torch.stack(torch.meshgrid(side, side, indexing="xy"), -1))
    inner = slice(SIDE // 3, -SIDE // 3)
    mean, better, true = (part[inner, inner] for part in (given.means[1], texture, truth))
    assert (better - true).abs().mean() < 0.9 * (mean - true).abs().mean()
    blurs = [(true.diff(dim=0).abs().mean() - each.diff(dim=0).abs().mean()).abs() for each in (mean, better)]
    assert blurs[1] < 0.6 * blurs[0], "where all agree now is not quite the truth, but they agree"
    warp = given.facts["refinement"]["warp"]
    assert warp["residual_after"] < 0.8 * warp["residual_before"]
    assert 0 < warp["median_pixels"] < warp["largest_pixels"] < 10

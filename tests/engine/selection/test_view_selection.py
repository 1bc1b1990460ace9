"""The method on a plane whose texture is known, seen by good and bad photographs; and on a real scan."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.core.config import PRESETS, TextureConfig
from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import Atlas, Camera, Mesh, Scene, View
from advtex_engine.methods import MethodInput, texture_function
from advtex_engine.methods.mean import mean_texture
from advtex_engine.methods.selected import Selection, select_views, with_detail
from advtex_engine.methods.view_selection import view_selection_no_descent
from advtex_engine.metrics.image_metrics import gradient_ratio
from advtex_engine.metrics.photograph import Photograph
from advtex_engine.pipeline import texture_scan
from advtex_engine.previews.live import Live
from advtex_engine.render.render_view import render_layers, render_view
from advtex_engine.render.view_maps import build_view_maps
from advtex_engine.runtime.checkpoint import WorkFolder
from advtex_options.methods import METHOD_HELP

DATA = Path(os.environ.get("ADVTEX_DATA", Path(__file__).parents[3] / "../shared/data"))
SIDE, CELLS = 128, 10
WIDTH, HEIGHT = 160, 128


def plane() -> Atlas:
    """The unit square about the origin at z = 0, its texture as it lies, and a square far below that nobody sees."""
    line = torch.linspace(0, 1, CELLS + 1)
    y, x = torch.meshgrid(line, line, indexing="ij")
    position = torch.stack((x - 0.5, y - 0.5, torch.zeros_like(x)), 2).view(-1, 3)
    corner = (torch.arange(CELLS)[:, None] * (CELLS + 1) + torch.arange(CELLS)).flatten()
    a, b, c, d = corner, corner + 1, corner + CELLS + 2, corner + CELLS + 1
    faces = torch.cat((torch.stack((a, b, c), 1), torch.stack((a, c, d), 1)))
    uv = (position[:, :2] + 0.5) * 0.7
    hidden = torch.tensor([[-0.1, -0.1, 1.0], [0.1, -0.1, 1.0], [0.1, 0.1, 1.0]])
    hidden_uv = torch.tensor([[0.8, 0.8], [0.95, 0.8], [0.95, 0.95]])
    more = torch.tensor([[0, 1, 2]]) + len(position)
    faces = torch.cat((faces, more))
    return Atlas(Mesh(torch.cat((position, hidden)), faces, torch.cat((uv, hidden_uv)), faces), SIDE, SIDE, "scan", 2)


def camera(x: float, y: float, distance: float) -> Camera:
    """Looks along +z at the plane from the side where z < 0."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([-x, -y, distance])
    K = torch.tensor([[110.0, 0, WIDTH / 2], [0, 110.0, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64)
    return Camera(K, pose, WIDTH, HEIGHT)


def truth() -> Tensor:
    """Noise of about three texels' grain, in [0.2, 0.8]."""
    noise = torch.rand((1, 3, 44, 44), generator=torch.Generator().manual_seed(2)) * 0.6 + 0.2
    return F.interpolate(noise, (SIDE, SIDE), mode="bilinear")[0].permute(1, 2, 0)


def photograph(atlas: Atlas, shot: Camera) -> Tensor:
    return (render_view(atlas, truth(), shot, supersample=3) * 255).round().to(torch.uint8)


def given(tmp_path: Path, views: list[View], atlas: Atlas | None = None) -> MethodInput:
    atlas = atlas or plane()
    scene = Scene(atlas.mesh, tuple(views), kind="object")
    maps = {1: build_view_maps(atlas, scene.views, scene.kind)}
    monitor = Monitor()
    work, live = WorkFolder(tmp_path / "work", "test", monitor), Live(scene, atlas, monitor)
    means = {1: mean_texture(maps[1])}
    return MethodInput(scene, atlas, maps, means, PRESETS["standard"], TextureConfig(), monitor, work, live)


def good_views(atlas: Atlas) -> list[View]:
    places = [(-0.15, 0.0, 0.9), (0.15, 0.05, 0.9), (0.0, -0.12, 0.95), (0.05, 0.12, 1.0)]
    shots = [camera(*place) for place in places]
    return [View(f"good{i}", shot, photograph(atlas, shot)) for i, shot in enumerate(shots)]


def error(selection: Selection) -> float:
    """Mean absolute difference from the truth over the seen plane's inner texels, of 255."""
    inner = slice(6, int(0.7 * SIDE) - 6)
    return float((selection.texture - truth())[inner, inner].abs().mean()) * 255


def test_the_method_is_registered() -> None:
    assert texture_function("view_selection_no_descent") is view_selection_no_descent
    assert "view_selection_no_descent" in METHOD_HELP


def test_good_photographs_give_the_truth_back(tmp_path: Path) -> None:
    atlas = plane()
    asked = given(tmp_path, good_views(atlas))
    selection = select_views(asked)
    assert error(selection) < 4
    assert selection.texture.shape == (SIDE, SIDE, 3)
    assert bool(((selection.texture >= 0) & (selection.texture <= 1)).all())
    texture, losses = view_selection_no_descent(asked)
    detailed = with_detail(selection.texture, selection.painted, asked.maps[1])
    assert torch.equal(texture, detailed), "the same input gives the same texture"
    assert error(replace(selection, texture=texture)) < error(selection)
    assert losses == []


def test_what_nobody_sees_is_marked_and_filled(tmp_path: Path) -> None:
    selection = select_views(given(tmp_path, good_views(plane())))
    hidden = int(0.93 * SIDE), int(0.9 * SIDE)
    assert selection.painted[hidden[1], hidden[0]] == -1
    assert not selection.known[hidden[1], hidden[0]]
    assert selection.confidence[hidden[1], hidden[0]] == 0
    assert float(selection.texture[hidden[1], hidden[0]].min()) > 0.1
    assert bool(selection.known[10:80, 10:80].all())
    assert bool((selection.confidence[~selection.known] == 0).all())
    assert float(selection.confidence[10:80, 10:80].min()) > 0


def bad_view(kind: str, atlas: Atlas) -> View:
    """Nearer than the good views, so that only its fault speaks against it."""
    shot = camera(0.0, 0.0, 0.85)
    image = photograph(atlas, shot)
    if kind == "blurred":
        soft = F.avg_pool2d(image.permute(2, 0, 1)[None].float(), 9, 1, 4, count_include_pad=False)
        image = soft[0].permute(1, 2, 0).to(torch.uint8)
    elif kind == "wrong color":
        image = torch.cat((255 - image[..., :1], image[..., 1:] // 3), 2)
    elif kind == "occluded":
        image[40:90, 50:110] = torch.tensor([250, 20, 20], dtype=torch.uint8)
    return View(kind, shot, image)


@pytest.mark.parametrize("kind", ["blurred", "wrong color", "occluded"])
def test_a_bad_photograph_spoils_little(tmp_path: Path, kind: str) -> None:
    atlas = plane()
    views = good_views(atlas)
    clean = select_views(given(tmp_path, views))
    bad = bad_view(kind, atlas)
    spoiled = select_views(given(tmp_path, [*views, bad]))
    alone = select_views(given(tmp_path, [bad]))
    assert error(alone) > 2 * error(clean), "the photograph is really bad"
    assert error(spoiled) - error(clean) < 0.2 * (error(alone) - error(clean))


def test_an_occluder_known_from_device_depth_is_never_sampled(tmp_path: Path) -> None:
    atlas = plane()
    shot = camera(0.0, 0.0, 0.9)
    image, depth = photograph(atlas, shot), torch.full((HEIGHT, WIDTH), 0.9)
    image[50:80, 60:100] = torch.tensor([255, 0, 0], dtype=torch.uint8)
    depth[50:80, 60:100] = 0.5
    selection = select_views(given(tmp_path, [View("hand", shot, image, depth)]))
    red = (selection.texture[..., 0] > 0.9) & (selection.texture[..., 1] < 0.1) & selection.known
    assert int(red.sum()) < 30  # bicubic samples at the rim
    assert int((selection.painted[10:80, 10:80] == -1).sum()) > 100


def test_views_of_different_exposure_leave_no_patchwork(tmp_path: Path) -> None:
    """A flat gray plane: whatever varies over the texture is seams."""
    shots = [camera(x, y, 0.8) for x in (-0.25, 0.25) for y in (-0.2, 0.2)]
    views = []
    for index, shot in enumerate(shots):
        gray = torch.full((HEIGHT, WIDTH, 3), 120 + 6 * index, dtype=torch.uint8)
        views.append(View(f"{index}", shot, gray))
    selection = select_views(given(tmp_path, views))
    assert len(set(selection.painted.flatten().tolist()) - {-1}) > 1, "there are seams to hide"
    inner = selection.texture[6:80, 6:80]
    steps = torch.cat((inner.diff(dim=0).abs().flatten(), inner.diff(dim=1).abs().flatten())) * 255
    assert float(steps.max()) < 2.5
    assert float(inner.min()) > 118 / 255
    assert float(inner.max()) < 140 / 255


def test_resting_on_one_view_keeps_its_sharpness(tmp_path: Path) -> None:
    """Cameras that are a pixel off blur an average; a selection stays as sharp as its photographs."""
    atlas = plane()
    views = [
        replace(view, color=view.color.roll((index % 3 - 1, index // 2 - 1), (0, 1)))
        for index, view in enumerate(good_views(atlas))
    ]
    selection = select_views(given(tmp_path, views))
    shot = camera(0.0, 0.0, 0.9)
    render = render_layers(atlas, selection.texture, shot)[0]
    photo = photograph(atlas, shot).float() / 255
    mask = torch.zeros((HEIGHT, WIDTH), dtype=torch.bool)
    mask[30:100, 40:120] = True
    assert 0.85 < gradient_ratio(render, Photograph(photo, mask)) < 1.15


@pytest.mark.data
@pytest.mark.slow
def test_a_real_scan_beats_averaging(tmp_path: Path) -> None:
    scan = DATA / "scans" / "shelf_bin"
    if not scan.exists():
        pytest.skip(f"no sample scan at {scan}")
    config = TextureConfig(method="view_selection", size=(320, 240), holdout=5, face_budget=8_000, refine=False)
    report = texture_scan(scan, tmp_path / "out", config, work=tmp_path / "work").report
    scores = report["heldout"]
    assert 0.75 < scores["texture"]["gradient_ratio"] < 1.25
    assert abs(scores["texture"]["gradient_ratio"] - 1) < abs(scores["mean"]["gradient_ratio"] - 1)

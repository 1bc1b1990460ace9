"""Each method on small scenes whose right answer is known: which view a face gets, what color a texel takes."""

from __future__ import annotations

import importlib
import itertools
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine import methods
from advtex_engine.adversarial.disagreement import disagreement
from advtex_engine.adversarial.discriminator import PatchDiscriminator
from advtex_engine.adversarial.optimizer import AdversarialOptimizer, crop_size
from advtex_engine.adversarial.probes import LeftOutCells
from advtex_engine.core.config import PRESETS, PRINTED, PyramidLevel, TextureConfig
from advtex_engine.core.errors import EngineError, Problem, Stopped
from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import Atlas, Camera, Mesh, Scene, View
from advtex_engine.methods import LossPoint, MethodInput, descent, gabor, selected, texture_function
from advtex_engine.methods.best_view import label_faces
from advtex_engine.methods.gabor import BLOCK, PASSES, TOGETHER
from advtex_engine.methods.mean import mean_texture
from advtex_engine.methods.selected import select_views, selected_start, with_detail
from advtex_engine.methods.sharpest import sharpness
from advtex_engine.methods.vgg import WEIGHTS_VARIABLE, load_vgg
from advtex_engine.methods.view_selection import view_selection
from advtex_engine.metrics.lpips import NETWORKS, WeightsError, load_features
from advtex_engine.pipeline import texture_scan
from advtex_engine.previews.live import Live
from advtex_engine.render.motion import Taps, smeared
from advtex_engine.render.motion import _taps as motion_taps
from advtex_engine.render.pairs import own_pairs
from advtex_engine.render.rasterize import rasterize
from advtex_engine.render.render_view import render_view
from advtex_engine.render.texels import map_texels
from advtex_engine.render.texture import sample_texels
from advtex_engine.render.view_maps import ViewMaps, build_view_maps
from advtex_engine.runtime.checkpoint import WorkFolder
from advtex_engine.runtime.threads import threads_each
from advtex_engine.selection import shared_detail
from advtex_engine.synthetic.patches import look_at
from advtex_engine.synthetic.planar import planar_maps
from advtex_engine.synthetic.scan import synthesize
from advtex_options.methods import BUILT_IN, Method, known_methods

SIDE, CELLS = 96, 8  # texels of the plane's side, and its quads
WIDTH, HEIGHT = 96, 80


def quads(z: float, left: float, right: float, cells: int) -> tuple[Tensor, Tensor]:
    """A square grid of cells x cells quads in the plane of height z: positions and faces."""
    x, y = torch.meshgrid(torch.linspace(left, right, cells + 1), torch.linspace(0, 1, cells + 1), indexing="xy")
    position = torch.stack((x, y, torch.full_like(x, z)), 2).view(-1, 3)
    corner = (torch.arange(cells)[:, None] * (cells + 1) + torch.arange(cells)).flatten()
    a, b, c, d = corner, corner + 1, corner + cells + 2, corner + cells + 1
    return position, torch.cat((torch.stack((a, b, c), 1), torch.stack((a, c, d), 1)))


def plane() -> Atlas:
    """The unit square at height 0, its texture as it lies: u along x, v along y."""
    position, faces = quads(0.0, 0.0, 1.0, CELLS)
    return Atlas(Mesh(position, faces, position[:, :2].clone(), faces), SIDE, SIDE, "scan", 1)


def truth() -> Tensor:
    """Smooth noise [SIDE,SIDE,3], so that bilinear interpolation is nearly exact."""
    noise = torch.rand((1, 3, 9, 9), generator=torch.Generator().manual_seed(1))
    return F.interpolate(noise, (SIDE, SIDE), mode="bicubic", align_corners=True).clamp(0, 1)[0].permute(1, 2, 0)


def camera(eye: tuple[float, float, float], target: tuple[float, float, float] = (0.5, 0.5, 0.0)) -> Camera:
    pose = torch.from_numpy(look_at(np.array(eye), np.array(target)))
    K = torch.tensor([[90.0, 0, WIDTH / 2], [0, 90.0, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64)
    return Camera(K, pose, WIDTH, HEIGHT)


def view(name: str, atlas: Atlas, texture: Tensor, place: Camera) -> View:
    image = render_view(atlas, texture, place, supersample=1)
    return View(name, place, (image * 255).round().clamp(0, 255).to(torch.uint8))


def task(
    atlas: Atlas, views: tuple[View, ...], work: Path, *, monitor: Monitor | None = None, **config: object
) -> MethodInput:
    maps = build_view_maps(atlas, views, "scene")
    listener = monitor or Monitor()
    preset = replace(PRINTED, levels=(PyramidLevel(3),), start="mean")
    scene = Scene(atlas.mesh, views)
    return MethodInput(
        scene,
        atlas,
        {1: maps},
        {1: mean_texture(maps)},
        preset,
        TextureConfig(**config),  # type: ignore[arg-type]  # keywords of one test each
        listener,
        WorkFolder(work, "", listener),
        Live(scene, atlas, listener),
    )


@pytest.fixture
def around(tmp_path: Path) -> MethodInput:
    """The plane, seen without any error from five places."""
    atlas, texture = plane(), truth()
    eyes = [(0.5, 0.45, 1.0), (0.1, 0.5, 1.1), (0.9, 0.5, 1.2), (0.5, 0.0, 1.3), (0.45, 0.9, 1.1)]
    views = tuple(view(str(number), atlas, texture, camera(eye)) for number, eye in enumerate(eyes))
    return task(atlas, views, tmp_path)


@pytest.mark.parametrize("method", BUILT_IN, ids=lambda method: method.name)
def test_what_a_record_names_is_there(method: Method) -> None:
    for place in filter(None, (method.function, method.weights)):
        module, _, function = place.partition(":")
        assert module.startswith("advtex_engine.methods.")
        assert callable(getattr(importlib.import_module(module), function))


def test_a_method_whose_function_is_gone_is_told_before_anything_is_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gone = replace(known_methods()["mean"], function="no_such_package:mean")
    monkeypatch.setattr(methods, "known_methods", lambda: {"mean": gone})
    words = "the method mean cannot be used: no_such_package:mean is not there .*; update or reinstall the package"
    with pytest.raises(EngineError, match=words):
        texture_scan(tmp_path, tmp_path / "out", TextureConfig(method="mean"), work=tmp_path / "work")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["mean", "l1", "best_view", "sharpest"])
def test_without_errors_every_method_finds_the_texture(name: str, around: MethodInput) -> None:
    texture, _ = texture_function(name)(around)
    assert texture.shape == (SIDE, SIDE, 3)
    seen = around.maps[1].slot_map >= 0
    assert (texture - truth())[seen].abs().mean() < 0.01
    assert (texture - truth())[seen].abs().quantile(0.99) < 0.05


def test_selection_alone_tells_where_it_shows_a_photograph_and_where_it_filled(tmp_path: Path) -> None:
    atlas, texture = plane(), truth()
    # From close by, the view's border leaves faces of which less is seen than a photograph must show to be chosen.
    given = task(atlas, (view("near", atlas, texture, camera((0.4, 0.45, 0.5))),), tmp_path)
    found, _ = texture_function("view_selection_no_descent")(given)
    known, touched = given.facts["known"], given.maps[1].slot_map >= 0
    assert 0.1 < known.float().mean() < 0.9
    assert (found - texture)[known & touched].abs().quantile(0.99) < 0.05
    assert (touched & ~known).any(), "what is filled counts as a guess, though a view touches it"


def test_a_wall_of_two_faces_shows_what_photographs_from_close_by_show_of_it(tmp_path: Path) -> None:
    corners = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    atlas, texture = Atlas(Mesh(corners, faces, corners[:, :2].clone(), faces), SIDE, SIDE, "scan", 1), truth()
    far = view("far", atlas, texture, camera((0.5, 0.45, 1.6)))
    near = [
        view(f"{x} {y}", atlas, texture, camera((x, y - 0.01, 0.6), (x, y, 0)))
        for x in (0.3, 0.7)
        for y in (0.31, 0.69)
    ]
    fine = replace(atlas, width=4 * SIDE, height=4 * SIDE)
    selection = select_views(task(fine, (far, *near), tmp_path))
    assert (selection.painted > 0).float().mean() > 0.7


def test_a_wall_of_two_faces_goes_to_the_views_that_show_its_parts_largest(tmp_path: Path) -> None:
    corners = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    atlas = Atlas(Mesh(corners, faces, corners[:, :2].clone(), faces), SIDE, SIDE, "scan", 1)
    ones = torch.ones((SIDE, SIDE, 3))
    black = view("far", atlas, 0 * ones, camera((0.5, 0.45, 1.6)))
    places = [(x / 6, y / 6) for x in (1, 3, 5) for y in (1, 3, 5)]
    white = [view(f"{x} {y}", atlas, ones, camera((x, y - 0.01, 0.35), (x, y, 0))) for x, y in places]
    texture, _ = texture_function("best_view")(task(atlas, (black, *white), tmp_path))
    assert texture.mean() > 0.9


def test_a_face_goes_to_the_view_that_shows_it_on_most_pixels(around: MethodInput) -> None:
    """Against pixels counted in a rendering of face indices."""
    atlas, maps = around.atlas, around.maps[1]
    labels = label_faces(maps, atlas, map_texels(atlas), lambda _view, area: area)
    faces = len(atlas.mesh.t_pos_idx)
    counts = []
    for each in around.scene.views:
        index = rasterize(atlas.mesh, each.camera).face_index
        counts.append(torch.bincount(index[index >= 0].long(), minlength=faces))
    ordered, best = torch.stack(counts).sort(0, descending=True)
    clear = ordered[0] > 1.25 * ordered[1]
    assert clear.sum() > 20
    assert torch.equal(labels[clear], best[0][clear])
    assert len(labels.unique()) > 1  # type: ignore[no-untyped-call]


def test_a_hidden_face_goes_to_a_view_that_sees_it(tmp_path: Path) -> None:
    """A board hangs over the left half: the nearer camera, above it, does not see what lies below."""
    lower, lower_faces = quads(0.0, 0.0, 1.0, CELLS)
    upper, upper_faces = quads(0.3, -0.2, 0.5, CELLS)
    position = torch.cat((lower, upper))
    faces = torch.cat((lower_faces, upper_faces + len(lower)))
    uv = torch.cat((lower[:, :2] * 0.45 + 0.02, torch.stack((upper[:, 0] * 0.4 + 0.6, upper[:, 1] * 0.45), 1)))
    atlas = Atlas(Mesh(position, faces, uv, faces), 2 * SIDE, 2 * SIDE, "scan", 2)
    texture = torch.rand((2 * SIDE, 2 * SIDE, 3), generator=torch.Generator().manual_seed(0))
    above, below = camera((0.5, 0.45, 1.0)), camera((1.6, 0.5, 0.25))
    given = task(atlas, (view("above", atlas, texture, above), view("below", atlas, texture, below)), tmp_path)
    labels = label_faces(given.maps[1], atlas, map_texels(atlas), lambda _view, area: area)
    middle = position[faces].mean(1)
    floor = torch.arange(len(faces)) < len(lower_faces)
    central = (middle[:, 1] - 0.5).abs() < 0.3
    hidden = floor & (middle[:, 0] > 0.1) & (middle[:, 0] < 0.35)
    assert not (labels[hidden] == 0).any()
    assert (labels[hidden] == 1).any()
    assert (labels[floor & central & (middle[:, 0] > 0.6)] == 0).all()
    assert (labels[~floor & central & (middle[:, 0] > 0.2)] == 0).all(), "the board itself is seen from above"


def test_the_sharpest_photograph_wins_over_a_nearer_blurred_one(tmp_path: Path) -> None:
    atlas = plane()
    texture = torch.rand((SIDE, SIDE, 3), generator=torch.Generator().manual_seed(3))
    near, far = (view(str(z), atlas, texture, camera((0.5, 0.45, z))) for z in (1.0, 1.15))
    planes = near.color.permute(2, 0, 1)[None].float()
    blurred = F.avg_pool2d(planes, 7, 1, 3, count_include_pad=False)[0].permute(1, 2, 0).round().to(torch.uint8)
    given = task(atlas, (replace(near, color=blurred), far), tmp_path)
    nearest, _ = texture_function("best_view")(given)
    sharpest, _ = texture_function("sharpest")(given)

    def contrast(image: Tensor) -> float:
        return float(image[20:-20, 20:-20].std())

    assert contrast(sharpest) > 2 * contrast(nearest)


def test_sharpness_falls_with_blur_and_knows_no_exposure(around: MethodInput) -> None:
    maps = around.maps[1]
    image = maps.color[0].view(HEIGHT, WIDTH, 3).permute(2, 0, 1)[None].float()
    noisy = (image + 40 * torch.randn(image.shape, generator=torch.Generator().manual_seed(0))).clamp(0, 255)
    soft = F.avg_pool2d(noisy, 5, 1, 2, count_include_pad=False)
    values = []
    for picture in (noisy, noisy * 0.6, soft):
        rows = picture[0].permute(1, 2, 0).round().to(torch.uint8).reshape(1, -1, 3)
        values.append(sharpness(replace(maps, color=rows), 0))
    assert values[1] == pytest.approx(values[0], abs=0.01)
    assert 0 <= values[2] < 0.8 * values[0] < 1
    flat = torch.full((1, HEIGHT * WIDTH, 3), 90, dtype=torch.uint8)
    assert 0 <= sharpness(replace(maps, color=flat), 0) <= 1


def flat_task(work: Path, monitor: Monitor | None = None, **config: object) -> tuple[MethodInput, Tensor]:
    """Five photographs of the same 24x32 texels that agree in nothing, one texel per pixel."""
    color = torch.randint(0, 256, (5, 24, 32, 3), generator=torch.Generator().manual_seed(2), dtype=torch.uint8)
    maps = planar_maps(color, 32, 24)
    given = task(plane(), (view("0", plane(), truth(), camera((0.5, 0.45, 1.0))),), work, monitor=monitor, **config)
    return replace(given, maps={1: maps}, means={1: mean_texture(maps)}), color


def test_l1_is_the_median_where_every_pixel_is_one_texel(tmp_path: Path) -> None:
    given, color = flat_task(tmp_path, steps=3000)
    texture, losses = texture_function("l1")(given)
    median = color.float().median(0).values / 255
    # The codes of texture coordinates are 1/65535 apart, so the pixels are not exactly the texels.
    assert (texture - median).abs().mean() < 0.01
    least = float((color.float() / 255 - median).abs().mean())
    assert losses[-1]["l1"] == pytest.approx(least, rel=0.03)
    assert losses[0]["l1"] > losses[-1]["l1"]


def test_l1_sees_every_view_equally_often(tmp_path: Path) -> None:
    """Without a number of steps it makes whole passes; a view without foreground is left out."""
    given, _ = flat_task(tmp_path)
    maps = given.maps[1]
    depth = maps.depth.clone()
    depth[3] = 0
    _, losses = texture_function("l1")(replace(given, maps={1: replace(maps, depth=depth)}))
    assert losses[-1]["step"] % 4 == 0
    assert losses[-1]["step"] >= 40


class Stopper(Monitor):
    def __init__(self, at: int) -> None:
        self.at, self.step = at, 0

    def progress(self, step: int, steps: int, losses: Mapping[str, float]) -> None:
        assert all(map(math.isfinite, losses.values()))
        self.step = step

    def stop_requested(self) -> bool:
        return self.step == self.at


def test_a_descent_that_is_stopped_goes_on_to_the_same_texture(tmp_path: Path) -> None:
    whole, losses = texture_function("l1")(flat_task(tmp_path / "whole", steps=30)[0])
    with pytest.raises(Stopped, match="after step 11 of 30"):
        texture_function("l1")(flat_task(tmp_path / "parts", Stopper(11), steps=30)[0])
    resumed, later = texture_function("l1")(flat_task(tmp_path / "parts", steps=30)[0])
    assert torch.equal(whole, resumed)
    assert losses == later


def test_a_stop_at_the_last_step_still_ends_the_run(tmp_path: Path) -> None:
    texture, _ = texture_function("l1")(flat_task(tmp_path, Stopper(30), steps=30)[0])
    assert texture.isfinite().all()


def photographed(picture: Tensor) -> Tensor:
    """Pixels of a texel's size: means over their areas, of bilinear samples a quarter of a texel to each side."""
    for axis in (0, 1):
        picture = 0.75 * picture + 0.125 * (picture.roll(1, axis) + picture.roll(-1, axis))
    return picture


def test_view_selection_keeps_what_is_sharp_and_sharpens_the_rest_where_photographs_are_displaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Photographs that are off by up to two pixels, each in its own direction; one half of the start is blurred."""
    for module in (gabor, shared_detail):
        monkeypatch.setattr(module, "shows_areas", lambda _: True)
    fine = torch.rand((1, 3, SIDE // 3, SIDE // 3), generator=torch.Generator().manual_seed(4))
    picture = F.interpolate(fine, (SIDE, SIDE), mode="bilinear")[0].permute(1, 2, 0)
    shifts = list(itertools.product(range(-2, 3), repeat=2))
    maps = planar_maps(
        torch.stack([(photographed(picture).roll(by, (0, 1)) * 255).round().to(torch.uint8) for by in shifts]),
        SIDE,
        SIDE,
    )
    blurred = F.avg_pool2d(F.pad(picture.permute(2, 0, 1)[None], (1,) * 4, mode="replicate"), 3, 1)[0].permute(1, 2, 0)
    start = torch.where((torch.arange(SIDE) < SIDE // 2)[:, None, None], blurred, picture)
    given = task(plane(), (view("0", plane(), truth(), camera((0.5, 0.45, 1.0))),), tmp_path)
    given = replace(given, maps={1: maps}, means={1: mean_texture(maps)}, start=start)

    def sharp(texture: Tensor) -> tuple[float, float]:
        """Gradients of the blurred and of the other half, of those of the picture."""
        found, wanted = (
            [part.diff(dim=0).abs().mean() + part.diff(dim=1).abs().mean() for part in (of[8:40], of[56:88])]
            for of in (texture[:, 8:-8], picture[:, 8:-8])
        )
        return float(found[0] / wanted[0]), float(found[1] / wanted[1])

    ends = {}
    for name in ("view_selection", "l1"):
        config, work = TextureConfig(method=name), WorkFolder(tmp_path / name, "", Monitor())
        ends[name], _ = texture_function(name)(replace(given, config=config, work=work))
    before, selected_now, l1_now = (sharp(texture) for texture in (start, ends["view_selection"], ends["l1"]))
    assert selected_now[0] > before[0] + 0.03 > before[0] > l1_now[0]
    assert 0.97 < selected_now[1] < 1.03
    assert l1_now[1] < 0.87


def test_view_selection_compares_other_windows_at_each_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Crops of a size, at other places: those of a fixed grid would be fitted and not the photograph."""
    seen = list[Tensor]()
    monkeypatch.setattr(gabor, "gabor_loss", lambda render, photograph, *_: (seen.append(photograph), render.sum())[1])
    color = torch.arange(5 * 96 * 120, dtype=torch.int32).view(5, 96, 120, 1).remainder(251).expand(-1, -1, -1, 3)
    maps = planar_maps(color.to(torch.uint8).contiguous(), 120, 96)
    given = task(plane(), (view("0", plane(), truth(), camera((0.5, 0.45, 1.0))),), tmp_path, steps=30)
    view_selection(replace(given, maps={1: maps}, means={1: mean_texture(maps)}))
    assert {tuple(photograph.shape) for photograph in seen} == {(1, 3, *reversed(crop_size(120, 96)))}
    assert len({float(photograph[0, 0, 0, 0]) for photograph in seen}) > 20


class Warned(Monitor):
    def __init__(self) -> None:
        self.codes = list[str]()

    def warning(self, problem: Problem) -> None:
        self.codes.append(problem.code)


@pytest.mark.parametrize(
    ("blurred", "follows", "lacks"), [(True, True, True), (True, False, False), (False, True, False)]
)
def test_detail_of_blurred_photographs_is_left_to_the_descent(
    blurred: bool, follows: bool, lacks: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    views = tuple(view(f"{x}", plane(), truth(), camera((x, 0.44, 0.8), (x, 0.45, 0))) for x in (0.4, 0.6))
    given = task(plane(), views, tmp_path)
    monkeypatch.setattr(selected, "shows_areas", lambda _: not blurred)
    selection = select_views(given)
    whole = with_detail(selection.texture, selection.painted, given.maps[1])
    assert not torch.equal(whole, selection.texture)
    texture, painted = selected_start(given, makes_detail=follows)
    assert torch.equal(texture, selection.texture if lacks else whole)
    assert torch.equal(painted, selection.painted)


@pytest.mark.parametrize("agree", [True, False])
def test_view_selection_leaves_a_start_that_other_photographs_have_nothing_to_say_about(
    tmp_path: Path, agree: bool
) -> None:
    """Photographs of one print that are off by two pixels, and photographs of nine prints."""
    fine = torch.rand((9, 3, SIDE // 3, SIDE // 3), generator=torch.Generator().manual_seed(4))
    prints = F.interpolate(fine, (SIDE, SIDE), mode="bilinear").permute(0, 2, 3, 1)
    shifts = list(itertools.product((-2, 0, 2), repeat=2))
    shown = [prints[0 if agree else number].roll(by, (0, 1)) for number, by in enumerate(shifts)]
    maps = planar_maps((torch.stack(shown) * 255).round().to(torch.uint8), SIDE, SIDE)
    monitor = Warned()
    given = task(plane(), (view("0", plane(), truth(), camera((0.5, 0.45, 1.0))),), tmp_path, monitor=monitor, steps=9)
    start, painted = shown[4].contiguous(), torch.full((SIDE, SIDE), 4, dtype=torch.int16)
    given = replace(given, maps={1: maps}, means={1: mean_texture(maps)}, start=start, painted=painted)
    texture, losses = view_selection(given)
    assert (gabor.start_unlikeness(given) > gabor.UNLIKE) != agree
    assert torch.equal(texture, with_detail(start, painted, maps)) != agree
    assert (monitor.codes, bool(losses)) == ([] if agree else ["photographs_disagree"], agree)


def test_a_descent_in_crops_sees_all_of_the_views_as_often(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = list[int]()
    loss = gabor.gabor_loss

    def looked(render: Tensor, *rest: Tensor) -> Tensor:
        seen.append(render.shape[2] * render.shape[3])
        return loss(render, *rest)

    monkeypatch.setattr(gabor, "gabor_loss", looked)
    color = torch.randint(0, 256, (5, 96, 120, 3), generator=torch.Generator().manual_seed(2), dtype=torch.uint8)
    given = task(plane(), (view("0", plane(), truth(), camera((0.5, 0.45, 1.0))),), tmp_path)
    given = replace(given, maps={1: planar_maps(color, 120, 96)})
    given = replace(given, means={1: mean_texture(given.maps[1])})
    width, height = crop_size(120, 96)
    for largest, checkpoint in ((None, "whole"), ((64, 72), "parts")):
        gabor.descended(given, largest=largest, passes=2, checkpoint=checkpoint)
        assert sum(seen) == pytest.approx(2 * 5 * width * height, rel=0.1)
        assert set(seen) == {width * height if largest is None else 64 * 72}
        seen.clear()


def test_the_wide_term_is_the_difference_of_means_over_blocks() -> None:
    """Against loops; its gradient pulls all pixels of a block alike, and background neither counts nor is pulled."""
    generator = torch.Generator().manual_seed(5)
    render, photograph = (torch.rand((1, 3, 24, 20), generator=generator) * 2 - 1 for _ in range(2))
    foreground = (torch.rand((1, 1, 24, 20), generator=generator) < 0.7).float()
    difference = (render - photograph) * foreground
    found = [
        difference[0, :, row : row + BLOCK, column : column + BLOCK].mean((1, 2)).abs().mean()
        for row in range(0, 24 - BLOCK + 1, BLOCK // 2)
        for column in range(0, 20 - BLOCK + 1, BLOCK // 2)
    ]
    render.requires_grad_(True)
    value = gabor.wide_loss(render, photograph, foreground)
    torch.testing.assert_close(value, torch.stack(found).mean())
    (pull,) = torch.autograd.grad(value, [render])
    assert bool((pull[(foreground == 0).expand_as(pull)] == 0).all())
    corner = pull[0, 0, : BLOCK // 2, : BLOCK // 2][foreground[0, 0, : BLOCK // 2, : BLOCK // 2] > 0]
    torch.testing.assert_close(corner, corner[:1].expand_as(corner))


@pytest.mark.parametrize(("cell", "texels"), [(1, 9), (3, 4)])
def test_view_selection_renders_means_over_pixels_where_photographs_are_such_means(
    cell: int, texels: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fine = torch.rand((1, 3, SIDE // cell, SIDE // cell), generator=torch.Generator().manual_seed(4))
    picture = F.interpolate(fine, (SIDE, SIDE), mode="bilinear")[0].permute(1, 2, 0)
    maps = planar_maps((picture * 255).round().to(torch.uint8).expand(3, -1, -1, -1).contiguous(), SIDE, SIDE)
    given = task(plane(), (view("0", plane(), truth(), camera((0.5, 0.45, 1.0))),), tmp_path)
    config = TextureConfig(method="view_selection", steps=3)
    given = replace(given, maps={1: maps}, means={1: mean_texture(maps)}, start=picture, config=config)
    seen = list[int]()

    def sample(values: Tensor, slots: Tensor, *rest: Tensor) -> Tensor:
        seen.append(slots.shape[1])
        return sample_texels(values, slots, *rest)

    monkeypatch.setattr(gabor, "sample_texels", sample)
    view_selection(given)
    assert seen == [texels] * (3 + 3 * TOGETHER)  # once each to find its motion, then the steps


@pytest.mark.parametrize("found", [True, False])
def test_photographs_that_moved_soften_nothing(found: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fine = torch.rand((1, 3, SIDE // 2, SIDE // 2), generator=torch.Generator().manual_seed(4))
    picture = F.interpolate(fine, (SIDE, SIDE), mode="bilinear")[0].permute(1, 2, 0)
    motion = motion_taps(25)
    moved = smeared(picture.permute(2, 0, 1), motion).permute(1, 2, 0)
    pictures = torch.stack([picture, *[moved] * 5])
    maps = planar_maps((pictures * 255).round().to(torch.uint8).contiguous(), SIDE, SIDE)
    given = task(plane(), (view("0", plane(), truth(), camera((0.5, 0.45, 1.0))),), tmp_path)
    config = TextureConfig(method="view_selection", steps=60)
    given = replace(given, maps={1: maps}, means={1: mean_texture(maps)}, start=picture, config=config)
    if not found:
        monkeypatch.setattr(gabor, "start_motions", lambda *_, **__: {})
    texture, _ = gabor.descended(given, 60)
    inner = slice(SIDE // 8, -SIDE // 8)
    strength = [image[inner, inner].diff(dim=1).abs().mean() for image in (texture, picture)]
    assert (strength[0] > 0.95 * strength[1]) == found


def test_what_the_game_is_judged_by_and_ends_with_knows_of_motion(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fine = torch.rand((1, 3, SIDE // 2, SIDE // 2), generator=torch.Generator().manual_seed(4))
    picture = F.interpolate(fine, (SIDE, SIDE), mode="bilinear")[0].permute(1, 2, 0)
    motion = motion_taps(25)
    moved = smeared(picture.permute(2, 0, 1), motion).permute(1, 2, 0)
    pictures = torch.stack([picture, *[moved] * 5])
    maps = planar_maps((pictures * 255).round().to(torch.uint8).contiguous(), SIDE, SIDE)
    given = task(plane(), (view("0", plane(), truth(), camera((0.5, 0.45, 1.0))),), tmp_path)
    preset = replace(PRESETS["standard"], levels=(PyramidLevel(20),), pretraining=0, averaging=5, turn=10, patience=9)
    given = replace(given, maps={1: maps}, means={1: mean_texture(maps)}, start=picture, preset=preset)
    given = replace(given, painted=torch.zeros((SIDE, SIDE), dtype=torch.int16))
    told: list[Mapping[int, Taps]] = []

    class Cells(LeftOutCells):
        def __init__(self, *args: Any, motions: Mapping[int, Taps], **others: Any) -> None:
            told.append(motions)
            super().__init__(*args, motions=motions, **others)

        def unlike(self, *_: object) -> float:
            return next(less)  # so that the start is not kept

    less = iter(range(20, 0, -1))

    def share(texture: Tensor, _maps: ViewMaps, _share: float, motions: Mapping[int, Taps]) -> Tensor:
        told.append(motions)
        return texture

    module = importlib.import_module("advtex_engine.methods.adversarial")
    monkeypatch.setattr(module, "LeftOutCells", Cells)
    monkeypatch.setattr(module, "share_detail", share)
    module.adversarial(given)
    assert len(told) == 2
    for motions in told:
        assert motions == {0: (), **dict.fromkeys(range(1, 6), motion)}


def test_view_selection_takes_what_is_wide_from_all_photographs_and_keeps_detail(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Spots of twelve pixels that the start shows too dark, over fine print: the print is as sharp as before."""
    for module in (gabor, shared_detail):
        monkeypatch.setattr(module, "shows_areas", lambda _: True)
    generator = torch.Generator().manual_seed(6)
    fine = F.interpolate(torch.rand((1, 1, SIDE // 3, SIDE // 3), generator=generator), (SIDE, SIDE), mode="bilinear")
    picture = (0.3 + 0.4 * fine[0, 0])[..., None].expand(-1, -1, 3).contiguous()
    shifts = list(itertools.product(range(-2, 3), repeat=2))
    maps = planar_maps(
        torch.stack([(photographed(picture).roll(by, (0, 1)) * 255).round().to(torch.uint8) for by in shifts]),
        SIDE,
        SIDE,
    )
    spots = F.interpolate((torch.rand((1, 1, 8, 8), generator=generator) < 0.5).float(), (SIDE, SIDE))[0, 0, ..., None]
    start = picture - 0.05 * spots
    given = task(plane(), (view("0", plane(), truth(), camera((0.5, 0.45, 1.0))),), tmp_path)
    config, work = TextureConfig(method="view_selection"), WorkFolder(tmp_path / "descended", "", Monitor())
    given = replace(given, maps={1: maps}, means={1: mean_texture(maps)}, start=start, config=config, work=work)
    texture, _ = texture_function("view_selection")(given)
    inner = (slice(8, -8), slice(8, -8))

    def wide(image: Tensor) -> Tensor:
        return F.avg_pool2d((image - picture)[inner].permute(2, 0, 1)[None], BLOCK, 2).abs().mean()

    def slope(image: Tensor) -> Tensor:
        return image[inner].diff(dim=0).abs().mean() + image[inner].diff(dim=1).abs().mean()

    assert wide(texture) < 0.5 * wide(start)
    assert 0.95 < float(slope(texture) / slope(picture)) < 1.05


@pytest.mark.parametrize(("method", "module"), [("view_selection", "gabor"), ("adversarial", "adversarial")])
def test_half_of_an_optimized_texture_s_finest_detail_is_what_photographs_share(
    method: str, module: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = task(plane(), (view("0", plane(), truth(), camera((0.5, 0.45, 1.0))),), tmp_path)
    start = given.means[1]
    given = replace(given, config=TextureConfig(method=method, steps=3, preset="preview"), start=start)
    given = replace(given, painted=torch.zeros(start.shape[:2], dtype=torch.int16))
    asked: list[tuple[Tensor, float]] = []
    monkeypatch.setattr(
        importlib.import_module(f"advtex_engine.methods.{module}"),
        "share_detail",
        lambda texture, _, share, *__: asked.append((texture, share)) or texture / 2,
    )
    texture, _ = texture_function(method)(replace(given, preset=replace(given.preset, turn=0, start="selection")))
    ((before, share),) = asked
    assert share == 0.5
    assert torch.equal(texture, before / 2)
    assert not torch.equal(before, start)


def test_four_times_the_steps_of_view_selection_end_near_where_the_steps_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its photographs are sharper than the start: with the same rate the texture would go on moving."""
    monkeypatch.setattr(gabor, "share_detail", lambda texture, *_: texture)  # what the steps do
    fine = torch.rand((1, 3, SIDE // 3, SIDE // 3), generator=torch.Generator().manual_seed(4))
    picture = F.interpolate(fine, (SIDE, SIDE), mode="bilinear")[0].permute(1, 2, 0)
    maps = planar_maps((picture * 255).round().to(torch.uint8).expand(5, -1, -1, -1).contiguous(), SIDE, SIDE)
    start = F.avg_pool2d(F.pad(picture.permute(2, 0, 1)[None], (1,) * 4, mode="replicate"), 3, 1)[0].permute(1, 2, 0)
    given = task(plane(), (view("0", plane(), truth(), camera((0.5, 0.45, 1.0))),), tmp_path)
    given = replace(given, maps={1: maps}, means={1: mean_texture(maps)}, start=start)

    def moved(steps: int | None) -> float:
        work = WorkFolder(tmp_path / str(steps), "", Monitor())
        texture, losses = view_selection(
            replace(given, config=TextureConfig(method="view_selection", steps=steps), work=work)
        )
        assert losses[-1]["step"] == (steps or few)
        return float((texture - start).abs().mean())

    few = math.ceil(5 * PASSES / TOGETHER)
    usual = moved(None)
    assert moved(4 * few) == pytest.approx(usual, rel=0.25)
    assert moved(few // 5) < 0.7 * usual, "few steps are not made up for by larger ones"


def test_view_selection_gives_the_same_texture_stopped_or_not(tmp_path: Path) -> None:
    whole, losses = texture_function("view_selection")(flat_task(tmp_path / "whole", steps=30)[0])
    with pytest.raises(Stopped, match="after step 11 of 30"):
        texture_function("view_selection")(flat_task(tmp_path / "parts", Stopper(11), steps=30)[0])
    resumed, later = texture_function("view_selection")(flat_task(tmp_path / "parts", steps=30)[0])
    assert torch.equal(whole, resumed)
    assert losses == later


def test_views_of_a_step_side_by_side_are_what_they_are_one_after_the_other(tmp_path: Path) -> None:
    ends = []
    for threads in (1, 2):
        with threads_each(threads):
            ends.append(texture_function("view_selection")(flat_task(tmp_path / str(threads), steps=6)[0])[0])
    start = flat_task(tmp_path / "start", steps=6)[0].means[1]
    assert float((ends[0] - start).abs().mean()) > 1e-3
    torch.testing.assert_close(ends[0], ends[1], atol=1e-4, rtol=0)


def test_view_selection_begins_with_the_photographs_in_the_tones_of_those_selected(tmp_path: Path) -> None:
    synthesize(tmp_path / "scan", views=8, width=128, height=96)
    shown = dict[str, MethodInput]()

    def keep(given: MethodInput) -> tuple[Tensor, list[LossPoint]]:
        shown["given"] = given
        return view_selection(given)

    config = TextureConfig(method="view_selection", steps=5, face_budget=2_000, refine=False)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("advtex_engine.pipeline.texture_function", lambda _: keep)
        result = texture_scan(tmp_path / "scan", tmp_path / "out", config, work=tmp_path / "work")
    given = shown["given"]
    assert given.start is not None
    untoned = build_view_maps(given.atlas, given.scene.views, given.scene.kind)
    assert not torch.equal(given.maps[1].color, untoned.color)
    assert disagreement(given.maps[1], given.start) < 0.99 * disagreement(untoned, given.start)
    assert [point["step"] for point in result.report["losses"]] == [1, 2, 3, 4, 5]
    assert result.report["game"] is None


def small_optimizer(around: MethodInput, **ablation: bool) -> AdversarialOptimizer:
    maps = around.maps[1]
    return AdversarialOptimizer(
        maps,
        own_pairs(maps),
        around.means[1][maps.slot_map >= 0],
        replace(PRINTED, **ablation),  # type: ignore[arg-type]  # flags of the ablations
        kind="scene",
        steps=4,
        generator=torch.Generator().manual_seed(0),
        discriminator=PatchDiscriminator(torch.Generator().manual_seed(0)),
    )


def test_without_auxiliary_views_the_real_example_is_the_source(around: MethodInput) -> None:
    batch = small_optimizer(around).draw()
    assert torch.equal(batch.visible, batch.foreground)
    difference = ((batch.real - batch.condition) * batch.visible).abs()
    assert difference.mean() < 0.01


def test_without_the_condition_the_discriminator_does_not_see_the_source(around: MethodInput) -> None:
    for condition in (True, False):
        of = small_optimizer(around, condition=condition)
        batch = of.draw()
        losses = of.play(batch)
        other = of.play(replace(batch, condition=batch.condition.flip(-1)))
        assert torch.equal(losses.discriminator, other.discriminator) is not condition
        assert losses.l1 == other.l1


@pytest.mark.parametrize("name", ["adversarial", "adversarial_no_auxiliary", "adversarial_no_condition"])
def test_the_ablations_run_and_differ(name: str, around: MethodInput) -> None:
    texture, losses = texture_function(name)(around)
    assert texture.isfinite().all()
    assert losses[-1]["step"] == 3
    if name != "adversarial":
        whole, _ = texture_function("adversarial")(
            replace(around, work=WorkFolder(around.work.path / "2", "", Monitor()))
        )
        assert not torch.equal(texture, whole)


def test_a_rate_may_be_in_units_of_the_views_disagreement(around: MethodInput, tmp_path: Path) -> None:
    units = {"color": 1.0, "disagreement": disagreement(around.maps[1], around.means[1]) ** 0.5}
    assert 0 < units["disagreement"] < 0.5
    for unit, size in units.items():
        preset = replace(around.preset, start="mean", lr_texture=2e-3, lr_unit=unit)
        given = replace(around, preset=preset, work=WorkFolder(tmp_path / unit, "", Monitor()))
        texture_function("adversarial")(given)
        assert given.facts["step"]["lr_texture"] == pytest.approx(2e-3 * size)


def feature_weights() -> dict[str, Tensor]:
    """VGG16's table with random weights of a sensible scale: features differ where images do, as with trained ones."""
    generator = torch.Generator().manual_seed(0)
    table = {}
    for layer in NETWORKS["vgg16"]:
        fan = layer.inputs * layer.kernel**2
        shape = (layer.outputs, layer.inputs, layer.kernel, layer.kernel)
        table[f"features.{layer.number}.weight"] = torch.randn(shape, generator=generator) * math.sqrt(2 / fan)
        table[f"features.{layer.number}.bias"] = torch.zeros(layer.outputs)
    return table


@pytest.fixture
def weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "weights"
    folder.mkdir()
    torch.save(feature_weights(), folder / "vgg16-397923af.pth")
    monkeypatch.setenv(WEIGHTS_VARIABLE, str(folder))
    return folder


@pytest.mark.usefixtures("weights")
def test_vgg_comes_nearer_in_features_and_in_colors(around: MethodInput, monkeypatch: pytest.MonkeyPatch) -> None:
    """From a gray start, since without errors the mean is the answer already."""
    monkeypatch.setattr(descent, "LR", 1e-2)
    gray = torch.full_like(around.means[1], 0.5)
    preset = replace(around.preset, levels=(PyramidLevel(15),))
    texture, losses = texture_function("vgg")(replace(around, means={1: gray}, preset=preset))
    assert losses[-1]["vgg"] < 0.9 * losses[0]["vgg"]
    seen = around.maps[1].slot_map >= 0
    before, after = ((start - truth())[seen].abs().mean() for start in (gray, texture))
    assert after < 0.9 * before


def test_the_truncated_network_gives_the_first_features_of_the_whole(weights: Path) -> None:
    images = torch.rand((1, 3, 32, 32), generator=torch.Generator().manual_seed(0))
    short, whole = load_vgg()(images), load_features("vgg16", weights)(images)
    assert len(short) == 3
    assert all(torch.equal(a, b) for a, b in zip(short, whole, strict=False))


def test_vgg_without_weights_says_what_is_missing(
    around: MethodInput, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(WEIGHTS_VARIABLE, str(tmp_path))
    with pytest.raises(WeightsError, match=r"no weights: .* has no file vgg16-\*\.pth"):
        texture_function("vgg")(around)
    with pytest.raises(WeightsError, match="no weights"):
        texture_scan(tmp_path, tmp_path / "out", TextureConfig(method="vgg"), work=tmp_path / "work")
    assert not (tmp_path / "out").exists(), "it is said before anything is done"


def test_colormap_always_refines_cameras() -> None:
    assert TextureConfig(method="colormap", refine=False).refines
    assert TextureConfig(method="colormap", preset="paper").refines
    assert TextureConfig(method="mean").refines
    assert not TextureConfig(method="mean", refine=False).refines
    assert not TextureConfig(preset="paper").refines

"""The pictures of a result, its page, and glimpses of the texture while it is made."""

from __future__ import annotations

import json
import math
import re
import time
from dataclasses import replace
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import trimesh
from atlases import of_trimesh
from browsing import FLAGS, chromium
from hypothesis import given, settings
from hypothesis import strategies as st
from playwright.sync_api import Page as Tab
from playwright.sync_api import sync_playwright
from torch import Tensor

from advtex_engine.adversarial.discriminator import PatchDiscriminator
from advtex_engine.adversarial.optimizer import AdversarialOptimizer
from advtex_engine.core.cameras import camera_center, project
from advtex_engine.core.config import PRESETS, Preset
from advtex_engine.core.monitor import Glimpse, Monitor
from advtex_engine.core.scene import TO_Y_UP, Atlas, Camera, Mesh, Scene, View
from advtex_engine.coverage import GUESSED, SEEN, UNSEEN
from advtex_engine.ingest.shrink import shrink
from advtex_engine.previews import live as live_module
from advtex_engine.previews.curves import MAX_POINTS, curves
from advtex_engine.previews.live import Live
from advtex_engine.previews.turntable import camera_at, circle_cameras, facing, find_circle
from advtex_engine.render.pairs import related_pairs
from advtex_engine.render.render_view import render_view
from advtex_engine.render.view_maps import ViewMaps, build_view_maps
from advtex_engine.results import seen as seen_module
from advtex_engine.results.export import export_model
from advtex_engine.results.gallery import MAX_VIEWS, chosen_views, write_gallery
from advtex_engine.results.initial_view import orbit
from advtex_engine.results.result_page import embedded, write_page
from advtex_engine.results.seen import write_seen

HOSTILE = "</script><script>document.title='taken'</script>&lt;img src=x onerror=alert(1)>\u2028.png"
SIDE = 64
VIEWER_MS = 60_000  # Chromium draws without a GPU


SHOWN = ("#frame", "#under", "#over", "#atlas img")
STATE = torch.full((SIDE, SIDE), SEEN, dtype=torch.uint8)
STATE[:, : SIDE // 2] = GUESSED
STATE[: SIDE // 2] = UNSEEN


def unwrapped(mesh: Mesh, texels: int = SIDE) -> Atlas:
    """Every face in a cell of its own, in the texture's middle of it."""
    faces = len(mesh.t_pos_idx)
    cells = math.ceil(math.sqrt(faces))
    corner = torch.tensor([[0.2, 0.2], [0.8, 0.2], [0.2, 0.8]])
    cell = torch.stack((torch.arange(faces) % cells, torch.arange(faces) // cells), 1)[:, None]
    v_uv = ((cell + corner) / cells).reshape(-1, 2)
    return Atlas(Mesh(mesh.v_pos, mesh.t_pos_idx, v_uv, torch.arange(3 * faces).view(-1, 3)), texels, texels, "scan", 1)


def box(inward: bool = False) -> Atlas:
    mesh = of_trimesh(trimesh.creation.box((2.0, 1.6, 1.2)))
    return unwrapped(Mesh(mesh.v_pos, mesh.t_pos_idx.flip(1) if inward else mesh.t_pos_idx))


def texture(seed: int = 0, side: int = SIDE) -> Tensor:
    return torch.rand((side, side, 3), generator=torch.Generator().manual_seed(seed))


def camera(
    position: tuple[float, float, float],
    target: tuple[float, float, float] = (0, 0, 0),
    size: tuple[int, int] = (96, 72),
) -> Camera:
    eye, goal, up = (torch.tensor(point, dtype=torch.float64) for point in (position, target, (0.0, 0.0, 1.0)))
    return camera_at(eye, goal, up, size)


def shot(atlas: Atlas, place: Camera, name: str) -> View:
    return View(name, place, (render_view(atlas, texture(), place, supersample=1) * 255).round().to(torch.uint8))


def scene(count: int = 16) -> tuple[Scene, Atlas]:
    atlas = box()
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    around = [camera((4 * math.cos(angle), 4 * math.sin(angle), 1.5)) for angle in angles]
    views = [shot(atlas, place, f"color/{number:02d}.png") for number, place in enumerate(around)]
    heldout = [replace(views[3], name=HOSTILE), replace(views[9], name="color/09b.png")]
    return Scene(atlas.mesh, tuple(views), tuple(heldout), kind="object"), atlas


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Scene, Atlas, tuple[Path, ...]]:
    out = tmp_path_factory.mktemp("result")
    made, atlas = scene()
    history = curves([{"step": 1, "l1": 0.5}, {"step": 2, "l1": math.nan}], [{"step": 2, "psnr": 30.0}])
    files = write_gallery(out, made, atlas, texture(), texture(1), history, STATE)
    export_model(out, atlas, texture(), up_axis=made.up_axis)
    return out, made, atlas, files


def test_what_is_not_seen_has_colors_of_its_own(result: tuple[Path, Scene, Atlas, tuple[Path, ...]]) -> None:
    out, _, atlas, _ = result
    page, seen = (read(out / f"previews/atlas_0{kind}.jpg").astype(int) for kind in ("", "_seen"))
    half = SIDE // 2
    clear = np.s_[half + 8 :, half + 8 :]  # JPEG's blocks keep to themselves
    assert np.abs(seen - page)[clear].max() <= 2
    purple, orange = seen[: half - 8].mean((0, 1)), seen[half + 8 :, : half - 8].mean((0, 1))
    assert purple[1] < purple[[0, 2]].min() - 60
    assert orange[2] < orange[1] - 60 < orange[0] - 60
    (path,) = write_seen(out, atlas, STATE)
    assert path == out / "model_seen.png"
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None
    assert np.array_equal(image, STATE.numpy()), "gray, of three values, as the texture lies"


def test_pages_have_an_image_each_of_what_is_seen_and_large_ones_are_thinned_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    atlas = replace(box(), pages=2)
    assert atlas.mesh.v_uv is not None
    atlas = replace(atlas, mesh=replace(atlas.mesh, v_uv=atlas.mesh.v_uv / 2 + torch.tensor([0.5, 0.5])))
    monkeypatch.setattr(seen_module, "MAX_SIDE", 16)
    (path,) = write_seen(tmp_path, atlas, STATE)
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None
    assert np.array_equal(image, STATE.numpy()[SIDE // 2 :: 2, SIDE // 2 :: 2])


def read(path: Path) -> np.ndarray:
    image = cv2.imread(str(path))
    assert image is not None
    return np.asarray(image[..., ::-1])


def test_the_manifest_lists_every_picture(result: tuple[Path, Scene, Atlas, tuple[Path, ...]]) -> None:
    out, _, atlas, files = result
    manifest = json.loads((out / "previews/manifest.json").read_text())
    usual = {"views", "turntable", "orbit", "thumbnail", "atlas", "photographs", "curves"}
    assert set(manifest) == usual | {"turntable_seen", "atlas_seen"}
    assert [view["name"] for view in manifest["views"] if view["heldout"]] == sorted([HOSTILE, "color/09b.png"])
    assert len(manifest["views"]) == MAX_VIEWS
    named = [view[kind] for view in manifest["views"] for kind in ("photo", "render", "mean", "seen")]
    named += [*manifest["turntable_seen"], *manifest["atlas_seen"]]
    named += [*manifest["turntable"], *manifest["atlas"], manifest["thumbnail"], manifest["curves"]]
    named += [manifest["photographs"], json.loads((out / manifest["photographs"]).read_text())["stream"]]
    others = {"previews/manifest.json", "previews/comparison.png", "previews/sheet.png"}
    assert sorted([*named, *others]) == sorted(path.relative_to(out).as_posix() for path in files)
    assert manifest["turntable"] == [f"previews/turntable/{frame:02d}.jpg" for frame in range(24)]
    assert {read(out / name).shape for name in manifest["turntable"]} == {(360, 480, 3)}
    assert read(out / manifest["thumbnail"]).shape == (256, 256, 3)
    assert json.loads((out / manifest["curves"]).read_text()) == {
        "steps": [1, 2],
        "series": {"l1": [0.5, None]},
        "quality": {"steps": [2], "series": {"psnr": [30.0]}},
    }
    assert max(read(out / manifest["atlas"][0]).shape) == atlas.width


def test_pictures_of_a_view_have_its_camera_and_size(result: tuple[Path, Scene, Atlas, tuple[Path, ...]]) -> None:
    out, made, atlas, _ = result
    manifest = json.loads((out / "previews/manifest.json").read_text())
    for entry, (view, _) in zip(manifest["views"], chosen_views(made), strict=True):
        wanted = {"photo": view.color / 255}
        wanted["render"], wanted["mean"] = (render_view(atlas, texture(seed), view.camera) for seed in (0, 1))
        for kind, picture in wanted.items():
            found = read(out / entry[kind])
            assert found.shape == (entry["height"], entry["width"], 3)
            assert np.abs(found - picture.numpy() * 255.0).mean() < 12, "more than a JPEG of noise loses"


class Page(HTMLParser):
    """Tags in their order, and the text of the data's element."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.data: dict[str, Any] = {}
        self.inside = False

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.inside = dict(attrs).get("id") == "data"

    def handle_data(self, data: str) -> None:
        if self.inside:
            self.data, self.inside = json.loads(data), False


TOLD = "The game ended after step 270 of 1500, judged by views: never better than its start."


def page_of(out: Path, name: str, files: tuple[Path, ...]) -> tuple[Page, str]:
    stage = {"stage": name, "seconds": 1.5, "peak_memory_bytes": 1 << 20, "peak_device_memory_bytes": None}
    scan = {"views": 16, "width": 96, "height": 72, "faces": 12, "heldout": [name], "notes": [name]}
    warning = {"where": name, "message": name, "remedy": name}
    report = {
        "scan": scan,
        "atlas": {"width": SIDE, "height": SIDE},
        "options": {"method": name, "preset": name, "box": None},
        "device": "cpu",
        "stages": [stage],
        "warnings": [warning],
        "heldout": {"texture": {"psnr": math.nan}, "mean": {}},
        "conventions": {"summary": name},
        "surface": {"seen": 0.5, "guessed": 0.125, "unseen": 0.375},
        "losses": [1],
        "game": {"points": [], "probes": {"told": TOLD}},
    }
    text = write_page(out, report, files)[-1].read_text()
    page = Page()
    page.feed(text)
    return page, text


def test_a_hostile_name_stays_a_name_on_the_page(result: tuple[Path, Scene, Atlas, tuple[Path, ...]]) -> None:
    out, _, _, files = result
    page, text = page_of(out, HOSTILE, (*files, out / "model.glb"))
    assert page.tags == page_of(out, "harmless", files)[0].tags
    report = page.data["report"]
    assert report["scan"]["notes"] == [report["stages"][0]["stage"]] == [HOSTILE]
    assert report["heldout"]["texture"] == {"psnr": None}
    assert "losses" not in report, "the curves have them"
    assert HOSTILE in [view["name"] for view in page.data["manifest"]["views"]]
    assert page.data["files"] == ["model.glb"]
    assert HOSTILE not in text
    assert page.data["probes"] == TOLD
    assert not re.search(r"innerHTML|outerHTML|document\.write|insertAdjacent|eval\(|fetch\(", text)
    assert re.findall(r"https?://[^\"]*", text) == ["http://www.w3.org/2000/svg"], "nothing comes from the network"


@pytest.mark.slow
def test_the_page_opens_from_disk_and_runs_no_name(result: tuple[Path, Scene, Atlas, tuple[Path, ...]]) -> None:
    out, made, _, files = result
    page_of(out, HOSTILE, files)
    problems = list[str]()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium(), args=FLAGS)
        tab = browser.new_page()
        tab.on("pageerror", lambda error: problems.append(str(error)))
        tab.on("requestfailed", lambda request: problems.append(request.url))
        own = ("file:", "blob:null/")
        tab.on("request", lambda request: None if request.url.startswith(own) else problems.append(request.url))
        tab.goto((out / "index.html").as_uri())
        assert tab.title() == "Textured model"
        view = tab.get_by_label("View")
        assert HOSTILE in view.locator("option:checked").inner_text()
        width = tab.locator("#over").evaluate("image => image.complete && image.naturalWidth")
        assert width == made.views[0].camera.width
        before = tab.locator("#over").evaluate("image => image.style.clipPath")
        tab.get_by_label("Where the left picture ends").press("ArrowLeft")
        assert tab.locator("#over").evaluate("image => image.style.clipPath") != before
        first = tab.locator("#frame").get_attribute("src")
        table = tab.locator("#table").bounding_box()
        assert table is not None
        tab.mouse.move(table["x"] + 200, table["y"] + 100)
        tab.mouse.down()
        tab.mouse.move(table["x"] + 100, table["y"] + 100)
        tab.mouse.up()
        turned = tab.locator("#frame").evaluate("image => image.src")
        assert not turned.endswith(first or "none")
        assert tab.locator("#probes").inner_text() == TOLD
        assert not tab.locator("#shares").is_visible()
        tab.get_by_label("Show what no photograph shows").check()
        assert (
            tab.locator("#shares").inner_text().startswith("Photographs show 50.0 % of the surface. 12.5 % is guessed")
        )
        shown = {name: tab.locator(name).evaluate("image => image.src") for name in SHOWN}
        assert shown["#frame"] == turned.replace(".jpg", "_seen.jpg")
        assert shown["#under"].endswith("_seen.jpg")
        assert shown["#atlas img"].endswith("atlas_0_seen.jpg")
        assert shown["#over"].endswith("_photo.jpg")
        check_solid(tab)
        browser.close()
    assert problems == []


def check_solid(tab: Tab) -> None:
    """The page's tools on the model in 3D, all of them made of what lies beside index.html."""
    tab.get_by_role("button", name="Show the model").click()
    tab.get_by_label("Compare with").select_option(index=1, timeout=VIEWER_MS)
    tab.get_by_role("slider", name="Photograph against model").wait_for()
    assert tab.locator(".wipe img").evaluate("image => image.naturalWidth") == 96
    tab.get_by_role("button", name="Measure").click()
    viewer = tab.locator("model-viewer").bounding_box()
    assert viewer is not None
    for aside in (-20, 20):
        tab.mouse.click(viewer["x"] + viewer["width"] / 2 + aside, viewer["y"] + viewer["height"] / 2)
    tab.get_by_text("Distance: ").wait_for()
    tab.get_by_role("button", name="Photographs where you stand").click()
    tab.locator(".lumigraph").wait_for()
    tab.get_by_role("button", name="Crop").click()
    tab.get_by_text("--box=0,0,0,2.002,1.602,1.202,0", exact=True).wait_for()
    assert not tab.get_by_role("button", name="Texture again").count(), "there is no server"
    assert tab.locator("#trouble").inner_text() == ""


@given(st.dictionaries(st.text(), st.lists(st.text() | st.integers() | st.none(), max_size=3), max_size=3))
def test_embedded_data_come_back_and_hold_no_markup(value: object) -> None:
    text = embedded(value)
    assert json.loads(text) == value
    assert not set(text) & set("<>&")


@given(st.lists(st.tuples(st.integers(0, 10**6), st.floats()), max_size=3 * MAX_POINTS))
def test_curves_keep_their_last_point_and_are_json(points: list[tuple[int, float]]) -> None:
    made = curves([{"step": step, "l1": value} for step, value in points], [])
    assert json.loads(json.dumps(made, allow_nan=False)) == made
    assert len(made["steps"]) <= MAX_POINTS
    assert made["steps"][-1:] == [step for step, _ in points[-1:]]
    assert all(len(values) == len(made["steps"]) for values in made["series"].values())


@pytest.mark.parametrize("inward", [False, True])
def test_the_turntable_holds_the_whole_model_and_little_else(inward: bool) -> None:
    atlas = box(inward)
    views = [shot(atlas, camera((0.3, 0.2, 0.1), (1, 0, 0)) if inward else camera((4, 1, 1)), "a")]
    circle = find_circle(atlas.mesh, views, "+z")
    assert circle.inside == inward
    assert circle.outer == 1
    filled = []
    for place in circle_cameras(circle):
        pixels, depth = project(place, atlas.mesh.v_pos)
        assert (depth > 0).all()
        assert ((pixels >= 0) & (pixels <= torch.tensor([480, 360]))).all()
        filled.append(float(((pixels.amax(0) - pixels.amin(0)) / torch.tensor([480, 360])).max()))
    assert max(filled) > 0.7


@pytest.mark.parametrize("up_axis", TO_Y_UP)
def test_viewers_begin_where_the_turntable_does(up_axis: str) -> None:
    atlas = box()
    circle = find_circle(atlas.mesh, [shot(atlas, camera((4, 1, 1)), "a")], up_axis)
    lean = torch.nn.functional.normalize(circle.up + torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64), dim=0)
    circle = replace(circle, up=lean)
    begin = orbit(circle, up_axis)
    around = np.array([math.sin(begin["theta"]), 0, math.cos(begin["theta"])])
    outward = math.sin(begin["phi"]) * around + np.array([0, math.cos(begin["phi"]), 0])
    x, y, z, w = TO_Y_UP[up_axis]
    roll, pitch, yaw = begin["orientation"]
    stand = trimesh.transformations.euler_matrix(roll, pitch, yaw, "szxy")[:3, :3]
    turn = stand @ trimesh.transformations.quaternion_matrix((w, x, y, z))[:3, :3]
    assert turn @ lean.numpy() == pytest.approx([0, 1, 0])
    expected = turn @ camera_center(circle_cameras(circle)[0]).numpy()
    assert np.array(begin["target"]) + begin["radius"] * outward == pytest.approx(expected)


def test_what_was_scanned_from_one_side_is_shown_from_there() -> None:
    atlas = box()
    angles = np.radians([-40, 0, 40])
    views = [shot(atlas, camera((4 * math.cos(angle), 4 * math.sin(angle), 1)), "a") for angle in angles]
    seen = [camera_center(place) for place in circle_cameras(find_circle(atlas.mesh, views, "+z"))]
    shown = np.degrees([math.atan2(place[1], place[0]) for place in seen])
    assert shown.max() == pytest.approx(60, abs=1)
    assert shown.min() == pytest.approx(-60, abs=1)
    assert np.abs(np.diff([*shown, shown[0]])).max() < 20, "it can be turned on and on"


def test_a_room_is_looked_into_and_an_object_looked_at() -> None:
    place = camera((6, 3, 4))
    whole, room = box(), box(inward=True)
    assert torch.equal(render_view(facing(whole, place, 1), texture(), place), render_view(whole, texture(), place))
    seen = {tuple(corners) for corners in facing(room, place, 1).mesh.t_pos_idx.sort(1).values.tolist()}
    walls = {tuple(corners) for corners in facing(whole, place, 1).mesh.t_pos_idx.sort(1).values.tolist()}
    assert seen, "the far walls"
    assert not seen & walls, "what an object shows is what a room hides"


def test_a_wrong_up_axis_is_not_believed() -> None:
    turned = torch.tensor([[1.0, 0, 0], [0, 0.6, -0.8], [0, 0.8, 0.6]])
    made, atlas = scene()
    mesh = replace(atlas.mesh, v_pos=atlas.mesh.v_pos @ turned.T)
    rigid = torch.eye(4, dtype=torch.float64)
    rigid[:3, :3] = turned.T
    poses = [view.camera.world_to_camera @ rigid for view in made.views]
    views = [
        replace(view, camera=replace(view.camera, world_to_camera=pose))
        for view, pose in zip(made.views, poses, strict=True)
    ]
    assert torch.allclose(find_circle(atlas.mesh, made.views, "+z").up, torch.tensor([0.0, 0, 1]).double())
    assert torch.allclose(find_circle(mesh, views, "+y").up.float(), turned[:, 2], atol=1e-4)


class Watcher(Monitor):
    def __init__(self) -> None:
        self.glimpses: list[Glimpse] = []

    def glimpsed(self, glimpse: Glimpse) -> None:
        self.glimpses.append(glimpse)


def test_a_glimpse_shows_the_texture_at_every_kth_pixel(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_module, "WIDTH", 32)
    made, atlas = scene()
    watcher, maps = Watcher(), build_view_maps(atlas, made.views, "object")
    live, dense = Live(made, atlas, watcher), texture()
    live.show(7, maps, dense[maps.slot_map >= 0], dense, [{"step": 7, "l1": 0.25}])
    (glimpse,) = watcher.glimpses
    assert (glimpse.step, list(glimpse.pictures)) == (7, ["0.jpg", "1.jpg"])
    assert glimpse.titles == {"0.jpg": HOSTILE, "1.jpg": "color/09b.png"}
    assert glimpse.curves["quality"]["steps"] == [7]
    assert glimpse.curves["quality"]["series"]["psnr"][0] > 45, "8 bits of color lose no more"
    for seen, view in zip(live._seen, made.heldout, strict=True):
        wanted = render_view(atlas, dense, view.camera, supersample=1)[1::3, 1::3]
        assert torch.allclose(seen.picture(dense[maps.slot_map >= 0]), wanted, atol=1e-4)
    image = cv2.imdecode(np.frombuffer(glimpse.pictures["0.jpg"], np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    assert image.shape == (24, 32, 3)


@settings(deadline=None)
@given(st.floats(0.001, 2.0), st.floats(0.01, 1.0))
def test_glimpses_take_their_share_of_the_time_and_no_more(cost: float, step: float) -> None:
    clock = Clock()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(live_module, "time", clock)
        live = Live(Scene(box().mesh, ()), box(), Monitor())
        shown = list[float]()
        while clock.now < 400:
            clock.now += step
            if live.due():
                shown.append(clock.now)
                clock.now += cost
                live._last, live._spent = clock.now, live._spent + cost
    assert shown[0] <= live_module.SECONDS + step
    assert all(later - earlier >= live_module.SECONDS for earlier, later in pairwise(shown))
    rounding = 1 + 1e-9
    assert (len(shown) - 1) * cost <= live_module.MAX_SHARE * shown[-1] * rounding


class Clock:
    now = 0.0

    def monotonic(self) -> float:
        return self.now


@pytest.mark.slow
def test_previews_cost_five_percent_of_a_preview_run_and_glimpses_one(tmp_path: Path) -> None:
    atlas = unwrapped(of_trimesh(trimesh.creation.icosphere(subdivisions=5)), 1024)
    dense, gray = texture(side=1024), torch.full((240, 320, 3), 128, dtype=torch.uint8)
    angles = np.linspace(0, 6, 14)
    around = [camera((2.6 * math.cos(angle), 2.6 * math.sin(angle), 0.6), size=(320, 240)) for angle in angles]
    views = [View(f"{number}", place, gray) for number, place in enumerate(around)]
    made, preset = Scene(atlas.mesh, tuple(views), kind="object"), PRESETS["preview"]
    run, live = 0.0, Live(made, atlas, Monitor())
    for level in preset.levels:
        small = replace(atlas, width=atlas.width // level.scale, height=atlas.height // level.scale)
        maps = build_view_maps(small, tuple(shrink(view, level.scale) for view in views), "object")
        run += level.steps * step_seconds(maps, preset)
    began = time.process_time()
    write_gallery(tmp_path, made, atlas, dense, dense, curves([], []))
    previews = time.process_time() - began
    values = dense[maps.slot_map >= 0]
    live.show(1, maps, values, dense, [])
    began = time.process_time()
    live.show(2, maps, values, dense, [])
    glimpse = time.process_time() - began
    assert previews <= 0.05 * run, f"{previews:.2f} s of {run:.1f} s"
    assert glimpse <= 0.01 * live_module.SECONDS, f"{1000 * glimpse:.0f} ms every {live_module.SECONDS:.0f} s"


def step_seconds(maps: ViewMaps, preset: Preset, steps: int = 3) -> float:
    """Processor time of one step of the optimization, the least of some."""
    generator = torch.Generator().manual_seed(0)
    optimizer = AdversarialOptimizer(
        maps,
        related_pairs(maps, "object", preset.max_pair_angle, preset.min_pair_overlap),
        torch.full((maps.slots, 3), 0.5),
        preset,
        kind="object",
        steps=preset.steps,
        generator=generator,
        discriminator=PatchDiscriminator(generator),
    )
    taken = []
    for _ in range(steps):
        began = time.process_time()
        optimizer.step()
        taken.append(time.process_time() - began)
    return min(taken)

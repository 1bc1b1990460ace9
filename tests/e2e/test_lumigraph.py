"""Photographs where the viewer stands: Chromium draws what torch draws, and the page's cameras are the engine's."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import cv2
import numpy as np
import pytest
import torch
from atlases import camera
from browsing import FLAGS, chromium
from lumigraph import blended, photographed_scene, photographs
from playwright.sync_api import Browser, Page, sync_playwright

from advtex_engine.core.cameras import camera_to_world
from advtex_engine.core.scene import TO_Y_UP, Camera
from advtex_engine.mesh.trim import in_box
from advtex_engine.results import export_model
from advtex_engine.results.photographs import photograph_stream
from advtex_options.box import parse_box
from advtex_viewer import FOLDER

pytestmark = pytest.mark.slow
DRAW = """async ({ views, place }) => {
    const { Lumigraph } = await import("/lumigraph.js");
    const { photographCamera } = await import("/cameras.js");
    const { triangles } = await import("/glb.js");
    const [model, stream] = await Promise.all(["/model.glb", "/stream"].map((name) => fetch(name)));
    const jpegs = await stream.blob();
    const found = await Promise.all(views.map(async (view) => ({
        camera: photographCamera(view),
        picture: await createImageBitmap(jpegs.slice(view.offset, view.offset + view.bytes, "image/jpeg")),
    })));
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [place.width, place.height];
    new Lumigraph(canvas, triangles(await model.arrayBuffer()), found).draw(photographCamera(place));
    const pixels = new Uint8Array(4 * place.width * place.height);
    const gl = canvas.getContext("webgl2");
    gl.readPixels(0, 0, place.width, place.height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
    return { pixels: Array.from(pixels), error: gl.getError() };
}"""


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=chromium(), args=FLAGS)
        yield opened
        opened.close()


@pytest.fixture
def page(browser: Browser, tmp_path: Path) -> Iterator[Page]:
    """A page with the viewer's scripts and the files of `tmp_path`, without a server."""
    with browser.new_page() as tab:
        tab.route("http://page/", lambda route: route.fulfill(body="", content_type="text/html"))
        tab.route("http://page/*.js", lambda route: route.fulfill(path=FOLDER / route.request.url.rpartition("/")[2]))
        tab.route("http://page/model.glb", lambda route: route.fulfill(path=tmp_path / "model.glb"))
        tab.route("http://page/stream", lambda route: route.fulfill(path=tmp_path / "stream"))
        tab.goto("http://page/")
        yield tab


@pytest.mark.parametrize("eye", [(2.6, 1.0, 1.8), (1.9, -2.2, 0.9)], ids=["on the path", "beside it"])
def test_the_browser_blends_photographs_as_torch_does(
    page: Page, tmp_path: Path, eye: tuple[float, float, float]
) -> None:
    scene, atlas, texture = photographed_scene()
    export_model(tmp_path, atlas, texture, up_axis=scene.up_axis)
    entries, stream = photograph_stream(scene, atlas, texture)
    (tmp_path / "stream").write_bytes(stream)
    colors = [decoded(stream[entry["offset"] :][: entry["bytes"]]) for entry in entries]
    given = photographs(scene.mesh, [view.camera for view in scene.views], colors)
    place = camera(eye, 200, 150, 180.0)
    color, share = blended(scene.mesh, given, place)
    drawn = page.evaluate(DRAW, {"views": entries, "place": in_glb(place)})
    assert drawn["error"] == 0
    found = np.array(drawn["pixels"], np.float64).reshape(150, 200, 4)[::-1] / 255
    wanted = torch.cat((color * share[..., None], share[..., None]), 2).numpy()
    assert 0.2 < wanted[..., 3].mean() < 0.9
    difference = np.abs(found - wanted).max(2)
    assert np.median(difference) < 0.01
    assert (difference > 0.06).mean() < 0.03, "other pixels are at edges, where rasterizers differ"


INSIDE = """async ({ points, box, rotations }) => {
    const { parseBox, placed, scanToGlb, shareKept } = await import("/box.js");
    const { rotated } = await import("/cameras.js");
    return rotations.map((rotation) => {
        const toGlb = scanToGlb(rotation);
        const place = placed(parseBox(box), toGlb);
        return points.map((point) => shareKept({ positions: rotated(toGlb, point), indices: [0, 0, 0] }, place) === 1);
    });
}"""


def test_the_page_crops_what_the_engine_crops(page: Page) -> None:
    """Whichever axis is up, on points of the scan's world."""
    points = torch.from_numpy(np.random.default_rng(0).uniform(-2, 2, (300, 3)))
    box = "0.3,-0.2,0.1,1,2,3,30"
    inside = page.evaluate(INSIDE, {"points": points.tolist(), "box": box, "rotations": list(TO_Y_UP.values())})
    wanted = [in_box(points, parse_box(box), up_axis).tolist() for up_axis in TO_Y_UP]
    assert inside == wanted
    assert wanted[0] != wanted[1], "the turn's sense is told apart"


def test_scene_viewer_is_given_the_whole_address_of_a_link(page: Page) -> None:
    intent = page.evaluate(
        """import("/viewer.js").then(({ sceneViewer }) => sceneViewer("/links/a.1.b/c/model.glb"))"""
    )
    place, _, app = intent.partition("#Intent;")
    assert urlsplit(place)[:3] == ("intent", "arvr.google.com", "/scene-viewer/1.0")
    assert parse_qs(urlsplit(place).query) == {
        "file": ["http://page/links/a.1.b/c/model.glb"],
        "mode": ["ar_preferred"],
        "resizable": ["false"],
    }
    told = dict(part.split("=", 1) for part in app.removesuffix(";end;").split(";"))
    assert told["scheme"] == "https"
    assert told["package"] == "com.google.android.googlequicksearchbox"
    assert told["S.browser_fallback_url"] == "http%3A%2F%2Fpage%2F"


def decoded(jpeg: bytes) -> torch.Tensor:
    image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return torch.from_numpy(image[..., ::-1].copy())


def in_glb(place: Camera) -> dict[str, object]:
    """As `previews/photographs.json` has cameras, of a scan whose z is up."""
    to_glb = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    pose = (to_glb @ camera_to_world(place).numpy()).tolist()
    return {"K": place.K.tolist(), "camera_to_world": pose, "width": place.width, "height": place.height}

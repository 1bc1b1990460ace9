"""The page in a real browser: from the key to the model, through broken lines, restarts, reloads and bad scans."""

from __future__ import annotations

import hashlib
import math
import os
import re
import shutil
import subprocess
import time
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
import trimesh
from sqlalchemy import delete

from advtex_contract.jobs import TERMINAL, JobSpec
from advtex_store import keys
from advtex_store.models import SessionRow

if TYPE_CHECKING:
    from browsing import Browsing
    from playwright.sync_api import Locator, Page

pytestmark = pytest.mark.slow
VIEWER_MS = 60_000  # Chromium draws without a GPU
LONG = "100000"  # steps; such a job is canceled
HOSTILE = "<img src=x onerror=alert(1)>"


@pytest.fixture(scope="module")
def _browsing(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browsing]:
    from browsing import browsing

    with browsing(tmp_path_factory.mktemp("page")) as running:
        yield running


@pytest.fixture
def web(_browsing: Browsing) -> Iterator[Browsing]:
    """The service and the browser of all tests; each has tabs of its own, and no script may fail in them."""
    _browsing.problems.clear()
    yield _browsing
    _browsing.close_pages()
    with _browsing.service.client() as client:
        for job in client.list_jobs():
            if job.state not in TERMINAL:
                client.cancel_job(job.id)
    assert _browsing.problems == []


@pytest.fixture
def archive(scan: Path, tmp_path: Path) -> Path:
    from tiny_scan import write_zip

    return write_zip(tmp_path / "shelf.zip", scan)


def expect(locator: Locator | Page) -> Any:
    """Playwright's, with more patience: two cores have other things to do."""
    from browsing import WAIT_MS
    from playwright.sync_api import expect as expected

    expected.set_options(timeout=WAIT_MS)
    return expected(locator)


def submit(page: Page, scan: Path, steps: str = "1", seed: str = "") -> None:
    """Choose the scan, and send it."""
    page.goto("/new")
    if scan.is_dir():
        drop(page, scan)
    else:
        page.set_input_files("#zip", str(scan))
    page.get_by_text("More options").click()
    page.locator("[name=steps]").fill(steps)
    page.locator("[name=seed]").fill(seed)
    page.get_by_role("button", name="Upload and texture").click()


def drop(page: Page, path: Path) -> None:
    """Drag a file or a folder from the desktop onto the page."""
    box = page.locator("#drop").bounding_box()
    assert box is not None
    data = {"items": [], "files": [str(path)], "dragOperationsMask": 1}
    mouse = page.context.new_cdp_session(page)
    for event in ("dragEnter", "dragOver", "drop"):
        mouse.send("Input.dispatchDragEvent", {"type": event, "x": box["x"] + 9, "y": box["y"] + 9, "data": data})


def state(page: Page, name: str) -> None:
    """Wait until the job of this page is in a state."""
    expect(page.locator("#now .badge")).to_have_text(name)


def id_of(page: Page) -> str:
    page.wait_for_url("**/jobs/*")
    return page.url.rpartition("/")[2]


def grown(path: Path, megabytes: int) -> Path:
    """The zip with more in it, of which nothing is needed."""
    with zipfile.ZipFile(path, "a") as bundle:
        bundle.writestr("notes.bin", os.urandom(megabytes << 20))
    return path


def test_the_api_is_tried_out_from_its_description(web: Browsing) -> None:
    """Everything comes from the server itself: the policy would stop what does not, and be noted as a problem."""
    page = web.page(signed_in=False)
    page.goto("/docs")
    page.get_by_role("button", name="Authorize").click()
    page.get_by_label("Value").fill(web.service.key)
    page.get_by_role("button", name="Apply credentials").click()
    page.get_by_role("button", name="Close", exact=True).click()
    call = page.locator("[id^=operations-keys-get_key]")
    call.locator(".opblock-summary-control").click()
    call.get_by_role("button", name="Try it out").click()
    call.get_by_role("button", name="Execute").click()
    expect(call.locator(".live-responses-table .response-col_status").last).to_contain_text("200")
    expect(call.locator(".live-responses-table")).to_contain_text('"scopes"')
    page.screenshot(path=web.pictures / "api.png")


def test_a_wrong_key_and_a_session_that_ends(web: Browsing, archive: Path) -> None:
    page = web.page(signed_in=False)
    page.goto("/new")
    page.get_by_label("Key").fill("adv_wrong")
    page.get_by_role("button", name="Sign in").click()
    expect(page.get_by_role("alert")).to_contain_text("unknown, revoked or expired")
    web.sign_in(page)
    expect(page).to_have_url(f"{web.url}/new")
    submit(page, archive, LONG)
    job = id_of(page)
    state(page, "running")
    with web.service.store.database.write() as session:
        session.execute(delete(SessionRow))
    page.wait_for_url("**/sign-in?next=*")  # as soon as the page asks for something
    web.sign_in(page)
    expect(page).to_have_url(f"{web.url}/jobs/{job}")
    with web.service.client() as client:
        client.cancel_job(job)
    state(page, "canceled")


def test_from_upload_through_a_broken_line_to_the_model(web: Browsing, archive: Path, axe: str) -> None:
    """Every connection breaks within its second piece; the work is followed live; the result is all there."""
    from cutting_proxy import CuttingProxy

    data = grown(archive, 24).read_bytes()
    with CuttingProxy(web.service.url, 7, 17 << 20, 20 << 20) as bad_line:
        page = web.page(url=bad_line.url, width=700)
        submit(page, archive, "300")
        expect(page.locator("#speed")).to_have_text(re.compile(r"of 25\.2 MB, .*/s, .* left"))
        job = id_of(page)
        assert bad_line.cuts >= 1
        page.locator("#now").get_by_text(re.compile(r"step [1-9]\d* of 300")).wait_for()
        state(page, "succeeded")
        with web.service.client() as client:
            stored = web.service.store.blobs.get(keys.scan_key(client.get_job(job).upload_id))
        assert hashlib.sha256(stored).digest() == hashlib.sha256(data).digest()
        page.set_default_timeout(VIEWER_MS)
        check_result(page, web, axe)
        check_crop(page, web, job, axe)
        web.close_pages()


def check_result(page: Page, web: Browsing, axe: str) -> None:
    """The model is drawn and turns, the slider moves, the atlas zooms, files come."""
    expect(page.locator("model-viewer")).to_be_attached()
    expect(page.locator(".stage .wait")).to_have_count(0, timeout=VIEWER_MS)
    deadline = time.monotonic() + VIEWER_MS / 1000
    while (drawn := canvas(page))[..., :3].std() < 8:
        assert time.monotonic() < deadline, "the canvas is blank"
    look(page, "viewer", web.pictures, axe)
    page.evaluate("document.querySelector('model-viewer').shadowRoot.querySelector('.userInput').focus()")
    for _ in range(6):
        page.keyboard.press("ArrowRight")
    deadline = time.monotonic() + 30
    while np.abs(canvas(page) - drawn).mean() < 1:
        assert time.monotonic() < deadline, "the model does not turn"
    check_tools(page)
    compare = page.locator("#compare")
    range_ = compare.get_by_role("slider")
    whole = pixels(compare.locator(".slider").screenshot())
    range_.fill("95")
    assert "95 % photograph" in (range_.get_attribute("aria-valuetext") or "")
    assert np.abs(pixels(compare.locator(".slider").screenshot()) - whole).mean() > 0.1
    heldout = compare.get_by_role("button", name="held out")
    assert heldout.count() == 2
    heldout.last.click()
    expect(compare.get_by_text("made without this photograph")).to_be_visible()
    compare.get_by_text("Average | result").click()
    expect(compare.locator(".tag.left")).to_have_text("Plain average")
    before = page.locator(".zoomed img").bounding_box()
    page.get_by_role("button", name="Zoom in").click()
    after = page.locator(".zoomed img").bounding_box()
    assert before is not None
    assert after is not None
    assert after["width"] > 1.4 * before["width"]
    expect(page.locator("#stages").get_by_role("row", name="Writing the model")).to_contain_text("MB")
    expect(page.locator("#scores").get_by_role("row", name="PSNR")).to_be_visible()
    with page.expect_download() as download:
        page.get_by_role("link", name="model.glb").click()
    assert download.value.path().read_bytes().startswith(b"glTF")


def check_tools(page: Page) -> None:
    """Light and background change, distances are in metres, photographs lie over the model and are blended with it."""
    drawn = canvas(page)
    page.get_by_label("Light", exact=True).select_option("Studio light")
    wait_until(page, lambda: np.abs(canvas(page) - drawn).mean() > 1, "the light does not change")
    page.get_by_label("Light", exact=True).select_option("As photographed")
    page.get_by_label("Background").select_option("Dark")
    expect(page.locator(".stage")).to_have_css("background-color", "rgb(20, 25, 28)")
    page.get_by_label("Compare with").select_option("000002, held out")
    wipe = page.get_by_role("slider", name="Photograph against model")
    expect(wipe).to_be_visible()
    page.get_by_role("button", name="Measure").click()
    stage = page.locator(".stage").bounding_box()
    assert stage is not None
    focal = 90 * min(stage["width"] / 96, stage["height"] / 72)  # the stage holds the photograph, which is 2 m away
    for pixels_aside in (0, 90):
        page.mouse.click(stage["x"] + stage["width"] / 2 - pixels_aside, stage["y"] + stage["height"] / 2)
    told = page.get_by_text(re.compile(r"Distance: \d+\.\d cm"))
    expect(told).to_be_visible()
    assert float(told.inner_text().split()[1]) == pytest.approx(100 * 2 * 90 / focal, abs=0.5)
    page.get_by_role("button", name="Measure").click()
    photographs = page.get_by_role("button", name="Photographs where you stand")
    photographs.click()
    expect(page.locator(".lumigraph")).to_be_visible()
    expect(wipe).to_be_visible()
    page.evaluate("document.querySelector('model-viewer').shadowRoot.querySelector('.userInput').focus()")
    page.keyboard.press("ArrowLeft")
    expect(wipe).to_be_hidden()
    photographs.click()
    expect(page.locator(".lumigraph")).to_be_hidden()


BOX_SEEN = """() => {
    const viewer = document.querySelector("model-viewer");
    const { theta, phi, radius } = viewer.getCameraOrbit();
    const { x, y, z } = viewer.getCameraTarget();
    const { clientWidth: width, clientHeight: height } = document.querySelector(".stage");
    const numbers = (line, names) => names.map((name) => Number(line.getAttribute(name)));
    const lines = [...document.querySelectorAll(".box line")];
    const ends = lines.flatMap((line) => [numbers(line, ["x1", "y1"]), numbers(line, ["x2", "y2"])]);
    const [field, orientation] = [viewer.getFieldOfView(), viewer.getAttribute("orientation")];
    return { theta, phi, radius, target: [x, y, z], field, width, height, ends, orientation };
}"""


def check_crop(page: Page, web: Browsing, job: str, axe: str) -> None:
    """A box is pulled, pushed by keys and typed; the job that is made of it has that box, as it is drawn, to a
    millimetre, and else the same scan and options."""
    page.get_by_role("button", name="Crop", exact=True).click()
    side = page.get_by_role("button", name="Side of most X")
    page.locator(".stage").evaluate("stage => stage.scrollIntoView({ block: 'center' })")
    side.hover()  # waits until it stands still
    before = numbers(page)
    grip = side.bounding_box()
    middle = page.get_by_role("button", name="Middle of the box").bounding_box()
    assert grip is not None
    assert middle is not None
    page.mouse.down()
    page.mouse.move((grip["x"] + middle["x"]) / 2 + 15, (grip["y"] + middle["y"]) / 2 + 15, steps=3)
    page.mouse.up()
    pulled = numbers(page)
    assert pulled[3] == pytest.approx(0.75 * before[3], abs=0.1)  # less, as what is nearer looks larger
    assert pulled[0] == pytest.approx(before[0] - (before[3] - pulled[3]) / 2, abs=0.0011)
    page.get_by_role("button", name="Side of most Z").press("Shift+ArrowUp")
    page.get_by_role("button", name="Turn of the box").press("Shift+ArrowRight")
    page.get_by_label("Center Y, m").fill("0.123")
    page.get_by_label("Center Y, m").press("Enter")
    box = numbers(page)
    assert box == pytest.approx([pulled[0], 0.123, pulled[2] + 0.05, *pulled[3:5], pulled[5] + 0.1, 10])
    drawn = page.evaluate(BOX_SEEN)
    assert np.abs(np.array(drawn["ends"]) - edges_of(box, drawn)).max() < 0.1, "a millimetre is .2 pixels"
    expect(page.get_by_text(re.compile(r"Keeps 100\.0 % of the model's faces"))).to_be_visible()
    look(page, "crop", web.pictures, axe)
    page.get_by_role("button", name="Texture again with this box").click()
    page.wait_for_url(lambda url: job not in url)
    with web.service.client() as client:
        old, new = client.get_job(job), client.get_job(id_of(page))
    assert [float(part) for part in (new.options.box or "").split(",")] == pytest.approx(box, abs=1e-9)
    assert new.upload_id == old.upload_id
    assert new.options.model_copy(update={"box": None}) == old.options


def numbers(page: Page) -> list[float]:
    """Center, size and turn, as the fields have them."""
    return [float(field.input_value()) for field in page.locator(".numbers input").all()]


def edges_of(box: list[float], drawn: dict[str, Any]) -> Any:
    """[24,2] pixels, where the ends of a box's edges are seen. The scan's z is up."""
    yaw = math.radians(box[6])
    turn = np.array([[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]])
    signs = np.array([[(1 if index >> axis & 1 else -1) for axis in range(3)] for index in range(8)])
    corners = np.array(box[:3]) + (signs * np.array(box[3:6]) / 2) @ turn.T
    as_glb = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    angles = [float(angle.removesuffix("rad")) for angle in drawn["orientation"].split()]
    stand = trimesh.transformations.euler_matrix(*angles, "szxy")[:3, :3]
    theta, phi = drawn["theta"], drawn["phi"]
    back = np.array([math.sin(phi) * math.sin(theta), math.cos(phi), math.sin(phi) * math.cos(theta)])
    right = np.array([math.cos(theta), 0, -math.sin(theta)])
    axes = np.stack((right, -np.cross(back, right), -back))
    seen = (corners @ (stand @ as_glb).T - drawn["target"] - drawn["radius"] * back) @ axes.T
    focal = drawn["height"] / 2 / math.tan(math.radians(drawn["field"]) / 2)
    pixels = seen[:, :2] / seen[:, 2:] * focal + np.array([drawn["width"], drawn["height"]]) / 2
    pairs = [(index, index | bit) for index in range(8) for bit in (1, 2, 4) if not index & bit]
    return pixels[np.array(pairs).ravel()]


def wait_until(page: Page, holds: Callable[[], bool], problem: str) -> None:
    deadline = time.monotonic() + 30
    while not holds():
        assert time.monotonic() < deadline, problem
        page.wait_for_timeout(50)


def canvas(page: Page) -> Any:
    """[240,320,4] float32 of what the viewer has drawn: it draws fewer pixels where it finds itself slow."""
    png = """async () => {
        const blob = await document.querySelector('model-viewer').toBlob();
        return Array.from(new Uint8Array(await blob.arrayBuffer()));
    }"""
    return cv2.resize(pixels(bytes(page.evaluate(png))), (320, 240), interpolation=cv2.INTER_AREA)


def pixels(png: bytes) -> Any:
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return image.astype(np.float32)


def test_reloading_in_the_middle_of_an_upload_goes_on_with_it(web: Browsing, archive: Path) -> None:
    grown(archive, 24)
    page = web.page()
    page.on("dialog", lambda dialog: dialog.accept())  # "leave the page?"
    offsets: list[int] = []
    page.on(
        "request", lambda sent: offsets.append(int(sent.headers["upload-offset"])) if sent.method == "PATCH" else None
    )
    line = page.context.new_cdp_session(page)
    slow = {"offline": False, "latency": 0, "downloadThroughput": -1, "uploadThroughput": 4 << 20}
    line.send("Network.emulateNetworkConditions", slow)
    submit(page, archive)
    expect(page.locator("#speed")).to_have_text(re.compile(r"(1[89]|2\d)\.\d MB of"))
    page.reload()
    line.send("Network.emulateNetworkConditions", {**slow, "uploadThroughput": -1})
    submit(page, archive)
    expect(page.locator("#notice")).to_contain_text("Going on with the upload")
    id_of(page)
    assert offsets[:2] == [0, 16 << 20]
    assert offsets[2] >= 16 << 20
    state(page, "succeeded")


def test_a_folder_is_sent_as_a_zip_and_hostile_names_stay_names(web: Browsing, scan: Path) -> None:
    hostile = scan.rename(scan.with_name(HOSTILE))
    (hostile / "color" / f"{HOSTILE}.txt").write_text("not an image")
    page = web.page()
    page.on("dialog", lambda dialog: web.problems.append(f"a script runs: {dialog.message}"))
    submit(page, hostile)
    job = id_of(page)
    state(page, "succeeded")
    expect(page.get_by_role("heading", level=1)).to_have_text(HOSTILE)
    page.goto("/")
    expect(page.locator(f'[data-id="{job}"] a')).to_have_text(HOSTILE)
    with web.service.client() as client:
        key = keys.scan_key(client.get_job(job).upload_id)
    path = web.service.store.blobs.path(key)  # type: ignore[attr-defined]
    with zipfile.ZipFile(path) as bundle:
        assert bundle.testzip() is None
        names = {f"{HOSTILE}/{file.relative_to(hostile).as_posix()}" for file in hostile.rglob("*") if file.is_file()}
        assert set(bundle.namelist()) == names


def test_cancel_retry_and_delete(web: Browsing, archive: Path) -> None:
    page = web.page()
    submit(page, archive, LONG)
    job = id_of(page)
    state(page, "running")
    glimpse = page.get_by_role("img", name="View color/4 as it is now")
    expect(glimpse).to_be_visible()
    assert glimpse.evaluate("image => image.decode().then(() => image.naturalWidth)") == 256
    expect(page.get_by_role("img", name="L1 loss: from 0.3 to 0.1")).to_be_visible()
    page.get_by_role("button", name="Cancel").click()
    page.get_by_role("button", name="Keep it").click()
    state(page, "running")
    page.get_by_role("button", name="Cancel").click()
    page.get_by_role("button", name="Cancel the job").click()
    state(page, "canceled")
    page.get_by_role("button", name="Retry").click()
    page.locator("#now").get_by_text(re.compile(r"step [\d,]+ of 100,000")).wait_for()
    expect(page.locator("#facts")).to_contain_text("attempt 2")
    page.reload()
    page.locator("#now").get_by_text(re.compile(r"step [\d,]+ of 100,000")).wait_for()
    page.get_by_role("button", name="Cancel").click()
    page.get_by_role("button", name="Cancel the job").click()
    state(page, "canceled")
    page.get_by_role("button", name="Delete").click()
    page.locator("dialog").get_by_role("button", name="Delete").click()
    page.wait_for_url(f"{web.url}/")
    expect(page.locator("#jobs:visible, #empty:visible")).to_be_visible()
    assert page.locator(f'[data-id="{job}"]').count() == 0


def test_the_list_lives_through_a_restart_of_the_server(web: Browsing, archive: Path) -> None:
    page, other = web.page(), web.page()
    page.goto("/")
    submit(other, archive, LONG)
    job = id_of(other)
    row = page.locator(f'[data-id="{job}"]')
    expect(row.locator(".badge")).to_have_text("running")
    state(other, "running")
    web.restart_server()
    for seen in (row, other.locator("#now")):
        step = steps_of(seen)
        deadline = time.monotonic() + 30
        while steps_of(seen) <= step + 100:
            assert time.monotonic() < deadline, "nothing comes any more"
            page.wait_for_timeout(100)
    with web.service.client() as client:
        client.cancel_job(job)
    expect(row.locator(".badge")).to_have_text("canceled")
    state(other, "canceled")


def steps_of(place: Locator) -> int:
    match = re.search(r"([\d,]+) (?:/|of) 100,000", place.inner_text())
    return int(match[1].replace(",", "")) if match else 0


def test_a_bad_scan_is_explained_before_and_after_it_is_sent(web: Browsing, scan: Path) -> None:
    page = web.page()
    page.goto("/new")
    dropped = page.evaluate_handle("""() => {
        const transfer = new DataTransfer();
        transfer.items.add(new File(["no zip at all"], "photo.zip"));
        return transfer;
    }""")
    page.dispatch_event("#drop", "drop", {"dataTransfer": dropped})
    expect(page.locator("#findings .error")).to_contain_text("no zip, or it is cut off")
    expect(page.get_by_role("button", name="Upload and texture")).to_be_disabled()
    (scan / "mesh.ply").unlink()
    page.set_input_files("#folder", str(scan))
    expect(page.locator("#findings .warning")).to_contain_text("Neither a mesh nor depth")
    page.get_by_role("button", name="Upload and texture").click()
    expect(page.get_by_role("alert")).to_contain_text("cannot be textured")
    expect(page.locator("#findings .error").first).to_contain_text("mesh")
    page.get_by_role("link", name="The job that was rejected").click()
    state(page, "rejected")
    expect(page.locator("#now .remedy").first).to_be_visible()


def test_a_failure_is_told_in_words_with_the_end_of_the_log(web: Browsing, archive: Path) -> None:
    from page_engines import FAILS

    page = web.page()
    submit(page, archive, seed=str(FAILS))
    state(page, "failed")
    expect(page.locator("#now")).to_contain_text("the widget is not a gadget")
    expect(page.get_by_role("region", name="The end of the log")).to_contain_text("looking for the widget")


@pytest.fixture(scope="module")
def axe(request: pytest.FixtureRequest) -> str:
    """The script, from pytest's cache."""
    npm = shutil.which("npm")
    if npm is None:
        pytest.skip("npm is not installed: it provides axe-core")
    assert request.config.cache is not None
    folder = Path(request.config.cache.mkdir("axe"))
    shutil.copy(Path(__file__).parent / "axe" / "package.json", folder)
    script = folder / "node_modules" / "axe-core" / "axe.min.js"
    if not script.exists():
        command = [npm, "install", "--no-save", "--no-audit", "--no-fund", "--ignore-scripts"]
        subprocess.run(command, cwd=folder, check=True, capture_output=True, timeout=240)
    return script.read_text()


IPHONE = """
    const known = DOMTokenList.prototype.supports;
    DOMTokenList.prototype.supports = function (token) { return token === "ar" || known.call(this, token); };
    Object.defineProperty(navigator, "userAgent", { get: () => "iPhone" });
    window.opened = new Promise((resolve) => {
        HTMLAnchorElement.prototype.click = function () { resolve({ rel: this.rel, href: this.href }); };
    });
"""


def test_quick_look_gets_the_usdz_without_the_session(web: Browsing, archive: Path) -> None:
    with web.service.client() as client:
        spec = JobSpec(upload_id=client.upload(archive).id)
        job = client.create_job(spec, idempotency_key="for AR").id
        client.wait_for_job(job, timeout=60)
        usdz = next(file for file in client.get_job(job).results if file.name == "model.usdz")
    page = web.page()
    page.add_init_script(IPHONE)
    page.goto(f"/jobs/{job}")
    page.get_by_role("button", name="View in AR").click(timeout=VIEWER_MS)
    opened = page.evaluate("opened")
    assert opened["rel"] == "ar"
    assert opened["href"].startswith("blob:"), "Quick Look sends no cookies"
    blob = page.evaluate(
        "async (address) => { const found = await (await fetch(address)).blob(); return [found.type, found.size]; }",
        opened["href"].partition("#")[0],
    )
    assert blob == ["model/vnd.usdz+zip", usdz.size]


def test_every_page_is_open_to_all_and_fits_every_screen(web: Browsing, axe: str, archive: Path) -> None:
    """axe-core finds nothing serious, nothing is wider than the screen, and without the viewer the model is seen in
    pictures. Those that are written here are for people to look at."""
    from crowd import gather

    with web.service.client() as client:
        jobs = {job.state.value: job.id for job in client.list_jobs()}
        spec = JobSpec(upload_id=client.upload(archive).id, label="for the pictures", batch="night")
        jobs["succeeded"] = client.create_job(spec, idempotency_key="pictures").id
        client.wait_for_job(jobs["succeeded"], timeout=60)
    places = {"jobs": "/", "batch": "/?batch=night", "new": "/new"}
    places |= {name: f"/jobs/{job}" for name, job in jobs.items() if name in ("succeeded", "failed", "rejected")}
    page = web.page()
    page.route("**/model-viewer.min.js", lambda route: route.abort())
    for name, address in places.items():
        page.goto(address)
        if name == "succeeded":
            expect(page.get_by_role("slider", name="Turn the model")).to_be_visible()
        look_at_all_sizes(page, name, web.pictures, axe)
    gather(web.service.store)
    page.goto("/fleet")
    page.locator("#failures summary").first.click()
    expect(page.get_by_role("list").filter(has_text="gpu-node-9-7")).to_contain_text(HOSTILE)
    look_at_all_sizes(page, "fleet", web.pictures, axe)
    page.get_by_role("button", name="Sign out").click()
    page.get_by_label("Key").wait_for()
    look_at_all_sizes(page, "sign-in", web.pictures, axe)


def look_at_all_sizes(page: Page, name: str, folder: Path, axe: str) -> None:
    for width, scheme in ((1280, "dark"), (1280, "light"), (390, "light"), (360, "dark")):
        page.set_viewport_size({"width": width, "height": 860})
        page.emulate_media(color_scheme=scheme)  # type: ignore[arg-type]
        look(page, f"{name}-{width}-{scheme}", folder, axe if (width > 390) == (scheme == "light") else "")


def look(page: Page, name: str, folder: Path, axe: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    page.wait_for_load_state("load")
    page.screenshot(path=folder / f"{name}.png", full_page=True)
    wide = page.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth")
    assert wide <= 0, f"{name} scrolls sideways"
    heights = page.evaluate("[...document.querySelectorAll('.bar nav a')].map(link => link.offsetHeight)")
    assert max(heights, default=0) < 40, f"{name}: a link of the bar takes two lines"
    if not axe:
        return
    page.evaluate(axe)
    found = page.evaluate("axe.run({resultTypes: ['violations']})")["violations"]
    serious = [(v["id"], v["nodes"][0]["html"]) for v in found if v["impact"] in ("serious", "critical")]
    assert serious == [], name

"""Decoded frames on disk, and the choice of views on the way from a scan to a scene."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from advtex_engine.core.config import TextureConfig
from advtex_engine.core.errors import OptionError, Stopped
from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import Camera, DepthFrame
from advtex_engine.ingest import frames as capture
from advtex_engine.ingest import read as ingest
from advtex_engine.ingest.frames import MAX_HELDOUT, Frame, FrameStore, view_budget
from advtex_engine.ingest.read import read_capture
from advtex_engine.pipeline import texture_scan
from advtex_engine.runtime import threads
from advtex_engine.runtime.threads import in_threads
from advtex_engine.synthetic.scan import synthesize

VIEWS, BUDGET = 14, 6
CONFIG = TextureConfig(method="mean", face_budget=2000, device="cpu", refine=False, max_views=BUDGET)


class Listener(Monitor):
    def __init__(self, stop_after: int = 1_000_000) -> None:
        self.notes, self.warnings, self.asked, self.stop_after = list[str](), list[str](), 0, stop_after

    def note(self, message: str) -> None:
        self.notes.append(message)

    def warning(self, problem: object) -> None:
        self.warnings.append(str(problem))

    def stop_requested(self) -> bool:
        self.asked += 1
        return self.asked > self.stop_after


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("long") / "scan"
    synthesize(folder, views=VIEWS, width=96, height=72)
    return folder


def camera(width: int, height: int) -> Camera:
    return Camera(torch.eye(3, dtype=torch.float64), torch.eye(4, dtype=torch.float64), width, height)


@st.composite
def frames(draw: st.DrawFn) -> Frame:
    width, height = draw(st.integers(1, 9)), draw(st.integers(1, 9))
    generator = torch.Generator().manual_seed(draw(st.integers(0, 99)))
    color = torch.randint(0, 256, (height, width, 3), generator=generator, dtype=torch.uint8)
    mask = torch.rand((height, width), generator=generator) > 0.5 if draw(st.booleans()) else None
    measured = None
    if draw(st.booleans()):
        depth = torch.rand((height + 1, width + 2), generator=generator)
        measured = DepthFrame(camera(width + 2, height + 1), depth, depth / 2 if draw(st.booleans()) else None)
    return Frame(str(draw(st.integers(0, 99))), camera(width, height), color, mask, measured, None, 0.5)


@given(given_frames=st.lists(frames(), max_size=6), spool=st.sampled_from([1, 200, 1 << 20]))
def test_what_is_stored_reads_back_equal_in_any_order(given_frames: list[Frame], spool: int) -> None:
    with pytest.MonkeyPatch.context() as patch, tempfile.TemporaryDirectory() as folder:
        patch.setattr(capture, "SPOOL_BYTES", spool)
        with FrameStore(Path(folder)) as store:
            stored = [store.put(frame) for frame in given_frames]
            assert list(Path(folder).iterdir()) == []
            for frame, kept in reversed(list(zip(given_frames, stored, strict=True))):
                found = store.get(kept)
                assert (found.name, found.camera, found.sharpness) == (frame.name, frame.camera, frame.sharpness)
                assert found.color.equal(frame.color)
                assert (found.mask is None) == (frame.mask is None)
                assert found.mask is None or frame.mask is None or found.mask.equal(frame.mask)
                assert (found.measured is None) == (frame.measured is None)
                if found.measured is not None and frame.measured is not None:
                    assert found.measured.depth.equal(frame.measured.depth)
                    assert (found.measured.confidence is None) == (frame.measured.confidence is None)


def test_threads_read_ahead_by_few_and_keep_the_order() -> None:
    drawn = list[int]()

    def items() -> range:
        return range(40)

    results = in_threads(lambda item: item * item, (drawn.append(item) or item for item in items()))
    for number, result in enumerate(results):
        assert result == number * number
        assert len(drawn) <= number + 1 + threads.WORKERS
    assert drawn == list(items())


def test_of_a_long_scan_no_more_views_than_the_budget_are_used(scan: Path, tmp_path: Path) -> None:
    listener = Listener()
    work = tmp_path / "work"
    report = texture_scan(scan, tmp_path / "out", CONFIG, work=work, monitor=listener).report
    choice = report["view_choice"]
    assert report["scan"]["views"] == len(choice["kept"]) == choice["budget"] == BUDGET
    assert choice["frames"] == VIEWS
    assert sum(map(len, choice["left_out"].values())) == VIEWS - BUDGET
    assert any(note.startswith(f"{BUDGET} of {VIEWS} frames become views") for note in listener.notes)
    assert report["warnings"] == []
    assert json.loads((tmp_path / "out" / "report.json").read_text())["view_choice"] == choice
    assert {file.suffix for file in work.iterdir()} == {".pt"}
    again = texture_scan(scan, tmp_path / "again", CONFIG, work=work, resume=True).report
    assert again["view_choice"] == choice


def test_a_scan_within_the_budget_keeps_all_frames(scan: Path, tmp_path: Path) -> None:
    config = TextureConfig(method="mean", face_budget=2000, device="cpu", refine=False, max_views=VIEWS)
    listener = Listener()
    report = texture_scan(scan, tmp_path / "out", config, work=tmp_path / "work", monitor=listener).report
    assert report["scan"]["views"] == VIEWS
    assert report["view_choice"] is None
    assert listener.notes == []


def test_held_out_frames_are_no_candidates(scan: Path) -> None:
    config = TextureConfig(holdout=7, max_views=BUDGET)
    with FrameStore() as store:
        found = read_capture(scan, config, store, Monitor())
        assert found.mesh is not None
        chosen, report = found.choose(found.mesh, BUDGET, Monitor())
        scene = chosen.scene(found.mesh, Monitor())
    assert report is not None
    assert report["frames"] == VIEWS - 2
    assert len(scene.views) == BUDGET
    assert [view.name for view in scene.heldout] == [frame.name for frame in found.heldout]
    assert {view.name for view in scene.views}.isdisjoint(view.name for view in scene.heldout)


def test_views_of_the_choice_are_the_frames_as_they_were_decoded(scan: Path) -> None:
    """And no frame's color is decoded a second time."""
    decoded = list[object]()
    original = ingest.color_image
    with pytest.MonkeyPatch.context() as patch, FrameStore() as store:
        patch.setattr(ingest, "color_image", lambda *given: (decoded.append(given[1]), original(*given))[1])
        found = read_capture(scan, CONFIG, store, Monitor())
        assert found.mesh is not None
        views = found.choose(found.mesh, BUDGET, Monitor())[0].scene(found.mesh, Monitor()).views
    everything = {view.name: view for view in ingest.ingest(scan, CONFIG, Monitor()).views}
    assert len(everything) == len(decoded) == len(set(decoded)) == VIEWS
    assert len(views) == BUDGET
    for view in views:
        whole = everything[view.name]
        assert view.color.equal(whole.color)
        assert view.depth is not None and whole.depth is not None
        assert view.depth.equal(whole.depth)


def test_a_stop_ends_the_decoding(scan: Path) -> None:
    listener = Listener(stop_after=3)
    with FrameStore() as store, pytest.raises(Stopped, match="while frames are decoded"):
        read_capture(scan, CONFIG, store, listener)
    assert listener.asked == 4


def test_the_budget_is_in_views_and_in_bytes() -> None:
    assert view_budget(300, 640, 480) == view_budget(300, 1296, 968) == 300
    assert view_budget(1000, 1296, 968) == 760
    assert view_budget(300, 4000, 3000) == 79
    with pytest.raises(OptionError, match="max_views 1 is out of bounds; give 2 to 2000 frames"):
        TextureConfig(max_views=1)
    assert MAX_HELDOUT < 100

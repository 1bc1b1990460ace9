"""Charts begun ahead and kept: always those of the mesh, whatever becomes of files, runs and other meshes."""

from __future__ import annotations

import os
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from advtex_engine import pipeline
from advtex_engine.atlas import chart_cache
from advtex_engine.atlas.build import begin_charts, build_atlas
from advtex_engine.atlas.chart_cache import ChartMaker, Position, chart_key
from advtex_engine.atlas.charting import Charts, Integers, make_charts
from advtex_engine.atlas.preparation import MeshPreparation
from advtex_engine.bench.scene import made_scene
from advtex_engine.core.config import TextureConfig
from advtex_engine.core.errors import Problem, ScanError, Stopped
from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import Mesh
from advtex_engine.ingest import read as ingest
from advtex_engine.synthetic.scan import synthesize

Arrays = tuple[Position, Integers]


@pytest.fixture(scope="module")
def ball() -> Arrays:
    scene, _ = made_scene(600, 1, 32, 24)
    return (scene.mesh.v_pos * 20).numpy(), scene.mesh.t_pos_idx.numpy()


@pytest.fixture(scope="module")
def charts(ball: Arrays) -> Charts:
    return make_charts(*ball, Monitor())


@pytest.fixture(autouse=True)
def _every_mesh_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chart_cache, "LEAST_FACES", 1)


class Listener(Monitor):
    def __init__(self) -> None:
        self.notes = list[str]()

    def note(self, message: str) -> None:
        self.notes.append(message)


def same(one: Charts, other: Charts) -> bool:
    return all(np.array_equal(value, getattr(other, name)) for name, value in vars(one).items())


def forbid(monkeypatch: pytest.MonkeyPatch) -> None:
    def make(*_: object, **__: object) -> Charts:
        raise AssertionError("the charts were kept")

    monkeypatch.setattr(chart_cache, "make_charts", make)


def test_charts_made_ahead_in_a_child_are_those_made_on_the_spot(ball: Arrays, charts: Charts) -> None:
    with ChartMaker(None) as maker:
        maker.begin(*ball)
        maker.begin(*ball)  # again: goes on with the same ones
        assert same(maker.make(*ball, Monitor()), charts)


def test_the_next_job_finds_them(ball: Arrays, charts: Charts, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "made" / "when needed"
    with ChartMaker(folder) as maker:
        assert same(maker.make(*ball, Monitor()), charts)
    forbid(monkeypatch)
    listener = Listener()
    with ChartMaker(folder) as maker:
        maker.begin(*ball)
        assert same(maker.make(*ball, listener), charts)
    assert listener.notes == ["the mesh's charts are those of an earlier job"]


def test_another_mesh_or_option_has_charts_of_its_own(ball: Arrays, monkeypatch: pytest.MonkeyPatch) -> None:
    position, faces = ball
    moved, turned = position.copy(), faces.copy()
    moved[0, 0] = np.nextafter(moved[0, 0], np.float32(9))
    turned[0] = np.roll(turned[0], 1)
    keys = [chart_key(position, faces), chart_key(moved, faces), chart_key(position, turned)]
    monkeypatch.setattr(chart_cache, "CHART_COST", 7.5)
    keys.append(chart_key(position, faces))
    assert len(set(keys)) == len(keys)
    monkeypatch.undo()
    assert chart_key(np.asfortranarray(position), faces.copy()) == keys[0]


@settings(max_examples=30, deadline=None)
@given(data=st.data())
def test_a_broken_file_is_made_again(data: st.DataObject, tmp_path_factory: pytest.TempPathFactory) -> None:
    """Cut off, or with a byte changed: what is read is right, or it is not used."""
    folder = tmp_path_factory.mktemp("charts")
    position = np.zeros((3, 3), np.float32)
    faces = np.array([[0, 1, 2]])
    right = Charts(np.arange(6.0).reshape(3, 2), np.array([[0, 1, 2]]), np.array([0]))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(chart_cache, "make_charts", lambda *_: right)
        with ChartMaker(folder) as maker:
            maker.make(position, faces, Monitor())
            (file,) = folder.iterdir()
            whole = file.read_bytes()
            if data.draw(st.booleans()):
                file.write_bytes(whole[: data.draw(st.integers(0, len(whole) - 1))])
            else:
                place = data.draw(st.integers(0, len(whole) - 1))
                changed = (whole[place] + data.draw(st.integers(1, 255))) % 256
                file.write_bytes(whole[:place] + bytes([changed]) + whole[place + 1 :])
            assert same(maker.make(position, faces, Monitor()), right)


def test_a_folder_that_cannot_be_used_costs_nothing_but_time(ball: Arrays, charts: Charts, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with ChartMaker(tmp_path / "file" / "charts") as maker:
        maker.begin(*ball)
        assert same(maker.make(*ball, Monitor()), charts)


def test_small_meshes_leave_no_file(ball: Arrays, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chart_cache, "LEAST_FACES", len(ball[1]) + 1)
    with ChartMaker(tmp_path) as maker:
        maker.begin(*ball)
        assert maker._begun is None
        maker.make(*ball, Monitor())
    assert list(tmp_path.iterdir()) == []


def test_the_folder_keeps_what_was_used_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    faces = np.array([[0, 1, 2]])
    monkeypatch.setattr(chart_cache, "make_charts", lambda *_: Charts(np.zeros((400, 2)), faces, np.zeros(1, np.int64)))
    meshes = [np.full((3, 3), number, np.float32) for number in range(4)]
    files = [tmp_path / chart_key(mesh, faces) for mesh in meshes]
    with ChartMaker(tmp_path) as maker:
        for mesh, file in zip(meshes[:3], files, strict=False):
            maker.make(mesh, faces, Monitor())
            os.utime(file, (0, time.time() - 1000 + files.index(file)))
        monkeypatch.setattr(chart_cache, "MAX_BYTES", int(2.5 * files[0].stat().st_size))
        maker.make(meshes[0], faces, Monitor())  # a use
        maker.make(meshes[3], faces, Monitor())
    assert [file.exists() for file in files] == [True, False, False, True]


def test_many_runs_share_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    faces = np.array([[0, 1, 2]])

    def made(position: Position, *_: object) -> Charts:
        return Charts(np.full((300, 2), float(position[0, 0])), faces, np.zeros(1, np.int64))

    monkeypatch.setattr(chart_cache, "make_charts", made)
    monkeypatch.setattr(chart_cache, "MAX_BYTES", 20_000)

    def run(number: int) -> bool:
        mesh = np.full((3, 3), number % 7, np.float32)
        with ChartMaker(tmp_path) as maker:
            return same(maker.make(mesh, faces, Monitor()), made(mesh))

    with ThreadPoolExecutor(8) as pool:
        assert all(pool.map(run, range(200)))
    assert sum(file.stat().st_size for file in tmp_path.iterdir()) <= 20_000 + 6_000  # the last two may have raced


class Endless:
    """Charts that never come, as of a child that hangs."""

    def __init__(self) -> None:
        self.started, self.ended = threading.Event(), threading.Event()

    def __call__(self, _position: Position, _faces: Integers, monitor: Monitor, *, apart: bool) -> Charts:
        assert apart
        self.started.set()
        while not monitor.stop_requested():
            time.sleep(0.01)
        self.ended.set()
        raise Stopped("canceled")


def test_what_was_begun_for_another_mesh_is_given_up(
    ball: Arrays, charts: Charts, monkeypatch: pytest.MonkeyPatch
) -> None:
    position, faces = ball
    endless = Endless()
    with ChartMaker(None) as maker:
        monkeypatch.setattr(chart_cache, "make_charts", endless)
        maker.begin(position + 1, faces)
        assert endless.started.wait(5)
        monkeypatch.undo()
        monkeypatch.setattr(chart_cache, "LEAST_FACES", 1)
        maker.begin(position, faces)
        assert endless.ended.is_set()
        assert same(maker.make(position, faces, Monitor()), charts)


def test_the_end_of_a_run_ends_what_was_begun(ball: Arrays, monkeypatch: pytest.MonkeyPatch) -> None:
    endless = Endless()
    monkeypatch.setattr(chart_cache, "make_charts", endless)

    def failing_run() -> None:
        with ChartMaker(None) as maker:
            maker.begin(*ball)
            assert endless.started.wait(5)
            raise RuntimeError("another stage failed")

    with pytest.raises(RuntimeError, match="another stage failed"):
        failing_run()
    assert endless.ended.is_set()


def test_a_stop_does_not_wait_for_the_charts(ball: Arrays, monkeypatch: pytest.MonkeyPatch) -> None:
    class Stopping(Monitor):
        def stop_requested(self) -> bool:
            assert threading.current_thread() is threading.main_thread()  # as the monitor is promised
            return endless.started.is_set()

    endless = Endless()
    monkeypatch.setattr(chart_cache, "make_charts", endless)
    with ChartMaker(None) as maker:
        maker.begin(*ball)
        with pytest.raises(Stopped, match="resume begins them again"):
            maker.make(*ball, Stopping())
    assert endless.ended.is_set()


def test_an_atlas_of_charts_begun_ahead_is_the_same(tmp_path: Path) -> None:
    scene, _ = made_scene(600, 8, 64, 48)
    mesh, cameras = Mesh(scene.mesh.v_pos, scene.mesh.t_pos_idx), [view.camera for view in scene.views]
    plain = build_atlas(mesh, cameras, TextureConfig(), Monitor())
    for _ in ("made", "kept"):
        with ChartMaker(tmp_path) as maker:
            begin_charts(mesh, maker)
            atlas = build_atlas(mesh, cameras, TextureConfig(), Monitor(), maker)
        assert (atlas.width, atlas.charts) == (plain.width, plain.charts)
        assert atlas.mesh.v_uv is not None
        assert plain.mesh.v_uv is not None
        assert atlas.mesh.v_uv.equal(plain.mesh.v_uv)
    with ChartMaker(tmp_path) as maker:
        begin_charts(scene.mesh, maker)  # it brings uv
        assert maker._begun is None


@pytest.mark.slow
def test_a_run_begins_with_the_charts_early_and_the_next_one_finds_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scan = tmp_path / "scan"
    synthesize(scan, views=4, width=96, height=72)
    made = list[str]()

    def make(position: Position, faces: Integers, monitor: Monitor, *, apart: bool = False) -> Charts:
        made.append("ahead" if apart else "on the spot")
        return make_charts(position, faces, monitor)

    monkeypatch.setattr(chart_cache, "make_charts", make)
    monkeypatch.setattr(pipeline, "charts_folder", lambda: tmp_path / "charts")
    config = TextureConfig(face_budget=500, refine=False, device="cpu")
    atlases = []
    for run in ("first", "second"):
        with pytest.raises(Stopped):
            pipeline.texture_scan(scan, tmp_path / run, config, work=tmp_path / run / "work", monitor=UntilAtlas())
        atlases.append(torch.load(tmp_path / run / "work" / "atlas.pt", weights_only=True))
    assert made == ["ahead"]
    assert atlases[0]["v_uv"].equal(atlases[1]["v_uv"])


def test_what_is_said_of_a_mesh_that_is_made_ready_is_said_on_the_runs_thread() -> None:
    class Told(Monitor):
        def warning(self, problem: Problem) -> None:
            assert threading.current_thread() is threading.main_thread()
            said.append(problem.code)

    said = list[str]()
    scene, _ = made_scene(600, 1, 32, 24)
    with ChartMaker(None) as maker, MeshPreparation(300, maker) as preparation:
        preparation.begin(scene.mesh, moves=True)
        mesh, _ = preparation.result(Told())
        assert maker._begun is None  # charts of a mesh that moves would be of no use
        preparation.begin(Mesh(mesh.v_pos, mesh.t_pos_idx))
        preparation.result(Told())
        assert maker._begun is not None
        preparation.begin(Mesh(mesh.v_pos * 0, mesh.t_pos_idx))
        with pytest.raises(ScanError, match="has an area"):
            preparation.result(Told())
    assert len(mesh.t_pos_idx) <= 300
    assert said == ["uv_dropped"]


@pytest.mark.slow
def test_charts_are_begun_while_frames_are_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of a mesh that is not decimated: the borders of others grow by what the frames show."""
    scan = tmp_path / "scan"
    synthesize(scan, views=4, width=96, height=72)
    begun = threading.Event()

    def make(position: Position, faces: Integers, monitor: Monitor, *, apart: bool = False) -> Charts:
        begun.set()
        return make_charts(position, faces, monitor)

    decode = ingest.color_image

    def decode_later(*given: Any) -> Any:
        assert begun.wait(60)  # no frame is decoded before
        return decode(*given)

    monkeypatch.setattr(chart_cache, "make_charts", make)
    monkeypatch.setattr(ingest, "color_image", decode_later)
    monkeypatch.setattr(pipeline, "charts_folder", lambda: tmp_path / "charts")
    config = TextureConfig(refine=False, device="cpu")
    with pytest.raises(Stopped):
        pipeline.texture_scan(scan, tmp_path / "out", config, work=tmp_path / "work", monitor=UntilAtlas())


class UntilAtlas(Monitor):
    """Stops a run that has its atlas."""

    def __init__(self) -> None:
        self.done = False

    def stage_finished(
        self, stage: str, _seconds: float, _peak_memory_bytes: int, _peak_device_memory_bytes: int | None
    ) -> None:
        self.done = self.done or stage == "atlas"

    def stop_requested(self) -> bool:
        return self.done

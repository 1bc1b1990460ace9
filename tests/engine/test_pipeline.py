"""The whole engine on a small synthesized scan: files, report, stop and resume, kill and resume, bad options."""

from __future__ import annotations

import filecmp
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import trimesh

from advtex_engine import pipeline
from advtex_engine.core.config import PRESETS, TextureConfig, resolve_preset
from advtex_engine.core.errors import OptionError, Problem, ScanError, Stopped
from advtex_engine.core.monitor import STAGES, Glimpse, Monitor, WarningKeeper
from advtex_engine.pipeline import texture_scan
from advtex_engine.runtime.checkpoint import WorkFolder
from advtex_engine.runtime.devices import choose_device
from advtex_engine.runtime.stage_records import Stages
from advtex_engine.synthetic.scan import synthesize

STEPS = 40
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scan") / "scan.zip"
    synthesize(path, views=12, width=96, height=72)
    return path


WITH_MESH = tuple(stage for stage in STAGES if stage != "fusion")  # of scans that bring a mesh
CONFIG = TextureConfig(preset="standard", steps=STEPS, holdout=6, face_budget=4000, device="cpu")


class Recorder(Monitor):
    def __init__(self, stop_at: int | None = None) -> None:
        self.stop_at, self.step = stop_at, 0
        self.stages: list[str] = []
        self.seconds: dict[str, float] = {}
        self.steps: list[int] = []
        self.files: set[str] = set()
        self.problems: list[Problem] = []
        self.glimpses: list[Glimpse] = []
        self.stage = ""

    def stage_started(self, stage: str) -> None:
        self.stage = stage

    def stage_finished(
        self, stage: str, seconds: float, peak_memory_bytes: int, peak_device_memory_bytes: int | None
    ) -> None:
        assert seconds >= 0
        assert peak_memory_bytes > 2**20
        self.stages.append(stage)
        self.seconds[stage] = seconds

    def progress(self, step: int, steps: int, losses: Mapping[str, float]) -> None:
        if self.stage != "optimization":
            return
        assert steps == STEPS
        self.steps.append(step)
        self.step = step

    def glimpsed(self, glimpse: Glimpse) -> None:
        self.glimpses.append(glimpse)

    def warning(self, problem: Problem) -> None:
        self.problems.append(problem)

    def checkpointed(self, files: tuple[Path, ...]) -> None:
        assert all(file.exists() for file in files)
        self.files |= {file.name for file in files}

    def stop_requested(self) -> bool:
        return self.stop_at is not None and self.step >= self.stop_at


@pytest.fixture(scope="module")
def whole(scan: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Recorder]:
    out = tmp_path_factory.mktemp("whole")
    recorder = Recorder()
    result = texture_scan(scan, out, CONFIG, work=out / "work", monitor=recorder)
    assert all(path.exists() for path in result.files)
    return out, recorder


def test_a_run_leaves_models_previews_and_a_report(whole: tuple[Path, Recorder]) -> None:
    out, recorder = whole
    assert tuple(recorder.stages) == WITH_MESH
    assert recorder.steps == list(range(1, STEPS + 1))
    for name in (
        "model.obj",
        "model.mtl",
        "model.png",
        "model.glb",
        "model.usdz",
        "model_seen.png",
        "model_mobile.glb",
        "model_lod1.glb",
        "model_lod2.glb",
        "previews/comparison.png",
        "previews/sheet.png",
    ):
        assert (out / name).stat().st_size > 50, name
    for name in ("model.3tz", "model_draco.glb", "model_webp.glb"):
        assert not (out / name).exists(), "nobody asked for it"
    manifest = json.loads((out / "previews/manifest.json").read_text())
    assert [view["heldout"] for view in manifest["views"]].count(True) == 2
    curves = json.loads((out / manifest["curves"]).read_text())
    assert curves["steps"] == list(range(1, STEPS + 1))
    shown = [glimpse.step for glimpse in recorder.glimpses]  # on a busy machine there is time for more than the last
    assert curves["quality"]["steps"] == shown == sorted(set(shown))
    assert shown[-1] == STEPS
    assert "<title>Textured model</title>" in (out / "index.html").read_text()
    report = json.loads((out / "report.json").read_text())
    assert [stage["stage"] for stage in report["stages"]] == list(WITH_MESH)
    assert report["losses"][-1]["step"] == STEPS
    game = report["game"]
    assert [point["at"] for point in game["points"]] == ["end of pretraining", "middle", "end"]
    assert [point["step"] for point in game["curve"]] == curves["steps"]
    for name in ("accuracy_real", "margin", "gradient_l1"):
        assert curves["series"][name][-1] == pytest.approx(game["curve"][-1][name], rel=1e-4)
        assert name not in report["losses"][-1], "told once"
    assert curves["series"]["gradient_l1"][:-1] == [None] * (STEPS - 1)
    assert report["scan"]["heldout"] == sorted(report["scan"]["heldout"])
    assert len(report["scan"]["heldout"]) == 2
    assert report["scan"]["views"] == 10
    assert set(report["heldout"]) == {"texture", "mean"}
    assert 0 < report["speckled_texels"] < 0.5
    assert report["options"]["steps"] == STEPS
    assert report["surface"]["seen"] > 0.5
    assert sum(report["surface"].values()) == pytest.approx(1)
    assert set(report["mesh"].values()) == {0}, "nothing is left out of the mesh, or added to it"
    assert "noise" in report["normal_map"]["why"], "the scan's mesh has errors all over"
    assert {"graph", "steps_per_launch", "kernels", "precision", "reasons"} <= set(report["step"])
    assert report["versions"]["torch"].startswith("2.")


def test_a_box_is_cut_out_closed_and_rid_of_what_was_never_seen(
    scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pipeline, "write_gallery", lambda *_: ())  # they take longer than all else
    monkeypatch.setattr(pipeline, "write_page", lambda *_: ())
    config = replace(CONFIG, method="mean", refine=False, box="0,0,0.2,1,1,0.2", close_holes=2.0)
    whole = texture_scan(scan, tmp_path / "whole", config, work=tmp_path / "work").report
    mesh, surface = whole["mesh"], whole["surface"]
    assert mesh["faces_outside_box"] > 0
    assert mesh["closed_holes"] >= 1
    assert mesh["made_up_faces"] > 0
    assert surface["unseen"] > 0.05, "the cut is wide, and no part of it counts as seen"
    recorder = Recorder()
    config = replace(config, unseen="remove")
    texture_scan(scan, tmp_path / "seen", config, work=tmp_path / "work", resume=True, monitor=recorder)
    assert "geometry" not in recorder.stages, "what is kept serves this as well"
    all_of_it, seen = (trimesh.load_mesh(tmp_path / name / "model.glb") for name in ("whole", "seen"))
    assert len(seen.faces) < len(all_of_it.faces) == whole["scan"]["faces"]
    assert 1 - seen.area / all_of_it.area == pytest.approx(surface["unseen"], abs=0.05)


def test_a_stopped_run_resumes_to_the_same_bytes_without_redoing_earlier_stages(
    scan: Path, whole: tuple[Path, Recorder], tmp_path: Path
) -> None:
    with pytest.raises(Stopped, match="step 10 of 40"):
        texture_scan(scan, tmp_path, CONFIG, work=tmp_path / "work", monitor=Recorder(stop_at=10))
    first = torch.load(tmp_path / "work" / "checkpoint.pt")["seconds"]
    again = Recorder()
    texture_scan(scan, tmp_path, CONFIG, work=tmp_path / "work", resume=True, monitor=again)
    assert again.steps[0] == 11
    assert "ingest" not in again.stages
    assert "atlas" not in again.stages
    assert filecmp.cmp(tmp_path / "model.png", whole[0] / "model.png", shallow=False)
    report = json.loads((tmp_path / "report.json").read_text())
    resumed = [stage["stage"] for stage in report["stages"] if stage["resumed"]]
    assert resumed == ["ingest", "conventions", "geometry", "refinement", "atlas"]
    (optimization,) = [stage["seconds"] for stage in report["stages"] if stage["stage"] == "optimization"]
    assert first > 0.01
    assert optimization == pytest.approx(first + again.seconds["optimization"], abs=0.002)
    assert [point["step"] for point in report["losses"]] == list(range(1, STEPS + 1))
    unbroken = json.loads((whole[0] / "report.json").read_text())
    assert (report["losses"], report["game"]) == (unbroken["losses"], unbroken["game"])


class StopsEarly(Recorder):
    """Stops in the steps that the start is made by."""

    def __init__(self) -> None:
        super().__init__()
        self.started = 0

    def progress(self, step: int, steps: int, losses: Mapping[str, float]) -> None:
        super().progress(step, steps, losses)
        self.started += self.stage == "initial_texture"

    def stop_requested(self) -> bool:
        return self.started > 0


def test_a_run_that_is_stopped_before_its_game_resumes_to_the_same_bytes(
    scan: Path, whole: tuple[Path, Recorder], tmp_path: Path
) -> None:
    with pytest.raises(Stopped, match="step 1 of"):
        texture_scan(scan, tmp_path, CONFIG, work=tmp_path / "work", monitor=StopsEarly())
    assert not (tmp_path / "work" / "descended.pt").exists()
    again = Recorder()
    texture_scan(scan, tmp_path, CONFIG, work=tmp_path / "work", resume=True, monitor=again)
    assert again.steps == list(range(1, STEPS + 1))
    assert filecmp.cmp(tmp_path / "model.png", whole[0] / "model.png", shallow=False)
    report = json.loads((tmp_path / "report.json").read_text())
    (optimization,) = [stage["seconds"] for stage in report["stages"] if stage["stage"] == "optimization"]
    assert optimization == pytest.approx(again.seconds["optimization"], abs=0.002)


def test_without_resume_and_with_other_options_the_work_folder_is_not_used(scan: Path, tmp_path: Path) -> None:
    config = replace(CONFIG, refine=False)
    with pytest.raises(Stopped):
        texture_scan(scan, tmp_path, config, work=tmp_path / "work", monitor=Recorder(stop_at=5))
    other = replace(config, face_budget=3000)
    recorder = Recorder(stop_at=1)
    with pytest.raises(Stopped, match="step 1 of"):
        texture_scan(scan, tmp_path, other, work=tmp_path / "work", resume=True, monitor=recorder)
    assert "atlas" in recorder.stages


@pytest.mark.slow
def test_a_killed_run_resumes_bit_identical(scan: Path, tmp_path: Path) -> None:
    config = TextureConfig(preset="standard", steps=80, face_budget=4000, device="cpu", refine=False)
    texture_scan(scan, tmp_path / "whole", config, work=tmp_path / "whole" / "work")
    killed = tmp_path / "killed"
    options = ["--preset", "standard", "--steps", "80", "--face-budget", "4000", "--device", "cpu", "--no-refine"]
    options += ["--checkpoint-seconds", "0.2"]
    child = subprocess.Popen(
        [sys.executable, "-m", "advtex_engine", "texture", str(scan), *options, "-o", str(killed)],
        env={**os.environ, "OMP_NUM_THREADS": str(torch.get_num_threads())},
        stderr=subprocess.PIPE,
        text=True,
    )
    assert child.stderr is not None
    for line in child.stderr:
        if "step " in line and (killed / "work" / "checkpoint.pt").exists():
            child.send_signal(signal.SIGKILL)
            break
    assert child.wait() == -signal.SIGKILL
    child.stderr.close()
    assert not (killed / "model.obj").exists()
    resumed = Resumed()
    texture_scan(scan, killed, config, work=killed / "work", resume=True, monitor=resumed)
    assert resumed.first_step > 1
    assert filecmp.cmp(killed / "model.png", tmp_path / "whole" / "model.png", shallow=False)


class Resumed(Monitor):
    """Remembers where the optimization began."""

    first_step, stage = 0, ""

    def stage_started(self, stage: str) -> None:
        self.stage = stage

    def progress(self, step: int, steps: int, losses: Mapping[str, float]) -> None:
        if self.stage == "optimization":
            self.first_step = self.first_step or step


@pytest.mark.slow
def test_a_terminated_run_leaves_a_checkpoint_and_its_exit_code_says_so(scan: Path, tmp_path: Path) -> None:
    arguments = [
        sys.executable,
        "-m",
        "advtex_engine",
        "texture",
        str(scan),
        "-o",
        str(tmp_path),
        "--preset",
        "standard",
    ]
    child = subprocess.Popen([*arguments, "--face-budget", "4000", "--no-refine"], stderr=subprocess.PIPE, text=True)
    assert child.stderr is not None
    for line in child.stderr:
        if "step " in line:
            child.terminate()
            break
    started = time.monotonic()
    _, errors = child.communicate(timeout=30)
    assert child.returncode == 130
    assert "resume goes on from there" in errors
    assert time.monotonic() - started < 10
    assert (tmp_path / "work" / "descent.pt").exists(), "of the passes that come before the game"


@pytest.mark.slow
def test_saving_takes_little_of_a_small_run(scan: Path, tmp_path: Path) -> None:
    """Checkpoints come as often as their share of the time lets them: nothing else bounds them here."""
    config = replace(PYRAMID, steps=600, checkpoint_seconds=0.01, refine=True)
    recorder = Checkpointed()
    report = texture_scan(scan, tmp_path, config, work=tmp_path / "work", monitor=recorder).report
    assert recorder.checkpoints > 0
    assert report["saving_seconds"] <= 0.02 * sum(stage["seconds"] for stage in report["stages"])


class Checkpointed(Monitor):
    """Counts checkpoints."""

    checkpoints = 0

    def checkpointed(self, files: tuple[Path, ...]) -> None:
        self.checkpoints += sum(file.name == "checkpoint.pt" for file in files)


def test_a_stage_that_was_interrupted_counts_what_was_spent_on_it_before(tmp_path: Path) -> None:
    for expected in (0.05, 0.1):
        keeper = WarningKeeper(Monitor())
        stages = Stages(keeper, WorkFolder(tmp_path, "run", keeper), CPU)
        with stages.run("view_maps"):
            time.sleep(0.05)
        stages.save()
        assert stages.records[0]["seconds"] >= expected


def memory_of_two_stages(folder: Path) -> list[int]:
    """Peaks of a stage that takes 256 MiB and of one after it that takes nothing."""
    keeper = WarningKeeper(Monitor())
    stages = Stages(keeper, WorkFolder(folder, "run", keeper), CPU)
    with stages.run("atlas"):
        torch.ones(64 << 20)
    with stages.run("view_maps"):
        pass
    assert [record["peak_device_memory_bytes"] for record in stages.records] == [None, None]
    return [record["peak_memory_bytes"] for record in stages.records]


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux can begin a peak anew")
def test_each_stage_has_its_own_peak_memory(tmp_path: Path) -> None:
    large, small = memory_of_two_stages(tmp_path)
    assert large - small > 200 << 20


def test_where_peaks_cannot_begin_anew_they_go_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def forbidden(path: Path, _content: str) -> int:
        raise PermissionError(path)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_text", forbidden)
        large, small = memory_of_two_stages(tmp_path)
    assert small >= large


def test_a_gpus_peak_is_that_of_the_stage(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """What CUDA's allocator is asked, and of which device."""
    device = torch.device("cuda:1")
    peaks = {device: 0}
    monkeypatch.setattr(torch.cuda, "reset_peak_memory_stats", lambda of: peaks.update({of: 0}))
    monkeypatch.setattr(torch.cuda, "max_memory_allocated", lambda of: peaks[of])
    keeper = WarningKeeper(Monitor())
    stages = Stages(keeper, WorkFolder(tmp_path, "run", keeper), device)
    for stage, taken in (("view_maps", 700), ("optimization", 500)):
        with stages.run(stage):
            peaks[device] = max(peaks[device], taken)
    assert [record["peak_device_memory_bytes"] for record in stages.records] == [700, 500]


def test_a_resumed_run_keeps_the_warnings_of_stages_that_it_takes_over(tmp_path: Path) -> None:
    problem = Problem("odd", "mesh", "is odd", "look at it")
    first = WarningKeeper(Monitor())
    stages = Stages(first, WorkFolder(tmp_path, "run", first), CPU)
    for stage in ("ingest", "atlas"):
        with stages.run(stage):
            first.warning(problem)
    stages.save()
    again = WarningKeeper(Monitor())
    resumed = Stages(again, WorkFolder(tmp_path, "run", again), CPU)
    resumed.restore("ingest")
    assert [warning["stage"] for warning in again.warnings] == ["ingest"]
    assert [record["stage"] for record in resumed.records] == ["ingest"]
    assert again.warnings[0]["remedy"] == "look at it"


PYRAMID = TextureConfig(preset="preview", steps=STEPS, face_budget=4000, device="cpu", refine=False, outputs="glb")


@pytest.fixture(scope="module")
def pyramid(scan: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Recorder]:
    out = tmp_path_factory.mktemp("pyramid")
    recorder = Recorder()
    texture_scan(scan, out, PYRAMID, work=out / "work", monitor=recorder)
    return out, recorder


def test_the_pyramid_starts_small_and_ends_at_full_size(pyramid: tuple[Path, Recorder]) -> None:
    out, recorder = pyramid
    assert {"view_maps_1.pt", "view_maps_2.pt"} <= recorder.files
    levels = json.loads((out / "report.json").read_text())["preset"]["levels"]
    assert sum(level["steps"] for level in levels) == STEPS
    assert [level["scale"] for level in levels] == [2, 1]
    assert recorder.steps[-1] == STEPS


@pytest.mark.parametrize("stop_at", [7, 21])
def test_a_pyramid_that_is_stopped_at_either_level_resumes_to_the_same_bytes(
    scan: Path, pyramid: tuple[Path, Recorder], tmp_path: Path, stop_at: int
) -> None:
    with pytest.raises(Stopped, match=f"step {stop_at} of"):
        texture_scan(scan, tmp_path, PYRAMID, work=tmp_path / "work", monitor=Recorder(stop_at=stop_at))
    texture_scan(scan, tmp_path, PYRAMID, work=tmp_path / "work", resume=True)
    assert filecmp.cmp(pyramid[0] / "model.png", tmp_path / "model.png", shallow=False)


def test_the_mean_method_takes_no_steps(scan: Path, tmp_path: Path) -> None:
    config = replace(CONFIG, method="mean", refine=False, holdout=None, outputs="tiles,draco,webp")
    result = texture_scan(scan, tmp_path, config, work=tmp_path / "work", monitor=Recorder())
    assert result.report["losses"] == []
    asked_for = {"model.3tz", "model_draco.glb", "model_webp.glb"}
    models = {path.name for path in result.files if path.parent == tmp_path and path.name.startswith("model")}
    assert models == {"model.obj", "model.mtl", "model.png", "model.glb", "model_seen.png", *asked_for}


def test_what_plays_a_game_plays_standard_unless_asked_otherwise() -> None:
    assert resolve_preset(TextureConfig(method="adversarial")) == PRESETS["standard"]
    assert resolve_preset(TextureConfig(preset="full")) == PRESETS["full"]


def test_a_shorter_run_is_the_same_in_proportion() -> None:
    shorter = resolve_preset(TextureConfig(preset="preview", steps=550))
    whole = PRESETS["preview"]
    assert whole.steps == 1_100
    assert [level.steps for level in shorter.levels] == [400, 150]
    assert (shorter.pretraining, shorter.averaging) == (whole.pretraining // 2, whole.averaging // 2)
    assert (shorter.lr_texture, shorter.lr_discriminator) == (whole.lr_texture, whole.lr_discriminator)


@pytest.mark.parametrize(("name", "smaller"), [("standard", 4), ("preview", 4), ("full", 4), ("paper", 1)])
def test_more_steps_from_a_sharp_start_are_smaller_ones(name: str, smaller: int) -> None:
    whole = PRESETS[name]
    longer = resolve_preset(TextureConfig(preset=name, steps=4 * whole.steps))
    assert longer.lr_texture == pytest.approx(whole.lr_texture / smaller)
    assert longer.lr_discriminator == pytest.approx(whole.lr_discriminator / smaller)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"preset": "best"}, "preset 'best' is unknown"),
        ({"method": "magic"}, "method 'magic' is unknown"),
        ({"size": (8, 8)}, "64 to 4096"),
        ({"holdout": 1}, "holdout 1"),
        ({"steps": 0}, "steps 0"),
        ({"face_budget": 3}, "100 to 2000000"),
        ({"max_texture_size": 100_000}, "256 to 16384"),
    ],
)
def test_options_out_of_bounds_are_named_with_their_bounds(options: dict[str, object], message: str) -> None:
    with pytest.raises(OptionError, match=message):
        TextureConfig(**options)  # type: ignore[arg-type]


def test_a_device_that_is_not_there_is_named() -> None:
    with pytest.raises(OptionError, match="'cuda:77' is not available here"):
        choose_device("cuda:77")


def test_a_gpu_has_its_index(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 1)
    monkeypatch.setattr(torch.cuda, "set_device", lambda _: None)
    monkeypatch.setattr(torch, "empty", lambda *_, **__: None)
    assert choose_device("auto") == choose_device("cuda") == torch.device("cuda:1")
    assert choose_device("cuda:0") == torch.device("cuda:0")


def test_a_file_that_is_no_scan_is_refused_with_a_remedy(tmp_path: Path) -> None:
    path = tmp_path / "scan.zip"
    path.write_bytes(b"not a zip")
    with pytest.raises(ScanError, match=r"scan\.zip"):
        texture_scan(path, tmp_path / "out", CONFIG, work=tmp_path / "work")

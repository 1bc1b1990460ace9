"""Where memory is short: what is given up and in which order, at the start and after an error; and the run goes on."""

from __future__ import annotations

import filecmp
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from advtex_engine import pipeline
from advtex_engine.adversarial.optimizer import AdversarialOptimizer
from advtex_engine.budget import limits
from advtex_engine.budget.limits import Budget, Limits
from advtex_engine.budget.workload import Workload, estimate
from advtex_engine.core.config import PRESETS, TextureConfig
from advtex_engine.core.errors import MemoryShortage, Problem, Stopped
from advtex_engine.core.monitor import Monitor, WarningKeeper
from advtex_engine.methods import MethodInput, adversarial
from advtex_engine.pipeline import texture_scan
from advtex_engine.render.streaming import LEAST_VIEWS
from advtex_engine.runtime.checkpoint import WorkFolder
from advtex_engine.synthetic.scan import synthesize

STEPS = 24
CPU = torch.device("cpu")
CONFIG = TextureConfig(preset="standard", steps=STEPS, face_budget=4000, device="cpu", refine=False)
WORK = Workload(200, 640, 480, (4096, 4096), 8 << 20, "adversarial", PRESETS["standard"])


class Listener(Monitor):
    def __init__(self, stop_at: int | None = None) -> None:
        self.stop_at, self.step = stop_at, 0
        self.notes, self.problems = list[str](), list[Problem]()
        self.steps = list[int]()
        self.stage = ""

    def stage_started(self, stage: str) -> None:
        self.stage = stage

    def progress(self, step: int, steps: int, losses: Any) -> None:
        if self.stage != "optimization":
            return
        self.step = step
        self.steps.append(step)

    def note(self, message: str) -> None:
        self.notes.append(message)

    def warning(self, problem: Problem) -> None:
        self.problems.append(problem)

    def stop_requested(self) -> bool:
        return self.stop_at is not None and self.step >= self.stop_at


def budget(folder: Path, device: torch.device = CPU, config: TextureConfig = CONFIG) -> Budget:
    keeper = WarningKeeper(Listener())
    return Budget(device, config, WorkFolder(folder, "run", keeper), keeper)


def has(monkeypatch: pytest.MonkeyPatch, available: int) -> None:
    """A device with so many bytes free."""
    monkeypatch.setattr(limits, "available_memory", lambda _device, _allowed: available)


def needed(work: Workload, on_device: int | None = None) -> int:
    parts = estimate(work, on_device)
    return sum(parts.values()) - parts.get("context", 0)


def test_what_fits_has_no_limits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    has(monkeypatch, int(needed(WORK) / 0.89))
    given = budget(tmp_path)
    assert not given.fit(WORK, "atlas")
    assert given.limits == Limits()
    assert not (tmp_path / "limits.pt").exists()


def test_of_views_as_many_stay_as_fit_and_that_is_only_noted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    has(monkeypatch, int(needed(WORK, 77) / 0.89))
    given = budget(tmp_path)
    assert not given.fit(WORK, "atlas")
    assert given.limits.on_device is not None
    assert 77 <= given.limits.on_device < 90
    heard = given.monitor.inner
    assert isinstance(heard, Listener)
    assert heard.problems == []
    assert len(heard.notes) == 1
    assert f"of 200 views {given.limits.on_device} at a time are on the device" in heard.notes[0]
    assert "GiB and the machine has" in heard.notes[0]


def test_what_the_device_holds_of_it_already_counts_as_free(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    has(monkeypatch, int(needed(WORK) / 0.89) - (1 << 30))
    given = budget(tmp_path)
    given.fit(WORK, "view_maps", 1 << 30, known=True)
    assert given.limits == Limits()


def test_then_the_crop_then_the_texture_and_then_it_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    small = replace(WORK, preset=replace(WORK.preset, max_crop=(192, 144), descent_crop=(192, 144)))
    has(monkeypatch, int(needed(small, LEAST_VIEWS) / 0.895))
    given = budget(tmp_path)
    assert not given.fit(WORK, "atlas")
    assert given.limits == Limits(on_device=LEAST_VIEWS, max_crop=(192, 144))
    preset = given.preset(WORK.preset)
    assert preset.max_crop == preset.descent_crop == (192, 144)
    has(monkeypatch, int(needed(small, LEAST_VIEWS) * 0.6))
    assert given.fit(WORK, "atlas"), "the atlas must be made anew"
    assert given.limits.texture == given.texture_config().max_texture_size == 2048
    assert given.texture_folder().load("x") is None
    quarter = replace(WORK, texture=(2048, 2048), slots=2 << 20)
    assert not given.fit(quarter, "atlas")
    has(monkeypatch, 1 << 20)
    for side in (1024, 512, 256):
        assert given.fit(quarter, "atlas")
        assert given.limits.texture == side
        quarter = replace(quarter, texture=(side, side), slots=side**2 // 2)
    with pytest.raises(MemoryShortage, match=r"needs [0-9.]+ GiB and the machine has 0.00 GiB; choose a smaller"):
        given.fit(quarter, "atlas")
    words = [measure["measure"] for measure in given.measures]
    assert "views" in words[0]
    assert "192x144" in words[1]
    assert next(word for word in words if "texture" in word) == "the texture has at most 2048 texels a side"


def test_limits_outlive_the_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    has(monkeypatch, int(needed(WORK, 20) / 0.89))
    first = budget(tmp_path)
    first.fit(WORK, "atlas")
    first.shrink("optimization", "no room")
    again = budget(tmp_path)
    assert again.limits == first.limits
    assert again.measures == first.measures
    has(monkeypatch, 1 << 40)
    again.fit(WORK, "atlas")
    assert again.limits == first.limits, "with more memory it goes on with the same steps"


@pytest.mark.parametrize(
    ("stage", "expected"),
    [
        ("view_maps", ["views"] * 5 + ["texture"] * 4),
        ("optimization", ["views"] * 5 + ["step"] + ["texture"] * 4),
        ("dilation", ["views"] * 5 + ["texture"] * 4),
        ("atlas", ["texture"] * 4),
        ("ingest", []),
        ("refinement", []),
    ],
)
def test_the_order_after_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stage: str, expected: list[str]
) -> None:
    has(monkeypatch, 1 << 40)
    given = budget(tmp_path)
    if stage not in ("atlas", "ingest", "refinement"):
        given.fit(WORK, "atlas")
    for _ in expected:
        given.shrink(stage, "cannot allocate")
    with pytest.raises(MemoryShortage, match=f"{stage} ran out of memory .cannot allocate.; nothing is left"):
        given.shrink(stage, "cannot allocate")
    heard = given.monitor.inner
    assert isinstance(heard, Listener)
    said = [problem.message for problem in heard.problems]
    assert [next(word for word in ("step", "views", "texture") if word in message) for message in said] == expected
    assert all(problem.where == stage and "smaller" in problem.remedy for problem in heard.problems)


def test_a_gpus_early_stages_are_done_on_the_cpu(tmp_path: Path) -> None:
    given = budget(tmp_path, torch.device("cuda"))
    assert given.early_device.type == "cuda"
    given.shrink("refinement", "CUDA out of memory")
    assert given.early_device.type == "cpu"
    with pytest.raises(MemoryShortage):
        given.shrink("refinement", "can't allocate memory")


def test_methods_without_pairs_have_their_views_on_the_host_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    has(monkeypatch, 1 << 40)
    given = budget(tmp_path)
    given.fit(replace(WORK, method="mean"), "atlas")
    for _ in range(2):
        given.shrink("initial_texture", "no room")
    assert given.limits.texture == 2048
    assert "one at a time" in given.measures[0]["measure"]


# The whole engine -----------------------------------------------------------------------------------------------------


@pytest.fixture(autouse=True)
def without_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """They take longer than all else, and know nothing of limits."""
    monkeypatch.setattr(pipeline, "write_gallery", lambda *_: ())
    monkeypatch.setattr(pipeline, "write_page", lambda *_: ())


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scan") / "scan.zip"
    synthesize(path, views=12, width=96, height=72)
    return path


@pytest.fixture(scope="module")
def cached(scan: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A work folder with all stages before the optimization."""
    folder = tmp_path_factory.mktemp("cached")
    with pytest.raises(Stopped):
        texture_scan(scan, folder / "out", CONFIG, work=folder / "work", monitor=Listener(stop_at=1))
    (folder / "work" / "checkpoint.pt").unlink()
    return folder / "work"


def run(scan: Path, cached: Path, out: Path, listener: Listener) -> dict[str, Any]:
    """From the cached stages, or from where the run in this folder stopped."""
    if not out.exists():
        shutil.copytree(cached, out / "work")
    return texture_scan(scan, out, CONFIG, work=out / "work", resume=True, monitor=listener).report


def test_a_run_with_too_little_memory_streams_its_views_and_resumes_bit_identical(
    scan: Path, cached: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = list[Workload]()
    fit = Budget.fit

    def short(self: Budget, work: Workload, *args: Any, **options: Any) -> bool:
        asked.append(work)
        has(monkeypatch, int(needed(work, 9) / limits.PLANNED_SHARE) + 1)
        return fit(self, work, *args, **options)

    monkeypatch.setattr(Budget, "fit", short)
    heard = Listener()
    report = run(scan, cached, tmp_path / "whole", heard)
    told = report["memory"]
    assert told["limits"]["on_device"] is not None
    assert LEAST_VIEWS <= told["limits"]["on_device"] < 12
    assert told["views"] == asked[0].views == 12
    assert told["parts"]["view_maps"] == told["limits"]["on_device"] * 96 * 72 * 9
    assert sum(told["parts"].values()) == told["estimated_bytes"] <= told["available_bytes"]
    assert [measure["stage"] for measure in told["measures"]] == ["atlas"]
    assert any("at a time are on the device" in note for note in heard.notes)
    assert "memory_short" not in {problem.code for problem in heard.problems}
    with pytest.raises(Stopped):
        run(scan, cached, tmp_path / "two", Listener(stop_at=17))
    saved = torch.load(tmp_path / "two" / "work" / "checkpoint.pt")
    assert saved["views"]["used"] == (17 % 4) or saved["views"]["place"] > 0
    again = Listener()
    run(scan, cached, tmp_path / "two", again)
    assert again.steps[0] == 18
    assert filecmp.cmp(tmp_path / "whole" / "model.png", tmp_path / "two" / "model.png", shallow=False)


def test_out_of_memory_makes_the_job_smaller_and_it_goes_on(
    scan: Path, cached: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A device that cannot hold all views, nor crops above 60 pixels: torch refuses at step 12."""
    monkeypatch.setattr(limits, "LEAST_CROP", 32)
    step, taken = AdversarialOptimizer.step, list[int]()

    def refused(self: AdversarialOptimizer) -> None:
        if self.index == 12 and (self.maps.count > 8 or min(self.crop) > 40):
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB")
        taken.append(self.index)
        step(self)

    monkeypatch.setattr(AdversarialOptimizer, "step", refused)
    heard = Listener()
    report = run(scan, cached, tmp_path / "run", heard)
    assert heard.steps[-1] == STEPS
    assert taken[-1] == STEPS - 1
    assert [problem.code for problem in heard.problems] == ["memory_short"] * 2
    assert "of 12 views 8 at a time" in heard.problems[0].message
    assert "a step sees" in heard.problems[1].message
    assert "2.00 GiB" in heard.problems[0].message
    told = report["memory"]
    assert [measure["stage"] for measure in told["measures"]] == ["optimization"] * 2
    assert told["limits"]["on_device"] == 8
    assert [w["code"] for w in report["warnings"]].count("memory_short") == 2
    assert report["preset"]["max_crop"] == told["limits"]["max_crop"]
    assert (tmp_path / "run" / "model.glb").exists()
    assert json.loads((tmp_path / "run" / "report.json").read_text())["memory"]["measures"] == told["measures"]


def test_a_texture_that_does_not_fit_is_made_smaller_and_then_the_job_fails_in_words(
    scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = replace(CONFIG, texels_per_pixel=4.0)
    sides = list[int]()

    def refuses(given: MethodInput) -> Any:
        sides.append(given.maps[1].slot_map.shape[0])
        raise RuntimeError("[enforce fail at alloc_cpu.cpp:127] DefaultCPUAllocator: can't allocate memory")

    monkeypatch.setattr(adversarial, "adversarial", refuses)
    with pytest.raises(MemoryShortage, match=r"optimization ran out of memory .*needs [0-9.]+ GiB.*choose a smaller"):
        texture_scan(scan, tmp_path, config, work=tmp_path / "work", monitor=Listener())
    assert sides == sorted(sides, reverse=True)
    assert sides[-1] <= sides[0] // 2
    assert sides[0] == sides[1], "first the views make room"

"""What is no longer finite: a run goes back once, then ends with its reason, and leaves no black model."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import pytest
import torch

from advtex_engine.adversarial.optimizer import AdversarialOptimizer
from advtex_engine.core.config import PRESETS, TextureConfig
from advtex_engine.core.errors import Diverged, Problem
from advtex_engine.core.monitor import Monitor
from advtex_engine.methods import mean
from advtex_engine.pipeline import texture_scan
from advtex_engine.runtime.checkpoint import Checkpoints
from advtex_engine.runtime.files import json_text
from advtex_engine.synthetic.scan import synthesize

STEPS, POISONED = 12, 8
CONFIG = TextureConfig(
    preset="standard", steps=STEPS, face_budget=800, max_texture_size=256, device="cpu", refine=False
)


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scan") / "scan"
    synthesize(path, views=8, width=96, height=72, seed=0)
    return path


class Warned(Monitor):
    def __init__(self) -> None:
        self.problems = list[Problem]()

    def warning(self, problem: Problem) -> None:
        self.problems.append(problem)

    @property
    def told(self) -> list[Problem]:
        return [problem for problem in self.problems if problem.code == "diverged"]


@pytest.mark.parametrize("rates", [{"lr_texture": 1e38}, {"lr_discriminator": 1e38}])
def test_a_run_that_diverges_again_ends_with_its_reason(
    scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rates: dict[str, float]
) -> None:
    monkeypatch.setitem(PRESETS, "standard", dataclasses.replace(PRESETS["standard"], pretraining=0, **rates))
    monitor = Warned()
    with pytest.raises(Diverged, match="also with half the learning rates; choose another"):
        texture_scan(scan, tmp_path / "out", CONFIG, work=tmp_path / "work", monitor=monitor)
    assert len(monitor.told) == 1
    assert not list((tmp_path / "out").glob("model*"))
    # The same again where a worker goes on with it: no checkpoint holds what is not finite.
    with pytest.raises(Diverged):
        texture_scan(scan, tmp_path / "out", CONFIG, work=tmp_path / "work", resume=True)


@pytest.fixture
def poisoned(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Step POISONED of the first run makes a texel NaN; -> the texture's rate in each step, over all runs."""
    rates = list[float]()
    step = AdversarialOptimizer.step

    def poisoned_step(self: AdversarialOptimizer) -> None:
        step(self)
        rates.append(self.preset.lr_texture)
        if len(rates) == POISONED:
            with torch.no_grad():
                self.values[3] = math.nan

    monkeypatch.setattr(AdversarialOptimizer, "step", poisoned_step)
    return rates


@pytest.mark.parametrize("saved_every", [5, 100])
def test_a_run_that_diverges_once_goes_on_from_its_last_checkpoint_with_half_the_rates(
    scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, poisoned: list[float], saved_every: int
) -> None:
    monkeypatch.setattr(Checkpoints, "due", lambda _: len(poisoned) % saved_every == 0)
    monitor = Warned()
    result = texture_scan(scan, tmp_path / "out", CONFIG, work=tmp_path / "work", monitor=monitor)
    again = 5 if saved_every == 5 else 0
    (told,) = monitor.told
    assert told.where == f"step {POISONED} of {STEPS}"
    assert f"from step {again} with half" in told.message
    rate = PRESETS["standard"].lr_texture
    assert poisoned == [rate] * POISONED + [rate / 2] * (STEPS - again)
    report = json.loads((tmp_path / "out" / "report.json").read_text(), parse_constant=pytest.fail)
    assert [warning["code"] for warning in report["warnings"]].count("diverged") == 1
    assert result.report["losses"][-1]["step"] == STEPS
    if saved_every == 5:
        state = torch.load(tmp_path / "work" / "checkpoint.pt", weights_only=True)
        assert state["halved"] is True
        assert bool(state["optimizer"]["values"].isfinite().all())


def test_no_methods_texture_is_exported_with_holes_in_its_numbers(
    scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sound = mean.mean
    monkeypatch.setattr(mean, "mean", lambda given: (sound(given)[0].fill_(math.nan), []))
    config = dataclasses.replace(CONFIG, method="mean", steps=None)
    with pytest.raises(Diverged, match="the method mean is not finite"):
        texture_scan(scan, tmp_path / "out", config, work=tmp_path / "work")
    assert not list((tmp_path / "out").glob("model*"))


def test_numbers_that_json_lacks_become_null() -> None:
    data = {"a": [math.nan, -math.inf, 1.5], "b": {"c": math.inf}, "path": Path("x")}
    assert json.loads(json_text(data), parse_constant=pytest.fail) == {
        "a": [None, None, 1.5],
        "b": {"c": None},
        "path": "x",
    }

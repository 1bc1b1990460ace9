"""The bench: what it says of a step, of its parts and of the sizes, on views so small that it takes a moment."""

from __future__ import annotations

import json

import pytest

from advtex_engine.__main__ import main
from advtex_engine.bench import step_flops
from advtex_engine.config import PRESETS
from advtex_engine.optimize import crop_size

SMALL = ["bench", "--device", "cpu", "--width", "96", "--height", "72"]
PARTS = {
    "draw and reproject",
    "render and forward",
    "texture backward",
    "discriminator backward and update",
    "texture update",
}


@pytest.mark.parametrize("preset", ["paper", "standard"])
def test_a_step_is_timed_with_its_parts_and_its_operations(preset: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*SMALL, "--preset", preset, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["preset"], result["width"], result["height"]) == (preset, 96, 72)
    assert result["crop"] == list(crop_size(96, 72, PRESETS[preset].max_crop))
    assert result["flops"] == step_flops(*result["crop"])
    assert 0 < result["step_ms_least"] <= result["step_ms"] < 10_000
    assert result["gflops_per_second"] == pytest.approx(result["flops"] / result["step_ms"] / 1e6, rel=0.01, abs=0.1)
    assert result["share"].keys() == PARTS
    assert all(share > 0 for share in result["share"].values())
    assert sum(result["share"].values()) == pytest.approx(1, abs=0.003)


def test_people_read_the_crop_and_the_full_frame(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(SMALL) == 0
    first, *rest = capsys.readouterr().out.splitlines()
    wide, high = crop_size(96, 72)
    assert first == f"preset paper, crops of {wide}x{high} from full frames of 96x72"
    assert any(line.startswith("step_ms ") for line in rest)

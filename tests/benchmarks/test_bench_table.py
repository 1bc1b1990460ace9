"""The table of the bench: rows are added, and what was not measured is said."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from typer.main import get_command

from advtex_engine.__main__ import app

PATH = Path(__file__).with_name("bench.py")


@pytest.fixture(scope="module")
def table() -> ModuleType:
    """By its path: the engine has a module of the same name."""
    spec = importlib.util.spec_from_file_location("bench_table", PATH)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def result(device: str, load: float) -> dict[str, Any]:
    row = {"ms": 12.5, "gflop": 2.0, "mb": 30.0, "floor_ms": 5.0, "ratio": 2.5}
    return {
        "device": device,
        "threads": 2,
        "precision": "fp32",
        "load": load,
        "width": 320,
        "height": 240,
        "views": 16,
        "faces": 80_688,
        "texture": 1024,
        "texels": 500_000,
        "preset": "paper",
        "step_ms": 123.4,
        "step_ms_least": 120.1,
        "floor_ms": 60.0,
        "ratio": 2.06,
        "steps_per_second": 8.1,
        "gflops_per_second": 150.0,
        "product_gflops_per_second": 99.0,
        "copy_gb_per_second": 8.5,
        "parts": {"draw and reproject": row},
        "stages": {"view maps": row, "decode": {"ms": 3.0}, "atlas": {"skipped": "making charts needs xatlas"}},
        "profile": {"busy_ms": 61.7, "operations": [{"name": "conv", "ms": 30.5, "calls": 15.0, "share": 0.494}]},
    }


def test_rows_are_added_and_gpu_rows_stay_empty_until_measured(
    table: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    devices = iter(["cpu", "NVIDIA H200"])

    def run(device: str, size: str, preset: str, views: int, faces: int) -> dict[str, Any]:
        assert (device, size, preset, views, faces) == ("auto", "320x240", "paper", 16, 80_000)
        return {
            "date": "2026-01-02 03:04 UTC",
            "command": "advtex-engine bench …",
            "result": result(next(devices), 1.25),
        }

    monkeypatch.setattr(table, "run", run)
    line = ["--sizes", "320x240", "--presets", "paper", "--results", str(tmp_path)]
    table.main(line)
    page = (tmp_path / "bench.md").read_text()
    assert (
        "| 2026-01-02 03:04 UTC | CPU, 2 threads, fp32 | 1.2 | 320x240, 16 | paper | 123.4 | 120.1 | 60 | 2.06 |"
        in page
    )
    assert "| - | NVIDIA H200 | not measured |" in page
    assert "No idle NVIDIA H200 was at hand" in page
    assert "| view maps | 12.5 | 2 | 30 | 5 | 2.5 |" in page
    assert "(61.7 ms, 0.50 of the step above)" in page
    assert "| `conv` | 30.5 | 15 | 0.494 |" in page
    assert "| decode | 3 | - | - | - | - |" in page
    assert "| atlas | left out | - | - | - | - |" in page
    table.main(line)
    assert len(json.loads((tmp_path / "bench.json").read_text())["cells"]) == 2
    page = (tmp_path / "bench.md").read_text()
    assert "CPU, 2 threads" in page
    assert "not measured |" not in page
    assert "at hand" not in page


def test_the_bench_is_run_as_anyone_would_and_its_line_kept(table: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    def process(command: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        assert command[:4] == [sys.executable, "-m", "advtex_engine", "bench"]
        bench = get_command(app).commands["bench"]  # type: ignore[attr-defined]
        options = bench.make_context("bench", list(command[4:])).params
        assert (options["width"], options["height"], options["views"], options["faces"]) == (64, 48, 8, 300)
        assert (options["device"], options["preset"], options["as_json"]) == ("cpu", "full", True)
        return subprocess.CompletedProcess(command, 0, json.dumps(result("cpu", 0.5)))

    monkeypatch.setattr(table.subprocess, "run", process)
    cell = table.run("cpu", "64x48", "full", 8, 300)
    assert cell["result"] == result("cpu", 0.5)
    assert cell["command"].startswith("advtex-engine bench --device cpu --width 64 --height 48 --preset full")

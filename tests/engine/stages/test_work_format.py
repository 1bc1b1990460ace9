"""What the work folder's files hold, as of a number: another version's files are ignored and not stumbled over.

The structure of every file (names, kinds, types and ranks of tensors) stands in work_format.json. Where a change of the
engine changes it, FORMAT in `checkpoint.py` is raised, and the file renewed:

    ADVTEX_RENEW=1 pytest tests/engine/stages/test_work_format.py
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from advtex_engine.core.config import TextureConfig
from advtex_engine.core.errors import Stopped
from advtex_engine.core.monitor import Monitor
from advtex_engine.pipeline import texture_scan
from advtex_engine.runtime import checkpoint
from advtex_engine.synthetic.scan import synthesize

KNOWN = Path(__file__).with_name("work_format.json")
FAULTS = ["lacks a name", "not a file of torch", "a broken pickle"]
CONFIGS = {
    name: TextureConfig(
        preset=preset,
        method=method,
        steps=6,
        size=(96, 72),
        face_budget=2_500,
        max_texture_size=256,
        device="cpu",
        outputs="glb",
    )
    for name, method, preset in (
        ("adversarial", "adversarial", "preview"),
        ("standard", "adversarial", "standard"),
        ("l1", "l1", "preview"),
    )
}


class StopsAtTwo(Monitor):
    def __init__(self) -> None:
        self.step, self.notes, self.stage = 0, list[str](), ""

    def stage_started(self, stage: str) -> None:
        self.stage = stage

    def progress(self, step: int, steps: int, losses: Mapping[str, float]) -> None:
        self.step = step if self.stage == "optimization" else 0

    def stop_requested(self) -> bool:
        return self.step >= 2

    def note(self, message: str) -> None:
        self.notes.append(message)


class Listens(StopsAtTwo):
    def stop_requested(self) -> bool:
        return False


@pytest.fixture(autouse=True)
def _no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing of a work folder goes into previews but what the model is made of, too."""
    for name in ("write_gallery", "write_page"):
        monkeypatch.setattr(f"advtex_engine.pipeline.{name}", lambda *_: ())


@pytest.fixture(scope="module")
def stopped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a scan and, per method, the work folder of a run that was stopped after its second step."""
    folder = tmp_path_factory.mktemp("format")
    # Without errors of geometry what decimation takes is shape: it is kept for a normal map.
    synthesize(folder / "scan", views=8, width=96, height=72, seed=0, geometry_error=0)
    for method, config in CONFIGS.items():
        with pytest.raises(Stopped):
            texture_scan(folder / "scan", folder / "out", config, work=folder / method, monitor=StopsAtTwo())
    return folder


def structure(value: Any) -> Any:
    """Names and kinds; of a list, of its first element; neither sizes nor values."""
    if isinstance(value, Tensor):
        return f"{str(value.dtype).removeprefix('torch.')} of {value.dim()} dimensions"
    if isinstance(value, dict):
        # param_groups are torch's own, by its version; of quality there is as much as there was time for.
        ours = {str(key): part for key, part in value.items() if key not in ("param_groups", "quality")}
        return {key: structure(part) for key, part in sorted(ours.items())}
    if isinstance(value, list | tuple):
        return [structure(value[0])] if value else []
    return type(value).__name__


def test_the_files_are_those_of_their_format(stopped: Path) -> None:
    found: dict[str, Any] = {"format": checkpoint.FORMAT}
    for method in CONFIGS:
        for file in sorted((stopped / method).glob("*.pt")):
            found[f"{method} {file.stem}"] = structure(torch.load(file, weights_only=True))
    if "ADVTEX_RENEW" in os.environ:
        KNOWN.write_text(json.dumps(found, indent=1) + "\n")
    assert found == json.loads(KNOWN.read_text()), "raise FORMAT in checkpoint.py, and renew this test's file"


def resumed(stopped: Path, folder: Path, method: str = "adversarial") -> list[str]:
    """What a run that goes on from a copy of the work folder notes."""
    monitor = Listens()
    result = texture_scan(
        stopped / "scan", folder / "out", CONFIGS[method], work=folder / "work", resume=True, monitor=monitor
    )
    assert monitor.step == 6
    assert {folder / "out" / "model.glb", folder / "out" / "model_normal.png"} <= set(result.files)
    assert result.report["normal_map"]["made"]
    return monitor.notes


@pytest.fixture
def folder(stopped: Path, tmp_path: Path) -> Path:
    shutil.copytree(stopped / "adversarial", tmp_path / "work")
    return tmp_path


def test_files_of_this_version_are_used_without_a_word(stopped: Path, folder: Path) -> None:
    assert not [note for note in resumed(stopped, folder) if "work folder" in note]


def test_what_another_version_left_is_made_anew(stopped: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("advtex_engine.stages.identity.FORMAT", checkpoint.FORMAT + 1)
    (note,) = [note for note in resumed(stopped, folder) if "work folder" in note]
    assert "by another version" in note


@pytest.mark.parametrize("name", ["scene", "detail", "stages", "atlas", "view_maps_1", "initial_texture", "checkpoint"])
@pytest.mark.parametrize("fault", FAULTS)
def test_a_file_that_lacks_something_or_is_broken_is_made_anew(
    stopped: Path, folder: Path, name: str, fault: str
) -> None:
    damage(folder / "work" / f"{name}.pt", fault)
    (note,) = [note for note in resumed(stopped, folder) if "work folder" in note]
    assert f"{name}.pt" in note


@pytest.mark.parametrize("fault", FAULTS)
def test_so_is_what_the_passes_before_a_game_have_left(stopped: Path, tmp_path: Path, fault: str) -> None:
    shutil.copytree(stopped / "standard", tmp_path / "work")
    damage(tmp_path / "work" / "descended.pt", fault)
    (note,) = [note for note in resumed(stopped, tmp_path, "standard") if "work folder" in note]
    assert "descended.pt" in note


def damage(file: Path, fault: str) -> None:
    if fault == "lacks a name":
        content = torch.load(file, weights_only=True)
        del content[next(key for key in content if key != "fingerprint")]
        torch.save(content, file)
    else:
        file.write_bytes((b"" if fault == "not a file of torch" else b"\x80\x02") + b"garbage" * 100)

"""Masks that leave nothing of a frame, or nothing of what it shows of the mesh."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from advtex_engine.core.config import TextureConfig
from advtex_engine.core.errors import Problem, ScanError
from advtex_engine.core.monitor import Monitor
from advtex_engine.ingest.read import ingest
from advtex_engine.pipeline import texture_scan
from advtex_engine.synthetic.scan import synthesize

VIEWS, WIDTH, HEIGHT = 8, 96, 72
Part = tuple[slice, slice]
NOTHING, CORNER = (slice(0, 0), slice(0, 0)), (slice(0, 2), slice(0, 4))
"""Rows and columns."""
CONFIG = TextureConfig(
    preset="preview", steps=6, face_budget=800, max_texture_size=256, holdout=4, refine=False, device="cpu"
)


class Warned(Monitor):
    def __init__(self) -> None:
        self.problems = list[Problem]()

    def warning(self, problem: Problem) -> None:
        self.problems.append(problem)

    def told(self, code: str) -> list[Problem]:
        return [problem for problem in self.problems if problem.code == code]


@pytest.fixture
def masked(tmp_path: Path) -> Callable[[dict[int, Part]], Path]:
    """Makes a scan without depth whose frames may only be used in the part that is given for their numbers."""

    def make(parts: dict[int, Part]) -> Path:
        scan = tmp_path / "scan"
        synthesize(scan, views=VIEWS, width=WIDTH, height=HEIGHT, seed=0)
        manifest = json.loads((scan / "scan.json").read_text())
        for number, frame in enumerate(manifest["frames"]):
            del frame["depth"]
            if number in parts:
                frame["mask"] = f"mask-{number}.png"
                mask = np.zeros((HEIGHT, WIDTH), np.uint8)
                mask[parts[number]] = 255
                cv2.imwrite(str(scan / frame["mask"]), mask)
        (scan / "scan.json").write_text(json.dumps(manifest))
        return scan

    return make


def test_masks_that_hide_all_of_every_frame_are_the_scans_fault(masked: Callable[[dict[int, Part]], Path]) -> None:
    scan = masked(dict.fromkeys(range(VIEWS), NOTHING))
    with pytest.raises(ScanError, match="masks leave no pixel of all frames") as raised:
        ingest(scan, CONFIG, Monitor())
    assert [problem.code for problem in raised.value.problems] == ["masked_out"]
    assert "and 5 more" in str(raised.value)


def test_frames_that_masks_hide_are_left_out_and_the_others_stay_what_they_are(
    masked: Callable[[dict[int, Part]], Path],
) -> None:
    scan = masked({1: NOTHING, 2: NOTHING, 3: (slice(10, 60), slice(None))})
    plain, warned = Warned(), Warned()
    scene = ingest(scan, CONFIG, warned)
    manifest = json.loads((scan / "scan.json").read_text())
    names = [frame["name"] for frame in manifest["frames"]]
    for frame in manifest["frames"]:
        frame.pop("mask", None)
    (scan / "scan.json").write_text(json.dumps(manifest))
    whole = ingest(scan, CONFIG, plain)
    assert [view.name for view in whole.heldout] == [names[2], names[6]]
    assert [view.name for view in scene.heldout] == [names[6]]
    assert [view.name for view in scene.views] == [names[number] for number in (0, 3, 4, 5, 7)]
    (told,) = warned.told("masked_out")
    assert told.where == f"{names[1]}, {names[2]}"
    assert "2 of 8" in told.message
    assert not plain.told("masked_out")


def test_frames_that_show_the_mesh_nowhere_are_counted(
    masked: Callable[[dict[int, Part]], Path], tmp_path: Path
) -> None:
    """The object is in the middle of the images: their corners show the background."""
    scan = masked({1: CORNER, 4: CORNER})
    warned = Warned()
    result = texture_scan(scan, tmp_path / "out", CONFIG, work=tmp_path / "work", monitor=warned)
    (told,) = warned.told("no_foreground")
    assert "2 of 6" in told.message
    assert (tmp_path / "out" / "model.glb") in result.files


@pytest.mark.parametrize("method", ["adversarial", "l1"])
def test_masks_that_leave_the_background_alone_are_the_scans_fault(
    masked: Callable[[dict[int, Part]], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str
) -> None:
    """Where the check of conventions finds nothing amiss with the background."""
    monkeypatch.setattr("advtex_engine.pipeline.checked_conventions", lambda *_: None)
    scan = masked(dict.fromkeys(range(VIEWS), CORNER))
    config = TextureConfig(preset="preview", method=method, steps=6, face_budget=800, device="cpu", refine=False)
    with pytest.raises(ScanError, match="all frames show nothing of the mesh"):
        texture_scan(scan, tmp_path / "out", config, work=tmp_path / "work")

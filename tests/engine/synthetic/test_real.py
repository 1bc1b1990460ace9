"""Scans with the errors of real ones: sound, repeatable, each error in its own files, and true where they say so."""

from __future__ import annotations

import dataclasses
import json
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent))
from small_room import small_room
from surfaces import distances, spread_points

from advtex_engine.__main__ import main
from advtex_engine.core.config import TextureConfig
from advtex_engine.core.errors import OptionError
from advtex_engine.core.monitor import Monitor
from advtex_engine.ingest.read import ingest
from advtex_engine.mesh import fusion
from advtex_engine.mesh.models import load_reference
from advtex_engine.metrics.evaluate import evaluate
from advtex_engine.synthetic import camera, real, room
from advtex_engine.synthetic.camera import Errors
from advtex_engine.synthetic.real import synthesize_real
from advtex_engine.synthetic.scan import compare_to_truth
from advtex_scan.check import check_scan

VIEWS, WIDTH, HEIGHT = 6, 64, 48
NONE = Errors.none()


@pytest.fixture(scope="module", autouse=True)
def few_surfaces() -> Iterator[None]:
    """What is written does not depend on how much there is to see."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(room, "SPACING", 500.0)
        drawn = small_room()
        patch.setattr(real, "drawn_scene", lambda _scene, _seed: drawn)
        patch.setattr(camera, "SUBFRAMES", 4)
        patch.setattr(real, "HELDOUT_VIEWS", 4)
        patch.setattr(fusion, "COARSEST", 0.06)
        patch.setattr(fusion, "VOXEL_SHARE", 1 / 30)
        yield


def made(folder: Path, errors: Errors | None = None, **more: Any) -> Path:
    synthesize_real(folder, views=VIEWS, width=WIDTH, height=HEIGHT, errors=errors, **more)
    return folder


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made(tmp_path_factory.mktemp("real") / "scan")


@pytest.fixture(scope="module")
def flawless(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made(tmp_path_factory.mktemp("real") / "scan", NONE)


def load(scan: Path, name: str) -> Any:
    return json.loads((scan / name).read_text())


def poses(frames: list[dict[str, Any]]) -> np.ndarray:
    return np.array([frame["camera_to_world"] for frame in frames])


def changed(first: Path, second: Path) -> set[str]:
    """Top folders and files whose bytes differ, color apart from its file format."""
    files = [
        {path.relative_to(scan).with_suffix("").as_posix(): path.read_bytes() for path in scan.rglob("*.*")}
        for scan in (first, second)
    ]
    assert files[0].keys() == files[1].keys()
    return {name.split("/")[0] for name in files[0] if files[0][name] != files[1][name] and "truth" not in name}


def test_the_scan_and_the_scan_of_its_held_out_views_are_sound(scan: Path) -> None:
    for folder, views in ((scan, VIEWS), (scan / "truth", real.HELDOUT_VIEWS)):
        report = check_scan(folder)
        assert report.ok
        assert [finding.code for finding in report.findings if finding.severity != "info"] == []
        scene = ingest(folder, TextureConfig(), Monitor())
        assert len(scene.views) == views
        assert len(scene.mesh.t_pos_idx) > 300


def test_the_same_arguments_make_the_same_scan(scan: Path, flawless: Path, tmp_path: Path) -> None:
    again = made(tmp_path / "scan.zip")
    with zipfile.ZipFile(again) as members:
        stored = {name: members.read(name) for name in members.namelist()}
    assert stored == {
        path.relative_to(scan).as_posix(): path.read_bytes() for path in scan.rglob("*") if path.is_file()
    }
    assert changed(flawless, made(tmp_path / "other", NONE, seed=1)) == {"color", "depth", "scan"}


@pytest.mark.parametrize(
    ("name", "where"),
    [
        *((name, {"color"}) for name in ("blur", "rolling_shutter", "distortion", "vignetting")),
        *((name, {"color"}) for name in ("exposure", "white_balance", "noise")),
        ("jpeg", {"color", "scan"}),
        ("drift", {"scan"}),
        ("fused", {"mesh"}),
        ("depth", {"depth"}),
    ],
)
def test_each_error_changes_what_it_should_and_nothing_else(
    name: str, where: set[str], flawless: Path, tmp_path: Path
) -> None:
    found = made(tmp_path / "scan", dataclasses.replace(NONE, **{name: True}))
    assert changed(flawless, found) == where
    assert load(found, "truth/cameras.json")["errors"] == dataclasses.asdict(NONE) | {name: True}


def test_without_errors_nothing_is_wrong(flawless: Path) -> None:
    truth, told = load(flawless, "truth/cameras.json"), load(flawless, "scan.json")
    assert np.allclose(poses(told["frames"]), poses(truth["frames"]), atol=1e-12)
    assert np.allclose(poses(load(flawless, "truth/scan.json")["frames"]), poses(truth["heldout"]), atol=1e-12)
    assert {frame["blur_pixels"] for frame in truth["frames"]} == {0.0}
    assert {frame["gain"] for frame in truth["frames"]} == {truth["gain"]}
    given, true = (load_reference(flawless / name) for name in ("mesh.ply", "truth/object.obj"))
    assert torch.equal(given.v_pos, true.v_pos)


def test_a_fused_mesh_drifts_with_its_poses(scan: Path) -> None:
    fused, true = load_reference(scan / "mesh.ply"), load_reference(scan / "truth/object.obj")
    off = distances(spread_points(fused, 500), true)
    assert 0.002 < float(off.median()) < 0.04
    assert len(fused.t_pos_idx) > 300


def test_the_truth_tells_how_each_frame_was_taken(scan: Path) -> None:
    truth = load(scan, "truth/cameras.json")
    assert len(truth["frames"]) == VIEWS
    for frame in truth["frames"]:
        assert 0.005 < frame["exposure_seconds"] < 0.08
        assert 0 <= frame["blur_pixels"] < 10
        assert 0 <= frame["clipped_share"] <= 1
        motion = np.array(frame["motion"])
        assert np.allclose(motion[len(motion) // 2], frame["camera_to_world"], atol=1e-9)
        assert not np.allclose(motion[0], motion[-1], atol=1e-5)
    assert len({frame["gain"] for frame in truth["frames"]}) == VIEWS
    assert max(frame["blur_pixels"] for frame in truth["frames"]) > 0.2


def test_held_out_views_are_the_truth_at_the_median_exposure(scan: Path) -> None:
    scores = compare_to_truth(scan / "truth/object.obj", scan)
    assert scores["views"] == real.HELDOUT_VIEWS
    picture = cv2.imread(str(scan / "truth/heldout/heldout-0002.png"))
    assert picture is not None
    assert 60 < picture.mean() < 200
    # Pictures are means of light, renders of the model are means of sRGB values.
    found = evaluate(scan / "truth/object.obj", scan / "truth", reference=scan / "truth/object.obj")
    assert found.mean["psnr"] > 18


def test_the_phone_s_depth_images_are_as_the_camera_file_says(tmp_path: Path) -> None:
    found = tmp_path / "scan"
    synthesize_real(found, views=3, width=320, height=240, sensor="lidar", errors=dataclasses.replace(NONE, depth=True))
    depth = cv2.imread(str(found / "depth/frame-0000.png"), cv2.IMREAD_UNCHANGED)
    assert depth is not None
    told = load(found, "scan.json")["depth_intrinsics"]
    assert depth.shape == (told["height"], told["width"]) == (192, 256)


def test_the_command_makes_such_a_scan(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "scan"
    assert main(["synthesize", str(out), "--real", "--scene", "object", "--views", "3", "--size", "48x32"]) == 0
    assert str(out) in capsys.readouterr().out
    assert load(out, "scan.json")["kind"] == "object"
    with pytest.raises(OptionError, match="too few"):
        synthesize_real(tmp_path / "none", views=2)


def test_a_chair_s_legs_are_thin_and_all_surfaces_of_furniture_are_flat() -> None:
    parts = list(room._chair(900.0, 1250.0, np.random.default_rng(0)))
    corners = np.array([part.surface(np.array([[0.0, 0.0], [1.0, 1.0]])) for part in parts])
    sides = np.sort(np.abs(np.diff(corners, axis=1)[:, 0]), axis=1)
    assert (sides[:, 0] == 0).all()
    assert np.isclose(sides[:, 1], 22.0).sum() >= 16

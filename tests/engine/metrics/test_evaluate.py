"""Evaluation of models of known quality on a scan made here: a printed board before a few cameras."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import platformdirs
import pytest
import torch
from lpips_weights import random_lpips, write_weights
from torch import Tensor

from advtex_engine.__main__ import main
from advtex_engine.core.errors import EngineError, OptionError, ScanError
from advtex_engine.core.scene import Atlas, Camera, Mesh, View
from advtex_engine.mesh.models import ModelError
from advtex_engine.metrics import lpips as perceptual
from advtex_engine.metrics.evaluate import (
    DEPTH_AGREEMENT,
    MIN_PIXELS,
    Evaluation,
    compare,
    evaluate,
    mean_scores,
    score_views,
)
from advtex_engine.metrics.image_metrics import METRICS
from advtex_engine.metrics.lpips import Source
from advtex_engine.render.pictures import CAPTION_HEIGHT, GUTTER
from advtex_engine.render.render_view import render_view
from advtex_engine.results.export import export_model

WIDTH, HEIGHT, FOCAL, FRAMES = 120, 96, 100.0, 5
COLUMNS = 8
SCORES = {
    *METRICS,
    *("lpips", "lpips_full", "band_error", "s3_ratio", "flat_energy", "coverage", "mask_share"),
    *("nearest_patch", "nearest_patch_reverse"),
}


def board(left: float = -0.6, right: float = 0.6, distance: float = 1.0) -> Atlas:
    """A board facing the cameras, in COLUMNS strips of two triangles; u is measured on the whole board."""
    x = torch.linspace(left, right, COLUMNS + 1)
    v_pos = torch.cat([torch.stack((x, torch.full_like(x, y), torch.full_like(x, distance)), 1) for y in (-0.48, 0.48)])
    v_uv = torch.stack(((v_pos[:, 0] + 0.6) / 1.2, (v_pos[:, 1] + 0.48) / 0.96), 1)
    first = torch.arange(COLUMNS)
    faces = torch.cat(
        (
            torch.stack((first, first + 1, first + COLUMNS + 2), 1),
            torch.stack((first, first + COLUMNS + 2, first + COLUMNS + 1), 1),
        )
    )
    return Atlas(Mesh(v_pos, faces, v_uv, faces), 144, 112, "scan", 1)


def print_(blur: float = 0.0) -> Tensor:
    """The board's texture: blocks of color and grain on one half, a plain wall on the other."""
    generator = torch.Generator().manual_seed(1)
    texture = torch.full((112, 144, 3), 0.6)
    blocks = torch.rand(14, 9, 3, generator=generator).repeat_interleave(8, 0).repeat_interleave(8, 1)
    texture[:, :72] = 0.8 * blocks + 0.2 * torch.rand(112, 72, 3, generator=generator)
    texture += 0.004 * torch.randn(112, 144, 3, generator=generator)
    if blur:
        texture = torch.from_numpy(cv2.GaussianBlur(texture.numpy(), (0, 0), blur))
    return texture.clamp(0, 1)


def camera(index: int) -> Camera:
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64)
    world_to_camera = torch.eye(4, dtype=torch.float64)
    world_to_camera[:2, 3] = torch.tensor([0.02 * index - 0.04, 0.01 * index])
    return Camera(K, world_to_camera, WIDTH, HEIGHT)


def write_ply(path: Path, mesh: Mesh) -> None:
    lines = [" ".join(map(str, row)) for row in mesh.v_pos.tolist()]
    lines += [" ".join(map(str, (3, *row))) for row in mesh.t_pos_idx.tolist()]
    header = (
        f"ply\nformat ascii 1.0\nelement vertex {len(mesh.v_pos)}\nproperty float x\nproperty float y\nproperty float z"
    )
    faces = f"element face {len(mesh.t_pos_idx)}\nproperty list uchar int vertex_indices\nend_header"
    path.write_text("\n".join((header, faces, *lines, "")))


def write_scan(folder: Path, depth: Callable[[np.ndarray], None] | None = None, up_axis: str = "+z") -> Path:
    """depth: edits the depth image in millimetres, which is the board's distance; None leaves depth out."""
    for name in ("color", "depth"):
        (folder / name).mkdir(parents=True)
    frames = []
    for index in range(FRAMES):
        view = camera(index)
        photo = (render_view(board(), print_(), view).clamp(0, 1) * 255).round().to(torch.uint8).numpy()
        cv2.imwrite(str(folder / f"color/{index}.png"), photo[..., ::-1])
        frame: dict[str, Any] = {"color": f"color/{index}.png"}
        if depth is not None:
            reading = np.full((HEIGHT, WIDTH), 1000, np.uint16)
            depth(reading)
            cv2.imwrite(str(folder / f"depth/{index}.png"), reading)
            frame["depth"] = f"depth/{index}.png"
        frame["camera_to_world"] = torch.linalg.inv(view.world_to_camera).tolist()
        frames.append(frame)
    size = {"fx": FOCAL, "fy": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2, "width": WIDTH, "height": HEIGHT}
    scan = {"version": 1, "kind": "object", "up_axis": up_axis, "depth_scale": 1000, "mesh": "mesh.ply"}
    intrinsics = {"color_intrinsics": size, "depth_intrinsics": size}
    (folder / "scan.json").write_text(json.dumps({**scan, **intrinsics, "frames": frames}))
    write_ply(folder / "mesh.ply", board().mesh)
    return folder


def write_model(folder: Path, atlas: Atlas, texture: Tensor, up_axis: str = "+z") -> Path:
    export_model(folder, atlas, texture, up_axis=up_axis, lossless=True)
    return folder / "model.obj"


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scan(tmp_path_factory.mktemp("scan") / "scan")


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_model(tmp_path_factory.mktemp("model"), board(), print_())


@pytest.fixture(autouse=True)
def no_weights_of_this_machine(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv(perceptual.WEIGHTS_VARIABLE, raising=False)
    monkeypatch.setattr(platformdirs, "user_cache_path", lambda name: tmp_path / "cache" / name)


# Scores ---------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def perfect(scan: Path, model: Path, tmp_path_factory: pytest.TempPathFactory) -> Evaluation:
    return evaluate(model, scan, weights=write_weights(tmp_path_factory.mktemp("weights")))


def test_the_model_that_the_photographs_show_scores_perfectly(perfect: Evaluation) -> None:
    assert perfect.missing == {}
    assert [row["view"] for row in perfect.per_view] == [f"{index:06}" for index in range(FRAMES)]
    for row in [*perfect.per_view, perfect.mean]:
        assert set(row) - {"view", "views"} == SCORES
        assert row["psnr"] > 45
        assert row["coverage"] == 1
        assert row["lpips"] < 0.01 and row["lpips_full"] < 0.01 and row["band_error"] < 0.02
        assert row["nearest_patch"] < 1 and row["nearest_patch_reverse"] < 1 and row["sliced_wasserstein"] < 0.2
        for name in ("gradient_ratio", "sharpness_ratio", "ssim", "s3_ratio"):
            assert row[name] == pytest.approx(1, abs=0.02), name
        assert row["flat_energy"] == pytest.approx(1, abs=0.15), "photographs are rounded to 8 bits, renders are not"
    assert perfect.mean["mask_share"] == pytest.approx(0.95, abs=0.05)
    assert perfect.mean["views"] == FRAMES


def test_means_are_those_of_the_views(perfect: Evaluation) -> None:
    for name in SCORES:
        assert perfect.mean[name] == pytest.approx(np.mean([row[name] for row in perfect.per_view]))


def test_every_score_of_a_blurred_model_is_worse(scan: Path, perfect: Evaluation, tmp_path: Path) -> None:
    blurred = write_model(tmp_path, board(), print_(blur=1.5))
    mean = evaluate(blurred, scan, weights=write_weights(tmp_path / "weights")).mean
    for name in ("psnr", "ssim", "gradient_ratio", "sharpness_ratio", "s3_ratio", "flat_energy"):
        assert mean[name] < 0.95 * perfect.mean[name], name
    for name in ("lpips", "lpips_full", "band_error", "sliced_wasserstein", "nearest_patch_reverse"):
        assert mean[name] > 2 * perfect.mean[name], name


def test_what_the_model_leaves_out_is_scored_as_black(scan: Path, perfect: Evaluation, tmp_path: Path) -> None:
    half = write_model(tmp_path, board(right=0.0), print_())
    mean = evaluate(half, scan, holdout=FRAMES).mean
    assert mean["coverage"] == pytest.approx(0.5, abs=0.05)
    assert mean["mask_share"] == pytest.approx(perfect.mean["mask_share"], abs=0.02)
    assert mean["psnr"] < 10
    assert mean["flat_energy"] is None, "the wall is not covered, so nothing can be said of it"


def test_a_surface_elsewhere_counts_as_left_out(scan: Path, tmp_path: Path) -> None:
    near = write_model(tmp_path / "near", board(distance=1 + 0.8 * DEPTH_AGREEMENT), print_())
    assert evaluate(near, scan, holdout=FRAMES).mean["coverage"] > 0.9
    far = write_model(tmp_path / "far", board(distance=1 + 1.2 * DEPTH_AGREEMENT), print_())
    with pytest.raises(EngineError, match="no view shows it where the scan's mesh is"):
        evaluate(far, scan, holdout=FRAMES)


def test_a_reference_decides_which_pixels_count(scan: Path, model: Path, perfect: Evaluation, tmp_path: Path) -> None:
    write_ply(tmp_path / "half.ply", board(right=0.0).mesh)
    mean = evaluate(model, scan, holdout=FRAMES, reference=tmp_path / "half.ply").mean
    assert mean["coverage"] == 1
    assert mean["mask_share"] == pytest.approx(perfect.mean["mask_share"] / 2, rel=0.1)


def test_device_depth_must_be_there_and_agree_with_the_mesh(model: Path, tmp_path: Path) -> None:
    def some_wrong(reading: np.ndarray) -> None:
        reading[:20] = 0
        reading[20:30] = 1100
        reading[30:40] = 1030

    mean = evaluate(model, write_scan(tmp_path / "scan", some_wrong), holdout=FRAMES).mean
    assert mean["mask_share"] == pytest.approx((HEIGHT - 30) / HEIGHT, abs=0.02)


@pytest.mark.parametrize("up_axis", ["+z", "-x", "-y"])
def test_a_glb_scores_as_its_obj(tmp_path: Path, up_axis: str) -> None:
    scan = write_scan(tmp_path / "scan", up_axis=up_axis)
    obj = write_model(tmp_path, board(), print_(blur=0.7), up_axis)
    ours, theirs = (evaluate(obj.with_suffix(suffix), scan, holdout=FRAMES).mean for suffix in (".glb", ".obj"))
    assert ours["coverage"] == 1
    for name in SCORES - {"lpips", "lpips_full"}:
        assert ours[name] == pytest.approx(theirs[name], rel=1e-2), name


def test_holdout_takes_the_frames_that_texturing_leaves_out(scan: Path, model: Path) -> None:
    assert [row["view"] for row in evaluate(model, scan, holdout=2).per_view] == ["000001", "000003"]
    with pytest.raises(EngineError, match="no frame is held out; lower the holdout below 40"):
        evaluate(model, scan, holdout=40)
    with pytest.raises(OptionError, match="holdout 1"):
        evaluate(model, scan, holdout=1)


def test_the_layout_can_be_told(scan: Path, model: Path) -> None:
    assert evaluate(model, scan, holdout=FRAMES, layout="native").mean["views"] == 1
    with pytest.raises(ScanError):
        evaluate(model, scan, holdout=FRAMES, layout="tum")


def test_size_is_that_of_renders_and_photographs(scan: Path, model: Path, tmp_path: Path) -> None:
    evaluate(model, scan, size=(80, 64), holdout=FRAMES, sheet=tmp_path / "sheet.png")
    sheet = cv2.imread(str(tmp_path / "sheet.png"))
    assert sheet is not None
    assert sheet.shape == (64 + CAPTION_HEIGHT + GUTTER, 3 * 80 + 2 * GUTTER, 3)


def test_without_weights_the_metric_is_missing_and_says_why(scan: Path, model: Path) -> None:
    evaluation = evaluate(model, scan, holdout=FRAMES)
    assert evaluation.mean["lpips"] is None and evaluation.mean["lpips_full"] is None
    assert set(evaluation.missing) == {"lpips", "lpips_full"}
    assert "has no file alexnet" in evaluation.missing["lpips"]
    assert evaluation.mean["gradient_ratio"] is not None


def test_a_broken_scan_and_a_broken_model_are_told_apart(scan: Path, model: Path, tmp_path: Path) -> None:
    with pytest.raises(ScanError):
        evaluate(model, tmp_path)
    with pytest.raises(ModelError):
        evaluate(tmp_path / "model.obj", scan)


# Views ----------------------------------------------------------------------------------------------------------------


def shot(depth: Tensor | None = None, texture: Tensor | None = None) -> View:
    photo = render_view(board(), print_() if texture is None else texture, camera(0)).clamp(0, 1)
    return View("shot", camera(0), (photo * 255).round().to(torch.uint8), depth)


def test_outside_of_the_pixels_that_count_both_images_are_the_photograph() -> None:
    depth = torch.ones(HEIGHT, WIDTH)
    depth[:, 70:] = 0
    comparison = compare(board(right=0.0), print_(blur=2.0), shot(depth), board().mesh)
    assert comparison is not None
    assert not bool(comparison.mask[:, 70:].any())
    assert torch.equal(comparison.image[~comparison.mask], comparison.photo[~comparison.mask])
    assert bool((comparison.image[comparison.mask & ~comparison.covered] == 0).all())
    assert bool((comparison.covered <= comparison.mask).all())
    assert float((comparison.image - comparison.photo)[comparison.covered].abs().mean()) > 0.01


def test_views_with_hardly_a_pixel_are_left_out() -> None:
    depth = torch.zeros(HEIGHT, WIDTH)
    depth[40:60, 40:60] = 1
    assert MIN_PIXELS > 400
    assert compare(board(), print_(), shot(depth)) is None
    scores = score_views(board(), {"print": print_()}, [shot(depth), shot()], None)
    assert scores["print"]["views"] == 1
    assert score_views(board(), {"print": print_()}, [shot(depth)], None) == {"print": {}}


def test_scores_of_heldout_views_need_no_files() -> None:
    gray = torch.full_like(print_(), 0.5)
    found = score_views(board(), {"print": print_(), "gray": gray}, [shot()], random_lpips())
    scores = found["print"]
    assert found["gray"]["lpips"] > 10 * scores["lpips"]
    assert set(scores) == SCORES - {"nearest_patch", "nearest_patch_reverse"} | {"views"}
    assert scores["coverage"] == 1 and scores["lpips"] < 0.01


def test_a_dense_texture_is_filtered_before_it_is_compared() -> None:
    dots = torch.zeros(112 * 6, 144 * 6, 3)
    dots[::3, ::3] = 1
    dense = replace(board(), width=144 * 6, height=112 * 6)
    view = shot(texture=torch.full((112, 144, 3), 1 / 9))
    comparison = compare(dense, dots, view)
    assert comparison is not None
    coarse = render_view(dense, dots, view.camera, supersample=2)
    errors = [(image - comparison.photo)[comparison.covered].square().mean() for image in (comparison.image, coarse)]
    assert errors[0] < 0.3 * errors[1]


def test_means_skip_what_is_missing() -> None:
    rows = [{"view": "a", "x": 1.0, "y": None, "z": None}, {"view": "b", "x": 2.0, "y": 4.0, "z": None}]
    assert mean_scores(rows) == {"x": 1.5, "y": 4.0, "z": None, "views": 2}


# The command ----------------------------------------------------------------------------------------------------------


def test_the_command_writes_json_and_sheet(
    scan: Path, model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = [
        "--holdout",
        "2",
        "--json",
        str(tmp_path / "scores.json"),
        "--contact-sheet",
        str(tmp_path / "sheet.png"),
    ]
    assert main(["evaluate", str(model), str(scan), *options]) == 0
    printed = capsys.readouterr()
    written = json.loads((tmp_path / "scores.json").read_text())
    assert written["model"] == str(model) and written["scan"] == str(scan) and written["holdout"] == 2
    assert [row["view"] for row in written["per_view"]] == ["000001", "000003"]
    assert set(written["mean"]) == SCORES | {"views"}
    assert written["mean"]["lpips"] is None and written["missing"]["lpips"]
    table = dict(line.split() for line in printed.out.splitlines())
    assert table["lpips"] == "-" and float(table["psnr"]) == pytest.approx(written["mean"]["psnr"], rel=1e-3)
    assert "lpips is missing: no weights" in printed.err
    assert cv2.imread(str(tmp_path / "sheet.png")) is not None


def test_weights_are_downloaded_only_when_asked_for(
    scan: Path, model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    origin = write_weights(tmp_path / "origin")
    sources = [Source(path.name, path.as_uri(), perceptual._sha256(path)) for path in sorted(origin.iterdir())]
    monkeypatch.setattr(perceptual, "LPIPS_SOURCES", sources)
    command = ["evaluate", str(model), str(scan), "--holdout", str(FRAMES)]
    assert main(command) == 0
    assert not (tmp_path / "cache").exists()
    assert main([*command, "--download-weights"]) == 0
    assert "lpips" not in capsys.readouterr().err.split("missing")[-1]
    assert sorted(path.name for path in (tmp_path / "cache/advtex/weights").iterdir()) == [s.name for s in sources]
    assert main(command) == 0, "the cache is used from now on"
    assert "missing" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["absent.obj", "{scan}"], 1, "absent.obj: cannot be read"),
        (["{model}", "absent"], 1, "absent"),
        (["{model}", "{scan}", "--holdout", "1"], 2, "holdout 1 is out of bounds"),
        (["{model}", "{scan}", "--reference", "absent.ply"], 1, "absent.ply: cannot be read"),
    ],
)
def test_the_command_says_what_is_wrong(
    scan: Path, model: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], code: int, message: str
) -> None:
    assert main(["evaluate", *(word.format(scan=scan, model=model) for word in arguments)]) == code
    assert message in capsys.readouterr().err

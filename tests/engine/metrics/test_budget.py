"""The budget of renders whose one fault is known: each part's cost goes where it belongs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from lpips_weights import random_lpips, write_weights
from torch import Tensor
from wavy_sheet import camera_over, paint, sheet

from advtex_engine.__main__ import main
from advtex_engine.core.cameras import scaled_camera
from advtex_engine.core.scene import Atlas, View
from advtex_engine.metrics.budget import (
    COSTS,
    LPIPS_SCORES,
    TABLE,
    along_motion,
    budget_scores,
    corrected_tone,
    dense_flow,
    own_motion,
    warped,
)
from advtex_engine.metrics.evaluate import DEPTH_AGREEMENT, Scores, compare, view_budget
from advtex_engine.metrics.lpips import Lpips
from advtex_engine.metrics.photograph import Photograph
from advtex_engine.refine.pose import exponential
from advtex_engine.render.rasterize import rasterize
from advtex_engine.render.render_view import render_view
from advtex_engine.results.export import export_model

WIDTH, HEIGHT, TEXELS = 320, 240, 512
CAMERA = scaled_camera(camera_over(0, 8), WIDTH, HEIGHT)


@pytest.fixture(scope="module")
def lpips() -> Lpips:
    return random_lpips()


def relief(cells: int = 40, size: float = 4.0) -> Atlas:
    mesh = sheet(size, cells, (0.15, 3.0, 2.0, 0.0))
    return Atlas(mesh, TEXELS, TEXELS, "scan", 1)


def painted() -> Tensor:
    line = (torch.arange(TEXELS) + 0.5) / TEXELS * 4 - 2
    y, x = torch.meshgrid(line, line, indexing="ij")
    return paint(torch.stack((x, y), -1))


@pytest.fixture(scope="module")
def photo() -> Tensor:
    """What the camera sees, with a little noise."""
    color = render_view(relief(), painted(), CAMERA)
    return (color + 0.003 * torch.randn(color.shape, generator=torch.Generator().manual_seed(3))).clamp(0, 1)


def region() -> Tensor:
    """[H,W] bool: most of the view, with a ragged edge and a hole."""
    rows, columns = torch.arange(HEIGHT)[:, None], torch.arange(WIDTH)
    mask = (rows > 10 + 6 * (columns / 9).sin()) & (columns < WIDTH - 12)
    mask[100:130, 60:110] = False
    return mask


def smooth_flow(largest: float) -> Tensor:
    """[H,W,2] pixels, of waves as wide as the view."""
    rows, columns = np.indices((HEIGHT, WIDTH), dtype=np.float32)
    right, down = np.sin(rows / 40) * np.cos(columns / 60), np.cos(rows / 50 + columns / 70)
    return torch.from_numpy(largest * np.stack((right, down), -1))


def moved(image: Tensor, flow: Tensor) -> Tensor:
    """What the image shows at p - flow(p)."""
    rows, columns = np.indices((HEIGHT, WIDTH), dtype=np.float32)
    x, y = columns - flow[..., 0].numpy(), rows - flow[..., 1].numpy()
    return torch.from_numpy(cv2.remap(image.numpy(), x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)).clamp(0, 1)


def blurred(image: Tensor) -> Tensor:
    return torch.from_numpy(cv2.GaussianBlur(image.numpy(), (0, 0), 2.0))


def shaken(image: Tensor, pixels: float, angle: float) -> Tensor:
    """The mean of what a camera sees on its way along a straight line."""
    shown = []
    for step in np.linspace(-0.5, 0.5, 33):
        matrix = np.float32([[1, 0, pixels * step * np.cos(angle)], [0, 1, pixels * step * np.sin(angle)]])
        way = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        shown.append(cv2.warpAffine(image.numpy(), matrix, (WIDTH, HEIGHT), flags=way, borderMode=cv2.BORDER_REFLECT))
    return torch.from_numpy(np.mean(shown, axis=0))


def vignetted(image: Tensor) -> Tensor:
    columns = torch.linspace(-1, 1, WIDTH)[:, None]
    return (image + 0.12 * columns).clamp(0, 1)


def of_image(image: Tensor, photo: Tensor, lpips: Lpips | None) -> Scores:
    mask = region()
    shown = torch.where(mask[..., None], image, photo)
    return budget_scores(photo, shown, shown, mask, mask, lpips)


def raw(scores: Scores) -> float:
    return sum(scores[name] or 0.0 for name in COSTS)


def share(scores: Scores, name: str) -> float:
    return (scores[name] or 0.0) / raw(scores)


def test_what_exposure_and_white_balance_cost_is_tone(photo: Tensor, lpips: Lpips) -> None:
    exposed = photo * torch.tensor([0.6, 0.7, 0.8]) + 0.03
    assert share(of_image(exposed, photo, lpips), "tone_cost") > 0.95


def test_what_a_vignette_costs_is_tone(photo: Tensor, lpips: Lpips) -> None:
    assert share(of_image(vignetted(photo), photo, lpips), "tone_cost") > 0.8


def test_what_a_smooth_flow_costs_is_displacement(photo: Tensor, lpips: Lpips) -> None:
    flow = smooth_flow(3.0)
    scores = of_image(moved(photo, flow), photo, lpips)
    assert share(scores, "displacement_cost") > 0.7
    truth = float(flow.norm(dim=-1)[region()].median())
    assert scores["displacement_pixels"] == pytest.approx(truth, rel=0.15)


def test_what_blur_costs_is_content(photo: Tensor, lpips: Lpips) -> None:
    scores = of_image(blurred(photo), photo, lpips)
    assert share(scores, "content_cost") > 0.9
    assert scores["displacement_pixels"] is not None
    assert scores["displacement_pixels"] < 0.5


@pytest.mark.parametrize(("pixels", "angle"), [(5.0, 0.0), (7.0, 0.6), (5.0, 2.2)])
def test_what_the_photograph_s_own_motion_costs_is_motion(
    photo: Tensor, lpips: Lpips, pixels: float, angle: float
) -> None:
    scores = of_image(photo, shaken(photo, pixels, angle), lpips)
    assert share(scores, "motion_cost") > 0.6
    found, direction = own_motion(photo, shaken(photo, pixels, angle), region())
    assert found == pytest.approx(pixels, rel=0.45)
    off = (direction - angle + np.pi / 2) % np.pi - np.pi / 2
    assert abs(off) <= np.pi / 12


def test_no_motion_excuses_a_texture_that_is_soft_or_moved_itself(photo: Tensor, lpips: Lpips) -> None:
    for image in (photo, blurred(photo), shaken(photo, 7.0, 0.6), moved(photo, smooth_flow(3.0))):
        scores = of_image(image, photo, lpips)
        assert scores["motion_pixels"] == 0
        assert scores["motion_cost"] == 0


def test_a_motion_s_blur_keeps_what_is_even_and_what_is_not_known(photo: Tensor) -> None:
    mask = region()
    smeared = along_motion(photo, mask, 7.0, 0.6)
    assert torch.equal(smeared[~mask], photo[~mask])
    assert not torch.equal(smeared[mask], photo[mask])
    even = torch.where(mask[..., None], 0.5, photo)
    assert torch.allclose(along_motion(even, mask, 7.0, 0.6), even, atol=1e-6)


def wrongly_posed(photo: Tensor) -> View:
    """Turned and moved by some pixels."""
    motion = exponential(torch.tensor([[0.006, -0.008, 0.004, 0.01, 0.008, -0.01]], dtype=torch.float64))[0]
    wrong = replace(CAMERA, world_to_camera=motion @ CAMERA.world_to_camera)
    return View("view", wrong, (photo * 255).round().to(torch.uint8), mask=region())


def test_what_a_wrong_pose_costs_is_pose(photo: Tensor, lpips: Lpips) -> None:
    atlas, texture = relief(), painted()
    view = wrongly_posed(photo)
    color = view.color
    given = compare(atlas, texture, view)
    assert given is not None
    scores = view_budget(atlas, texture, view, given, atlas.mesh, "scene", lpips)
    assert scores["pose_pixels"] is not None
    assert scores["pose_pixels"] > 1.5
    assert share(scores, "pose_cost") > 0.9
    assert scores["displacement_pixels"] is not None
    assert scores["displacement_pixels"] < 0.4
    assert raw(scores) == pytest.approx(lpips.masked(given.image, Photograph(given.photo, given.mask)), abs=1e-9)

    elsewhere = torch.where(given.mask[..., None], color, 255 - color)
    other = replace(view, color=elsewhere)
    again = compare(atlas, texture, other)
    assert again is not None
    assert view_budget(atlas, texture, other, again, atlas.mesh, "scene", None)["pose_pixels"] == scores["pose_pixels"]


def test_the_right_pose_is_seen_where_the_device_s_depth_fits_the_wrong_one_alone(photo: Tensor, lpips: Lpips) -> None:
    """In half of the view: depths that agree by a hair from where the camera was said to be."""
    atlas, texture, view = relief(), painted(), wrongly_posed(photo)
    right, wrong = (rasterize(atlas.mesh, camera).depth for camera in (CAMERA, view.camera))
    half = (torch.arange(WIDTH) > WIDTH // 2).expand(HEIGHT, -1)
    depth = torch.where(half, wrong - DEPTH_AGREEMENT + 1e-4, right)
    view = replace(view, depth=depth)
    given = compare(atlas, texture, view)
    assert given is not None
    assert float(((depth - right)[given.mask] < -DEPTH_AGREEMENT).float().mean()) > 0.3
    assert share(view_budget(atlas, texture, view, given, atlas.mesh, "scene", lpips), "pose_cost") > 0.99


def test_pixels_that_count_by_the_wrong_pose_alone_cost_pose(lpips: Lpips) -> None:
    """Beside the mesh's border, where the photograph shows what nobody scanned."""
    atlas, texture = relief(size=1.6), painted()
    beyond = torch.rand((HEIGHT, WIDTH, 3), generator=torch.Generator().manual_seed(5))
    there = rasterize(atlas.mesh, CAMERA).face_index >= 0
    assert 0.2 < float(there.float().mean()) < 0.8
    view = replace(wrongly_posed(torch.where(there[..., None], render_view(atlas, texture, CAMERA), beyond)), mask=None)
    given = compare(atlas, texture, view)
    assert given is not None
    assert int((given.mask & ~there).sum()) > 500
    assert share(view_budget(atlas, texture, view, given, atlas.mesh, "scene", lpips), "pose_cost") > 0.97


def test_a_camera_that_loses_the_scene_is_not_taken(
    photo: Tensor, lpips: Lpips, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As one does that is refined against a texture that shows something else."""
    atlas, texture, view = relief(), painted().roll(200, 1), wrongly_posed(photo)
    half = (torch.arange(WIDTH) > WIDTH // 2).expand(HEIGHT, -1)
    view = replace(view, depth=rasterize(atlas.mesh, CAMERA).depth + torch.where(half, -0.03, 0.03))
    given = compare(atlas, texture, view)
    assert given is not None
    pose = CAMERA.world_to_camera.clone()
    pose[2, 3] += 0.08  # metres, away from the sheet: half of the depths are .11 off then
    away = replace(view, camera=replace(view.camera, world_to_camera=pose))
    refined = (away,), [{"kept_pose": False, "moved_pixels": 9.0}]
    monkeypatch.setattr("advtex_engine.metrics.evaluate.refine_heldout", lambda *_, **__: refined)
    scores = view_budget(atlas, texture, view, given, atlas.mesh, "scene", lpips)
    assert (scores["pose_cost"], scores["pose_pixels"]) == (0.0, 0.0)


def test_no_pose_excuses_what_the_model_leaves_out(photo: Tensor, lpips: Lpips) -> None:
    """Slits that are as wide as the camera is off, so that what one pose leaves out, the other shows."""
    whole, texture = relief(160), painted()
    middles = whole.mesh.v_pos[whole.mesh.t_pos_idx.long()].mean(1)
    kept = (middles[:, 0] * 40).floor() % 16 != 0
    mesh = replace(
        whole.mesh,
        t_pos_idx=whole.mesh.t_pos_idx[kept],
        t_uv_idx=whole.mesh.t_uv_idx[kept],  # type: ignore[index]
    )
    slit = replace(whole, mesh=mesh)
    view = wrongly_posed(photo)
    given, right = (compare(slit, texture, replace(view, camera=c), whole.mesh) for c in (view.camera, CAMERA))
    assert given is not None
    assert right is not None
    left_out = lpips.masked(right.image, Photograph(right.photo, right.mask))
    scores = view_budget(slit, texture, view, given, whole.mesh, "scene", lpips)
    assert scores["lpips_corrected"] == pytest.approx(left_out, rel=0.1)


def test_all_costs_sum_to_the_raw_figure(photo: Tensor, lpips: Lpips) -> None:
    image = blurred(moved(vignetted(photo * 0.8), smooth_flow(2.0)))
    scores = of_image(image, photo, lpips)
    assert raw(scores) == pytest.approx(lpips.masked(image, Photograph(photo, region())), abs=1e-9)
    assert all((scores[name] or 0.0) > 0 for name in ("tone_cost", "displacement_cost", "content_cost"))
    left = (scores["displacement_cost"] or 0.0) + (scores["content_cost"] or 0.0)
    assert scores["lpips_corrected"] == pytest.approx(left, abs=1e-9)


def test_a_correction_that_makes_things_worse_costs_less_than_nothing(photo: Tensor, lpips: Lpips) -> None:
    mask = region()
    worse = torch.where(mask[..., None], photo.roll(5, 1), photo)
    scores = budget_scores(photo, photo, worse, mask, mask, lpips)
    assert (scores["pose_cost"] or 0.0) < -0.001
    assert raw(scores) == pytest.approx(0, abs=1e-9)


def test_pixels_that_do_not_count_change_nothing(photo: Tensor) -> None:
    mask = region()
    image = moved(vignetted(photo * 0.8), smooth_flow(2.0))
    noise = torch.rand(photo.shape, generator=torch.Generator().manual_seed(1))
    other_photo, other_image = (torch.where(mask[..., None], picture, noise) for picture in (photo, image))
    found = []
    for ours, theirs in ((image, photo), (other_image, other_photo)):
        toned = corrected_tone(ours, theirs, mask)
        flow = dense_flow(toned, theirs, mask)
        found.append((toned[mask], flow[mask], warped(toned, flow, mask)[mask]))
    assert all(torch.equal(first, second) for first, second in zip(*found, strict=True))


def test_holes_of_the_model_stay_black(photo: Tensor) -> None:
    known = region()
    known[150:180, 200:260] = False
    image = torch.where(known[..., None], moved(photo * 0.7 + 0.1, smooth_flow(2.0)), 0.0)
    toned = corrected_tone(image, photo, known)
    after = warped(toned, dense_flow(toned, photo, known), known)
    assert bool((after[~known] == 0).all())
    assert float(after[known].min()) > 0.02, "nothing is drawn from the holes"


def test_clipped_pixels_do_not_decide_the_exposure(photo: Tensor) -> None:
    bright = (1.7 * photo).clamp(0, 1)
    clear = (bright < 0.95).all(-1)
    assert 0.2 < float(clear.to(torch.float32).mean()) < 0.9
    toned = corrected_tone(photo, bright, torch.ones_like(clear))
    assert float((toned - bright)[clear].abs().mean()) < 1e-4


def test_without_weights_the_displacement_is_measured(photo: Tensor) -> None:
    scores = of_image(moved(photo, smooth_flow(3.0)), photo, None)
    assert all(scores[name] is None for name in LPIPS_SCORES)
    assert scores["displacement_pixels"] is not None


def test_a_model_that_shows_nothing_has_no_displacement(photo: Tensor, lpips: Lpips) -> None:
    nothing = torch.zeros_like(region())
    black = torch.where(region()[..., None], 0.0, photo)
    scores = budget_scores(photo, black, black, region(), nothing, lpips)
    assert scores["displacement_pixels"] is None
    assert share(scores, "content_cost") == 1


def write_scan(folder: Path, photo: Tensor) -> Path:
    """Three frames of the same photograph, in the native layout, beside the model that they show."""
    export_model(folder, relief(), painted(), up_axis="+z")
    frames = []
    for name in ("0.png", "1.png", "2.png"):
        cv2.imwrite(str(folder / name), (photo * 255).round().to(torch.uint8).numpy()[..., ::-1])
        frames.append({"color": name, "camera_to_world": torch.linalg.inv(CAMERA.world_to_camera).tolist()})
    fx, fy, cx, cy = (float(CAMERA.K[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
    size = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": WIDTH, "height": HEIGHT}
    scan = {"version": 1, "kind": "scene", "up_axis": "+z", "mesh": "model.obj", "color_intrinsics": size}
    (folder / "scan.json").write_text(json.dumps({**scan, "frames": frames}))
    return folder


def test_the_command_writes_the_budget_when_asked(
    photo: Tensor, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    export_model(tmp_path / "model", relief(), 0.8 * painted(), up_axis="+z")
    command = ["evaluate", str(tmp_path / "model/model.obj"), str(write_scan(tmp_path / "scan", photo))]
    command += ["--size", "160x120", "--holdout", "3", "--budget"]
    path = tmp_path / "scores.json"
    assert main([*command, "--json", str(path), "--lpips-weights", str(write_weights(tmp_path / "weights"))]) == 0
    written = json.loads(path.read_text())
    for row in (*written["per_view"], written["mean"]):
        assert sum(row[name] for name in COSTS) == pytest.approx(row["lpips"], abs=1e-9)
        assert row["tone_cost"] > 0.5 * row["lpips"]
    *_, head, view, mean = capsys.readouterr().out.splitlines()
    assert head.split() == " ".join(["view", *TABLE.values()]).split()
    assert [line.split()[0] for line in (view, mean)] == ["000001", "mean"]
    assert float(mean.split()[1]) == pytest.approx(written["mean"]["lpips"], abs=1e-4)

    assert main([*command, "--json", str(path), "--lpips-weights", str(tmp_path)]) == 0
    assert set(json.loads(path.read_text())["missing"]) == {"lpips", "lpips_full", *LPIPS_SCORES}
    assert capsys.readouterr().out.splitlines()[-1].split()[:2] == ["mean", "-"]

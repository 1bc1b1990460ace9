"""Camera refinement on a textured relief whose cameras and exposures are known, and its parts against plain twins."""

from __future__ import annotations

import json
import math
import os
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from wavy_sheet import FOCAL, HEIGHT, WIDTH, camera_over, paint, sheet

from advtex_engine.core.cameras import project
from advtex_engine.core.config import TextureConfig
from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import Camera, Mesh, Scene, View
from advtex_engine.ingest.read import ingest
from advtex_engine.pipeline import texture_scan
from advtex_engine.refine.check import MIN_CELLS
from advtex_engine.refine.exposure import corrected_color, fit_exposure
from advtex_engine.refine.points import (
    CELLS_ACROSS,
    Candidates,
    Observations,
    looks,
    observe,
    surface_cells,
    surface_depths,
)
from advtex_engine.refine.pose import exponential, keep_gauge, local_contrast, pose_jacobian, sample_points, twist
from advtex_engine.refine.run import (
    Refinement,
    apply_refinement,
    refine_cameras,
    refinement_from_dict,
    refinement_to_dict,
)
from advtex_engine.refine.solve import Anchor, residuals, solve_views, weighted_mean
from advtex_engine.refine.working_views import working_views
from advtex_engine.render.rasterize import rasterize
from advtex_engine.synthetic.camera import Errors
from advtex_engine.synthetic.real import synthesize_real
from advtex_engine.synthetic.scan import synthesize

VIEWS = 10
CPU = torch.device("cpu")
SCANS = Path(os.environ.get("ADVTEX_DATA", Path(__file__).parents[3].parent / "shared" / "data")) / "scans"


def photograph(mesh: Mesh, camera: Camera, name: str, gain: Tensor, offset: float) -> View:
    fragments = rasterize(mesh, camera)
    corners = mesh.v_pos[mesh.t_pos_idx[fragments.face_index.clamp(min=0).long()]]
    color = paint((corners * fragments.barycentric[..., None]).sum(2)) * gain + offset
    color[fragments.face_index < 0] = 0
    return View(name, camera, (color * 255).round().clamp(0, 255).to(torch.uint8))


@pytest.fixture(scope="module")
def gains() -> Tensor:
    """[V,3], of geometric mean 1 per channel."""
    gains = torch.exp(0.1 * torch.randn(VIEWS, 3, generator=torch.Generator().manual_seed(3)))
    return gains / gains.log().mean(0).exp()


@pytest.fixture(scope="module")
def true_scene(gains: Tensor) -> Scene:
    mesh = sheet(2.0, 40, (0.1, 4, 3, 0))
    views = [photograph(mesh, camera_over(i, VIEWS), f"view{i}", gains[i], 0.01 * (-1) ** i) for i in range(VIEWS)]
    held = photograph(mesh, camera_over(1, VIEWS), "held", torch.tensor([1.3, 1.0, 0.8]), 0.0)
    return Scene(mesh, tuple(views), (held,))


def misplaced(scene: Scene, pixels: float) -> Scene:
    """The scene with cameras that are off by about that many pixels, one half by turning, one half by moving."""
    twists = torch.randn(VIEWS, 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    twists *= 0.5 * pixels / FOCAL * torch.tensor([1, 1, 1, 1.7, 1.7, 1.7])
    views = [
        replace(view, camera=replace(view.camera, world_to_camera=motion @ view.camera.world_to_camera))
        for view, motion in zip(scene.views, exponential(twists), strict=True)
    ]
    return replace(scene, views=tuple(views))


def scattered(position: Tensor, normal: Tensor, seen: Tensor | None = None) -> Candidates:
    """Points of no face in particular."""
    count = len(position)
    seen = torch.ones((count, 0), dtype=torch.bool) if seen is None else seen
    return Candidates(
        position, normal, torch.ones(count), torch.zeros(count).long(), torch.zeros(count, 3).double(), seen
    )


def observed(position: Tensor, normal: Tensor, cameras: list[Camera], depths: Tensor, most: int) -> Observations:
    seen = torch.zeros((len(position), len(cameras)), dtype=torch.bool)
    for view, (rows, _) in enumerate(looks(position, normal, cameras, depths)):
        seen[rows, view] = True
    return observe(scattered(position, normal, seen), most)


def errors(scene: Scene, truth: Scene) -> Tensor:
    """[V] pixels that the relief's vertices are off, without the common motion that nobody can know."""
    poses, true = (torch.stack([v.camera.world_to_camera for v in s.views]) for s in (scene, truth))
    every = torch.arange(len(truth.mesh.v_pos)).expand(VIEWS, -1)
    points = Observations(truth.mesh.v_pos.double(), every, torch.ones_like(every, dtype=torch.bool))
    aligned = keep_gauge(poses, true, points)
    off = []
    for pose, view in zip(aligned, truth.views, strict=True):
        moved, _ = project(replace(view.camera, world_to_camera=pose), truth.mesh.v_pos)
        there, _ = project(view.camera, truth.mesh.v_pos)
        off.append((moved - there).norm(dim=1).median())
    return torch.stack(off)


@pytest.fixture(scope="module")
def refined(true_scene: Scene) -> tuple[Scene, Refinement]:
    given = misplaced(true_scene, 3.0)
    return given, refine_cameras(given, CPU, 0)


def test_wrong_cameras_come_close_to_the_truth(true_scene: Scene, refined: tuple[Scene, Refinement]) -> None:
    given, refinement = refined
    before, after = errors(given, true_scene), errors(apply_refinement(given, refinement), true_scene)
    assert before.mean() > 2
    assert after.mean() < 0.15 * before.mean()
    assert after.max() < 0.5


def test_right_cameras_stay(true_scene: Scene) -> None:
    report = refine_cameras(true_scene, CPU, 0).report
    assert max(frame["moved_pixels"] for frame in report["frames"]) < 0.2


def test_exposures_are_found_and_the_mean_stays(gains: Tensor, refined: tuple[Scene, Refinement]) -> None:
    _, refinement = refined
    offsets = torch.tensor([0.01 * (-1) ** i for i in range(VIEWS)])[:, None]
    for level in (0.3, 0.45, 0.6):
        photographed = gains * level + offsets
        corrected = refinement.gain * photographed + refinement.offset
        assert (corrected - level).abs().mean() < 0.15 * (photographed - level).abs().mean()
    assert refinement.gain.log().mean(0).abs().max() < 0.01
    assert refinement.offset.mean(0).abs().max() < 0.005


def test_a_camera_that_adapts_on_its_way_leaves_each_place_as_it_was_photographed() -> None:
    """24 views along a wall, brighter by a fifth from one end to the other, and each by its own chance on top of it."""
    views, seen = 24, 200
    generator = torch.Generator().manual_seed(0)
    paint = 0.25 + 0.4 * torch.rand((views + 6) * 40, 3, generator=generator)
    place = torch.arange(views)[:, None] * 40 + torch.arange(seen)
    drift = torch.linspace(-0.1, 0.1, views)
    gain = torch.exp(drift + 0.03 * torch.randn(views, generator=generator))
    color = paint[place] * gain[:, None, None]
    valid = torch.ones((views, seen), dtype=torch.bool)
    points = Observations(torch.zeros((len(paint), 3), dtype=torch.float64), place, valid)
    found, offset = fit_exposure(color, valid, points)
    corrected = color * found[:, None] + offset[:, None]

    def brightness(shown: Tensor) -> Tensor:
        """[P], of each place on average, relative to its paint."""
        mean, _ = weighted_mean((shown / paint[place]).mean(2), valid.float(), points)
        return mean[seen:-seen]

    def spread(shown: Tensor) -> Tensor:
        """Of what the views see at a place."""
        return torch.stack([residuals(part, valid, points, 1.0)[0] for part in shown.unbind(2)]).abs().mean()

    ends = brightness(corrected)[[0, -300]]
    assert brightness(color)[[0, -300]].diff() > 0.1
    assert ends.diff() > 0.08
    assert (brightness(corrected) - brightness(color)).abs().max() < 0.03
    assert spread(corrected) < 0.6 * spread(color)


def test_the_report_says_what_happened_to_each_frame(refined: tuple[Scene, Refinement]) -> None:
    given, refinement = refined
    frames = refinement.report["frames"]
    assert [frame["name"] for frame in frames] == [view.name for view in given.views]
    for frame, pose, view in zip(frames, refinement.world_to_camera, given.views, strict=True):
        assert frame["residual_after"] < frame["residual_before"]
        assert not frame["kept_pose"]
        old, new = view.camera.world_to_camera, pose
        centers = [-m[:3, :3].T @ m[:3, 3] for m in (old, new)]
        assert frame["moved_mm"] == pytest.approx(1000 * float((centers[0] - centers[1]).norm()), abs=1e-3)
        cosine = (float((new[:3, :3] @ old[:3, :3].T).trace()) - 1) / 2
        assert frame["turned_degrees"] == pytest.approx(math.degrees(math.acos(min(1, cosine))), abs=1e-2)
    json.dumps(refinement.report, allow_nan=False)


def test_the_same_input_gives_the_same_result_and_survives_its_cache(refined: tuple[Scene, Refinement]) -> None:
    given, refinement = refined
    again = refinement_from_dict({**refinement_to_dict(refine_cameras(given, CPU, 0)), "fingerprint": "x"})
    assert torch.equal(again.world_to_camera, refinement.world_to_camera)
    assert torch.equal(again.gain, refinement.gain)
    assert torch.equal(again.offset, refinement.offset)
    assert again.report == refinement.report


def test_held_out_views_and_everything_else_stay_as_they_are(refined: tuple[Scene, Refinement]) -> None:
    given, refinement = refined
    scene = apply_refinement(given, refinement)
    assert scene.heldout is given.heldout
    assert scene.mesh is given.mesh
    for new, old in zip(scene.views, given.views, strict=True):
        assert torch.equal(new.camera.K, old.camera.K)
        assert new.color.dtype == torch.uint8


def test_the_mean_motion_is_small(refined: tuple[Scene, Refinement]) -> None:
    given, refinement = refined
    working = working_views(given.mesh, given.views, given.kind, CPU, 0)
    assert working is not None
    points = working.fitted
    shifts, turns = [], []
    for view, pose, point, seen in zip(given.views, refinement.world_to_camera, points.point, points.seen, strict=True):
        place = points.position[point[seen]]
        _, z = project(view.camera, place)
        local = place @ view.camera.world_to_camera[:3, :3].T + view.camera.world_to_camera[:3, 3]
        moved = (local - pose[:3, 3]) @ pose[:3, :3]
        weight = (1 / z.square() / (1 / z.square()).sum())[:, None]
        shifts.append((weight * (moved - place)).sum(0))
        turns.append((weight * torch.linalg.cross(place, moved)).sum(0))
    for motions in (torch.stack(shifts), torch.stack(turns)):
        assert motions.mean(0).norm() < 0.15 * motions.norm(dim=1).mean()
    assert torch.stack(shifts).norm(dim=1).min() > 1e-3  # metres
    assert 0 < refinement.report["mean"]["common_pixels"] < 0.3 * refinement.report["mean"]["moved_pixels"]


@pytest.mark.parametrize("seed", [9, 10])
def test_photographs_that_have_nothing_in_common_keep_their_cameras(true_scene: Scene, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    noise = [torch.randint(60, 190, (15, 20, 3), generator=generator, dtype=torch.uint8) for _ in true_scene.views]
    views = [
        replace(view, color=part.repeat_interleave(8, 0).repeat_interleave(8, 1))
        for view, part in zip(true_scene.views, noise, strict=True)
    ]
    refinement = refine_cameras(replace(true_scene, views=tuple(views)), CPU, 0)
    for frame, pose, view in zip(refinement.report["frames"], refinement.world_to_camera, views, strict=True):
        assert frame["kept_pose"]
        assert torch.equal(pose, view.camera.world_to_camera)
    assert not refinement.report["device"]["corrected"]


def test_one_photograph_of_something_else_moves_by_no_more_than_a_fraction_of_a_pixel(
    true_scene: Scene, refined: tuple[Scene, Refinement]
) -> None:
    given, _ = refined
    noise = torch.randint(60, 190, (15, 20, 3), generator=torch.Generator().manual_seed(9), dtype=torch.uint8)
    other = replace(given.views[4], color=noise.repeat_interleave(8, 0).repeat_interleave(8, 1))
    scene = replace(given, views=(*given.views[:4], other, *given.views[5:]))
    refinement = refine_cameras(scene, CPU, 0)
    kept = [frame["kept_pose"] for frame in refinement.report["frames"]]
    assert kept == [index == 4 for index in range(VIEWS)]
    # It shares in the common motion that keeps the mean of all nil; the given cameras are off by 3 pixels.
    assert refinement.report["frames"][4]["moved_pixels"] < 0.75


def test_a_view_that_shares_nothing_keeps_its_camera(true_scene: Scene) -> None:
    far = replace(true_scene.views[0].camera, world_to_camera=torch.eye(4, dtype=torch.float64))
    lost = replace(true_scene.views[0], name="lost", camera=far)
    refinement = refine_cameras(replace(true_scene, views=(*true_scene.views, lost)), CPU, 0)
    assert refinement.report["frames"][-1]["kept_pose"]
    assert refinement.report["frames"][-1]["residual_after"] is None
    assert torch.equal(refinement.world_to_camera[-1], far.world_to_camera)
    alone = refine_cameras(replace(true_scene, views=true_scene.views[:1]), CPU, 0)
    assert torch.equal(alone.world_to_camera[0], true_scene.views[0].camera.world_to_camera)
    assert torch.equal(alone.gain, torch.ones(1, 3))


@given(st.floats(0.5, 2.0), st.floats(-0.1, 0.1))
def test_correction_keeps_clipped_highlights_and_order(gain: float, offset: float) -> None:
    levels = (torch.arange(256) / 255)[:, None].expand(-1, 3)
    corrected = corrected_color(levels, torch.full((3,), gain), torch.full((3,), offset))
    assert torch.equal(corrected[-1], torch.ones(3))
    assert corrected.min() >= 0
    assert corrected.max() <= 1
    middle = slice(30, 200)
    expected = (gain * levels[middle] + offset).clamp(0, 1)
    assert torch.allclose(corrected[middle], expected, atol=1e-6)
    assert (corrected.diff(dim=0) > -1e-6).all() or gain > 1 or offset > 0


@settings(max_examples=25)
@given(st.lists(st.floats(-0.5, 0.5), min_size=6, max_size=6))
def test_a_motion_of_all_cameras_is_taken_out_again(values: list[float]) -> None:
    motion = exponential(torch.tensor([values], dtype=torch.float64))[0]
    cameras = torch.stack([camera_over(i, VIEWS).world_to_camera for i in range(4)])
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    every = torch.arange(50).expand(4, -1)
    seen = Observations(points, every, torch.ones_like(every, dtype=torch.bool))
    assert torch.allclose(keep_gauge(cameras @ motion, cameras, seen), cameras, atol=1e-6)
    assert torch.allclose(exponential(twist(motion[None]))[0], motion, atol=1e-9)


def random_problem(seed: int) -> tuple[Tensor, Tensor, Tensor, Observations]:
    """Jacobian [4,3,12], residual and weight [4,12], observations of 9 points."""
    generator = torch.Generator().manual_seed(seed)
    point = torch.stack([torch.randperm(9, generator=generator) for _ in range(4)]).repeat(1, 2)[:, :12]
    weight = torch.rand(4, 12, generator=generator, dtype=torch.float64)
    jacobian = torch.randn(4, 3, 12, generator=generator, dtype=torch.float64)
    residual = torch.randn(4, 12, generator=generator, dtype=torch.float64)
    points = Observations(torch.zeros(9, 3, dtype=torch.float64), point, torch.ones(4, 12, dtype=torch.bool))
    mean, _ = weighted_mean(residual, weight, points)
    return jacobian, residual - mean[point], weight, points


@pytest.mark.parametrize("anchored", [False, True])
def test_the_solver_agrees_with_dense_least_squares(anchored: bool) -> None:
    jacobian, residual, weight, points = random_problem(0)
    prior, offset = torch.full((4, 3), 0.3, dtype=torch.float64), torch.randn(4, 3, dtype=torch.float64)
    other, _, other_weight, _ = random_problem(1)
    anchor = Anchor((other, jacobian), other_weight, points) if anchored else None
    found = solve_views(jacobian, residual, weight, points, prior, offset, anchor)

    # Unknowns: 4 x 3 parameters and one value per point; rows are scaled by the root of their weight.
    rows, sides = [], []
    for view in range(4):
        for k in range(12):
            row = torch.zeros(12 + 9, dtype=torch.float64)
            row[3 * view : 3 * view + 3] = jacobian[view, :, k]
            row[12 + points.point[view, k]] = -1
            rows.append(row * weight[view, k].sqrt())
            sides.append(-residual[view, k] * weight[view, k].sqrt())
    for parameter in range(12):
        row = torch.zeros(12 + 9, dtype=torch.float64)
        row[parameter] = 1
        rows.append(row * 0.3**0.5)
        sides.append(-offset.flatten()[parameter] * 0.3**0.5)
    for component in (other, jacobian) if anchored else ():
        for point in range(9):
            here = points.point == point
            total = (other_weight * here).sum()
            row = torch.zeros(12 + 9, dtype=torch.float64)
            row[:12] = (component * (other_weight * here)[:, None]).sum(2).flatten() / total
            rows.append(row * total.sqrt())
            sides.append(-(row[:12] @ offset.flatten()) * total.sqrt())
    dense = torch.linalg.lstsq(torch.stack(rows), torch.stack(sides)[:, None]).solution[:12, 0]
    assert torch.allclose(found.flatten(), dense, atol=1e-6)


def test_the_pose_jacobian_agrees_with_differences(true_scene: Scene) -> None:
    cameras, depths, _ = surface_depths(true_scene.mesh, true_scene.views[:2], (WIDTH, HEIGHT), "scene")
    vertices = true_scene.mesh.v_pos.double()
    normal = torch.tensor([0.0, 0, 1], dtype=torch.float64).expand_as(vertices)
    points = observed(vertices, normal, cameras, depths, 400)
    K = torch.stack([camera.K for camera in cameras])
    poses = torch.stack([camera.world_to_camera for camera in cameras])
    # A linear image, so that the derivative of the sampled value is exact.
    rows, columns = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    ramp = 0.3 * columns - 0.2 * rows
    features = torch.stack((ramp, torch.full_like(ramp, 0.3), torch.full_like(ramp, -0.2))).expand(2, -1, -1, -1)
    jacobian = pose_jacobian(sample_points(features, K, poses, points, (WIDTH, HEIGHT)), K)
    step = 1e-3
    for parameter in range(6):
        sampled = []
        for sign in (1, -1):
            change = torch.zeros(2, 6, dtype=torch.float64)
            change[:, parameter] = sign * step
            sampled.append(sample_points(features, K, exponential(change) @ poses, points, (WIDTH, HEIGHT)))
        both = sampled[0].valid & sampled[1].valid
        slope = (sampled[0].value - sampled[1].value) / (2 * step)
        assert both.sum() > 200
        assert torch.allclose(slope[both], jacobian[:, parameter][both], rtol=0.02, atol=0.3)


def test_points_behind_something_and_near_its_outline_are_not_observed() -> None:
    wall = torch.tensor([[-2.0, -2, 2], [2, -2, 2], [2, 2, 2], [-2, 2, 2]])
    card = torch.tensor([[-0.2, -0.2, 1.0], [0.2, -0.2, 1], [0.2, 0.2, 1], [-0.2, 0.2, 1]])
    mesh = Mesh(torch.cat((wall, card)), torch.tensor([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]))
    camera = replace(camera_over(0, VIEWS), world_to_camera=torch.eye(4, dtype=torch.float64))
    view = View("view", camera, torch.zeros(HEIGHT, WIDTH, 3, dtype=torch.uint8))
    cameras, depths, _ = surface_depths(mesh, (view,), (WIDTH, HEIGHT), "scene")
    # On the card; on the wall behind it; just beside its outline as seen from here; well beside.
    position = torch.tensor([[0.0, 0, 1], [0, 0, 2], [0.42, 0, 2], [0.7, 0, 2]], dtype=torch.float64)
    normal = torch.tensor([0.0, 0, 1], dtype=torch.float64).expand_as(position)
    points = observed(position, normal, cameras, depths, 10)
    seen = points.position[points.point[points.seen]]
    assert seen.tolist() == [[0.0, 0, 1], [0.7, 0, 2]]
    assert int(points.seen.sum()) == 2


def test_local_contrast_ignores_exposure_where_there_is_contrast() -> None:
    image = torch.rand(1, 60, 80, generator=torch.Generator().manual_seed(4))
    plain, exposed = (local_contrast(part, 2)[:, 0] for part in (image, 0.8 * image + 0.1))
    assert (plain - exposed).abs().mean() < 0.1 * plain.abs().mean()


def test_outliers_lose_their_weight() -> None:
    point = torch.zeros(6, 1, dtype=torch.int64)
    points = Observations(torch.zeros(1, 3, dtype=torch.float64), point, torch.ones(6, 1, dtype=torch.bool))
    value = torch.tensor([[0.1], [0.0], [-0.1], [0.05], [-0.05], [3.0]])
    residual, weight = residuals(value, points.seen, points, 0.3)
    assert weight[5] < 0.02
    assert weight[:5].min() > 0.8
    assert residual[:5].abs().max() < 0.2


def test_the_run_reports_refinement_and_the_paper_preset_does_without(tmp_path: Path) -> None:
    scan = tmp_path / "scan.zip"
    synthesize(scan, views=6, width=96, height=72)
    reports = []
    for preset in ("standard", "paper"):
        config = TextureConfig(preset=preset, method="mean", face_budget=2000, device="cpu", steps=1)
        out = tmp_path / preset
        reports.append(texture_scan(scan, out, config, work=out / "work").report)
    assert len(reports[0]["refinement"]["frames"]) == 6
    assert reports[1]["refinement"] is None
    assert ["refinement" in [stage["stage"] for stage in report["stages"]] for report in reports] == [True, False]


@pytest.mark.data
@pytest.mark.slow
def test_a_real_kitchen_agrees_better_with_itself() -> None:
    scan = SCANS / "redkitchen_A"
    if not scan.exists():
        pytest.skip("the sample scans are not there; point ADVTEX_DATA at them")
    scene = ingest(scan, TextureConfig(size=(320, 240), holdout=8), Monitor())
    report = refine_cameras(scene, CPU, 0).report
    assert report["mean"]["residual_after"] < 0.85 * report["mean"]["residual_before"]
    assert report["mean"]["color_after"] < 0.85 * report["mean"]["color_before"]
    assert report["mean"]["kept_pose"] < 0.1


def test_grossly_wrong_poses_are_found_from_depth_before_photographs_are_compared(tmp_path: Path) -> None:
    synthesize(tmp_path, views=12, width=160, height=120, camera_error=0.01, camera_turn=math.radians(5))
    scene = ingest(tmp_path, TextureConfig(), Monitor())
    refinement = refine_cameras(scene, CPU, 0)
    assert refinement.report["mean"]["by_depth"] > 0.8
    truth = json.loads((tmp_path / "truth" / "cameras.json").read_text())
    true = {
        frame["name"]: torch.linalg.inv(torch.tensor(frame["camera_to_world"]).double()) for frame in truth["frames"]
    }
    off = []
    for view, pose in zip(scene.views, refinement.world_to_camera, strict=True):
        there, _ = project(view.camera, scene.mesh.v_pos)
        found, _ = project(replace(view.camera, world_to_camera=pose), scene.mesh.v_pos)
        right, _ = project(replace(view.camera, world_to_camera=true[Path(view.name).stem]), scene.mesh.v_pos)
        off.append([float((pixels - right).norm(dim=1).median()) for pixels in (there, found)])
    before, after = torch.tensor(off).median(0).values
    assert before > 5
    assert after < 0.2


def test_what_is_behind_an_object_has_no_say_in_its_contrast() -> None:
    generator = torch.Generator().manual_seed(6)
    image, other = torch.rand(2, 1, 96, 128, generator=generator)
    known = torch.zeros(1, 96, 128, dtype=torch.bool)
    known[:, 30:70, 40:90] = True
    for scale in (1, 2, 4, 8):
        one, another = (
            local_contrast(torch.where(known, image, behind), scale, known) for behind in (other, 0 * other)
        )
        assert torch.equal(one, another)
        everything = local_contrast(image, scale, torch.ones_like(known))
        torch.testing.assert_close(everything, local_contrast(image, scale), rtol=0, atol=1e-4)
        inside = known[:, scale // 2 :: scale, scale // 2 :: scale]
        assert one[:, 0][inside].abs().mean() > 0.3 * everything[:, 0][inside].abs().mean()


def test_a_small_object_is_divided_into_enough_cells() -> None:
    mesh = sheet(0.3, 10, (0.0, 1, 1, 0))
    views = tuple(photograph(mesh, camera_over(i, VIEWS), f"view{i}", torch.ones(3), 0.0) for i in range(VIEWS))
    cameras, depths, _ = surface_depths(mesh, views, (WIDTH, HEIGHT), "object")
    position = torch.rand(1000, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(7))
    position = 0.3 * (position - 0.5) * torch.tensor([1, 1, 0])
    candidates = scattered(position, torch.zeros_like(position))
    of_object, of_room = (surface_cells(candidates, cameras, depths, kind) for kind in ("object", "scene"))
    assert len(of_object.unique()) > 0.5 * CELLS_ACROSS**2
    assert len(of_room.unique()) < MIN_CELLS**2


@pytest.mark.slow
def test_cameras_far_from_a_small_object_find_their_places(tmp_path: Path) -> None:
    """It covers a quarter of the image across; in coarse images what is around it is within reach of all its pixels."""
    drift = replace(Errors.none(), drift=True)
    synthesize_real(tmp_path, scene="object", views=12, width=192, height=144, seed=1, errors=drift)
    scene = ingest(tmp_path, TextureConfig(size=(192, 144), device="cpu"), Monitor())
    told = json.loads((tmp_path / "truth" / "cameras.json").read_text())["frames"]
    true = {frame["name"]: torch.tensor(frame["camera_to_world"], dtype=torch.float64).inverse() for frame in told}
    poses = torch.stack([view.camera.world_to_camera for view in scene.views])
    truth = torch.stack([true[view.name] for view in scene.views])
    refinement = refine_cameras(scene, CPU, 0)
    vertices = scene.mesh.v_pos[::50].double()
    every = torch.arange(len(vertices)).expand(len(poses), -1)
    points = Observations(vertices, every, torch.ones_like(every, dtype=torch.bool))
    off = []
    for found in (poses, refinement.world_to_camera):
        moved = keep_gauge(found, truth, points)
        pixels = [
            project(replace(scene.views[0].camera, world_to_camera=pose), vertices)[0] for pose in (*moved, *truth)
        ]
        off.append(torch.stack([(a - b).norm(dim=1).median() for a, b in zip(pixels[:12], pixels[12:], strict=True)]))
    assert off[0].mean() > 1
    assert off[1].max() < 0.3
    assert not refinement.report["distortion"]["corrected"]

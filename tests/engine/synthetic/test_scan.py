"""Synthetic scans: sound, repeatable, wrong by as much as was asked for, and true where they claim to be."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import trimesh
from embreex import rtcore_scene
from embreex.mesh_construction import TriangleMesh
from hypothesis import given, settings
from hypothesis import strategies as st

from advtex_engine.core.config import TextureConfig
from advtex_engine.core.errors import OptionError
from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import Atlas, Mesh
from advtex_engine.ingest.read import ingest
from advtex_engine.mesh.normals import vertex_normals
from advtex_engine.render.rasterize import rasterize
from advtex_engine.results.export import export_model
from advtex_engine.synthetic import object as synthetic_object
from advtex_engine.synthetic import patches
from advtex_engine.synthetic import scan as module
from advtex_engine.synthetic.scan import CAMERA_ERROR, DISTANCE, GEOMETRY_ERROR, compare_to_truth, synthesize
from advtex_scan.check import check_scan

VIEWS, WIDTH, HEIGHT = 6, 96, 72


@pytest.fixture(scope="module", autouse=True)
def few_lights() -> Iterator[None]:
    """Shadows are as good from few lights here, and sooner."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(patches, "LIGHTS", 8)
        yield


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small synthetic scan as a folder."""
    out = tmp_path_factory.mktemp("synthetic") / "scan"
    synthesize(out, views=VIEWS, width=WIDTH, height=HEIGHT)
    return out


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same scan as a zip, made a second time."""
    out = tmp_path_factory.mktemp("synthetic") / "new" / "scan.zip"
    synthesize(out, views=VIEWS, width=WIDTH, height=HEIGHT)
    return out


@pytest.fixture(scope="module")
def exact(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Another seed, without camera and geometry errors."""
    out = tmp_path_factory.mktemp("synthetic") / "scan"
    synthesize(out, views=3, width=WIDTH, height=HEIGHT, seed=1, camera_error=0, geometry_error=0)
    return out


@pytest.fixture(scope="module")
def still_life() -> tuple[Atlas, torch.Tensor]:
    return synthetic_object.build(0)


def load(scan: Path, name: str) -> Any:
    return json.loads((scan / name).read_text())


def poses(frames: list[dict[str, Any]]) -> np.ndarray:
    return np.array([frame["camera_to_world"] for frame in frames])


def test_the_scan_is_sound(scan: Path) -> None:
    report = check_scan(scan)
    assert report.ok
    assert [finding.code for finding in report.findings if finding.severity != "info"] == []
    scene = ingest(scan, TextureConfig(), Monitor())
    assert len(scene.views) == VIEWS
    assert (scene.kind, scene.up_axis) == ("object", "+z")
    assert all(view.depth is not None and bool((view.depth > 0).any()) for view in scene.views)


def test_folder_and_zip_of_the_same_arguments_hold_the_same_bytes(scan: Path, archive: Path) -> None:
    with zipfile.ZipFile(archive) as members:
        assert members.testzip() is None
        stored = {name: members.read(name) for name in members.namelist()}
    files = {path.relative_to(scan).as_posix(): path.read_bytes() for path in scan.rglob("*") if path.is_file()}
    assert stored == files
    assert list(stored) == sorted(stored)


def test_another_seed_makes_another_scan(scan: Path, exact: Path) -> None:
    ours, theirs = (load(path, "truth/cameras.json")["heldout"] for path in (scan, exact))
    assert not np.allclose(poses(ours), poses(theirs))
    assert (scan / "truth/object.png").read_bytes() != (exact / "truth/object.png").read_bytes()


def test_camera_errors_stay_within_their_bounds_and_reach_for_them(scan: Path) -> None:
    estimated = poses(load(scan, "scan.json")["frames"])
    true = poses(load(scan, "truth/cameras.json")["frames"])
    translation = estimated[:, :3, 3] - true[:, :3, 3]
    assert np.abs(translation).max() <= CAMERA_ERROR
    assert np.abs(translation).max() > 0.5 * CAMERA_ERROR
    turn = np.swapaxes(true[:, :3, :3], 1, 2) @ estimated[:, :3, :3]
    assert np.allclose(turn @ np.swapaxes(turn, 1, 2), np.eye(3), atol=1e-12)
    angle = np.arccos(np.clip((np.trace(turn, axis1=1, axis2=2) - 1) / 2, -1, 1))
    assert angle.max() <= 3**0.5 * CAMERA_ERROR / DISTANCE
    assert angle.min() > 0


def test_no_errors_were_asked_for_and_none_are_there(exact: Path) -> None:
    assert np.array_equal(poses(load(exact, "scan.json")["frames"]), poses(load(exact, "truth/cameras.json")["frames"]))
    mesh = trimesh.load_mesh(exact / "mesh.ply", process=False)
    rows = [line.split()[1:] for line in (exact / "truth/object.obj").read_text().splitlines() if line[:2] == "v "]
    assert np.array_equal(np.asarray(mesh.vertices, np.float32), np.array(rows, np.float32))


def test_vertices_move_along_their_normals_by_smoothed_noise() -> None:
    ball = trimesh.creation.icosphere(subdivisions=2)
    mesh = Mesh(torch.from_numpy(ball.vertices).float(), torch.from_numpy(ball.faces).long())
    moved = module._bent(mesh, 0.05, np.random.default_rng(4)).v_pos - mesh.v_pos
    offset = (moved * vertex_normals(mesh)).sum(1)
    assert torch.allclose(moved, offset[:, None] * vertex_normals(mesh), atol=1e-6)
    expected = np.random.default_rng(4).uniform(-0.05, 0.05, len(ball.vertices))
    for _ in range(3):
        expected = np.array([np.mean(expected[near]) for near in ball.vertex_neighbors])
    assert np.allclose(offset.numpy(), expected, atol=1e-6)


def test_the_scan_s_mesh_is_bent_by_less_than_a_millimetre(scan: Path) -> None:
    mesh = trimesh.load_mesh(scan / "mesh.ply", process=False)
    rows = [line.split()[1:] for line in (scan / "truth/object.obj").read_text().splitlines() if line[:2] == "v "]
    distance = np.linalg.norm(np.asarray(mesh.vertices) - np.array(rows, np.float64), axis=1)
    assert 0.0003 < np.sqrt((distance**2).mean()) < 0.001
    assert distance.max() < GEOMETRY_ERROR
    assert 20_000 < len(mesh.faces) < 40_000


def test_depth_images_hold_millimetres_along_the_axis_of_the_true_camera(scan: Path) -> None:
    truth, entry = load(scan, "truth/cameras.json"), load(scan, "scan.json")["frames"][2]
    body = trimesh.load_mesh(scan / "truth/object.obj")
    rays = rtcore_scene.EmbreeScene()
    TriangleMesh(rays, body.vertices[body.faces].astype(np.float32))
    K, matrix = np.array(truth["intrinsics_matrix"]), np.array(truth["frames"][2]["camera_to_world"])
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    pixels = np.stack([u, v, np.ones_like(u)], -1).reshape(-1, 3)
    directions = (pixels @ np.linalg.inv(K).T @ matrix[:3, :3].T).astype(np.float32)
    origins = np.broadcast_to(matrix[:3, 3].astype(np.float32), directions.shape).copy()
    found = rays.run(origins, directions, output=True)
    depth = cv2.imread(str(scan / entry["depth"]), cv2.IMREAD_UNCHANGED)
    assert depth is not None
    assert depth.dtype == np.uint16
    stored, hit = depth.ravel() / 1000, found["primID"] >= 0
    assert ((stored > 0) != hit).mean() < 0.002
    # Directions have length 1 along z, so Embree's ray parameter is the depth.
    error = (stored - found["tfar"])[hit & (stored > 0)]
    assert abs(np.median(error)) < 0.0003
    assert 0.0005 < np.quantile(np.abs(error), 0.68) < 0.0016


def test_photographs_are_the_truth_with_noise_and_another_exposure(scan: Path, still_life: Any) -> None:
    atlas, texture = still_life
    camera = module._shots(VIEWS, WIDTH, HEIGHT, np.random.default_rng(0), "frame")[1].camera
    clean = module.render_view(atlas, texture, camera, supersample=3, background=module.BACKDROP).numpy() * 255
    photo = cv2.imread(str(scan / "color/frame-0001.png"))
    assert photo is not None
    photo = photo[..., ::-1].astype(np.float64)
    middle = (clean > 20) & (clean < 225)
    gain = (photo * clean)[middle].sum() / (clean**2)[middle].sum()
    assert 0.85 < gain < 1.15
    assert 1 < (photo - gain * clean)[middle].std() < 4


def test_cameras_surround_the_object_and_frame_it(scan: Path) -> None:
    truth = load(scan, "truth/cameras.json")
    centers = np.concatenate([poses(truth["frames"]), poses(truth["heldout"])])[:, :3, 3]
    assert centers[:, 2].min() > 0.1
    quadrants = {(x > 0, y > 0) for x, y in centers[:, :2]}
    assert len(quadrants) == 4
    for path in sorted((scan / "color").iterdir()):
        photo = cv2.imread(str(path))
        assert photo is not None
        assert 0.2 < (np.abs(photo.astype(int) - photo[0, 0]).max(2) > 30).mean() < 0.95


def test_every_visible_surface_faces_outwards(still_life: Any) -> None:
    mesh = still_life[0].mesh
    for shot in module._shots(4, 160, 120, np.random.default_rng(7), "view"):
        face = rasterize(mesh, shot.camera).face_index.long()
        a, b, c = (mesh.v_pos[mesh.t_pos_idx[face[face >= 0], corner]] for corner in range(3))
        eye = -shot.camera.world_to_camera[:3, :3].T @ shot.camera.world_to_camera[:3, 3]
        assert ((torch.linalg.cross(b - a, c - a) * (eye.float() - a)).sum(1) > 0).float().mean() > 0.999


@given(st.lists(st.tuples(st.integers(2, 300), st.integers(2, 300)), min_size=1, max_size=25))
@settings(max_examples=30, deadline=None)
def test_charts_lie_apart_and_inside(shapes: list[tuple[int, int]]) -> None:
    taken = np.zeros((synthetic_object.TEXTURE_SIZE,) * 2, bool)
    for (height, width), (row, column) in zip(shapes, patches.pack(shapes, synthetic_object.TEXTURE_SIZE), strict=True):
        assert row >= 1
        assert column >= 1
        place = taken[row - 1 : row + height + 1, column - 1 : column + width + 1]
        assert place.shape == (height + 2, width + 2)
        assert not place.any()
        place[...] = True


def test_the_truth_is_as_close_to_itself_as_can_be(archive: Path, scan: Path) -> None:
    scores = compare_to_truth(scan / "truth/object.obj", archive)
    assert scores["views"] == module.HELDOUT_VIEWS
    assert scores["psnr"] > 60
    assert scores["ssim"] == pytest.approx(1, abs=1e-4)
    assert scores["gradient_ratio"] == pytest.approx(1, abs=1e-4)


def test_a_blurred_texture_scores_worse(scan: Path, still_life: Any, tmp_path: Path) -> None:
    atlas, texture = still_life
    blurred = torch.from_numpy(cv2.GaussianBlur(texture.numpy(), (0, 0), 16))
    export_model(tmp_path, atlas, blurred, up_axis="+z")
    scores = compare_to_truth(tmp_path / "model.obj", scan)
    assert scores["psnr"] < 35
    assert scores["gradient_ratio"] < 0.8
    assert scores["sharpness_ratio"] < scores["gradient_ratio"]
    assert scores["sliced_wasserstein"] > 1


def test_heldout_pictures_are_renders_of_the_truth(scan: Path, still_life: Any) -> None:
    truth = load(scan, "truth/cameras.json")
    assert len(truth["heldout"]) == module.HELDOUT_VIEWS
    entry = truth["heldout"][3]
    picture = cv2.imread(str(scan / f"truth/heldout/{entry['name']}.png"))
    assert picture is not None
    world_to_camera = torch.from_numpy(np.linalg.inv(np.array(entry["camera_to_world"])))
    camera = module.Camera(torch.tensor(truth["intrinsics_matrix"]), world_to_camera, WIDTH, HEIGHT)
    again = module.render_view(*still_life, camera, supersample=3, background=module.BACKDROP).numpy() * 255
    assert np.abs(again - picture[..., ::-1]).max() < 1


def test_a_scan_takes_the_place_of_an_older_one(scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "scan"
    (out / "truth").mkdir(parents=True)
    (out / "truth/cameras.json").write_text("{}")
    (out / "old.txt").touch()

    def write(folder: Path, *_: object) -> None:
        folder.mkdir()
        (folder / "scan.json").touch()

    monkeypatch.setattr(module, "_write_scan", write)
    synthesize(out)
    assert [path.name for path in out.rglob("*")] == ["scan.json"]
    assert [path.name for path in tmp_path.iterdir()] == ["scan"]


def test_folders_with_something_else_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(OptionError, match="holds something else"):
        synthesize(tmp_path, views=3, width=16, height=16)
    assert (tmp_path / "thesis.txt").read_text() == "mine"


@pytest.mark.parametrize(
    ("wrong", "words"),
    [({"views": 2}, "too few"), ({"width": 8}, "too small"), ({"camera_turn": -1.0}, "must not be negative")],
)
def test_numbers_out_of_bounds_are_named(tmp_path: Path, wrong: dict[str, Any], words: str) -> None:
    with pytest.raises(OptionError, match=words):
        synthesize(tmp_path / "scan", **wrong)
    assert list(tmp_path.iterdir()) == []


def test_a_camera_is_turned_and_moved_by_separate_errors() -> None:
    rng = np.random.default_rng(0)
    turned = module._misplaced(np.eye(4), module.Errors(0.0, 0.1, 0.0), rng)
    assert np.array_equal(turned[:3, 3], np.zeros(3))
    angle = np.arccos((np.trace(turned[:3, :3]) - 1) / 2)
    assert 0 < angle <= 0.1 * np.sqrt(3) + 1e-3
    moved = module._misplaced(np.eye(4), module.Errors(0.1, 0.0, 0.0), rng)
    assert np.array_equal(moved[:3, :3], np.eye(3))
    assert 0 < np.abs(moved[:3, 3]).max() <= 0.1


def test_an_interrupted_synthesis_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(module, "_write_scan", fail)
    with pytest.raises(KeyboardInterrupt):
        synthesize(tmp_path / "scan.zip")
    assert list(tmp_path.iterdir()) == []


def test_zip_members_have_fixed_times(archive: Path) -> None:
    with zipfile.ZipFile(io.BytesIO(archive.read_bytes())) as members:
        assert {entry.date_time for entry in members.infolist()} == {(1980, 1, 1, 0, 0, 0)}

"""What a scan says must not be used changes nothing: pixels outside of masks, depth without confidence.

Two copies of a scan differ in nothing else. What all later stages and methods are given (mesh, views, held-out views)
is the same to the last bit, and so is what is found out about the scan on the way there.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh

from advtex_engine.conventions.check import deep_check
from advtex_engine.core.cameras import pixel_centers, unproject
from advtex_engine.core.config import TextureConfig
from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import Camera, Mesh, Scene
from advtex_engine.ingest.frames import FrameStore
from advtex_engine.ingest.read import ingest, read_capture
from advtex_engine.mesh.registration import register_mesh
from advtex_engine.render.rasterize import rasterize
from advtex_engine.synthetic.patches import look_at

WIDTH, HEIGHT, VIEWS = 96, 72, 8
Pair = tuple[Path, Path]


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Pair:
    """Two scans with the same masks and confidences, and other noise where these are 0."""
    folder = tmp_path_factory.mktemp("pair")
    for seed in (1, 2):
        write_scan(folder / str(seed))
        spoil(folder / str(seed), np.random.default_rng(seed))
    return folder / "1", folder / "2"


def write_scan(scan: Path) -> None:
    """Boxes with waves on them, seen from a circle."""
    sizes = ((2, 2, 0.1), (0, 0, 0)), ((0.5, 0.4, 0.6), (0.3, 0, 0.35)), ((0.3, 0.7, 0.4), (-0.4, 0.1, 0.25))
    boxes = [trimesh.creation.box(size, trimesh.transformations.translation_matrix(at)) for size, at in sizes]
    shape = trimesh.util.concatenate([box.subdivide_to_size(0.2) for box in boxes])
    mesh = Mesh(torch.tensor(np.array(shape.vertices)).float(), torch.tensor(np.array(shape.faces)).long())
    K = torch.tensor([[90.0, 0, 48], [0, 90, 36], [0, 0, 1]], dtype=torch.float64)
    frames = []
    for kind in ("color", "depth"):
        (scan / kind).mkdir(parents=True)
    for number, angle in enumerate(np.arange(VIEWS) * 0.3):
        pose = look_at(np.array([1.8 * np.cos(angle), 1.8 * np.sin(angle), 1.2]), np.array([0, 0, 0.2]))
        camera = Camera(K, torch.from_numpy(pose), WIDTH, HEIGHT)
        depth = rasterize(mesh, camera).depth
        places = unproject(camera, pixel_centers(camera), depth).numpy()
        color = 128 + 60 * np.sin(places @ [31, 17, 23])[..., None] + 60 * np.sin(places * [13, 29, 19])
        frame = {kind: f"{kind}/{number}.png" for kind in ("color", "depth")}
        assert cv2.imwrite(str(scan / frame["color"]), color.astype(np.uint8))
        assert cv2.imwrite(str(scan / frame["depth"]), (1000 * depth.numpy()).astype(np.uint16))
        frames.append({**frame, "camera_to_world": np.linalg.inv(pose).tolist()})
    intrinsics = {"fx": 90, "fy": 90, "cx": 48, "cy": 36, "width": WIDTH, "height": HEIGHT}
    told = {"version": 1, "mesh": "mesh.ply", "color_intrinsics": intrinsics, "depth_intrinsics": intrinsics}
    (scan / "scan.json").write_text(json.dumps({**told, "frames": frames}))
    shape.export(scan / "mesh.ply")


def spoil(scan: Path, noise: np.random.Generator) -> None:
    """Puts noise where masks and confidences, which are written too, say that nothing may be used."""
    told = json.loads((scan / "scan.json").read_text())
    for number, frame in enumerate(told["frames"]):
        shape = np.random.default_rng(number)
        used = cv2.resize(shape.random((6, 8)), (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC) < 0.7
        trust = cv2.resize(shape.random((6, 8)), (WIDTH, HEIGHT), interpolation=cv2.INTER_NEAREST)
        trust = np.where(trust < 0.3, 0, (255 * trust).astype(np.uint8))
        color, depth = (cv2.imread(str(scan / frame[kind]), cv2.IMREAD_UNCHANGED) for kind in ("color", "depth"))
        color[~used] = noise.integers(0, 256, (int((~used).sum()), 3))
        unread = (trust == 0) | ~used
        depth[unread] = noise.integers(1, 8000, int(unread.sum()))
        frame |= {"mask": f"mask/{number}.png", "confidence": f"confidence/{number}.png"}
        for kind, image in (("color", color), ("depth", depth), ("mask", used * np.uint8(255)), ("confidence", trust)):
            (scan / frame[kind]).parent.mkdir(exist_ok=True)
            assert cv2.imwrite(str(scan / frame[kind]), image)
    (scan / "scan.json").write_text(json.dumps(told))


def assert_same(one: Scene, other: Scene) -> None:
    assert torch.equal(one.mesh.v_pos, other.mesh.v_pos)
    assert torch.equal(one.mesh.t_pos_idx, other.mesh.t_pos_idx)
    pairs = zip((*one.views, *one.heldout), (*other.views, *other.heldout), strict=True)
    for view, same in pairs:
        assert view.mask is not None and same.mask is not None and view.depth is not None and same.depth is not None
        assert torch.equal(view.color, same.color)
        assert torch.equal(view.depth, same.depth)
        assert torch.equal(view.mask, same.mask)
        assert 0.2 < float(view.mask.float().mean()) < 0.95


@pytest.mark.parametrize("size", [None, (85, 64)])
def test_every_stage_after_ingest_is_given_the_same(pair: Pair, size: tuple[int, int] | None) -> None:
    config = TextureConfig(size=size, holdout=4)
    one, other = (ingest(scan, config, Monitor()) for scan in pair)
    assert len(one.heldout) == 2
    assert_same(one, other)


def test_the_same_mesh_is_fused(pair: Pair, tmp_path: Path) -> None:
    scenes = []
    for scan in pair:
        copy = tmp_path / scan.name
        shutil.copytree(scan, copy)
        (copy / "mesh.ply").unlink()
        told = json.loads((scan / "scan.json").read_text())
        (copy / "scan.json").write_text(json.dumps({key: value for key, value in told.items() if key != "mesh"}))
        scenes.append(ingest(copy, TextureConfig(), Monitor()))
    assert len(scenes[0].mesh.t_pos_idx) > 1000
    assert_same(*scenes)


def test_conventions_are_judged_the_same(pair: Pair) -> None:
    one, other = (deep_check(scan, None) for scan in pair)
    assert one is not None and other is not None
    assert one.to_dict() == other.to_dict()


def test_the_same_views_are_chosen(pair: Pair) -> None:
    chosen = []
    for scan in pair:
        with FrameStore() as store:
            capture = read_capture(scan, TextureConfig(max_views=4), store, Monitor())
            assert capture.mesh is not None
            capture, report = capture.choose(capture.mesh, 4, Monitor())
            chosen.append((report, [frame.name for frame in capture.training]))
    assert len(chosen[0][1]) == 4
    assert chosen[0] == chosen[1]


def test_a_placed_model_is_moved_the_same_way(pair: Pair) -> None:
    moved = []
    for scan in pair:
        with FrameStore() as store:
            capture = read_capture(scan, TextureConfig(), store, Monitor())
            assert capture.mesh is not None
            frames = capture.measured()
            placed = replace(capture.mesh, v_pos=capture.mesh.v_pos + 0.01)
            moved.append(register_mesh(placed, frames))
    assert torch.equal(moved[0][0].v_pos, moved[1][0].v_pos)
    assert moved[0][1] == moved[1][1]
    assert moved[0][1]["accepted"]

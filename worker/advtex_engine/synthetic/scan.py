"""Synthetic scans with known truth: photographs of the synthetic object, with the errors that real scans have.

A scan in the native layout, plus `truth/`, which scan readers ignore:

    scan.json  color/*.png  depth/*.png  mesh.ply
    truth/object.obj .mtl .png      the object as it is
    truth/cameras.json              the poses as they were, of the frames and of the held-out views
    truth/heldout/*.png             views from other places, without noise, exposure changes or camera errors

The errors are those of the paper's supplement ("Details for Synthetic 3D Data Generation"): each camera is moved by a
translation uniform in [-e_t, e_t] per axis and turned by Euler angles uniform in [-e_a, e_a]; each vertex gets a scalar
uniform in [-e_g, e_g], smoothed by three Laplacian steps, and moves by it along its normal.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from advtex_engine.core.cameras import camera_to_world
from advtex_engine.core.errors import OptionError
from advtex_engine.core.rows import distinct_rows
from advtex_engine.core.scene import Atlas, Camera, Mesh
from advtex_engine.mesh.normals import vertex_normals
from advtex_engine.mesh.read import NUMPY, to_mesh
from advtex_engine.metrics.image_metrics import score_views
from advtex_engine.render.rasterize import rasterize
from advtex_engine.render.render_view import render_layers, render_view
from advtex_engine.results.export import export_model
from advtex_engine.synthetic import object as synthetic_object
from advtex_engine.synthetic.files import (
    TRUTH,
    intrinsics,
    new_scan,
    pose,
    require_size,
    thread_per_view,
    write_ply,
    write_png,
)
from advtex_engine.synthetic.patches import look_at
from advtex_scan.mesh import MeshSource, parse_mesh

CAMERA_ERROR = 0.002
"""e_t in metres. At DISTANCE it shifts a 320x240 frame by up to 1.7 pixels per axis, and the turn that goes with it as
much again: a point is off by 1.8 pixels (median), as in real scans (3 to 20 mm at 2 to 3 m are 0.3 to 2.6 pixels)."""
GEOMETRY_ERROR = 0.004
"""e_g in metres, little more than 1 % of the object's 0.3 m. Smoothing leaves 0.5 mm (rms), seen as lumpy edges."""
LAPLACIAN_STEPS = 3
TARGET = (0.0, 0.0, 0.085)
"""Where the cameras look, metres."""
DISTANCE = 0.4
"""Mean distance of the cameras, metres."""
RINGS = ((14.0, 0.40), (34.0, 0.35), (58.0, 0.25))
"""Elevation in degrees and share of the views of each ring."""
FOCAL = 1.05
"""Focal length over the image's width: a phone's field of view."""
SUPERSAMPLE = 3
EXPOSURE_SPREAD = 0.04
"""Standard deviation of the logarithm of the frames' exposure."""
SENSOR_NOISE = 1.5
"""Standard deviation in gray levels of 255."""
DEPTH_NOISE = 0.001
"""Standard deviation in metres."""
DEPTH_SCALE = 1000.0
HELDOUT_VIEWS = 8
BACKDROP = 0.8


@dataclass(frozen=True)
class Shot:
    """A view of the synthetic scan, and the camera as it was."""

    name: str
    camera: Camera


@dataclass(frozen=True)
class Errors:
    """What real scans have: e_t in metres, e_a in radians, e_g in metres (see the module's docstring)."""

    camera: float
    turn: float
    geometry: float


def synthesize(
    out: Path,
    *,
    views: int = 60,
    width: int = 320,
    height: int = 240,
    seed: int = 0,
    camera_error: float = CAMERA_ERROR,
    camera_turn: float | None = None,
    geometry_error: float = GEOMETRY_ERROR,
) -> None:
    """Write a synthetic scan: a zip when `out` ends in .zip, else a folder, which is replaced if it is one of these.

    views: frames of width x height pixels. camera_error: e_t in metres. camera_turn: e_a in radians, by default the
    angle that moves the image as far (e_t / DISTANCE). geometry_error: e_g in metres. The same arguments make the same
    scan. Raises OptionError for numbers out of bounds and for a folder that holds something else.
    """
    require_size(views, width, height)
    errors = Errors(camera_error, camera_error / DISTANCE if camera_turn is None else camera_turn, geometry_error)
    if min(errors.camera, errors.turn, errors.geometry) < 0:
        raise OptionError(f"errors are sizes and must not be negative: {errors}")
    with new_scan(out) as folder:
        _write_scan(folder, views, width, height, seed, errors)


def compare_to_truth(model: Path, scan: Path) -> dict[str, float]:
    """How close a result came to the truth: `score_views` of the model against the true object.

    model: an OBJ that `export_model` wrote. scan: what `synthesize` wrote, folder or zip. Both objects are rendered
    from the true held-out cameras; pixels count where both are seen.
    """
    truth = json.loads(_member(scan, TRUTH))
    K = np.array(truth["intrinsics_matrix"])
    ours = _load_model(model.read_bytes(), lambda name: (model.parent / name).read_bytes())
    theirs = _load_model(_member(scan, "truth/object.obj"), lambda name: _member(scan, f"truth/{name}"))

    def render(view: dict[str, Any]) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """The result, the truth, and where both are."""
        world_to_camera = np.linalg.inv(np.array(view["camera_to_world"]))
        camera = Camera(torch.from_numpy(K), torch.from_numpy(world_to_camera), truth["width"], truth["height"])
        (result, seen), (original, there) = (
            render_layers(atlas, texture, camera, supersample=SUPERSAMPLE) for atlas, texture in (ours, theirs)
        )
        return result, original, (seen == 1) & (there == 1)

    with thread_per_view() as pool:
        renders, originals, masks = zip(*pool.map(render, truth["heldout"]), strict=True)
        return score_views(renders, originals, masks)


def _load_model(obj: bytes, read: Callable[[str], bytes]) -> tuple[Atlas, torch.Tensor]:
    """An OBJ of triangles with one texture, and that texture [H,W,3] uint8; `read` gets the files that it names."""
    source = MeshSource("model.obj", io.BytesIO(obj), len(obj), lambda name, _limit: read(name))
    mesh = to_mesh(parse_mesh(source, NUMPY))
    assert mesh.v_uv is not None
    mtl = read(_value_of(obj, b"mtllib"))
    image = cv2.imdecode(np.frombuffer(read(_value_of(mtl, b"map_Kd")), np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    texture = torch.from_numpy(np.ascontiguousarray(image[..., ::-1]))
    return Atlas(mesh, texture.shape[1], texture.shape[0], "scan", 0), texture


def _value_of(text: bytes, key: bytes) -> str:
    """What follows `key` on the first line that starts with it."""
    line = next(line for line in text.splitlines() if line.startswith(key + b" "))
    return line.split(maxsplit=1)[1].decode()


def _member(scan: Path, name: str) -> bytes:
    if scan.is_dir():
        return (scan / name).read_bytes()
    with zipfile.ZipFile(scan) as archive:
        return archive.read(name)


def _write_scan(folder: Path, views: int, width: int, height: int, seed: int, errors: Errors) -> None:
    rng = np.random.default_rng(seed)
    for name in ("color", "depth", "truth/heldout"):
        (folder / name).mkdir(parents=True)
    shots = _shots(views, width, height, rng, "frame")
    heldout = _shots(HELDOUT_VIEWS, width, height, rng, "heldout", turn=0.37)

    def capture(index: int) -> None:
        """Write one frame; its randomness is its own, so that frames may be made in any order."""
        shot, noise = shots[index], np.random.default_rng([seed, index])
        clean = render_view(atlas, texture, shot.camera, supersample=SUPERSAMPLE, background=BACKDROP)
        write_png(folder / f"color/{shot.name}.png", _exposed(clean.numpy(), noise))
        depth = rasterize(atlas.mesh, shot.camera).depth.numpy()
        write_png(folder / f"depth/{shot.name}.png", _measured(depth, noise))

    def keep(shot: Shot) -> None:
        clean = render_view(atlas, texture, shot.camera, supersample=SUPERSAMPLE, background=BACKDROP)
        write_png(folder / f"truth/heldout/{shot.name}.png", np.rint(clean.numpy() * 255).astype(np.uint8))

    with thread_per_view() as pool:
        atlas, texture = synthetic_object.build(seed)
        list(pool.map(capture, range(views)))
        list(pool.map(keep, heldout))
    write_ply(folder / "mesh.ply", _bent(atlas.mesh, errors.geometry, rng))
    scan = {
        "version": 1,
        "kind": "object",
        "up_axis": "+z",
        "depth_scale": DEPTH_SCALE,
        "color_intrinsics": intrinsics(shots[0].camera),
        "depth_intrinsics": intrinsics(shots[0].camera),
        "mesh": "mesh.ply",
        "frames": [
            {"color": f"color/{shot.name}.png", "depth": f"depth/{shot.name}.png"}
            | pose(shot.name, _misplaced(camera_to_world(shot.camera).numpy(), errors, rng))
            for shot in shots
        ],
    }
    (folder / "scan.json").write_text(json.dumps(scan, indent=1))
    export_model(folder / "truth", atlas, texture, up_axis="+z", lossless=True, name="object")
    truth = {
        "width": width,
        "height": height,
        "intrinsics_matrix": shots[0].camera.K.tolist(),
        "frames": [pose(shot.name, camera_to_world(shot.camera).numpy()) for shot in shots],
        "heldout": [pose(shot.name, camera_to_world(shot.camera).numpy()) for shot in heldout],
    }
    (folder / TRUTH).write_text(json.dumps(truth, indent=1))


def _shots(count: int, width: int, height: int, rng: np.random.Generator, prefix: str, turn: float = 0.0) -> list[Shot]:
    """Cameras on rings of a hemisphere, a little off them, looking at the object; in order along each ring."""
    focal = FOCAL * width
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float64)
    ends = np.rint(np.cumsum([share for _, share in RINGS]) * count).astype(int)
    shots = []
    for index in range(count):
        ring = int(np.searchsorted(ends, index, side="right"))
        first = int(ends[ring - 1]) if ring else 0
        around = (index - first + turn + rng.uniform(-0.2, 0.2)) / max(int(ends[ring]) - first, 1)
        azimuth = 2 * np.pi * around + 0.5 * ring
        elevation = np.radians(RINGS[ring][0] + rng.uniform(-4, 4))
        distance = DISTANCE * rng.uniform(0.8, 1.15)
        towards = [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
        target = np.array(TARGET) + rng.uniform(-0.015, 0.015, 3)
        world_to_camera = look_at(np.array(TARGET) + distance * np.array(towards), target)
        camera = Camera(K, torch.from_numpy(world_to_camera), width, height)
        shots.append(Shot(f"{prefix}-{index:04d}", camera))
    return shots


def _exposed(image: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.uint8]:
    """The photograph of a clean image: another exposure, white balance within 1 %, sensor noise; [H,W,3] uint8."""
    gain = np.exp(EXPOSURE_SPREAD * rng.standard_normal() + 0.01 * rng.standard_normal(3))
    # Gain acts on light, of which sRGB values are about the 2.2nd root.
    levels = 255 * image * gain ** (1 / 2.2) + SENSOR_NOISE * rng.standard_normal(image.shape)
    return np.rint(np.clip(levels, 0, 255)).astype(np.uint8)


def _measured(depth: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.uint16]:
    """Depth as a sensor stores it: noisy, in units of 1/DEPTH_SCALE metres, 0 where nothing was hit."""
    noisy = depth + DEPTH_NOISE * rng.standard_normal(depth.shape)
    return np.where(depth > 0, np.rint(noisy * DEPTH_SCALE), 0).astype(np.uint16)


def _misplaced(camera_to_world: NDArray[np.float64], errors: Errors, rng: np.random.Generator) -> NDArray[np.float64]:
    """The pose with the paper's camera errors, turned about the camera's own centre."""
    translation = rng.uniform(-errors.camera, errors.camera, 3)
    x, y, z = rng.uniform(-1, 1, 3) * errors.turn
    turn = _axis_turn(2, z) @ _axis_turn(1, y) @ _axis_turn(0, x)
    moved = camera_to_world.copy()
    moved[:3, :3] = moved[:3, :3] @ turn
    moved[:3, 3] += translation
    return moved


def _axis_turn(axis: int, angle: float) -> NDArray[np.float64]:
    turn = np.eye(3)
    first, second = (axis + 1) % 3, (axis + 2) % 3
    turn[first, first] = turn[second, second] = np.cos(angle)
    turn[first, second], turn[second, first] = -np.sin(angle), np.sin(angle)
    return turn


def _bent(mesh: Mesh, error: float, rng: np.random.Generator) -> Mesh:
    """The mesh with the paper's geometry errors and without its texture coordinates."""
    faces = mesh.t_pos_idx
    count = len(mesh.v_pos)
    edges = torch.cat((faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]))
    edges, _ = distinct_rows(torch.cat((edges, edges.flip(1))))
    degree = torch.zeros(count).index_add_(0, edges[:, 0], torch.ones(len(edges)))
    offset = torch.from_numpy(rng.uniform(-error, error, count).astype(np.float32))
    for _ in range(LAPLACIAN_STEPS):
        offset = torch.zeros(count).index_add_(0, edges[:, 0], offset[edges[:, 1]]) / degree.clamp(min=1)
    return Mesh(mesh.v_pos + offset[:, None] * vertex_normals(mesh), faces)

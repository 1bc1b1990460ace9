"""Synthetic scans that suffer from what real ones do: a hand-held camera, a depth sensor, a tracker, and the truth.

A scan in the native layout, plus `truth/`, which scan readers ignore:

    scan.json  color/*.jpg  depth/*.png  mesh.ply     poses as a tracker finds them, the mesh fused from the depth
    truth/object.obj .mtl .png                        the scene as it is, at the exposure of the median frame
    truth/cameras.json                                the poses as they were; how each frame was taken, how much of
                                                      it is blurred and clipped, and the poses from the begin of its
                                                      first row to the end of its last; the lens; the errors
    truth/heldout/*.png                               sharp views from between the frames, at the median exposure
    truth/scan.json  truth/mesh.ply                   these views as a scan of its own, at the poses that the tracker
                                                      would have found, with the fused mesh: for `evaluate`
    truth/depth/*.png                                 and their depth, exact

Two questions, two sets of poses: from the true ones, `compare` tells how close a result is to the scene; from the
tracker's, `evaluate` tells it as it does of held-out photographs, whose poses drift with the mesh.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from advtex_engine.core.cameras import camera_to_world, pixel_centers, scaled_camera, unproject
from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import Camera, DepthFrame, Mesh
from advtex_engine.mesh.fusion import fuse
from advtex_engine.render.render_view import gbuffer, shade
from advtex_engine.results.export import export_model
from advtex_engine.synthetic import object as synthetic_object
from advtex_engine.synthetic import room
from advtex_engine.synthetic.camera import (
    BACKDROP,
    DISTORTION,
    READOUT,
    Errors,
    Exposure,
    automatics,
    blur_pixels,
    compressed,
    develop,
    expose,
    meter,
)
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
from advtex_engine.synthetic.patches import GAMMA, Array, DrawnScene, Sky, assemble
from advtex_engine.synthetic.sensor import DEPTH_SCALE, NEAREST, SensorName, depth_camera, look, measure, stored
from advtex_engine.synthetic.trajectory import Path as CameraPath
from advtex_engine.synthetic.trajectory import drift, moved, object_path, object_widening, room_path

SceneName = Literal["room", "object"]
FOCAL = {"room": 0.86, "object": 1.05}
"""Focal length over the width of the image."""
DISTANCE = {"room": 1.6, "object": 0.35}
"""Metres from the camera to what it sees, about; to an object more, if the sensor needs it."""
HELDOUT_VIEWS = 10
HELDOUT_SUPERSAMPLE = 4
HELDOUT_MOVE = 0.05
"""Metres per metre of distance that held-out views lie beside the camera's path, at the most."""
CLIPPED = 254
"""Levels from which a pixel is counted as clipped."""
FACTS_STEP = 8
"""Pixels between those whose blur is looked at."""
MOTION_POSES = 5
"""Poses that tell how the camera moved while a frame was taken."""


@dataclass(frozen=True)
class Shot:
    """A frame of the scan: its true camera, the pose [4,4] that the tracker found, and how it was taken."""

    name: str
    camera: Camera
    tracked: Array
    exposure: Exposure


def synthesize_real(
    out: Path,
    *,
    scene: SceneName = "room",
    sensor: SensorName = "structured",
    views: int = 60,
    width: int = 640,
    height: int = 480,
    seed: int = 0,
    errors: Errors | None = None,
) -> None:
    """Write a scan with the errors of real ones: a zip when `out` ends in .zip, else a folder, as `synthesize` does.

    views: frames of width x height pixels, evenly over the path: with fewer, they lie further apart. errors: all by
    default. The same arguments make the same scan. Raises OptionError as `synthesize` does.
    """
    require_size(views, width, height)
    with new_scan(out) as folder, thread_per_view() as pool:
        drawn = drawn_scene(scene, seed)
        recording = _record(drawn, scene, sensor, views, (width, height), seed, errors or Errors())
        for name in ("color", "depth", "truth/heldout", "truth/depth"):
            (folder / name).mkdir(parents=True)
        taken = list(pool.map(lambda shot: _take(folder, drawn, recording, sensor, shot), recording.shots))
        list(pool.map(lambda shot: _keep(folder / "truth", drawn, shot), recording.heldout))
        frames = [frame for frame, _ in taken]
        mesh = fuse(frames, torch.device("cpu"), Monitor())[0] if recording.errors.fused else drawn.atlas.mesh
        _write(folder, drawn, recording, scene, mesh, [facts for _, facts in taken])


@lru_cache(maxsize=1)
def drawn_scene(scene: SceneName, seed: int) -> DrawnScene:
    """The room or the object, lit. The newest one is kept: it takes as long as many frames, and studies share it."""
    if scene == "room":
        return assemble(room.patches(seed), room.TEXTURE_SIZE, room.SKY)
    return assemble(synthetic_object.patches(seed), synthetic_object.TEXTURE_SIZE, Sky())


@dataclass(frozen=True)
class Recording:
    """What was recorded: the camera's path, the frames and the held-out views, and with which errors."""

    path: CameraPath
    shots: Sequence[Shot]
    heldout: Sequence[Shot]
    errors: Errors
    seed: int


def _record(
    drawn: DrawnScene,
    scene: SceneName,
    sensor: SensorName,
    views: int,
    size: tuple[int, int],
    seed: int,
    errors: Errors,
) -> Recording:
    """When and where every picture is taken. All that is random is drawn whatever the errors, so that they compare."""
    rng = np.random.default_rng([seed, 4])
    widening = 1.0 if scene == "room" else object_widening(NEAREST[sensor])
    path = room_path(rng) if scene == "room" else object_path(rng, widening)
    distance = widening * DISTANCE[scene]
    focal = FOCAL[scene] * size[0]
    K = torch.tensor([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]], dtype=torch.float64)
    camera = Camera(K, torch.eye(4, dtype=torch.float64), *size)
    times = path.duration * (np.arange(views) + 0.5) / views
    exposures, gain = automatics(meter(drawn, path, camera, times), times, errors, rng)
    # Held-out views lie halfway between two frames.
    gaps = np.rint(np.linspace(0, views - 2, HELDOUT_VIEWS + 2)[1:-1])
    between = path.duration * (gaps + 1) / views
    metres, radians = (part * errors.drift for part in drift(np.concatenate([times, between]), distance, rng))
    beside = rng.uniform(-1, 1, (HELDOUT_VIEWS, 3)) * HELDOUT_MOVE * distance
    true = path.poses(np.concatenate([times, between]))
    true[views:, :3, 3] += beside
    tracked = moved(true, metres, radians)
    sharp = Exposure(0.0, 0.0, gain)
    shots = [
        Shot(
            f"frame-{index:04d}" if index < views else f"heldout-{index - views:04d}",
            replace(camera, world_to_camera=torch.from_numpy(np.linalg.inv(true[index]))),
            tracked[index],
            exposures[index] if index < views else sharp,
        )
        for index in range(len(true))
    ]
    return Recording(path, shots[:views], shots[views:], errors, seed)


def _take(
    folder: Path, drawn: DrawnScene, recording: Recording, sensor: SensorName, shot: Shot
) -> tuple[DepthFrame, dict[str, Any]]:
    """Write a frame; what fusion gets of it, and what is true of it. Its randomness is its own."""
    errors, number = recording.errors, int(shot.name.rsplit("-", 1)[1])
    light = expose(drawn, recording.path, shot.camera, shot.exposure, errors)
    photo = develop(light, shot.camera, shot.exposure, errors, np.random.default_rng([recording.seed, 5, number]))
    if errors.jpeg:
        (folder / f"color/{shot.name}.jpg").write_bytes(compressed(photo))
    else:
        write_png(folder / f"color/{shot.name}.png", photo)
    camera = depth_camera(shot.camera, sensor)
    seen = look(drawn, camera)
    depth = measure(seen, camera, sensor, recording.seed, number) if errors.depth else seen.depth
    write_png(folder / f"depth/{shot.name}.png", stored(depth))
    there = replace(camera, world_to_camera=torch.from_numpy(np.linalg.inv(shot.tracked)))
    frame = DepthFrame(there, torch.from_numpy(stored(depth).astype(np.float32) / np.float32(DEPTH_SCALE)))
    return frame, _facts(recording, shot, photo, camera, seen.depth)


def _facts(
    recording: Recording, shot: Shot, photo: NDArray[np.uint8], camera: Camera, depth: NDArray[np.float32]
) -> dict[str, Any]:
    """How a frame was taken, where the camera was meanwhile, and what came of it. camera, depth: what it shows."""
    every = (slice(None, None, FACTS_STEP),) * 2
    there = torch.from_numpy(depth)[every]
    points = unproject(camera, pixel_centers(camera)[every], there)[there > 0]
    blur = blur_pixels(recording.path, shot.camera, shot.exposure, points.numpy())
    readout = READOUT if recording.errors.rolling_shutter else 0.0
    instants = shot.exposure.middle + (shot.exposure.seconds + readout) * np.linspace(-0.5, 0.5, MOTION_POSES)
    return shot.exposure.to_dict() | {
        "blur_pixels": round(float(np.median(blur)) if len(blur) else 0.0, 3),
        "clipped_share": round(float((photo.max(-1) >= CLIPPED).mean()), 4),
        "motion": recording.path.poses(instants).tolist(),
    }


def _keep(truth: Path, drawn: DrawnScene, shot: Shot) -> None:
    """Write a held-out view, sharp and clean, and its depth."""
    light = shade(gbuffer(drawn.atlas, shot.camera, HELDOUT_SUPERSAMPLE), drawn.radiance, BACKDROP)
    write_png(truth / f"heldout/{shot.name}.png", _shown(light, shot.exposure.gain).numpy())
    write_png(truth / f"depth/{shot.name}.png", stored(look(drawn, shot.camera).depth))


def _shown(light: Tensor, gain: float) -> Tensor:
    """Light as the sRGB values [...,3] uint8 of a flawless photograph."""
    return (255 * (light * gain).clamp(0, 1) ** (1 / GAMMA)).round().to(torch.uint8)


def _write(
    folder: Path, drawn: DrawnScene, recording: Recording, scene: SceneName, mesh: Mesh, facts: list[dict[str, Any]]
) -> None:
    """The scan, the scan of held-out views, and the truth, around the pictures that are written already."""
    shots, heldout, errors = recording.shots, recording.heldout, recording.errors
    mesh = Mesh(mesh.v_pos, mesh.t_pos_idx)
    for place, views, images in ((folder, shots, "color"), (folder / "truth", heldout, "heldout")):
        write_ply(place / "mesh.ply", mesh)
        suffix = "jpg" if errors.jpeg and images == "color" else "png"
        (place / "scan.json").write_text(json.dumps(_scan(place, views, images, suffix, scene), indent=1))
    texture = _shown(drawn.radiance, heldout[0].exposure.gain)
    export_model(folder / "truth", drawn.atlas, texture, up_axis="+z", lossless=True, name="object")
    truth = {
        "width": shots[0].camera.width,
        "height": shots[0].camera.height,
        "intrinsics_matrix": shots[0].camera.K.tolist(),
        "lens": list(DISTORTION) if errors.distortion else [0.0, 0.0],
        "readout_seconds": READOUT if errors.rolling_shutter else 0.0,
        "errors": asdict(errors),
        "gain": heldout[0].exposure.gain,
        "frames": [_true_pose(shot) | fact for shot, fact in zip(shots, facts, strict=True)],
        "heldout": [_true_pose(shot) for shot in heldout],
    }
    (folder / TRUTH).write_text(json.dumps(truth, indent=1))


def _scan(folder: Path, shots: Sequence[Shot], images: str, suffix: str, scene: SceneName) -> dict[str, Any]:
    """`scan.json` of frames at the tracker's poses."""
    depth = cv2.imread(str(folder / f"depth/{shots[0].name}.png"), cv2.IMREAD_UNCHANGED)
    assert depth is not None
    camera = scaled_camera(shots[0].camera, depth.shape[1], depth.shape[0])
    return {
        "version": 1,
        "kind": "object" if scene == "object" else "scene",
        "up_axis": "+z",
        "depth_scale": DEPTH_SCALE,
        "color_intrinsics": intrinsics(shots[0].camera),
        "depth_intrinsics": intrinsics(camera),
        "mesh": "mesh.ply",
        "frames": [
            {"color": f"{images}/{shot.name}.{suffix}", "depth": f"depth/{shot.name}.png"}
            | pose(shot.name, shot.tracked)
            for shot in shots
        ],
    }


def _true_pose(shot: Shot) -> dict[str, Any]:
    return pose(shot.name, camera_to_world(shot.camera).numpy())

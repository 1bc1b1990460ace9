"""Redwood, Open3D and SceneNN: `image/`, `color/` or `rgb/` beside `depth/`, and a trajectory.

The trajectory is a `.log`, five lines per frame, `id id id+1` and a 4x4 camera-to-world matrix, or Open3D's json of
class PinholeCameraTrajectory, whose `extrinsic` is world-to-camera, 16 numbers column by column; both with OpenCV axes
and metres. The id is the frame's place in the sorted folder. Images and depth images pair up in order if there are as
many of the one as of the other, else by the first number in their names. Depth is in millimetres and registered to
color. Intrinsics come from the json trajectory, else from a json with an `intrinsic_matrix` (9 numbers column by
column), else from `camera-intrinsics.txt` (3x3), else they are PrimeSense's default. Principal points count the first
pixel's centre as (0, 0). Mesh: mesh.ply, integrated.ply (also in `scene/`), else the one mesh that is there.
"""

from __future__ import annotations

from typing import Any

from advtex_scan.archive import ScanArchive
from advtex_scan.errors import ScanFormatError
from advtex_scan.layouts._json import json_numbers, json_object, json_size
from advtex_scan.layouts._mesh_choice import choose_mesh
from advtex_scan.layouts._reader import Match, ScanReader, parse_numbers
from advtex_scan.layouts._sequences import (
    CAMERA_FILE,
    LIST_LIMIT,
    PRIMESENSE,
    by_name,
    by_place,
    fitted,
    frame_name,
    images_in,
    paired,
)
from advtex_scan.manifest import FrameEntry, Intrinsics, Matrix4, ScanManifest
from advtex_scan.matrices import invert_rigid, up_axis_of

NAME = "redwood"
COLOR_FOLDERS = ("image/", "color/", "rgb/")
DEPTH_FOLDER = "depth/"
LOG_NAMES = ("trajectory.log", "scene/trajectory.log", "scene/key.log")
MESHES = ("mesh.ply", "integrated.ply", "scene/integrated.ply")
HEAD_BYTES = 1024
FILES_LOOKED_AT = 50  # of .log and json files each
BLOCK = 5  # lines of a frame in a .log
MAX_FRAMES = 100_000
REMEDY = "write `id id id+1` and the four rows of the camera-to-world matrix for each frame"


def detect(archive: ScanArchive) -> Match | None:
    """Look for a folder of images and a trajectory."""
    folder = _color_folder(archive)
    trajectory = _trajectory_file(archive) if folder else None
    return Match(0.75, f"there are {folder} and the trajectory {trajectory}") if trajectory else None


def read(reader: ScanReader) -> ScanManifest | None:
    """Read all images with a pose."""
    folder, trajectory = _color_folder(reader.archive), _trajectory_file(reader.archive)
    if folder is None or trajectory is None:
        return None
    colors, depths = images_in(reader.archive, folder), images_in(reader.archive, DEPTH_FOLDER)
    reader.frames_found = len(colors)
    reader.used.update(colors, depths)
    own, poses = _log(reader, trajectory) if trajectory.endswith(".log") else _json_trajectory(reader, trajectory)
    camera = own or _camera(reader, reader.color_size([*colors]))
    depth_camera = fitted(camera, reader.image_size([*depths]))
    frames = []
    for color, number, depth in zip(colors, by_place(colors, poses), paired(colors, depths), strict=True):
        if number is None:
            remedy = "nothing to do unless the trajectory should cover it"
            reader.drop("missing_pose", color, "is not in the trajectory; the frame is left out", remedy)
            continue
        pose = poses[number]
        if pose is not None and camera is not None:
            frames.append(FrameEntry(frame_name(color), color, depth, pose, camera, depth_camera))
    return ScanManifest(
        layout=NAME,
        frames=by_name(frames),
        mesh=choose_mesh(reader, MESHES),
        up_axis=up_axis_of(frame.camera_to_world for frame in frames),
    )


def _color_folder(archive: ScanArchive) -> str | None:
    return next((folder for folder in COLOR_FOLDERS if images_in(archive, folder)), None)


def _trajectory_file(archive: ScanArchive) -> str | None:
    """Find the .log or json that starts like a trajectory: a documented name first, then the one nearest to the top."""
    names = sorted((name for name in archive.names() if name.count("/") <= 1), key=lambda name: (name.count("/"), name))
    logs = [name for name in names if name.lower().endswith(".log")]
    for name in [*(name for name in LOG_NAMES if name in archive), *logs[:FILES_LOOKED_AT]]:
        lines = _head(archive, name).split("\n")
        numbers = [parse_numbers(line) for line in lines[:4]]
        if [len(values) if values else 0 for values in numbers] == [3, 4, 4, 4]:
            return name
    jsons = [name for name in names if name.lower().endswith(".json")]
    return next((name for name in jsons[:FILES_LOOKED_AT] if '"PinholeCameraTrajectory"' in _head(archive, name)), None)


def _head(archive: ScanArchive, name: str) -> str:
    try:
        return archive.head(name, HEAD_BYTES).decode("utf-8", "replace")
    except ScanFormatError:
        return ""


def _log(reader: ScanReader, name: str) -> tuple[None, dict[int, Matrix4 | None]]:
    """Return camera-to-world poses by id; None where tracking was lost or the matrix is no pose, which is reported."""
    lines = [line for line in (reader.text(name, LIST_LIMIT) or "").splitlines() if line.strip()]
    poses: dict[int, Matrix4 | None] = {}
    for start in range(0, min(len(lines), BLOCK * MAX_FRAMES), BLOCK):
        ids = parse_numbers(lines[start])
        values = parse_numbers(" ".join(lines[start + 1 : start + BLOCK]))
        if not ids or not ids[0].is_integer() or values is None or len(values) != 16:
            message = f"the {BLOCK} lines from {lines[start][:40]!r} are no frame of a trajectory"
            reader.findings.error("bad_trajectory", name, message, REMEDY)
            break
        if int(ids[0]) in poses:
            reader.findings.error("bad_trajectory", name, f"two frames have the id {ids[0]:g}", REMEDY)
            break
        poses[int(ids[0])] = reader.pose(values, f"{name}: {ids[0]:g}")
    return None, poses


def _json_trajectory(reader: ScanReader, name: str) -> tuple[Intrinsics | None, dict[int, Matrix4 | None]]:
    """Return the first frame's camera, and camera-to-world poses by place."""
    trajectory = json_object(reader, name) or {}
    parameters = trajectory.get("parameters")
    if not isinstance(parameters, list) or len(parameters) > MAX_FRAMES:
        reader.findings.error("bad_trajectory", name, "has no list of parameters", "write it with Open3D")
        return None, {}
    poses: dict[int, Matrix4 | None] = {}
    for place, entry in enumerate(parameters):
        values = json_numbers(entry.get("extrinsic"), 16) if isinstance(entry, dict) else None
        where = f"{name}: parameters[{place}]"
        if values is None:
            message = "its extrinsic does not hold 16 numbers"
            reader.findings.error("bad_trajectory", where, message, "write it with Open3D")
            continue
        rows = [values[column * 4 + row] for row in range(4) for column in range(4)]
        world_to_camera = reader.pose(rows, where)
        poses[place] = invert_rigid(world_to_camera) if world_to_camera else None
    first = parameters[0] if parameters and isinstance(parameters[0], dict) else {}
    return _json_camera(reader, first.get("intrinsic"), name), poses


def _json_camera(reader: ScanReader, value: Any, where: str) -> Intrinsics | None:
    """Read Open3D's PinholeCameraIntrinsic; None if this is none."""
    matrix = json_numbers(value.get("intrinsic_matrix"), 9) if isinstance(value, dict) else None
    size = json_size(value.get("width"), value.get("height")) if isinstance(value, dict) else None
    if matrix is None or size is None:
        return None
    return reader.opencv_intrinsics((matrix[0], matrix[4], matrix[6], matrix[7]), size, where)


def _camera(reader: ScanReader, size: tuple[int, int] | None) -> Intrinsics | None:
    if size is None:
        return None
    jsons = [name for name in reader.archive.names() if name.lower().endswith(".json") and "/" not in name]
    for name in jsons[:FILES_LOOKED_AT]:
        if '"intrinsic_matrix"' in _head(reader.archive, name):
            camera = _json_camera(reader, json_object(reader, name), name)
            if camera is None and not reader.findings.count("bad_intrinsics"):
                remedy = "write width, height and intrinsic_matrix as Open3D does"
                reader.findings.error("bad_intrinsics", name, "describes no camera", remedy)
            return camera
    if CAMERA_FILE in reader.archive:
        return reader.matrix_intrinsics(CAMERA_FILE, size)
    message = "no file states the camera; PrimeSense's default is taken (f = 525 at 640x480)"
    reader.findings.warning("default_camera", "", message, "add intrinsic.json as Open3D writes it")
    return PRIMESENSE.intrinsics()

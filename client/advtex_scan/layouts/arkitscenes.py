"""ARKitScenes (raw and 3dod): `lowres_wide/`, `lowres_wide_intrinsics/`, `lowres_depth/` and `lowres_wide.traj`.

Files are named `<video>_<seconds>.png` and `.pincam`. The finest of `wide/`, `vga_wide/` and `lowres_wide/` that is
there is taken, with the intrinsics of the same name: `width height fx fy cx cy`, one file for each image. The
trajectory holds `seconds rx ry rz tx ty tz` in each line: a rotation vector and a translation, world-to-camera, OpenCV
axes, metres, ten times a second; poses of images between them are interpolated. An image gets the depth image nearest
in time, in millimetres up to 5 m and registered to color, with its `confidence/` of 0 to 2; z is up. Principal points
were scaled down from those of the sensor's 1920x1440 pixels, which count the first pixel's centre as (0, 0): half such
a pixel is added.
Mesh: `<video>_3dod_mesh.ply`, mesh.ply, else the one mesh that is there.
"""

from __future__ import annotations

import math
import re

from advtex_scan.archive import ScanArchive
from advtex_scan.layouts._arkit import CONFIDENCE_HIGH, LIDAR_METRES
from advtex_scan.layouts._mesh_choice import choose_mesh
from advtex_scan.layouts._reader import OPENCV_OFFSET, Match, ScanReader, parse_numbers, parse_size
from advtex_scan.layouts._sequences import Track, by_name, fitted, folder_of, frame_name, images_in, list_lines, nearest
from advtex_scan.manifest import FrameEntry, Intrinsics, ScanManifest
from advtex_scan.matrices import from_rotation_vector, invert_rigid

NAME = "arkitscenes"
POSE_FILE = "lowres_wide.traj"
COLOR_FOLDERS = ("wide", "vga_wide", "lowres_wide")
DEPTH_FOLDER, CONFIDENCE_FOLDER = "lowres_depth/", "confidence/"
STAMP = re.compile(r".*_([0-9]{1,12}\.[0-9]{1,9})\.\w+")
SENSOR_WIDTH = 1920
SAME_TIME = 0.005  # seconds; time stamps of one frame differ by 0.001 between the files
DEPTH_TIME = 0.02  # depth comes 60 times a second
POSE_GAP = 0.25
_Stamped = tuple[list[float], list[str]]  # times, sorted, and the files of these times


def detect(archive: ScanArchive) -> Match | None:
    """Look for `lowres_wide.traj` beside a folder of images."""
    folder = folder_of(archive, POSE_FILE)
    kind = None if folder is None else _color_folder(archive, folder)
    return Match(0.9, f"{folder}{POSE_FILE} and {folder}{kind}/ are there") if kind else None


def read(reader: ScanReader) -> ScanManifest | None:
    """Read all images with a pose and intrinsics."""
    folder = folder_of(reader.archive, POSE_FILE)
    kind = None if folder is None else _color_folder(reader.archive, folder)
    if folder is None or kind is None:
        return None
    colors = images_in(reader.archive, f"{folder}{kind}/")
    depths = _stamped(images_in(reader.archive, folder + DEPTH_FOLDER))
    trusts = _stamped(images_in(reader.archive, folder + CONFIDENCE_FOLDER))
    cameras = _stamped([name for name in reader.archive.names() if name.startswith(f"{folder}{kind}_intrinsics/")])
    reader.frames_found = len(colors)
    reader.used.update(colors, depths[1], trusts[1], cameras[1])
    depth_size = reader.image_size([*depths[1]])
    track = _track(reader, folder + POSE_FILE)
    frames = []
    for color in colors:
        time = _time(color)
        pose = None if time is None else track.at(time)
        if time is None or pose is None:
            message = f"has no pose in {POSE_FILE}; the frame is left out"
            reader.drop("missing_pose", color, message, "nothing to do unless many frames have none")
            continue
        camera_path = _at(cameras, time, SAME_TIME)
        if camera_path is None:
            message = f"has no file in {kind}_intrinsics/; the frame is left out"
            reader.drop("missing_intrinsics", color, message, "copy the folder again from the data set")
            continue
        camera = _camera(reader, camera_path)
        if camera is not None:
            depth = _at(depths, time, DEPTH_TIME)
            trust = _at(trusts, _time(depth) or time, SAME_TIME) if depth else None
            depth_camera = fitted(camera, depth_size)
            frames.append(FrameEntry(frame_name(color), color, depth, pose, camera, depth_camera, confidence=trust))
    meshes = tuple(name for name in reader.archive.names() if name.endswith("_3dod_mesh.ply"))
    return ScanManifest(
        layout=NAME,
        frames=by_name(frames),
        mesh=choose_mesh(reader, (*meshes, "mesh.ply")),
        confidence_max=CONFIDENCE_HIGH,
        depth_farthest=LIDAR_METRES,
    )


def _color_folder(archive: ScanArchive, folder: str) -> str | None:
    return next((kind for kind in COLOR_FOLDERS if images_in(archive, f"{folder}{kind}/")), None)


def _time(path: str) -> float | None:
    match = STAMP.fullmatch(path)
    return float(match[1]) if match else None


def _stamped(paths: list[str]) -> _Stamped:
    pairs = sorted((time, path) for path in paths if (time := _time(path)) is not None)
    return [time for time, _ in pairs], [path for _, path in pairs]


def _at(stamped: _Stamped, time: float, tolerance: float) -> str | None:
    index = nearest(stamped[0], time, tolerance)
    return None if index is None else stamped[1][index]


def _track(reader: ScanReader, name: str) -> Track:
    poses = []
    for line in list_lines(reader, name):
        values = parse_numbers(line)
        if values is None or len(values) != 7 or not all(map(math.isfinite, values)):
            message = f"a line does not hold 7 numbers: {line[:80]!r}"
            reader.findings.error("bad_list", name, message, "write seconds rx ry rz tx ty tz in each line")
            continue
        world_to_camera = from_rotation_vector(values[1:4], values[4:7])
        pose = reader.pose([value for row in world_to_camera for value in row], f"{name}: {values[0]:f}")
        if pose is not None:
            poses.append((values[0], invert_rigid(pose)))
    poses.sort(key=lambda pose: pose[0])
    return Track([time for time, _ in poses], [pose for _, pose in poses], gap=POSE_GAP, tolerance=SAME_TIME)


def _camera(reader: ScanReader, name: str) -> Intrinsics | None:
    words = (reader.text(name) or "").split()
    values = parse_numbers(" ".join(words[2:]))
    size = parse_size(*words[:2]) if len(words) == 6 else None
    if size is None or values is None or len(values) != 4:
        remedy = "write width height fx fy cx cy"
        reader.findings.error("bad_intrinsics", name, "describes no camera", remedy)
        return None
    half = OPENCV_OFFSET * size[0] / SENSOR_WIDTH
    return reader.intrinsics((values[0], values[1], values[2] + half, values[3] + half), size, name)

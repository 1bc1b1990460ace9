"""TUM RGB-D: `rgb.txt` and `depth.txt` list `timestamp path`, `groundtruth.txt` lists `timestamp tx ty tz qx qy qz qw`.

Poses are camera-to-world, OpenCV axes, metres; 5000 units of depth are a metre; depth is registered to color. The three
streams are not synchronous: an image gets the nearest depth image within 0.02 s, and the pose at its own time where
poses come faster than every 0.02 s (motion capture), else the nearest one within 0.02 s (poses of the frames).
Intrinsics are not in the folder: `camera-intrinsics.txt` (3x3) may state them; else the lists' comments name the
recording (`# file: 'rgbd_dataset_freiburg1_desk.bag'`) and so the camera with its distortion; else they are the
driver's default. Principal points count the first pixel's centre as (0, 0). The world's z axis points up.
"""

from __future__ import annotations

import math
import re

from advtex_scan.archive import ScanArchive
from advtex_scan.layouts._mesh_choice import choose_mesh
from advtex_scan.layouts._reader import Match, ScanReader, parse_numbers
from advtex_scan.layouts._sequences import (
    CAMERA_FILE,
    PRIMESENSE,
    Pinhole,
    Track,
    by_name,
    fitted,
    folder_of,
    frame_name,
    list_lines,
    nearest,
)
from advtex_scan.manifest import Distortion, FrameEntry, Intrinsics, Matrix4, ScanManifest
from advtex_scan.matrices import from_quaternion

NAME = "tum"
COLOR_LIST, DEPTH_LIST, POSE_LIST = "rgb.txt", "depth.txt", "groundtruth.txt"
DEPTH_SCALE = 5000.0
SAME_TIME = 0.02  # seconds; frames are 0.033 s apart
UNIT_TOLERANCE = 0.01  # of a quaternion's length; four printed digits give 1e-4
CAMERAS = {  # those of freiburg3 were undistorted by its makers
    "freiburg1": Pinhole(
        (517.3, 516.5, 318.6, 255.3), (640, 480), Distortion(0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
    ),
    "freiburg2": Pinhole(
        (520.9, 521.0, 325.1, 249.7), (640, 480), Distortion(0.2312, -0.7849, -0.0033, -0.0001, 0.9172)
    ),
    "freiburg3": Pinhole((535.4, 539.2, 320.1, 247.6), (640, 480)),
}
COMMENT_BYTES = 1 << 10  # at the start of a list
RECORDING = re.compile(r"#.*(freiburg[123])")


def detect(archive: ScanArchive) -> Match | None:
    """Look for `rgb.txt` and `groundtruth.txt`."""
    folder = folder_of(archive, COLOR_LIST, POSE_LIST)
    return None if folder is None else Match(0.9, f"{folder}{COLOR_LIST} and {POSE_LIST} are there")


def read(reader: ScanReader) -> ScanManifest | None:
    """Read all images of `rgb.txt` that are there and have a pose."""
    folder = folder_of(reader.archive, COLOR_LIST, POSE_LIST)
    if folder is None:
        return None
    colors = _images(reader, folder, COLOR_LIST)
    depths = _images(reader, folder, DEPTH_LIST) if folder + DEPTH_LIST in reader.archive else []
    depths = [(time, path) for time, path in depths if path in reader.archive]
    reader.used.update(path for _, path in depths)
    reader.frames_found = len(colors)
    size = reader.color_size([path for _, path in colors if path in reader.archive])
    camera = _camera(reader, folder, size)
    depth_camera = fitted(camera, reader.image_size([path for _, path in depths]))
    track = _track(reader, folder + POSE_LIST)
    times = [time for time, _ in depths]
    frames = []
    for time, path in colors:
        pose = _pose(reader, track, time, path)
        if pose is None or camera is None:
            continue
        index = nearest(times, time, SAME_TIME)
        depth = None if index is None else depths[index][1]
        frames.append(FrameEntry(frame_name(path), path, depth, pose, camera, depth_camera))
    return ScanManifest(
        layout=NAME,
        frames=by_name(frames),
        mesh=choose_mesh(reader, ("mesh.ply",)),
        depth_scale=DEPTH_SCALE,
    )


def _images(reader: ScanReader, folder: str, name: str) -> list[tuple[float, str]]:
    """Return time and path of each line, by time."""
    entries = []
    for line in list_lines(reader, folder + name):
        words = line.split(maxsplit=1)
        time = parse_numbers(words[0])
        if len(words) != 2 or time is None or len(time) != 1 or not math.isfinite(time[0]):
            message = f"a line is no time and path: {line[:80]!r}"
            reader.findings.error("bad_list", folder + name, message, "write a time in seconds and a path in each line")
            continue
        entries.append((time[0], folder + words[1].removeprefix("./")))
    return sorted(entries)


def _track(reader: ScanReader, name: str) -> Track:
    poses = []
    for line in list_lines(reader, name):
        values = parse_numbers(line)
        if values is None or len(values) != 8 or not math.isfinite(values[0]):
            remedy = "write timestamp tx ty tz qx qy qz qw in each line"
            reader.findings.error("bad_list", name, f"a line does not hold 8 numbers: {line[:80]!r}", remedy)
            continue
        time, quaternion = values[0], values[4:8]
        length = math.hypot(*quaternion)
        if not all(map(math.isfinite, values)) or length == 0:
            continue  # tracking was lost; the images near this time find no pose
        if abs(length - 1) > UNIT_TOLERANCE:
            message = f"the quaternion at {time:f} has the length {length:.3g}, not 1"
            reader.findings.error("bad_pose", name, message, "write unit quaternions, qx qy qz qw")
            continue
        x, y, z, w = (value / length for value in quaternion)
        poses.append((time, from_quaternion(x, y, z, w, values[1:4])))
    poses.sort(key=lambda pose: pose[0])
    return Track([time for time, _ in poses], [pose for _, pose in poses], gap=SAME_TIME, tolerance=SAME_TIME)


def _pose(reader: ScanReader, track: Track, time: float, path: str) -> Matrix4 | None:
    """Return the pose of an image; None, counted as dropped, if there is no image or no pose."""
    if path not in reader.archive:
        remedy = f"add the image, or take its line out of {COLOR_LIST}"
        reader.drop("missing_color", path, "is listed but not there; the frame is left out", remedy)
        return None
    reader.used.add(path)
    pose = track.at(time)
    if pose is None:
        message = f"has no pose within {SAME_TIME:g} s; the frame is left out"
        reader.drop("missing_pose", path, message, f"nothing to do unless {POSE_LIST} should cover it")
    return pose


def _camera(reader: ScanReader, folder: str, size: tuple[int, int] | None) -> Intrinsics | None:
    if size is None:
        return None
    if folder + CAMERA_FILE in reader.archive:
        return reader.matrix_intrinsics(folder + CAMERA_FILE, size)
    for name in (COLOR_LIST, POSE_LIST):
        match = RECORDING.search(reader.archive.head(folder + name, COMMENT_BYTES).decode("utf-8", "replace"))
        if match:
            return CAMERAS[match[1]].intrinsics()
    message = "no file states the camera; the default of such sensors is taken (f = 525 at 640x480)"
    reader.findings.warning("default_camera", "", message, f"add {CAMERA_FILE} with the 3x3 matrix")
    return PRIMESENSE.intrinsics()

"""SUN3D: `image/0000001-000000000000.jpg`, `depth/0000001-000000000000.png`, `extrinsics/*.txt`, `intrinsics.txt`.

File names hold the frame's number and its time in microseconds. The last file in `extrinsics/` holds the three upper
rows of one camera-to-world matrix per image, in order; OpenCV axes, metres. An image gets the depth image nearest in
time. Depth is in millimetres with its bits rotated left by three and registered to color. Intrinsics are 3x3 and count
the first pixel's centre as (0, 0). Mesh: mesh.ply, else the one mesh that is there.
"""

from __future__ import annotations

import re
from pathlib import PurePosixPath

from advtex_scan.archive import ScanArchive
from advtex_scan.layouts._mesh_choice import choose_mesh
from advtex_scan.layouts._reader import Match, ScanReader, parse_numbers
from advtex_scan.layouts._sequences import LIST_LIMIT, by_name, fitted, frame_name, images_in, nearest
from advtex_scan.manifest import FrameEntry, ScanManifest
from advtex_scan.matrices import up_axis_of

NAME = "sun3d"
COLOR_FOLDER, DEPTH_FOLDER, POSE_FOLDER = "image/", "depth/", "extrinsics/"
CAMERA_FILE = "intrinsics.txt"
STAMP = re.compile(r"[0-9]{1,18}-([0-9]{1,18})\.\w+")
SAME_TIME = 100_000  # microseconds; three frames, as the sensor sometimes loses one
POSE_NUMBERS = 12


def detect(archive: ScanArchive) -> Match | None:
    """Look for `image/`, `extrinsics/` with text files, and `intrinsics.txt`."""
    sound = CAMERA_FILE in archive and _pose_file(archive) and images_in(archive, COLOR_FOLDER)
    return Match(0.85, f"there are {COLOR_FOLDER}, {POSE_FOLDER} and {CAMERA_FILE}") if sound else None


def read(reader: ScanReader) -> ScanManifest | None:
    """Read all images with a pose."""
    pose_file = _pose_file(reader.archive)
    if pose_file is None:
        return None
    colors, depths = images_in(reader.archive, COLOR_FOLDER), images_in(reader.archive, DEPTH_FOLDER)
    reader.frames_found = len(colors)
    reader.used.update(colors, depths, (name for name in reader.archive.names() if name.startswith(POSE_FOLDER)))
    camera = reader.matrix_intrinsics(CAMERA_FILE, reader.color_size([*colors]))
    depth_camera = fitted(camera, reader.image_size([*depths]))
    poses = _poses(reader, pose_file)
    frames = []
    stamped = sorted((time, path) for path in depths if (time := _time(path)) is not None)
    times = [time for time, _ in stamped]
    for place, color in enumerate(colors):
        if place >= len(poses):
            message = f"is beyond the {len(poses)} poses in {pose_file}; the frame is left out"
            reader.drop("missing_pose", color, message, "copy the file again from the data set")
            continue
        pose = reader.pose(poses[place], f"{pose_file}: pose {place}")
        if pose is None or camera is None:
            continue
        time = _time(color)
        index = None if time is None else nearest(times, time, SAME_TIME)
        depth = None if index is None else stamped[index][1]
        frames.append(FrameEntry(frame_name(color), color, depth, pose, camera, depth_camera))
    return ScanManifest(
        layout=NAME,
        frames=by_name(frames),
        mesh=choose_mesh(reader, ("mesh.ply",)),
        up_axis=up_axis_of(frame.camera_to_world for frame in frames),
        depth_rotated=True,
    )


def _pose_file(archive: ScanArchive) -> str | None:
    """Return the newest one: their names are times."""
    files = [name for name in archive.names() if name.startswith(POSE_FOLDER) and name.endswith(".txt")]
    return files[-1] if files else None


def _time(path: str) -> int | None:
    match = STAMP.fullmatch(PurePosixPath(path).name)
    return int(match[1]) if match else None


def _poses(reader: ScanReader, name: str) -> list[list[float]]:
    values = parse_numbers(reader.text(name, LIST_LIMIT) or "")
    if not values or len(values) % POSE_NUMBERS:
        remedy = "write three rows of four numbers for each image"
        reader.findings.error("bad_numbers", name, "does not hold 3x4 matrices", remedy)
        return []
    return [values[start : start + POSE_NUMBERS] for start in range(0, len(values), POSE_NUMBERS)]

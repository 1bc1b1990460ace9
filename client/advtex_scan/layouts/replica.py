"""Replica as rendered for NICE-SLAM: `results/frame000000.jpg`, `results/depth000000.png` and `traj.txt`.

`traj.txt` holds a camera-to-world matrix in each line, row by row; OpenCV axes, metres, z up. `cam_params.json`, beside
it or one folder up, holds {"camera": {"w", "h", "fx", "fy", "cx", "cy", "scale"}}, scale being the depth units per
metre; without it the data set's own values are taken. Principal points count the first pixel's centre as (0, 0).
Mesh: mesh.ply, else the one mesh that is there (`room0_mesh.ply` lies one folder up).
"""

from __future__ import annotations

import math
import re

from advtex_scan.archive import ScanArchive
from advtex_scan.layouts._json import json_numbers, json_object, json_size
from advtex_scan.layouts._mesh_choice import choose_mesh
from advtex_scan.layouts._reader import Match, ScanReader, parse_numbers
from advtex_scan.layouts._sequences import (
    Pinhole,
    by_name,
    by_place,
    fitted,
    folder_of,
    frame_name,
    images_in,
    list_lines,
    number_of,
)
from advtex_scan.manifest import FrameEntry, Intrinsics, Matrix4, ScanManifest

NAME = "replica"
POSE_FILE, CAMERA_FILE = "traj.txt", "cam_params.json"
FRAME = re.compile(r".*/frame\d+\.\w+")
DEPTH = re.compile(r".*/depth\d+\.\w+")
CAMERA = Pinhole((600.0, 600.0, 599.5, 339.5), (1200, 680))
DEPTH_SCALE = 6553.5


def detect(archive: ScanArchive) -> Match | None:
    """Look for `traj.txt` beside `results/frame*`."""
    folder = folder_of(archive, POSE_FILE)
    if folder is None or not _images(archive, folder, FRAME):
        return None
    return Match(0.9, f"{folder}{POSE_FILE} and {folder}results/frame* are there")


def read(reader: ScanReader) -> ScanManifest | None:
    """Read all images with a pose."""
    folder = folder_of(reader.archive, POSE_FILE)
    if folder is None:
        return None
    colors, depths = _images(reader.archive, folder, FRAME), _images(reader.archive, folder, DEPTH)
    reader.frames_found = len(colors)
    reader.used.update(colors, depths)
    poses = _poses(reader, folder + POSE_FILE)
    camera, scale = _camera(reader, folder)
    depth_camera = fitted(camera, reader.image_size([*depths]))
    by_number = {number_of(depth): depth for depth in depths}
    frames = []
    for color, place in zip(colors, by_place(colors, poses), strict=True):
        if place is None:
            message = f"has no line in {POSE_FILE}; the frame is left out"
            reader.drop("missing_pose", color, message, "copy the file again from the data set")
            continue
        pose = poses[place]
        if pose is not None and camera is not None:
            depth = by_number.get(number_of(color))
            frames.append(FrameEntry(frame_name(color), color, depth, pose, camera, depth_camera))
    return ScanManifest(layout=NAME, frames=by_name(frames), mesh=choose_mesh(reader, ("mesh.ply",)), depth_scale=scale)


def _images(archive: ScanArchive, folder: str, kind: re.Pattern[str]) -> list[str]:
    return [name for name in images_in(archive, f"{folder}results/") if kind.fullmatch(name)]


def _poses(reader: ScanReader, name: str) -> dict[int, Matrix4 | None]:
    poses: dict[int, Matrix4 | None] = {}
    for place, line in enumerate(list_lines(reader, name)):
        values = parse_numbers(line)
        if values is None or len(values) != 16:
            message = f"line {place + 1} does not hold 16 numbers"
            reader.findings.error("bad_numbers", name, message, "write one 4x4 matrix in each line")
        poses[place] = reader.pose(values, f"{name}: {place + 1}") if values and len(values) == 16 else None
    return poses


def _camera(reader: ScanReader, folder: str) -> tuple[Intrinsics | None, float]:
    """Return the camera, and how many depth units a metre has."""
    above = folder.rpartition("/")[0].rpartition("/")[0]
    candidates = (folder + CAMERA_FILE, f"{above}/{CAMERA_FILE}" if above else CAMERA_FILE)
    name = next((name for name in candidates if name in reader.archive), None)
    if name is None:
        message = f"there is no {CAMERA_FILE}; the data set's own camera is taken (f = 600 at 1200x680)"
        reader.findings.warning("default_camera", "", message, f"add {CAMERA_FILE} if it was rendered otherwise")
        return CAMERA.intrinsics(), DEPTH_SCALE
    value = (json_object(reader, name) or {}).get("camera")
    given = value if isinstance(value, dict) else {}
    numbers = json_numbers([given.get(key) for key in ("fx", "fy", "cx", "cy", "scale")], 5)
    size = json_size(given.get("w"), given.get("h"))
    if numbers is None or size is None or not 0 < numbers[4] < math.inf:
        remedy = 'write {"camera": {"w", "h", "fx", "fy", "cx", "cy", "scale"}}'
        reader.findings.error("bad_intrinsics", name, "describes no camera", remedy)
        return None, DEPTH_SCALE
    fx, fy, cx, cy, scale = numbers
    return reader.opencv_intrinsics((fx, fy, cx, cy), size, name), scale

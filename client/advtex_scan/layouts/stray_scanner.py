"""Stray Scanner: `rgb.mp4`, `odometry.csv`, `camera_matrix.csv`, `depth/000000.png`, `confidence/000000.png`.

`odometry.csv` has a head line and then, for each frame, its number in the video, its place x, y, z and the quaternion
qx, qy, qz, qw: camera-to-world, and since the app turns the camera by 180 degrees about x itself, OpenCV axes. Newer
captures add fx, fy, cx, cy of each frame; otherwise `camera_matrix.csv` (3x3, for the video's size) holds for all.
Depth is in millimetres (older captures: `.npy`); confidence is 0 to 2. The app makes no mesh.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from advtex_scan._packed import read_npy_header
from advtex_scan.archive import ScanArchive
from advtex_scan.errors import ScanFormatError
from advtex_scan.layouts._arkit import CONFIDENCE_HIGH, LIDAR_METRES, UP_AXIS
from advtex_scan.layouts._mesh_choice import choose_mesh
from advtex_scan.layouts._reader import Match, ScanReader, parse_numbers
from advtex_scan.layouts._sequences import by_name, fitted, list_lines
from advtex_scan.manifest import ByteRange, FileRef, FrameEntry, Intrinsics, Matrix4, ScanManifest, VideoFrame
from advtex_scan.matrices import from_quaternion

NAME = "stray_scanner"
VIDEO_FILE, POSE_FILE, CAMERA_FILE = "rgb.mp4", "odometry.csv", "camera_matrix.csv"
IMAGE = re.compile(r"(depth|confidence)/(\d{1,9})\.(png|npy)")
POSE_KEYS = ("x", "y", "z", "qx", "qy", "qz", "qw")
CAMERA_KEYS = ("fx", "fy", "cx", "cy")


@dataclass(frozen=True, slots=True)
class _Images:
    """Depth and confidence images by frame, and the size of the depth images."""

    depth: Mapping[int, str]
    confidence: Mapping[int, str]
    size: tuple[int, int] | None


def detect(archive: ScanArchive) -> Match | None:
    """Look for `rgb.mp4` with `odometry.csv`."""
    if VIDEO_FILE not in archive or POSE_FILE not in archive:
        return None
    return Match(0.95, f"{VIDEO_FILE} and {POSE_FILE} are there")


def read(reader: ScanReader) -> ScanManifest | None:
    """Read all pictures of the video with a pose."""
    video = reader.video(VIDEO_FILE)
    rows = _rows(reader)
    if video is None:
        reader.frames_found = len(rows)
        return None
    reader.frames_found = video.frames
    size = (video.width, video.height)
    common = _common_camera(reader, size) if CAMERA_FILE in reader.archive else None
    images = _images(reader)
    entries = [_frame(reader, number, row, common, size, images) for number, row in rows.items()]
    unposed = video.frames - len([number for number in rows if number < video.frames])
    if unposed:
        reader.dropped["missing_pose"] += unposed
        message = f"{unposed} of {video.frames} pictures have no pose in {POSE_FILE} and are left out"
        reader.findings.info("missing_pose", VIDEO_FILE, message)
    return ScanManifest(
        layout=NAME,
        frames=by_name(entry for entry in entries if entry),
        mesh=choose_mesh(reader, ("mesh.ply",)),
        up_axis=UP_AXIS,
        confidence_max=CONFIDENCE_HIGH,
        depth_farthest=LIDAR_METRES,
    )


def _rows(reader: ScanReader) -> dict[int, dict[str, str]]:
    """Return what the list says of each frame, by its number."""
    lines = [[word.strip() for word in line.split(",")] for line in list_lines(reader, POSE_FILE)]
    head = lines[0] if lines else []
    if not {"frame", *POSE_KEYS} <= set(head):
        message = f"its first line does not name the columns frame, {', '.join(POSE_KEYS)}"
        reader.findings.error("bad_list", POSE_FILE, message, "export the capture again")
        return {}
    rows: dict[int, dict[str, str]] = {}
    for place, words in enumerate(lines[1:], start=2):
        row = dict(zip(head, words, strict=False))
        number = row.get("frame", "")
        if not (number.isascii() and number.isdecimal() and len(number) <= 9):
            message = f"line {place} does not begin with a time and a frame's number"
            reader.drop("bad_line", POSE_FILE, message, "export the capture again")
        else:
            rows.setdefault(int(number), row)
    return dict(sorted(rows.items()))


def _frame(
    reader: ScanReader,
    number: int,
    row: Mapping[str, str],
    common: Intrinsics | None,
    size: tuple[int, int],
    images: _Images,
) -> FrameEntry | None:
    pose, camera = _pose(reader, number, row), _camera(reader, number, row, common, size)
    if pose is None or camera is None:
        return None
    return FrameEntry(
        name=f"{number:06d}",
        color=VideoFrame(VIDEO_FILE, number),
        depth=_depth(reader, images.depth.get(number)),
        camera_to_world=pose,
        color_intrinsics=camera,
        depth_intrinsics=fitted(camera, images.size),
        confidence=images.confidence.get(number),
    )


def _pose(reader: ScanReader, number: int, row: Mapping[str, str]) -> Matrix4 | None:
    values = parse_numbers(" ".join(row.get(key, "") for key in POSE_KEYS))
    if values is None or len(values) != len(POSE_KEYS):
        message = "has no place and quaternion; the frame is left out"
        reader.drop("missing_pose", f"{POSE_FILE}: frame {number}", message, "export the capture again")
        return None
    pose = from_quaternion(values[3], values[4], values[5], values[6], values[:3])
    return reader.pose([value for line in pose for value in line], f"{POSE_FILE}: frame {number}")


def _common_camera(reader: ScanReader, size: tuple[int, int]) -> Intrinsics | None:
    K = reader.numbers(CAMERA_FILE, (9,))
    return reader.intrinsics((K[0], K[4], K[2], K[5]), size, CAMERA_FILE) if K else None


def _camera(
    reader: ScanReader, number: int, row: Mapping[str, str], common: Intrinsics | None, size: tuple[int, int]
) -> Intrinsics | None:
    values = parse_numbers(" ".join(row.get(key, "") for key in CAMERA_KEYS))
    if values and len(values) == len(CAMERA_KEYS):
        return reader.intrinsics((values[0], values[1], values[2], values[3]), size, f"{POSE_FILE}: frame {number}")
    if common is None and not reader.findings.count("bad_numbers") + reader.findings.count("bad_intrinsics"):
        remedy = f"add {CAMERA_FILE} with the 3x3 matrix"
        reader.findings.error("no_color_intrinsics", POSE_FILE, "there are no color intrinsics", remedy)
    return common


def _images(reader: ScanReader) -> _Images:
    found: dict[str, dict[int, str]] = {"depth": {}, "confidence": {}}
    for name in reader.archive.names():
        match = IMAGE.fullmatch(name)
        if match and (match[3] == "png" or match[1] == "depth"):
            reader.used.add(name)
            found[match[1]].setdefault(int(match[2]), name)
    depths = [*found["depth"].values()]
    size = reader.image_size([name for name in depths if name.endswith(".png")])
    if size is None and depths:
        try:
            header = read_npy_header(reader.archive, depths[0])
            size = header.width, header.height
        except ScanFormatError as error:
            reader.findings.extend(error.findings)
    return _Images(found["depth"], found["confidence"], size)


def _depth(reader: ScanReader, name: str | None) -> FileRef | None:
    if name is None or name.endswith(".png"):
        return name
    return ByteRange(name, 0, reader.archive.size(name), "npy")

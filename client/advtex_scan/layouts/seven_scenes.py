"""7-Scenes, BundleFusion and 3DMatch: `frame-000000.color.jpg|png`, `.depth.png`, `.pose.txt`.

Poses are camera-to-world in metres, OpenCV axes. Intrinsics, first match wins:
  color   color-intrinsics.txt, color-intrinsics-estimated.txt, camera-intrinsics.color.txt, info.txt,
          camera-intrinsics.txt
  depth   depth-intrinsics.txt, camera-intrinsics.depth.txt, info.txt, camera-intrinsics.txt, else as the color camera
If depth-to-color.txt or depth-to-color-estimated.txt is there (depth-camera to color-camera coordinates, 4x4), the
poses are the depth camera's; otherwise color is taken as registered to depth. Files count the first pixel's centre as
(0, 0). Mesh: mesh.ply, else the one mesh that is there.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

from advtex_scan.archive import ScanArchive
from advtex_scan.layouts._mesh_choice import choose_mesh
from advtex_scan.layouts._reader import Match, ScanReader, parse_numbers, parse_settings, parse_size
from advtex_scan.manifest import IDENTITY, FrameEntry, Intrinsics, Matrix4, ScanManifest
from advtex_scan.matrices import compose, invert_rigid, says_nothing, up_axis_of

NAME = "seven_scenes"
FRAME = re.compile(r"((?:.*/)?frame-\d+)\.(color|depth|pose)\.(jpg|jpeg|png|txt)")
COLOR_FILES = ("color-intrinsics.txt", "color-intrinsics-estimated.txt", "camera-intrinsics.color.txt")
DEPTH_FILES = ("depth-intrinsics.txt", "camera-intrinsics.depth.txt")
COMMON_FILE = "camera-intrinsics.txt"
INFO_FILE = "info.txt"
TRANSFORM_FILES = ("depth-to-color.txt", "depth-to-color-estimated.txt")


@dataclass
class _Frame:
    files: dict[str, str] = field(default_factory=dict)  # "color", "depth", "pose" -> path


def detect(archive: ScanArchive) -> Match | None:
    """Look for any `frame-NNNNNN.color.*`."""
    found = sum(1 for frame in _frames(archive).values() if "color" in frame.files)
    return Match(0.9, f"{found} files are named frame-NNNNNN.color.*") if found else None


def read(reader: ScanReader) -> ScanManifest | None:
    """Read all frames with color and pose."""
    frames = _frames(reader.archive)
    reader.frames_found = len(frames)
    colors = [frame.files["color"] for frame in frames.values() if "color" in frame.files]
    depths = [frame.files["depth"] for frame in frames.values() if "depth" in frame.files]
    info = _info(reader)
    color_size, depth_size = reader.color_size([*colors]), reader.image_size([*depths])
    color = _camera(reader, info, "Color", COLOR_FILES, color_size)
    depth = _camera(reader, info, "Depth", DEPTH_FILES, depth_size)
    if depth is None and color is not None and depth_size == (color.width, color.height):
        message = "there are no depth intrinsics; depth is taken to be registered to color"
        reader.findings.info("depth_as_color", "", message)
        depth = color
    if color is None and color_size and not reader.findings.count("bad_intrinsics"):
        remedy = f"add {COLOR_FILES[0]} or {COMMON_FILE} with the 3x3 matrix"
        reader.findings.error("no_color_intrinsics", "", "there are no color intrinsics", remedy)
    depth_to_color = _depth_to_color(reader)
    if depth_to_color is None:
        _check_extrinsics(reader, info)
    entries = [_entry(reader, name, frame, color, depth, depth_to_color) for name, frame in frames.items()]
    usable = tuple(entry for entry in entries if entry)
    return ScanManifest(
        layout=NAME,
        frames=usable,
        mesh=choose_mesh(reader, ("mesh.ply",)),
        up_axis=up_axis_of(frame.camera_to_world for frame in usable),
        depth_scale=_depth_scale(reader, info),
        depth_to_color=depth_to_color or IDENTITY,
    )


def _frames(archive: ScanArchive) -> dict[str, _Frame]:
    frames: dict[str, _Frame] = {}
    for name in archive.names():
        match = FRAME.fullmatch(name)
        if match and (match[3] == "txt") == (match[2] == "pose"):
            frames.setdefault(match[1], _Frame()).files.setdefault(match[2], name)
    return dict(sorted(frames.items()))


def _entry(
    reader: ScanReader,
    name: str,
    frame: _Frame,
    color: Intrinsics | None,
    depth: Intrinsics | None,
    depth_to_color: Matrix4 | None,
) -> FrameEntry | None:
    reader.used.update(frame.files.values())
    if "color" not in frame.files:
        remedy = "add the image, or remove the frame's other files"
        reader.drop("missing_color", name, "has no color image; the frame is left out", remedy)
        return None
    if "pose" not in frame.files:
        remedy = "add the frame's .pose.txt, or remove the frame"
        reader.drop("missing_pose", name, "has no pose; the frame is left out", remedy)
        return None
    pose = reader.pose_file(frame.files["pose"])
    if pose is None or color is None:
        return None
    if depth_to_color is not None:
        pose = compose(pose, invert_rigid(depth_to_color))
    return FrameEntry(name, frame.files["color"], frame.files.get("depth"), pose, color, depth)


def _info(reader: ScanReader) -> dict[str, str]:
    text = reader.text(INFO_FILE) if INFO_FILE in reader.archive else None
    return parse_settings(text) if text else {}


def _camera(
    reader: ScanReader, info: dict[str, str], kind: str, files: tuple[str, ...], size: tuple[int, int] | None
) -> Intrinsics | None:
    """Return intrinsics of the "Color" or "Depth" camera for images of `size`."""
    if size is None:
        return None
    for name in files:
        if name in reader.archive:
            return reader.matrix_intrinsics(name, size)
    values = parse_numbers(info.get(f"m_calibration{kind}Intrinsic", ""))
    if values and len(values) == 16:
        stated = parse_size(info.get(f"m_{kind.lower()}Width", ""), info.get(f"m_{kind.lower()}Height", ""))
        return reader.opencv_intrinsics((values[0], values[5], values[2], values[6]), stated or size, INFO_FILE)
    return reader.matrix_intrinsics(COMMON_FILE, size) if COMMON_FILE in reader.archive else None


def _depth_to_color(reader: ScanReader) -> Matrix4 | None:
    for name in TRANSFORM_FILES:
        if name in reader.archive:
            return reader.rigid_file(name)
    return None


def _check_extrinsics(reader: ScanReader, info: dict[str, str]) -> None:
    for key in ("m_calibrationColorExtrinsic", "m_calibrationDepthExtrinsic"):
        values = parse_numbers(info.get(key, ""))
        if values is None or len(values) not in (0, 16):
            message = f"{key} does not hold 16 numbers and is ignored"
        elif values and not says_nothing(values):
            message = f"{key} is not the identity and is ignored"
        else:
            continue
        remedy = f"state where the color camera is in {TRANSFORM_FILES[0]}"
        reader.findings.warning("extrinsic_ignored", INFO_FILE, message, remedy)


def _depth_scale(reader: ScanReader, info: dict[str, str]) -> float:
    values = parse_numbers(info.get("m_depthShift", "1000"))
    if values and len(values) == 1 and 0 < values[0] < float("inf"):
        return values[0]
    reader.findings.error("bad_value", INFO_FILE, "m_depthShift is no positive number", "1000 stands for millimetres")
    return 1000.0

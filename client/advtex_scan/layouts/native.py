"""advtex's own layout: `scan.json` beside the files that it names. Every path is relative to `scan.json`.

    {
      "version": 1,
      "kind": "object" | "scene",                  optional, default "scene"
      "up_axis": "+x" | "-x" | ... | "-z",         optional, default "+z"; the world direction that points up
      "depth_scale": 1000,                         optional; stored depth units per metre; 0 and 65535 are no reading
      "color_intrinsics": INTRINSICS,              here or in each frame
      "depth_intrinsics": INTRINSICS,              here or in each frame, where frames have depth
      "depth_to_color": MATRIX,                    optional; depth-camera to color-camera coordinates
      "mesh": "mesh.ply",                          optional where frames have depth: it is fused from that
      "mesh_to_world": MATRIX,                     optional; the mesh's coordinates to the poses' world
      "mesh_refinement": "none" | "rigid" | "scaled",  optional, default "none"; how the mesh, roughly placed (a CAD
                                                   model), is moved onto the depth images: rigidly, or scaled too
      "confidence_max": 255,                       optional; the value in confidence images that means full trust
      "frames": [
        {
          "name": "000000",                        optional, default the frame's number in six digits; orders the frames
          "color": "color/0.jpg",
          "depth": "depth/0.png",                  optional; 16-bit gray PNG
          "confidence": "confidence/0.png",        optional; 8-bit gray PNG of the depth image's size
          "mask": "mask/0.png",                    optional; 8-bit image of the color image's size, 0 = not to be used
          "camera_to_world": MATRIX,               of the color camera; OpenCV axes, metres
          "color_intrinsics": INTRINSICS,          optional, in place of the common ones
          "depth_intrinsics": INTRINSICS           likewise
        }
      ]
    }

INTRINSICS is {"fx", "fy", "cx", "cy", "width", "height"} in pixels; the centre of the first pixel is (0.5, 0.5). For
images that still have their lens's distortion, it holds {"k1", "k2", "p1", "p2", "k3"} as well, as OpenCV counts them.
MATRIX is 4 rows of 4 numbers, or the same 16 numbers in one list. A pose of only NaN or infinities drops its frame;
since JSON has no such numbers, null is read as NaN.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, cast, get_args

from advtex_scan.archive import ScanArchive
from advtex_scan.layouts._json import json_number, json_object
from advtex_scan.layouts._reader import Match, ScanReader
from advtex_scan.manifest import (
    IDENTITY,
    Distortion,
    FrameEntry,
    Intrinsics,
    Matrix4,
    MeshEntry,
    MeshRefinement,
    ScanKind,
    ScanManifest,
    UpAxis,
)
from advtex_scan.matrices import matrix4, pose_problem

NAME = "native"
FILE = "scan.json"
VERSION = 1
MAX_FRAMES = 100_000
CAMERAS = ("color_intrinsics", "depth_intrinsics")
TRANSFORMS = ("depth_to_color", "mesh_to_world")
SCAN_KEYS = {
    *("version", "kind", "up_axis", "depth_scale", "confidence_max", "mesh", "mesh_refinement", "frames"),
    *CAMERAS,
    *TRANSFORMS,
}
IMAGES = ("depth", "confidence", "mask")
FRAME_KEYS = {"name", "color", "camera_to_world", *IMAGES, *CAMERAS}
INTRINSICS_KEYS = ("fx", "fy", "cx", "cy", "width", "height")
DISTORTION_KEYS = ("k1", "k2", "p1", "p2", "k3")
Json = Mapping[str, Any]


def detect(archive: ScanArchive) -> Match | None:
    """Look for a `scan.json` beside or above everything else."""
    return Match(1.0, f"{FILE} is there") if FILE in archive else None


def read(reader: ScanReader) -> ScanManifest | None:
    """Read the manifest that `scan.json` describes; None if it is no JSON object of version 1."""
    scan = _load(reader)
    if scan is None:
        return None
    _unknown_keys(reader, scan, SCAN_KEYS, FILE)
    frames = scan.get("frames")
    if not isinstance(frames, list):
        reader.findings.error("bad_value", f"{FILE}: frames", "is missing or no list", "list the frames")
        frames = []
    if len(frames) > MAX_FRAMES:
        message = f"lists {len(frames)} frames; at most {MAX_FRAMES} are accepted"
        reader.findings.error("too_many_frames", FILE, message, "split the scan")
        frames = []
    common = {kind: _intrinsics(reader, scan[kind], kind) for kind in CAMERAS if scan.get(kind) is not None}
    reader.frames_found = len(frames)
    entries = [_frame(reader, frame, index, common) for index, frame in enumerate(frames)]
    transforms = {key: _rigid(reader, scan[key], key) for key in TRANSFORMS if scan.get(key) is not None}
    return ScanManifest(
        layout=NAME,
        frames=tuple(sorted((entry for entry in entries if entry), key=lambda entry: entry.name)),
        mesh=_mesh(reader, scan, transforms.get("mesh_to_world") or IDENTITY),
        kind=cast(ScanKind, _choice(reader, scan, "kind", "scene", get_args(ScanKind))),
        up_axis=cast(UpAxis, _choice(reader, scan, "up_axis", "+z", get_args(UpAxis))),
        depth_scale=_positive(reader, scan.get("depth_scale", 1000.0), "depth_scale"),
        depth_to_color=transforms.get("depth_to_color") or IDENTITY,
        confidence_max=_byte(reader, scan.get("confidence_max", 255), "confidence_max"),
    )


def _load(reader: ScanReader) -> Json | None:
    scan = json_object(reader, FILE, "write it with a JSON library, as documented")
    if scan is None:
        return None
    if scan.get("version") != VERSION:
        message = f"states version {str(scan.get('version'))[:20]}; this program reads version {VERSION}"
        reader.findings.error("bad_version", FILE, message, f'write "version": {VERSION}')
        return None
    return scan


def _frame(reader: ScanReader, frame: Any, index: int, common: Mapping[str, Intrinsics | None]) -> FrameEntry | None:
    where = f"{FILE}: frames[{index}]"
    if not isinstance(frame, dict):
        reader.findings.error("bad_value", where, "is no object", "give color and camera_to_world")
        return None
    _unknown_keys(reader, frame, FRAME_KEYS, where)
    color = _path(reader, frame.get("color"), f"{where}.color")
    images = {kind: _path(reader, frame[kind], f"{where}.{kind}") for kind in IMAGES if frame.get(kind) is not None}
    pose = _pose(reader, frame.get("camera_to_world"), f"{where}.camera_to_world")
    given = [kind for kind in CAMERAS if frame.get(kind) is not None]
    cameras = {**common, **{kind: _intrinsics(reader, frame[kind], f"frames[{index}].{kind}") for kind in given}}
    if "color_intrinsics" not in cameras:
        remedy = "give color_intrinsics once at the top or in each frame"
        reader.findings.error("no_color_intrinsics", where, "has no color_intrinsics", remedy)
    if "depth_intrinsics" in cameras and cameras["depth_intrinsics"] is None:
        images["depth"] = None  # given, but found wrong and reported above
    name = frame.get("name", f"{index:06d}")
    if not isinstance(name, str) or not name.isprintable() or not 0 < len(name) <= 200:
        reader.findings.error("bad_value", f"{where}.name", "is no printable text", "give each frame a short name")
        return None
    color_camera = cameras.get("color_intrinsics")
    if color is None or pose is None or color_camera is None:
        return None
    return FrameEntry(
        name=name,
        color=color,
        depth=images.get("depth"),
        camera_to_world=pose,
        color_intrinsics=color_camera,
        depth_intrinsics=cameras.get("depth_intrinsics"),
        confidence=images.get("confidence"),
        mask=images.get("mask"),
    )


def _unknown_keys(reader: ScanReader, value: Json, known: set[str], where: str) -> None:
    unknown = sorted(str(key)[:40] for key in value if key not in known)
    if unknown:
        message = f"has unknown keys, which are ignored: {', '.join(unknown[:5])}"
        reader.findings.warning("unknown_key", where, message, "correct the spelling or remove them")


def _path(reader: ScanReader, value: Any, where: str) -> str | None:
    if not isinstance(value, str) or not value:
        reader.findings.error("bad_value", where, "is missing or no path", "give a path relative to scan.json")
        return None
    name = value.removeprefix("./")
    if name not in reader.archive:
        message = f"names {name[:200]!r}, which is not in the scan"
        reader.findings.error("missing_file", where, message, "add the file or correct the path")
        return None
    reader.used.add(name)
    return name


def _mesh(reader: ScanReader, scan: Json, mesh_to_world: Matrix4) -> MeshEntry | None:
    refinement = _choice(reader, scan, "mesh_refinement", "none", get_args(MeshRefinement))
    if scan.get("mesh") is None:
        return None  # the check reports it
    path = _path(reader, scan["mesh"], f"{FILE}: mesh")
    reader.mesh_reported = path is None
    return MeshEntry(path, mesh_to_world, cast(MeshRefinement, refinement)) if path else None


def _numbers(value: Any) -> list[float] | None:
    """Return 16 numbers from a flat or nested list; null becomes NaN."""
    if isinstance(value, list) and len(value) == 4 and all(isinstance(row, list) for row in value):
        value = [number for row in value for number in row]
    if not isinstance(value, list) or len(value) != 16:
        return None
    numbers = [math.nan if number is None else json_number(number) for number in value]
    return None if None in numbers else cast(list[float], numbers)


def _pose(reader: ScanReader, value: Any, where: str) -> Matrix4 | None:
    if value is None:
        reader.drop("missing_pose", where, "is missing; the frame is left out", "give the frame's camera_to_world")
        return None
    numbers = _numbers(value)
    if numbers is None:
        reader.findings.error("bad_value", where, "is no 4x4 matrix", "give 4 rows of 4 numbers")
        return None
    return reader.pose(numbers, where)


def _rigid(reader: ScanReader, value: Any, key: str) -> Matrix4 | None:
    numbers = _numbers(value)
    problem = pose_problem(matrix4(numbers)) if numbers else "is no 4x4 matrix"
    if numbers is None or problem:
        message = str(problem).replace("the pose", "the transform")
        reader.findings.error("bad_transform", f"{FILE}: {key}", message, "give a rigid 4x4 matrix")
        return None
    return matrix4(numbers)


def _intrinsics(reader: ScanReader, value: Any, key: str) -> Intrinsics | None:
    where = f"{FILE}: {key}"
    numbers = [json_number(value.get(name)) for name in INTRINSICS_KEYS] if isinstance(value, dict) else [None]
    sizes = numbers[4:]
    if None in numbers or not all(size and size.is_integer() and 0 < size < 1 << 20 for size in sizes):
        remedy = "give fx, fy, cx, cy, width and height in pixels"
        reader.findings.error("bad_intrinsics", where, "is no camera", remedy)
        return None
    fx, fy, cx, cy, width, height = cast(list[float], numbers)
    camera = reader.intrinsics((fx, fy, cx, cy), (int(width), int(height)), where)
    given = {name: json_number(value[name]) for name in DISTORTION_KEYS if value.get(name) is not None}
    coefficients = {name: number for name, number in given.items() if number is not None and math.isfinite(number)}
    if len(coefficients) < len(given):
        message = f"{', '.join(sorted(given.keys() - coefficients))} are no finite numbers"
        reader.findings.error("bad_intrinsics", where, message, "give the lens's coefficients as OpenCV counts them")
        return None
    return replace(camera, distortion=Distortion(**coefficients)) if camera and any(coefficients.values()) else camera


def _choice(reader: ScanReader, scan: Json, key: str, default: str, allowed: tuple[str, ...]) -> str:
    value = scan.get(key, default)
    if value in allowed:
        return str(value)
    remedy = f"choose one of {', '.join(allowed)}"
    reader.findings.error("bad_value", f"{FILE}: {key}", f"{str(value)[:40]!r} is unknown", remedy)
    return default


def _byte(reader: ScanReader, value: Any, key: str) -> int:
    if isinstance(value, int) and not isinstance(value, bool) and 0 < value < 256:
        return value
    remedy = "give the largest value in the confidence images"
    reader.findings.error("bad_value", f"{FILE}: {key}", "is no whole number from 1 to 255", remedy)
    return 255


def _positive(reader: ScanReader, value: Any, key: str) -> float:
    number = json_number(value)
    if number is not None and math.isfinite(number) and number > 0:
        return number
    reader.findings.error("bad_value", f"{FILE}: {key}", "is no positive number", "1000 stands for millimetres")
    return 1000.0

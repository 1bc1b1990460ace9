"""Polycam's raw data: `keyframes/corrected_images/<time>.jpg`, `corrected_cameras/<time>.json`, `depth/<time>.png`.

Corrected cameras come from a global optimization, and their images are undistorted with a black border; both are
absent from long captures, where `images/` and `cameras/` stand in. A camera is a JSON object: fx, fy, cx, cy, width,
height, t_00 .. t_23 (row and column of the 3x4 camera-to-world, OpenGL axes), blur_score (lower is blurrier).
Depth is in millimetres and registered to color; `confidence/<time>.png` holds 0, 127 or 255.
Mesh: `raw.glb`, whose coordinates the inverse of `alignmentTransform` in `mesh_info.json` (16 numbers, column by
column) takes to the cameras' world; else the one mesh that is there, as it stands.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from advtex_scan.archive import ScanArchive
from advtex_scan.layouts._arkit import LIDAR_METRES, UP_AXIS
from advtex_scan.layouts._json import json_number, json_numbers, json_object, json_size
from advtex_scan.layouts._mesh_choice import choose_mesh
from advtex_scan.layouts._reader import Match, ScanReader
from advtex_scan.layouts._sequences import by_name, fitted, padded
from advtex_scan.manifest import FrameEntry, Intrinsics, Matrix4, MeshEntry, ScanManifest
from advtex_scan.matrices import invert_rigid, matrix4, opencv_axes, pose_problem

NAME = "polycam"
FILE = re.compile(
    r"(.*/)?(corrected_images|images|corrected_cameras|cameras|depth|confidence)/(\d{1,18})\.(jpg|json|png)"
)
SUFFIXES = {"images": "jpg", "cameras": "json", "depth": "png", "confidence": "png"}
MESH_FILE, MESH_INFO_FILE = "raw.glb", "mesh_info.json"
POSE_KEYS = [f"t_{row}{column}" for row in range(3) for column in range(4)]
BORDER = 15 / 1024  # of the width; what undistortion leaves black is a few pixels less

Files = dict[str, dict[str, str]]  # kind of file -> time -> path


def detect(archive: ScanArchive) -> Match | None:
    """Look for cameras with their images, below `keyframes/` or at the top."""
    files = _files(archive)
    for kind in ("corrected_", ""):
        shared = files.get(f"{kind}cameras", {}).keys() & files.get(f"{kind}images", {}).keys()
        if shared:
            return Match(0.95, f"{len(shared)} images have a camera of the same time in {kind}cameras/")
    return None


def read(reader: ScanReader) -> ScanManifest | None:
    """Read all keyframes; the uncorrected ones only if none is corrected."""
    files = _files(reader.archive)
    reader.used.update(path for paths in files.values() for path in paths.values())
    kind = "corrected_" if files.get("corrected_cameras") else ""
    colors, cameras = files.get(f"{kind}images", {}), files.get(f"{kind}cameras", {})
    _report_uncorrected(reader, bool(kind), files)
    times = sorted(colors.keys() | cameras.keys() | files.get("cameras", {}).keys(), key=int)
    reader.frames_found = len(times)
    depth_size = reader.image_size([*files.get("depth", {}).values()])
    frames = []
    for time in times:
        if time not in cameras or time not in colors:
            what = "corrected camera" if time not in cameras and kind else "camera" if time not in cameras else "image"
            reader.drop(f"missing_{what.split()[-1]}", time, f"has no {what}; the frame is left out", "export it again")
            continue
        found = _camera(reader, cameras[time])
        if found is None:
            continue
        camera, pose, sharpness = found
        frames.append(
            FrameEntry(
                name=padded(time),
                color=colors[time],
                depth=files.get("depth", {}).get(time),
                camera_to_world=pose,
                color_intrinsics=camera,
                depth_intrinsics=fitted(camera, depth_size),
                confidence=files.get("confidence", {}).get(time),
                border=round(BORDER * camera.width) if kind else 0,
                sharpness=sharpness,
            )
        )
    return ScanManifest(
        layout=NAME, frames=by_name(frames), mesh=_mesh(reader), up_axis=UP_AXIS, depth_farthest=LIDAR_METRES
    )


def _files(archive: ScanArchive) -> Files:
    files: Files = {}
    for name in archive.names():
        match = FILE.fullmatch(name)
        if match and SUFFIXES[match[2].removeprefix("corrected_")] == match[4]:
            files.setdefault(match[2], {}).setdefault(match[3], name)
    return files


def _report_uncorrected(reader: ScanReader, corrected: bool, files: Files) -> None:
    if not corrected:
        message = "the cameras are the phone's own, not corrected; long captures are exported so"
        reader.findings.warning("uncorrected", "", message, "nothing to do: the cameras are refined here as well")
    elif files.get("cameras"):
        message = f"{len(files['cameras'])} cameras before their correction are left aside"
        reader.findings.info("uncorrected_ignored", min(files["cameras"].values()), message)


def _camera(reader: ScanReader, name: str) -> tuple[Intrinsics, Matrix4, float | None] | None:
    """Return the camera, its pose, and how sharp its image is."""
    given: Mapping[str, Any] | None = json_object(reader, name)
    if given is None:
        return None
    pinhole = json_numbers([given.get(key) for key in ("fx", "fy", "cx", "cy")], 4)
    size = json_size(given.get("width"), given.get("height"))
    values = json_numbers([given.get(key) for key in POSE_KEYS], 12)
    if pinhole is None or size is None or values is None:
        message = "does not hold fx, fy, cx, cy, width, height and t_00 to t_23"
        reader.findings.error("bad_value", name, message, "export the raw data again")
        return None
    fx, fy, cx, cy = pinhole
    camera = reader.intrinsics((fx, fy, cx, cy), size, name)
    pose = reader.pose(values, name)
    return (camera, opencv_axes(pose), json_number(given.get("blur_score"))) if camera and pose else None


def _mesh(reader: ScanReader) -> MeshEntry | None:
    mesh = choose_mesh(reader, (MESH_FILE,))
    if MESH_INFO_FILE not in reader.archive:
        return mesh
    values = json_numbers((json_object(reader, MESH_INFO_FILE) or {}).get("alignmentTransform"), 16)
    if mesh is None or mesh.path != MESH_FILE:
        return mesh
    alignment = matrix4([values[4 * column + row] for row in range(4) for column in range(4)]) if values else None
    if alignment is None or pose_problem(alignment):
        message = "alignmentTransform is no rigid 4x4 matrix"
        reader.findings.error("bad_transform", MESH_INFO_FILE, message, "export the raw data again")
        return mesh
    return replace(mesh, mesh_to_world=invert_rigid(alignment))

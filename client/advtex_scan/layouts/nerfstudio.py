"""`transforms.json` of nerfstudio, instant-ngp and NeRFCapture, with the images that it names.

For all frames or for each: fl_x, fl_y (or camera_angle_x, camera_angle_y), cx, cy, w, h, camera_model, and the lens
distortion k1, k2, p1, p2, k3; principal points count the image's corner as (0, 0). Each of `frames` has a file_path
(its suffix may be left out), a transform_matrix (camera-to-world, OpenGL axes), and optionally a mask_path and depth:
  depth_file_path   16-bit PNG in millimetres, or .npy (floats are metres); nerfstudio
  depth_path        16-bit PNG; `integer_depth_scale` (or `depth_integer_scale`) of the file is metres per unit
8-bit depth, as NeRFCapture writes offline, ends at one metre and is left out.
`applied_transform` (3x4) has been applied to the poses and is undone: a mesh is taken to lie in the world before it,
except the one that `ply_file_path` names. Mesh: that one if it has faces, mesh.ply, else the one mesh that is there.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import PurePosixPath
from typing import Any

from advtex_scan._packed import read_npy_header
from advtex_scan.archive import ScanArchive
from advtex_scan.errors import ScanFormatError
from advtex_scan.images import read_image_header
from advtex_scan.layouts._json import json_number, json_numbers, json_object, json_size
from advtex_scan.layouts._mesh_choice import choose_mesh
from advtex_scan.layouts._reader import IMAGE_SUFFIXES, Match, ScanReader
from advtex_scan.layouts._sequences import by_name, fitted, folder_of, padded
from advtex_scan.manifest import (
    IDENTITY,
    ByteRange,
    Distortion,
    FileRef,
    FrameEntry,
    Intrinsics,
    Matrix4,
    MeshEntry,
    ScanManifest,
)
from advtex_scan.matrices import compose, invert_rigid, matrix4, opencv_axes, pose_problem, up_axis_of

NAME = "nerfstudio"
FILE = "transforms.json"
PINHOLES = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
DISTORTION_KEYS = ("k1", "k2", "p1", "p2", "k3")
SCALE_KEYS = ("integer_depth_scale", "depth_integer_scale")  # metres per unit
MILLIMETRES = 1000.0
MAX_FRAMES = 100_000

Json = Mapping[str, Any]


def detect(archive: ScanArchive) -> Match | None:
    """Look for a `transforms.json`."""
    folder = folder_of(archive, FILE)
    return None if folder is None else Match(0.85, f"{folder}{FILE} is there")


def read(reader: ScanReader) -> ScanManifest | None:
    """Read all frames with an image and a pose."""
    folder = folder_of(reader.archive, FILE)
    scan = json_object(reader, f"{folder}{FILE}")
    listed = scan.get("frames") if scan else None
    if scan is None or folder is None or not isinstance(listed, list) or len(listed) > MAX_FRAMES:
        if scan is not None:
            remedy = "give the file that was written beside the images"
            reader.findings.error(
                "bad_value", f"{folder}{FILE}", f'has no list of at most {MAX_FRAMES} "frames"', remedy
            )
        return None
    reader.frames_found = len(listed)
    applied = _applied_transform(reader, scan)
    entries = [_Frame(reader, folder, scan, frame, index).entry(applied) for index, frame in enumerate(listed)]
    frames = by_name(entry for entry in entries if entry)
    return ScanManifest(
        layout=NAME,
        frames=frames,
        mesh=_mesh(reader, folder, scan, applied),
        up_axis=up_axis_of(frame.camera_to_world for frame in frames),
        depth_scale=_depth_scale(reader, scan, listed),
    )


class _Frame:
    """One of the listed frames; what it does not say itself is said for all."""

    def __init__(self, reader: ScanReader, folder: str, scan: Json, frame: Any, index: int) -> None:
        self.reader = reader
        self.folder = folder
        self.where = f"{FILE}: frames[{index}]"
        self.own: Json = frame if isinstance(frame, dict) else {}
        self.common = scan

    def entry(self, applied: Matrix4) -> FrameEntry | None:
        """Return the frame, with poses from before `applied`; None, with a finding, if it lacks anything."""
        color = self._file("file_path", IMAGE_SUFFIXES)
        if color is None:
            remedy = "add the image, or remove the frame"
            self.reader.drop("missing_color", self.where, "names no image that is there; it is left out", remedy)
            return None
        pose, camera = self._pose(), self._camera(color)
        mask = self._file("mask_path")
        if pose is None or camera is None:
            return None
        depth, depth_size = self._depth()
        return FrameEntry(
            name=padded(str(PurePosixPath(color).with_suffix("")).removeprefix(self.folder)),
            color=color,
            depth=depth,
            camera_to_world=compose(invert_rigid(applied), opencv_axes(pose)),
            color_intrinsics=camera,
            depth_intrinsics=fitted(camera, depth_size) if depth else None,
            mask=mask,
        )

    def _get(self, key: str) -> Any:
        return self.own.get(key, self.common.get(key))

    def _file(self, key: str, suffixes: tuple[str, ...] = ()) -> str | None:
        """Return the file that a key names, with one of the suffixes if it has none."""
        value = self.own.get(key)
        if not isinstance(value, str):
            return None
        name = self.folder + value.removeprefix("./")
        found = next(
            (path for path in (name, *(name + suffix for suffix in suffixes)) if path in self.reader.archive), None
        )
        if found:
            self.reader.used.add(found)
        return found

    def _pose(self) -> Matrix4 | None:
        rows = self.own.get("transform_matrix")
        values = [value for row in rows if isinstance(row, list) for value in row] if isinstance(rows, list) else None
        numbers = json_numbers(values, 16) or json_numbers(values, 12)
        if numbers is None:
            self.reader.findings.error(
                "bad_value", self.where, "has no transform_matrix of 4x4 numbers", "export it again"
            )
            return None
        return self.reader.pose(numbers, self.where)

    def _camera(self, color: str) -> Intrinsics | None:
        size = json_size(self._get("w"), self._get("h"))
        if size is None:
            try:
                header = read_image_header(self.reader.archive, color)
            except ScanFormatError as error:
                self.reader.findings.extend(error.findings)
                return None
            size = header.width, header.height
        model = self._get("camera_model")
        if self._get("is_fisheye") or (isinstance(model, str) and model not in PINHOLES):
            remedy = "undistort the images to a pinhole camera first, for example with COLMAP's image_undistorter"
            message = f"its camera model {str(model)[:40]} is not supported"
            self.reader.findings.error("camera_model", self.where, message, remedy)
            return None
        fx = self._focal("fl_x", "camera_angle_x", size[0])
        fy = self._focal("fl_y", "camera_angle_y", size[1]) or fx
        cx, cy = json_number(self._get("cx")), json_number(self._get("cy"))
        if fx is None or fy is None:
            self.reader.findings.error("no_color_intrinsics", self.where, "has no focal length", "add fl_x and fl_y")
            return None
        pinhole = fx, fy, size[0] / 2 if cx is None else cx, size[1] / 2 if cy is None else cy
        camera = self.reader.intrinsics(pinhole, size, self.where)
        return replace(camera, distortion=self._distortion()) if camera else None

    def _focal(self, key: str, angle_key: str, side: int) -> float | None:
        focal, angle = json_number(self._get(key)), json_number(self._get(angle_key))
        if focal is None and angle is not None and 0 < angle < math.pi:
            return side / 2 / math.tan(angle / 2)
        return focal

    def _distortion(self) -> Distortion | None:
        values = [json_number(self._get(key)) or 0.0 for key in DISTORTION_KEYS]
        return Distortion(*values) if any(values) and all(map(math.isfinite, values)) else None

    def _depth(self) -> tuple[FileRef | None, tuple[int, int] | None]:
        """Return the depth image and its size; None if there is none that can be used."""
        name = self._file("depth_file_path") or self._file("depth_path")
        if name is None:
            return None, None
        archive = self.reader.archive
        try:
            if name.endswith(".npy"):
                array = read_npy_header(archive, name)
                return ByteRange(name, 0, archive.size(name), "npy"), (array.width, array.height)
            header = read_image_header(archive, name)
        except ScanFormatError as error:
            self.reader.findings.extend(error.findings)
            return None, None
        if header.bits == 8:
            message = "is an 8-bit depth image, which ends at about one metre; it is left out"
            self.reader.findings.info("depth_ignored", name, message, "record online, which stores 16 bits")
            return None, None
        return name, (header.width, header.height)


def _depth_scale(reader: ScanReader, scan: Json, frames: list[Any]) -> float:
    """Return the units per metre. nerfstudio's key means millimetres, the others have their scale."""
    if not any(isinstance(frame, dict) and "depth_path" in frame for frame in frames):
        return MILLIMETRES
    given = next((scan[key] for key in SCALE_KEYS if scan.get(key) is not None), 1 / MILLIMETRES)
    metres = json_number(given)
    if metres is not None and 1e-9 < metres < 1e3:
        return 1 / metres
    remedy = "give the metres per stored unit, 0.001 for millimetres"
    reader.findings.error("bad_value", f"{FILE}: {SCALE_KEYS[0]}", "is no sensible number", remedy)
    return MILLIMETRES


def _applied_transform(reader: ScanReader, scan: Json) -> Matrix4:
    rows = scan.get("applied_transform")
    if rows is None:
        return IDENTITY
    values = [value for row in rows if isinstance(row, list) for value in row] if isinstance(rows, list) else None
    numbers = json_numbers(values, 12) or json_numbers(values, 16)
    problem = pose_problem(matrix4(numbers)) if numbers else "is no 3x4 matrix"
    if numbers is None or problem:
        message = str(problem).replace("the pose", "the transform")
        reader.findings.error("bad_transform", f"{FILE}: applied_transform", message, "give a rigid 3x4 matrix")
        return IDENTITY
    return matrix4(numbers)


def _mesh(reader: ScanReader, folder: str, scan: Json, applied: Matrix4) -> MeshEntry | None:
    named = scan.get("ply_file_path")
    path = folder + named.removeprefix("./") if isinstance(named, str) else ""
    mesh = choose_mesh(reader, (path, "mesh.ply"))
    if mesh is not None and mesh.path == path:
        return replace(mesh, mesh_to_world=invert_rigid(applied))
    return mesh

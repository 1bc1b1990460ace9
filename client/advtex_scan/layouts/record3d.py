"""Record3D's `.r3d`, a zip: `metadata` (JSON), `rgbd/<i>.jpg`, `rgbd/<i>.depth`, `rgbd/<i>.conf`.

`metadata` holds w, h (color), dw, dh (depth; older files lack them), K (9 numbers, column by column) and
perFrameIntrinsicCoeffs ([fx, fy, cx, cy] of each frame; older files lack them), both for the color image, and poses
([qx, qy, qz, qw, tx, ty, tz] of each frame): camera-to-world, OpenGL axes. Depth is LZFSE of 32-bit floats in metres,
NaN for no reading; confidence is LZFSE of bytes 0 to 2. There is no mesh, unless one was put beside them.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from advtex_scan._packed import lzfse_size
from advtex_scan.archive import ScanArchive
from advtex_scan.errors import ScanFormatError
from advtex_scan.layouts._arkit import CONFIDENCE_HIGH, UP_AXIS
from advtex_scan.layouts._json import json_numbers, json_object, json_size
from advtex_scan.layouts._mesh_choice import choose_mesh
from advtex_scan.layouts._reader import Match, ScanReader
from advtex_scan.layouts._sequences import by_name
from advtex_scan.manifest import ByteRange, Codec, FrameEntry, Intrinsics, Matrix4, ScanManifest
from advtex_scan.matrices import from_quaternion, opencv_axes

NAME = "record3d"
METADATA = "metadata"
FILE = re.compile(r"rgbd/(\d{1,9})\.(jpg|depth|conf)")
OLD_DEPTH_SIZES = ((256, 192), (640, 480))  # LiDAR and TrueDepth, longer side first
FLOAT_BYTES = 4

Json = Mapping[str, Any]


def detect(archive: ScanArchive) -> Match | None:
    """Look for `metadata` with `rgbd/<i>.jpg`."""
    found = sum(1 for name in archive.names() if name.endswith(".jpg") and FILE.fullmatch(name))
    if not found or METADATA not in archive:
        return None
    return Match(0.95, f"{METADATA} and {found} images in rgbd/ are there")


def read(reader: ScanReader) -> ScanManifest | None:
    """Read all images with a pose."""
    metadata = json_object(reader, METADATA)
    if metadata is None:
        return None
    frames = _files(reader)
    reader.frames_found = len(frames)
    size = json_size(metadata.get("w"), metadata.get("h"))
    if size is None:
        reader.findings.error("bad_value", METADATA, "does not hold the images' size, w and h", "export it again")
        return None
    depth_size = _depth_size(reader, metadata, size, [files["depth"] for files in frames.values() if "depth" in files])
    entries = [_frame(reader, metadata, index, files, size, depth_size) for index, files in frames.items()]
    return ScanManifest(
        layout=NAME,
        frames=by_name(entry for entry in entries if entry),
        mesh=choose_mesh(reader, ("mesh.ply",)),
        up_axis=UP_AXIS,
        confidence_max=CONFIDENCE_HIGH,
    )


def _files(reader: ScanReader) -> dict[int, dict[str, str]]:
    frames: dict[int, dict[str, str]] = {}
    for name in reader.archive.names():
        match = FILE.fullmatch(name)
        if match:
            reader.used.add(name)
            frames.setdefault(int(match[1]), {}).setdefault(match[2], name)
    return dict(sorted(frames.items()))


def _frame(
    reader: ScanReader,
    metadata: Json,
    index: int,
    files: dict[str, str],
    size: tuple[int, int],
    depth_size: tuple[int, int] | None,
) -> FrameEntry | None:
    if "jpg" not in files:
        reader.drop("missing_color", f"rgbd/{index}", "has no image; the frame is left out", "export the scan again")
        return None
    pose = _pose(reader, metadata, index)
    camera = _camera(reader, metadata, index, size)
    if pose is None or camera is None:
        return None
    with_depth = "depth" in files and depth_size is not None
    return FrameEntry(
        name=f"{index:06d}",
        color=files["jpg"],
        depth=_whole(reader, files["depth"], "lzfse_f32") if with_depth else None,
        camera_to_world=pose,
        color_intrinsics=camera,
        depth_intrinsics=camera.scaled(*depth_size) if depth_size else None,
        confidence=_whole(reader, files["conf"], "lzfse_u8") if with_depth and "conf" in files else None,
    )


def _whole(reader: ScanReader, name: str, codec: Codec) -> ByteRange:
    return ByteRange(name, 0, reader.archive.size(name), codec)


def _pose(reader: ScanReader, metadata: Json, index: int) -> Matrix4 | None:
    poses = metadata.get("poses")
    values = json_numbers(poses[index], 7) if isinstance(poses, list) and index < len(poses) else None
    if values is None:
        message = f"has no pose of 7 numbers in {METADATA}; the frame is left out"
        reader.drop("missing_pose", f"rgbd/{index}.jpg", message, "export the scan again")
        return None
    x, y, z, w = values[:4]
    pose = reader.pose(
        [v for row in from_quaternion(x, y, z, w, values[4:]) for v in row], f"{METADATA}: poses[{index}]"
    )
    return opencv_axes(pose) if pose else None


def _camera(reader: ScanReader, metadata: Json, index: int, size: tuple[int, int]) -> Intrinsics | None:
    each = metadata.get("perFrameIntrinsicCoeffs")
    values = json_numbers(each[index], 4) if isinstance(each, list) and index < len(each) else None
    if values is None:
        K = json_numbers(metadata.get("K"), 9)
        values = [K[0], K[4], K[6], K[7]] if K else None
    if values is None:
        message = "holds no intrinsics, neither K nor perFrameIntrinsicCoeffs"
        reader.findings.error("no_color_intrinsics", METADATA, message, "export the scan again")
        return None
    return reader.intrinsics((values[0], values[1], values[2], values[3]), size, METADATA)


def _depth_size(reader: ScanReader, metadata: Json, size: tuple[int, int], depths: list[str]) -> tuple[int, int] | None:
    """Return what `metadata` says, else what fits the number of values in the first depth image."""
    stated = json_size(metadata.get("dw"), metadata.get("dh"))
    if stated or not depths:
        return stated
    try:
        count = lzfse_size(reader.archive, _whole(reader, depths[0], "lzfse_f32")) // FLOAT_BYTES
    except ScanFormatError as error:
        reader.findings.extend(error.findings)
        return None
    for long, short in OLD_DEPTH_SIZES:
        if count == long * short:
            return (long, short) if size[0] >= size[1] else (short, long)
    message = f"holds {count} values, which is no known size; the depth images are left out"
    reader.findings.warning(
        "depth_ignored", depths[0], message, f"state their width and height, dw and dh, in {METADATA}"
    )
    return None

"""ScanNet's `.sens` stream, version 4 (SensReader's `sensorData.h`), read frame by frame and never as a whole.

Little endian: u32 version; u64 length and bytes of the sensor's name; 4 x 16 f32 row-major (intrinsic color, extrinsic
color, intrinsic depth, extrinsic depth); i32 color compression (0 raw, 1 png, 2 jpeg); i32 depth compression (0 raw
u16, 1 zlib u16, 2 occi u16); u32 color width, height, depth width, height; f32 depth units per metre; u64 number of
frames; then per frame 16 f32 camera-to-world (depth camera, OpenCV axes, metres; -inf where tracking was lost), two u64
time stamps, u64 color bytes, u64 depth bytes, the color blob and the depth blob. Intrinsics count the first pixel's
centre as (0, 0). `<scene>.txt` and the mesh lie beside it, as for `scannet`.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Literal

from advtex_scan.archive import ScanArchive
from advtex_scan.errors import ScanFormatError
from advtex_scan.layouts._mesh_choice import choose_mesh
from advtex_scan.layouts._reader import Match, ScanReader
from advtex_scan.layouts._scannet_info import documented_meshes, read_scene_info
from advtex_scan.manifest import IDENTITY, ByteRange, FrameEntry, Intrinsics, Matrix4, ScanManifest
from advtex_scan.matrices import compose, invert_rigid, says_nothing

NAME = "sens"
VERSION = 4
START = struct.Struct("<IQ")
BODY = struct.Struct("<64f2i4IfQ")
FRAME = struct.Struct("<16f4Q")
MAX_SENSOR_NAME = 4096
MAX_FRAMES = 100_000
COLOR_CODECS: dict[int, Literal["raw_rgb8", "png", "jpeg"]] = {0: "raw_rgb8", 1: "png", 2: "jpeg"}
DEPTH_CODECS: dict[int, Literal["raw_u16", "zlib_u16"]] = {0: "raw_u16", 1: "zlib_u16"}
OCCI = 2


@dataclass(frozen=True, slots=True)
class _Header:
    color: Intrinsics
    depth: Intrinsics | None
    color_codec: Literal["raw_rgb8", "png", "jpeg"]
    depth_codec: Literal["raw_u16", "zlib_u16"] | None
    depth_scale: float
    frames: int
    start: int  # byte position of the first frame


def detect(archive: ScanArchive) -> Match | None:
    """Look for a file that ends in `.sens`."""
    streams = _streams(archive)
    return Match(0.7, f"{streams[0]} is there") if streams else None


def read(reader: ScanReader) -> ScanManifest | None:
    """Read all frames with a finite pose."""
    streams = _streams(reader.archive)
    if len(streams) > 1:
        message = f"there are {len(streams)} .sens files"
        reader.findings.error("ambiguous_stream", streams[0], message, "give one scan at a time")
        return None
    path = streams[0]
    reader.used.add(path)
    header = _header(reader, path)
    if header is None:
        return None
    reader.frames_found = header.frames
    depth_to_color = read_scene_info(reader).depth_to_color
    return ScanManifest(
        layout=NAME,
        frames=tuple(_frames(reader, path, header, depth_to_color)),
        mesh=choose_mesh(reader, documented_meshes(reader)),
        depth_scale=header.depth_scale,
        depth_to_color=depth_to_color or IDENTITY,
    )


def _streams(archive: ScanArchive) -> list[str]:
    return [name for name in archive.names() if name.lower().endswith(".sens")]


def _header(reader: ScanReader, path: str) -> _Header | None:
    try:
        version, name_length = START.unpack(reader.archive.read_range(path, 0, START.size))
        if version != VERSION or name_length > MAX_SENSOR_NAME:
            message = f"is no .sens stream of version {VERSION} (it starts with {version})"
            reader.findings.error("bad_sens", path, message, "export the scan again with ScanNet's tools")
            return None
        start = START.size + name_length
        values = BODY.unpack(reader.archive.read_range(path, start, BODY.size))
    except ScanFormatError as error:
        reader.findings.extend(error.findings)
        return None
    color_kind, depth_kind, color_width, color_height, depth_width, depth_height, scale, frames = values[64:]
    color = reader.opencv_intrinsics(_pinhole(values[0:16]), (color_width, color_height), f"{path} (color camera)")
    depth = None
    if depth_width and depth_height:
        depth = reader.opencv_intrinsics(_pinhole(values[32:48]), (depth_width, depth_height), f"{path} (depth camera)")
    _check_extrinsics(reader, path, (values[16:32], values[48:64]))
    sound = color_kind in COLOR_CODECS and frames <= MAX_FRAMES and math.isfinite(scale) and scale > 0
    if not sound:
        message = f"its header makes no sense: color codec {color_kind}, {frames} frames, depth scale {scale:g}"
        reader.findings.error("bad_sens", path, message, "export the scan again with ScanNet's tools")
    if depth_kind not in DEPTH_CODECS:
        kind = "occi" if depth_kind == OCCI else str(depth_kind)
        remedy = "store depth as zlib or raw 16-bit, or export the frames as a folder"
        reader.findings.error("depth_format", path, f"its depth codec {kind} is not supported", remedy)
    if color is None or not sound:
        return None
    return _Header(
        color, depth, COLOR_CODECS[color_kind], DEPTH_CODECS.get(depth_kind), scale, frames, start + BODY.size
    )


def _pinhole(matrix: tuple[float, ...]) -> tuple[float, float, float, float]:
    return matrix[0], matrix[5], matrix[2], matrix[6]


def _check_extrinsics(reader: ScanReader, path: str, matrices: tuple[tuple[float, ...], ...]) -> None:
    for matrix in matrices:
        if not says_nothing(matrix):
            remedy = "state the color camera by colorToDepthExtrinsics in the scene's .txt"
            reader.findings.warning("extrinsic_ignored", path, "an extrinsic matrix of a camera is ignored", remedy)


def _frames(reader: ScanReader, path: str, header: _Header, depth_to_color: Matrix4 | None) -> list[FrameEntry]:
    entries = []
    offset = header.start
    color_to_depth = invert_rigid(depth_to_color) if depth_to_color else None
    for index in range(header.frames):
        try:
            values = FRAME.unpack(reader.archive.read_range(path, offset, FRAME.size))
        except ScanFormatError as error:
            reader.findings.extend(error.findings)
            break
        color_start = offset + FRAME.size
        color_bytes, depth_bytes = values[18:20]
        offset = color_start + color_bytes + depth_bytes
        where = f"{path} (frame {index})"
        if offset > reader.archive.size(path):
            message = f"is cut off: {index} of {header.frames} frames are whole"
            reader.findings.error("truncated_file", path, message, "copy the file again in full")
            break
        pose = reader.pose(list(values[:16]), where)
        if pose is None or not _sizes_are_sound(reader, header, color_bytes, depth_bytes, where):
            continue
        color = ByteRange(path, color_start, color_bytes, header.color_codec)
        depth = None
        if depth_bytes and header.depth_codec:
            depth = ByteRange(path, color_start + color_bytes, depth_bytes, header.depth_codec)
        pose = compose(pose, color_to_depth) if color_to_depth else pose
        entries.append(FrameEntry(f"{index:06d}", color, depth, pose, header.color, header.depth))
    return entries


def _sizes_are_sound(reader: ScanReader, header: _Header, color_bytes: int, depth_bytes: int, where: str) -> bool:
    """Tell whether blobs have the length that their codec implies; compressed ones must not be longer than raw ones."""
    pixels = header.color.width * header.color.height
    depth_pixels = header.depth.width * header.depth.height if header.depth else 0
    color_ok = color_bytes == 3 * pixels if header.color_codec == "raw_rgb8" else 0 < color_bytes <= 4 * pixels + 65536
    raw = 2 * depth_pixels
    depth_ok = depth_bytes in (0, raw) if header.depth_codec == "raw_u16" else depth_bytes <= raw + raw // 100 + 1024
    if color_ok and depth_ok:
        return True
    message = f"its {color_bytes} color and {depth_bytes} depth bytes do not fit the image sizes"
    reader.findings.error("bad_sens", where, message, "export the scan again with ScanNet's tools")
    return False

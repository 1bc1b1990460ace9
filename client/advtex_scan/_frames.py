"""Checks of single frames: image headers against each other and against the intrinsics, and the images' ends."""

from __future__ import annotations

from dataclasses import replace

from advtex_scan.errors import ScanFormatError
from advtex_scan.images import ImageHeader, check_end, place, read_image_header
from advtex_scan.layouts import ScanReader
from advtex_scan.manifest import ByteRange, FrameEntry, Intrinsics

ASPECT_TOLERANCE = 0.01  # ScanNet's 1296x968 pictures are often resampled to 640x480, which is off by 0.4 %


def check_frame(reader: ScanReader, frame: FrameEntry) -> FrameEntry | None:
    """The frame with its color intrinsics at the image's size; None, with a finding, if it cannot be used."""
    color = _color_camera(reader, frame)
    depth_is_sound = frame.depth is None or _depth_is_sound(reader, frame)
    if color is None or not depth_is_sound:
        return None
    return frame if color is frame.color_intrinsics else replace(frame, color_intrinsics=color)


def _color_camera(reader: ScanReader, frame: FrameEntry) -> Intrinsics | None:
    if isinstance(frame.color, ByteRange) and frame.color.codec == "raw_rgb8":
        return frame.color_intrinsics
    header = _header(reader, frame.color)
    return _scaled_color(reader, frame, header) if header else None


def _header(reader: ScanReader, ref: str | ByteRange) -> ImageHeader | None:
    try:
        header = read_image_header(reader.archive, ref)
        check_end(reader.archive, ref, header)
        return header
    except ScanFormatError as error:
        reader.findings.extend(error.findings)
        return None


def _scaled_color(reader: ScanReader, frame: FrameEntry, header: ImageHeader) -> Intrinsics | None:
    camera = frame.color_intrinsics
    if (header.width, header.height) == (camera.width, camera.height):
        return camera
    sizes = f"is {header.width}x{header.height} pixels, its intrinsics are for {camera.width}x{camera.height}"
    aspect = header.width * camera.height / (header.height * camera.width)
    if abs(aspect - 1) > ASPECT_TOLERANCE:
        remedy = "give the intrinsics of these images; cropped or padded images need their own"
        reader.findings.error("color_size", place(frame.color), sizes, remedy)
        return None
    message = f"{sizes}; they are scaled to the image"
    reader.findings.warning("color_scaled", place(frame.color), message, "check that the images were only resampled")
    return camera.scaled(header.width, header.height)


def _depth_is_sound(reader: ScanReader, frame: FrameEntry) -> bool:
    depth, camera = frame.depth, frame.depth_intrinsics
    assert depth is not None
    where = place(depth)
    raw = isinstance(depth, ByteRange) and depth.codec in ("raw_u16", "zlib_u16")
    header = None if raw else _header(reader, depth)
    if header is None and not raw:
        return False
    if camera is None:
        remedy = "give the depth camera's intrinsics, or leave the depth images out"
        reader.findings.error("no_depth_intrinsics", where, "has depth, but there are no depth intrinsics", remedy)
        return False
    if header is None:
        return True
    if (header.format, header.bits, header.channels) != ("png", 16, 1):
        message = f"is a {header.format.upper()} with {header.channels} x {header.bits} bits"
        remedy = "store depth as 16-bit gray PNG, or leave it out"
        reader.findings.error("depth_format", where, message, remedy)
        return False
    if (header.width, header.height) != (camera.width, camera.height):
        message = f"is {header.width}x{header.height} pixels, its intrinsics are for {camera.width}x{camera.height}"
        reader.findings.error("depth_size", where, message, "give the intrinsics of these depth images")
        return False
    return True

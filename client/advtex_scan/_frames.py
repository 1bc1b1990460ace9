"""Checks of single frames: image headers against each other and against the intrinsics, and the images' ends."""

from __future__ import annotations

from dataclasses import replace

from advtex_scan._lenses import distortion_problem
from advtex_scan._packed import check_lzfse, read_npy_header
from advtex_scan.errors import ScanFormatError
from advtex_scan.images import ImageHeader, check_end, place, read_image_header
from advtex_scan.layouts import ScanReader
from advtex_scan.manifest import ByteRange, FileRef, FrameEntry, Intrinsics, VideoFrame

ASPECT_TOLERANCE = 0.01  # ScanNet's 1296x968 pictures are often resampled to 640x480, which is off by 0.4 %


def check_frame(reader: ScanReader, frame: FrameEntry) -> FrameEntry | None:
    """Return the frame with its color intrinsics at the image's size; None, with a finding, if it cannot be used."""
    color = _color_camera(reader, frame)
    depth_is_sound = frame.depth is None or _depth_is_sound(reader, frame)
    if color is None or not depth_is_sound or not _mask_is_sound(reader, frame, color):
        return None
    if not _lenses_are_sound(reader, frame):
        return None
    confidence = frame.confidence if _confidence_is_sound(reader, frame) else None
    return replace(frame, color_intrinsics=color, confidence=confidence)


def _lenses_are_sound(reader: ScanReader, frame: FrameEntry) -> bool:
    cameras = [(frame.color, frame.color_intrinsics)]
    if frame.depth is not None and frame.depth_intrinsics is not None:
        cameras.append((frame.depth, frame.depth_intrinsics))
    for ref, camera in cameras:
        problem = distortion_problem(camera)
        if problem:
            remedy = "correct the coefficients, or undistort the images and leave them out"
            reader.findings.error("bad_distortion", place(ref), problem, remedy)
            return False
    return True


def _color_camera(reader: ScanReader, frame: FrameEntry) -> Intrinsics | None:
    if isinstance(frame.color, ByteRange) and frame.color.codec == "raw_rgb8":
        return frame.color_intrinsics
    if isinstance(frame.color, VideoFrame):
        video = reader.video(frame.color.path)
        if video is not None and frame.color.index >= video.frames:
            message = f"is beyond the video's {video.frames} pictures"
            reader.findings.error("missing_color", place(frame.color), message, "copy the video again in full")
            return None
        size = (video.width, video.height) if video else None
    else:
        header = _header(reader, frame.color)
        size = (header.width, header.height) if header else None
    return _scaled_color(reader, frame, size) if size else None


def _header(reader: ScanReader, ref: FileRef) -> ImageHeader | None:
    try:
        header = read_image_header(reader.archive, ref)
        check_end(reader.archive, ref, header)
        return header
    except ScanFormatError as error:
        reader.findings.extend(error.findings)
        return None


def _scaled_color(reader: ScanReader, frame: FrameEntry, size: tuple[int, int]) -> Intrinsics | None:
    camera = frame.color_intrinsics
    width, height = size
    if size == (camera.width, camera.height):
        return camera
    sizes = f"is {width}x{height} pixels, its intrinsics are for {camera.width}x{camera.height}"
    aspect = width * camera.height / (height * camera.width)
    if abs(aspect - 1) > ASPECT_TOLERANCE:
        remedy = "give the intrinsics of these images; cropped or padded images need their own"
        reader.findings.error("color_size", place(frame.color), sizes, remedy)
        return None
    message = f"{sizes}; they are scaled to the image"
    reader.findings.warning("color_scaled", place(frame.color), message, "check that the images were only resampled")
    return camera.scaled(width, height)


def _depth_is_sound(reader: ScanReader, frame: FrameEntry) -> bool:
    depth, camera = frame.depth, frame.depth_intrinsics
    assert depth is not None
    where = place(depth)
    if camera is None:
        remedy = "give the depth camera's intrinsics, or leave the depth images out"
        reader.findings.error("no_depth_intrinsics", where, "has depth, but there are no depth intrinsics", remedy)
        return False
    if isinstance(depth, ByteRange) and depth.codec in ("raw_u16", "zlib_u16"):
        return True
    if isinstance(depth, ByteRange) and depth.codec in ("lzfse_f32", "npy"):
        return _numbers_are_sound(reader, depth, camera)
    header = _header(reader, depth)
    if header is None:
        return False
    if (header.format, header.bits, header.channels) != ("png", 16, 1):
        message = f"is a {header.format.upper()} with {header.channels} x {header.bits} bits"
        remedy = "store depth as 16-bit gray PNG, or leave it out"
        reader.findings.error("depth_format", where, message, remedy)
        return False
    return _size_fits(reader, where, (header.width, header.height), camera)


def _numbers_are_sound(reader: ScanReader, ref: ByteRange, camera: Intrinsics) -> bool:
    """Tell whether a file of plain numbers has the camera's size, as far as can be told without unpacking it."""
    try:
        if ref.codec == "npy":
            header = read_npy_header(reader.archive, ref.path)
            return _size_fits(reader, ref.path, (header.width, header.height), camera)
        check_lzfse(reader.archive, ref, 4 * camera.width * camera.height)
    except ScanFormatError as error:
        reader.findings.extend(error.findings)
        return False
    return True


def _size_fits(reader: ScanReader, where: str, size: tuple[int, int], camera: Intrinsics) -> bool:
    if size == (camera.width, camera.height):
        return True
    message = f"is {size[0]}x{size[1]} pixels, its intrinsics are for {camera.width}x{camera.height}"
    reader.findings.error("depth_size", where, message, "give the intrinsics of these depth images")
    return False


def _confidence_is_sound(reader: ScanReader, frame: FrameEntry) -> bool:
    """Tell whether the confidence image fits the depth image; one that does not is left out, with a warning."""
    confidence, camera = frame.confidence, frame.depth_intrinsics
    if confidence is None or frame.depth is None or camera is None:
        return False
    remedy = "export it again; without it all readings are trusted alike"
    try:
        if isinstance(confidence, ByteRange) and confidence.codec == "lzfse_u8":
            check_lzfse(reader.archive, confidence, camera.width * camera.height)
            return True
        header = read_image_header(reader.archive, confidence)
        check_end(reader.archive, confidence, header)
    except ScanFormatError as error:
        message = f"{error.findings[0].message}; it is ignored"
        reader.findings.warning("confidence_ignored", place(confidence), message, remedy)
        return False
    if (header.bits, header.channels, header.width, header.height) == (8, 1, camera.width, camera.height):
        return True
    message = f"is {header.width}x{header.height} pixels of {header.channels} x {header.bits} bits; it is ignored"
    reader.findings.warning("confidence_ignored", place(confidence), message, remedy)
    return False


def _mask_is_sound(reader: ScanReader, frame: FrameEntry, camera: Intrinsics) -> bool:
    if frame.mask is None:
        return True
    header = _header(reader, frame.mask)
    if header is None:
        return False
    if (header.bits, header.width, header.height) == (8, camera.width, camera.height):
        return True
    sizes = f"{header.width}x{header.height} pixels of {header.bits} bits; its image is {camera.width}x{camera.height}"
    reader.findings.error(
        "mask_size", place(frame.mask), f"is {sizes}", "store masks as 8-bit images of the image's size"
    )
    return False

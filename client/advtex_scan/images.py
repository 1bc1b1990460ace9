"""Sizes and bit depths of PNG and JPEG images, from their headers, and whether their ends are there."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from typing import Literal

from advtex_scan.archive import ScanArchive
from advtex_scan.errors import Finding, ImageError
from advtex_scan.manifest import FileRef, VideoFrame

MAX_PIXELS = 64_000_000  # a 48-megapixel phone picture passes, a decompression bomb does not
FIRST_BYTES = 4 << 10
LAST_BYTES = 1 << 10  # an end marker is the last thing in most files
MOST_BYTES = 1 << 20  # a JPEG's profile and thumbnail may stand before its size
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
EXR_SIGNATURE = b"\x76\x2f\x31\x01"
# Both apps that may write it can write something else: a reader of all its compressions would be for nothing but that.
EXR_REMEDY = (
    "OpenEXR is not read: write depth as 16-bit PNG; of Record3D export the .r3d (Shareable/Internal format), "
    "of 3D Scanner App a capture in low resolution with depth"
)
PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
PNG_DEPTHS = {0: (1, 2, 4, 8, 16), 2: (8, 16), 3: (1, 2, 4, 8), 4: (8, 16), 6: (8, 16)}
JPEG_SIZES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # start-of-frame markers


@dataclass(frozen=True, slots=True)
class ImageHeader:
    """What an image's header says: size in pixels, bits per sample, samples per pixel (a palette counts as one)."""

    format: Literal["png", "jpeg"]
    width: int
    height: int
    bits: int
    channels: int


def place(ref: FileRef | VideoFrame) -> str:
    """Name the file of a reference, with the position for a member of a stream or video."""
    if isinstance(ref, str):
        return ref
    if isinstance(ref, VideoFrame):
        return f"{ref.path} (frame {ref.index})"
    return f"{ref.path} (byte {ref.offset})" if ref.offset else ref.path


def read_image_header(archive: ScanArchive, ref: FileRef) -> ImageHeader:
    """Read the header of a PNG or JPEG. Raises ImageError if it is none, cut off, or larger than MAX_PIXELS."""
    data = archive.head(ref, FIRST_BYTES)
    header = parse_image_header(data, place(ref))
    if header is None and len(data) == FIRST_BYTES:
        header = parse_image_header(archive.head(ref, MOST_BYTES), place(ref))
    if header is None:
        raise _no_image(place(ref), "is cut off: its size is missing")
    if header.width * header.height > MAX_PIXELS:
        message = f"claims {header.width}x{header.height} pixels; at most {MAX_PIXELS // 10**6} megapixels are accepted"
        raise ImageError(Finding("error", "image_too_large", place(ref), message, "scale the images down"))
    return header


def check_end(archive: ScanArchive, ref: FileRef, header: ImageHeader) -> None:
    """Raise ImageError if the image is cut off. The tail is read, and the whole file only if the end is not there."""
    if not has_end(archive.tail(ref, LAST_BYTES), header) and not has_end(archive.read(ref), header):
        raise cut_off(place(ref))


def has_end(data: bytes, header: ImageHeader) -> bool:
    """Tell whether an image that ends with `data` is whole; decoders fill what is missing with gray and say nothing."""
    if header.format == "png":
        return data.rfind(b"IEND") > data.rfind(b"IDAT")
    return data.rfind(b"\xff\xd9") > data.rfind(b"\xff\xda")  # end of image after the last start of scan


def cut_off(where: str) -> ImageError:
    """Return the error for an image without its end."""
    remedy = "copy the file again in full, or leave the frame out"
    return ImageError(Finding("error", "truncated_image", where, "is cut off: its end is missing", remedy))


def parse_image_header(data: bytes, where: str) -> ImageHeader | None:
    """Read the header of the image that starts with `data`; None if more is needed. Raises ImageError if it is none."""
    if data.startswith(PNG_SIGNATURE):
        return _png(data, where)
    if data.startswith(b"\xff\xd8"):
        return _jpeg(data, where)
    if data.startswith(EXR_SIGNATURE):
        raise ImageError(Finding("error", "exr_image", where, "is an OpenEXR image", EXR_REMEDY))
    raise _no_image(where, "is empty" if not data else "is neither PNG nor JPEG")


def _no_image(where: str, what: str) -> ImageError:
    return ImageError(Finding("error", "not_an_image", where, what, "replace it by a sound PNG or JPEG"))


def _png(data: bytes, where: str) -> ImageHeader | None:
    if len(data) < 33:
        return None
    length, kind, width, height, bits, color_type = struct.unpack_from(">I4sIIBB", data, 8)
    (crc,) = struct.unpack_from(">I", data, 29)
    if length != 13 or kind != b"IHDR" or crc != zlib.crc32(data[12:29]):
        raise _no_image(where, "is a PNG with a damaged header")
    if width == 0 or height == 0 or bits not in PNG_DEPTHS.get(color_type, ()):
        raise _no_image(where, "is a PNG whose header makes no sense")
    return ImageHeader("png", width, height, bits, PNG_CHANNELS[color_type])


def _jpeg(data: bytes, where: str) -> ImageHeader | None:
    at = 2
    while at + 4 <= len(data):
        if data[at] != 0xFF:
            raise _no_image(where, "is a JPEG with a damaged header")
        marker = data[at + 1]
        if marker == 0xFF:  # padding
            at += 1
        elif marker == 0x01 or 0xD0 <= marker <= 0xD7:  # markers without a length
            at += 2
        elif marker in JPEG_SIZES:
            if at + 10 > len(data):
                return None
            bits, height, width, channels = struct.unpack_from(">BHHB", data, at + 4)
            if width == 0 or height == 0:
                raise _no_image(where, "is a JPEG whose size is zero")
            return ImageHeader("jpeg", width, height, bits, channels)
        elif marker in (0x00, 0xD8, 0xD9, 0xDA):
            raise _no_image(where, "is a JPEG without a size in its header")
        else:
            at += 2 + max(2, int.from_bytes(data[at + 2 : at + 4], "big"))
    return None

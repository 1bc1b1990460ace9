"""COLMAP's sparse models: `cameras` and `images`, as text or binary, read front to back and never as a whole.

A camera has a model and its parameters; a pose is world-to-camera, a quaternion w x y z and a translation, OpenCV axes.
Binary files are little endian. cameras.bin: u64 count; per camera u32 id, i32 model, u64 width, u64 height, f64
parameters. images.bin: u64 count; per image u32 id, 4 f64 quaternion, 3 f64 translation, u32 camera id, the name with a
zero at its end, u64 count of points and 24 bytes for each. images.txt has two lines per image, the second one for its
points.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

from advtex_scan.archive import ScanArchive
from advtex_scan.errors import ArchiveError, Finding
from advtex_scan.layouts._reader import parse_numbers, parse_size

MAX_ENTRIES = 100_000
MAX_NAME = 1024
MAX_LINE = 1 << 16
SKIPPED_AT_ONCE = 1 << 20
POINT_BYTES = 24
COUNT = struct.Struct("<Q")
CAMERA = struct.Struct("<IiQQ")
IMAGE = struct.Struct("<I7dI")
MODELS = {  # in the order of their binary numbers: name and how many parameters it has
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL": 4,
    "RADIAL": 5,
    "OPENCV": 8,
    "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12,
    "FOV": 5,
    "SIMPLE_RADIAL_FISHEYE": 4,
    "RADIAL_FISHEYE": 5,
    "THIN_PRISM_FISHEYE": 12,
    "RAD_TAN_THIN_PRISM_FISHEYE": 16,
    "SIMPLE_DIVISION": 4,
    "DIVISION": 5,
    "SIMPLE_FISHEYE": 3,
    "FISHEYE": 4,
    "EUCM": 6,
    "EQUIRECTANGULAR": 2,
}


@dataclass(frozen=True, slots=True)
class ModelCamera:
    """A camera as the model states it."""

    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class ModelImage:
    """An image as the model states it: quaternion w x y z and translation, world-to-camera."""

    name: str
    camera: int
    quaternion: tuple[float, ...]
    translation: tuple[float, ...]


def read_cameras(archive: ScanArchive, path: str) -> dict[int, ModelCamera]:
    """Return the cameras by id. Raises ArchiveError if the file is broken."""
    with archive.open(path) as stream:
        return dict(_binary_cameras(stream, path) if path.endswith(".bin") else _text_cameras(stream, path))


def read_images(archive: ScanArchive, path: str) -> Iterator[ModelImage]:
    """Yield the images in the order of the file. Raises ArchiveError where the file is broken."""
    with archive.open(path) as stream:
        yield from _binary_images(stream, path) if path.endswith(".bin") else _text_images(stream, path)


def _broken(path: str, message: str) -> ArchiveError:
    return ArchiveError(Finding("error", "bad_colmap", path, message, "export the model again with COLMAP"))


def _take(stream: BinaryIO, layout: struct.Struct, path: str) -> tuple[int | float, ...]:
    data = stream.read(layout.size)
    if len(data) < layout.size:
        raise _broken(path, "is cut off")
    return layout.unpack(data)


def _count(stream: BinaryIO, path: str) -> int:
    (count,) = _take(stream, COUNT, path)
    if count > MAX_ENTRIES:
        raise _broken(path, f"claims {count} entries; at most {MAX_ENTRIES} are accepted")
    return int(count)


def _binary_cameras(stream: BinaryIO, path: str) -> Iterator[tuple[int, ModelCamera]]:
    names = list(MODELS)
    for _ in range(_count(stream, path)):
        identity, model, width, height = map(int, _take(stream, CAMERA, path))
        if not 0 <= model < len(names):
            raise _broken(path, f"camera {identity} has the unknown model {model}")
        if not (0 < width < 10**6 and 0 < height < 10**6):
            raise _broken(path, f"camera {identity} has {width}x{height} pixels")
        parameters = _take(stream, struct.Struct(f"<{MODELS[names[model]]}d"), path)
        yield identity, ModelCamera(names[model], width, height, parameters)


def _binary_images(stream: BinaryIO, path: str) -> Iterator[ModelImage]:
    for _ in range(_count(stream, path)):
        values = _take(stream, IMAGE, path)
        name = bytearray()
        while (byte := stream.read(1)) != b"\0":
            name += byte
            if not byte or len(name) > MAX_NAME:
                raise _broken(path, "is cut off, or the name of an image does not end")
        (points,) = _take(stream, COUNT, path)
        _skip(stream, int(points) * POINT_BYTES, path)
        yield ModelImage(name.decode("utf-8", "replace"), int(values[8]), values[1:5], values[5:8])


def _skip(stream: BinaryIO, length: int, path: str) -> None:
    while length:
        passed = len(stream.read(min(length, SKIPPED_AT_ONCE)))
        if not passed:
            raise _broken(path, "is cut off")
        length -= passed


def _text_cameras(stream: BinaryIO, path: str) -> Iterator[tuple[int, ModelCamera]]:
    for line in _lines(stream, path):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        parameters = parse_numbers(" ".join(words[4:]))
        size = parse_size(*words[2:4]) if len(words) > 4 else None
        identity = _whole(words[0])
        if identity is None or size is None or parameters is None or MODELS.get(words[1]) != len(parameters):
            raise _broken(path, f"a line describes no camera: {line[:80]!r}")
        yield identity, ModelCamera(words[1], *size, tuple(parameters))


def _text_images(stream: BinaryIO, path: str) -> Iterator[ModelImage]:
    lines = _lines(stream, path)
    for line in lines:
        words = line.split(maxsplit=9)
        if not words or words[0].startswith("#"):
            continue
        values = parse_numbers(" ".join(words[1:8]))
        camera = _whole(words[8]) if len(words) == 10 else None
        if values is None or len(values) != 7 or camera is None:
            raise _broken(path, f"a line describes no image: {line[:80]!r}")
        next(lines, None)  # the image's points
        yield ModelImage(words[9].strip(), camera, tuple(values[:4]), tuple(values[4:]))


def _lines(stream: BinaryIO, path: str) -> Iterator[str]:
    """Yield the lines, cut off at MAX_LINE; the points of an image fill long ones."""
    entries = 0
    while line := stream.readline(MAX_LINE):
        rest = line
        while rest and not rest.endswith(b"\n"):
            rest = stream.readline(MAX_LINE)
        entries += 1
        if entries > 3 * MAX_ENTRIES:
            raise _broken(path, f"has more than {3 * MAX_ENTRIES} lines")
        yield line.decode("utf-8", "replace")


def _whole(word: str) -> int | None:
    return int(word) if word.isascii() and word.isdecimal() and len(word) <= 10 else None

"""What the layouts of recorded sequences share: images in order, poses by place or by time, one camera for all."""

from __future__ import annotations

import math
import re
from bisect import bisect_left
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath

from advtex_scan.archive import ScanArchive
from advtex_scan.layouts._reader import IMAGE_SUFFIXES, OPENCV_OFFSET, ScanReader
from advtex_scan.manifest import Distortion, FrameEntry, Intrinsics, Matrix4
from advtex_scan.matrices import matrix4, pose_problem

LIST_LIMIT = 32 << 20  # bytes of a list of poses or images; the longest of TUM have 2 MB
CAMERA_FILE = "camera-intrinsics.txt"  # 3x3; for data sets that state their camera on a web page only
NUMBER_DIGITS = 18  # of the numbers by which names are sorted
NAME_DIGITS = 6  # of the numbers in a frame's name


@dataclass(frozen=True, slots=True)
class Pinhole:
    """A data set's published camera: fx, fy, cx, cy in pixels, the first pixel's centre at (0, 0), and its size."""

    fx_fy_cx_cy: tuple[float, float, float, float]
    size: tuple[int, int]
    distortion: Distortion | None = None

    def intrinsics(self) -> Intrinsics:
        """Return the same with the image's corner at (0, 0)."""
        fx, fy, cx, cy = self.fx_fy_cx_cy
        return Intrinsics(fx, fy, cx + OPENCV_OFFSET, cy + OPENCV_OFFSET, *self.size, self.distortion)


PRIMESENSE = Pinhole((525.0, 525.0, 319.5, 239.5), (640, 480))


def natural_key(name: str) -> tuple[str, ...]:
    """Return what sorts names as their numbers go: 2 before 10."""
    return tuple(part.zfill(NUMBER_DIGITS) if part.isdecimal() else part for part in re.split(r"(\d+)", name))


def by_name(frames: Iterable[FrameEntry]) -> tuple[FrameEntry, ...]:
    """Return frames in the order of their names, as a manifest has them."""
    return tuple(sorted(frames, key=lambda frame: frame.name))


def frame_name(path: str) -> str:
    """Return the image's name without folder and suffix, its numbers padded, so that names sort as their numbers go."""
    return padded(PurePosixPath(path).stem)


def padded(name: str) -> str:
    """Return a name with its numbers in at least six digits."""
    return re.sub(r"\d+", lambda match: match[0].zfill(NAME_DIGITS), name)


def number_of(path: str) -> int | None:
    """Return the first number in a file's name."""
    match = re.search(r"[0-9]{1,18}", PurePosixPath(path).name)
    return int(match[0]) if match else None


def images_in(archive: ScanArchive, folder: str) -> list[str]:
    """Return the images directly in a folder (a path that ends in `/`, or empty), in the order of their numbers."""
    found = [name for name in archive.names() if name.startswith(folder) and "/" not in name[len(folder) :]]
    return sorted((name for name in found if name.lower().endswith(IMAGE_SUFFIXES)), key=natural_key)


def folder_of(archive: ScanArchive, *files: str) -> str | None:
    """Return the folder that holds all of these files, the outermost of several; it ends in `/` unless it is the top.

    Looked for by the first of the files.
    """
    names = [name for name in archive.names() if name == files[0] or name.endswith("/" + files[0])]
    folders = sorted((name[: -len(files[0])] for name in names), key=lambda folder: (folder.count("/"), folder))
    return next((folder for folder in folders if all(folder + file in archive for file in files)), None)


def by_place(images: Sequence[str], numbers: Collection[int]) -> list[int | None]:
    """Return which of the numbers of a trajectory's poses is each image's.

    As many poses as images go in order, whatever they are numbered from. Otherwise a number is a place among the
    images, unless one of them is beyond the last: then the numbers in the images' names are meant.
    """
    if len(numbers) == len(images):
        return [*sorted(numbers)]
    known = set(numbers)
    if all(0 <= number < len(images) for number in known):
        return [place if place in known else None for place in range(len(images))]
    return [number if (number := number_of(image)) in known else None for image in images]


def paired(colors: Sequence[str], depths: Sequence[str]) -> list[str | None]:
    """Return the depth image of each image: in order if there are as many, else by the first number in their names."""
    if len(colors) == len(depths):
        return [*depths]
    by_number = {number_of(depth): depth for depth in reversed(depths)}
    by_number.pop(None, None)
    return [by_number.get(number_of(color)) for color in colors]


def nearest(times: Sequence[float], time: float, tolerance: float) -> int | None:
    """Return the index of the nearest of sorted times; None if it is further away than `tolerance`."""
    after = bisect_left(times, time)
    around = [index for index in (after - 1, after) if 0 <= index < len(times)]
    best = min(around, key=lambda index: abs(times[index] - time), default=None)
    return best if best is not None and abs(times[best] - time) <= tolerance else None


@dataclass(frozen=True, slots=True)
class Track:
    """Poses by time, sorted.

    Where two of them are at most `gap` seconds apart, the pose between them is interpolated, for they come faster than
    the camera turns; otherwise the nearest one counts if it is at most `tolerance` seconds away.
    """

    times: Sequence[float]
    poses: Sequence[Matrix4]
    gap: float
    tolerance: float

    def at(self, time: float) -> Matrix4 | None:
        """Return the pose at a time; None if there is none near it."""
        after = bisect_left(self.times, time)
        if 0 < after < len(self.times) and self.times[after] - self.times[after - 1] <= self.gap:
            start, end = self.times[after - 1], self.times[after]
            between = blend(self.poses[after - 1], self.poses[after], (time - start) / (end - start))
            if pose_problem(between) is None:
                return between
        index = nearest(self.times, time, self.tolerance)
        return None if index is None else self.poses[index]


def blend(a: Matrix4, b: Matrix4, share: float) -> Matrix4:
    """Return the pose `share` of the way from a to b, a small turn apart: entries blended, axes made orthonormal."""
    mixed = [
        [(1 - share) * x + share * y for x, y in zip(row_a, row_b, strict=True)]
        for row_a, row_b in zip(a[:3], b[:3], strict=True)
    ]
    x, y = ([row[column] for row in mixed] for column in (0, 1))
    x = _unit(x)
    along = sum(p * q for p, q in zip(x, y, strict=True))
    y = _unit([q - along * p for p, q in zip(x, y, strict=True)])
    z = [x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]]
    return matrix4([value for row in range(3) for value in (x[row], y[row], z[row], mixed[row][3])])


def _unit(vector: list[float]) -> list[float]:
    length = math.hypot(*vector)
    return [value / length for value in vector] if length else vector


def list_lines(reader: ScanReader, name: str) -> list[str]:
    """Return the lines of a list that say something: without comments and blank ones."""
    lines = (line.strip() for line in (reader.text(name, LIST_LIMIT) or "").splitlines())
    return [line for line in lines if line and not line.startswith("#")]


def fitted(camera: Intrinsics | None, size: tuple[int, int] | None) -> Intrinsics | None:
    """Return the camera for images of another resolution, where their shape is the same."""
    if camera is None or size is None:
        return camera
    shape = size[0] * camera.height / (size[1] * camera.width)
    return camera.scaled(*size) if abs(shape - 1) < 0.01 else camera

"""What the layouts share: reading small text files, poses and intrinsics, with every problem put down as a finding."""

from __future__ import annotations

import math
import re
from collections import Counter
from dataclasses import dataclass
from typing import Protocol

from advtex_scan.archive import ScanArchive
from advtex_scan.errors import Findings, ScanFormatError
from advtex_scan.images import read_image_header
from advtex_scan.manifest import FileRef, Intrinsics, Matrix4, ScanManifest
from advtex_scan.matrices import is_lost, matrix4, pose_problem
from advtex_scan.video import VideoHeader, read_video_header

TEXT_LIMIT = 1 << 20  # bytes of a pose, intrinsics or info file
OPENCV_OFFSET = 0.5  # added to the principal point where files count the first pixel's centre as (0, 0)
SIZE_VOTES = 5  # images that decide for which size intrinsics without a size are
IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")


@dataclass(frozen=True, slots=True)
class Match:
    """How sure a layout is that it reads an archive (0 to 1), and what it saw."""

    score: float
    why: str


class Layout(Protocol):
    """A module that reads one layout."""

    NAME: str

    def detect(self, archive: ScanArchive) -> Match | None:
        """Tell whether the names (and heads) of the files are of this layout; this never raises."""
        ...

    def read(self, reader: ScanReader) -> ScanManifest | None:
        """Return all frames that have a color image and a pose; None if there is nothing to build on."""
        ...


class ScanReader:
    """An archive being read: collects findings, the files that were used, and frames dropped by reason."""

    def __init__(self, archive: ScanArchive) -> None:
        self.archive = archive
        self.findings = Findings()
        self.used: set[str] = set()
        self.frames_found = 0
        self.dropped: Counter[str] = Counter()
        self.mesh_reported = False  # a finding says why there is no mesh
        self._videos: dict[str, VideoHeader | None] = {}

    def text(self, name: str, limit: int = TEXT_LIMIT) -> str | None:
        """Return a text file of at most `limit` bytes; None, with a finding, if it cannot be read."""
        self.used.add(name)
        try:
            return self.archive.read(name, limit).decode("utf-8", "replace")
        except ScanFormatError as error:
            self.findings.extend(error.findings)
            return None

    def numbers(self, name: str, counts: tuple[int, ...]) -> list[float] | None:
        """Return the numbers of a text file, as many as one of `counts`; None, with a finding, otherwise."""
        text = self.text(name)
        if text is None:
            return None
        values = parse_numbers(text)
        if values is None or len(values) not in counts:
            wanted = " or ".join(map(str, counts))
            remedy = f"write {wanted} numbers and nothing else"
            self.findings.error("bad_numbers", name, f"does not hold {wanted} numbers", remedy)
            return None
        return values

    def pose(self, values: list[float], where: str) -> Matrix4 | None:
        """Return a rigid 4x4 from 12 or 16 numbers; None if tracking was lost (dropped, counted) or it is none."""
        transform = matrix4(values)
        if is_lost(transform):
            remedy = "nothing to do unless many frames are lost"
            self.drop("lost_tracking", where, "has no finite pose (tracking was lost); the frame is left out", remedy)
            return None
        problem = pose_problem(transform)
        if problem:
            remedy = "write camera-to-world matrices with orthonormal rotations, or leave the frame out"
            self.findings.error("bad_pose", where, problem, remedy)
            return None
        return transform

    def pose_file(self, name: str) -> Matrix4 | None:
        """Return the pose in a text file of 4x4 (or 3x4) numbers."""
        values = self.numbers(name, (16, 12))
        return None if values is None else self.pose(values, name)

    def rigid_file(self, name: str) -> Matrix4 | None:
        """Return a fixed transform between two cameras."""
        values = self.numbers(name, (16, 12))
        if values is None:
            return None
        problem = pose_problem(matrix4(values))
        if problem:
            message = problem.replace("the pose", "the transform")
            self.findings.error("bad_transform", name, message, "write a rigid 4x4 matrix")
            return None
        return matrix4(values)

    def drop(self, reason: str, where: str, message: str, remedy: str) -> None:
        """Leave a frame out, counted by reason, with a warning."""
        self.dropped[reason] += 1
        self.findings.warning(reason, where, message, remedy)

    def video(self, name: str) -> VideoHeader | None:
        """Read what a video says of its pictures; None, with one finding for all frames, if it cannot be read."""
        if name not in self._videos:
            self.used.add(name)
            try:
                self._videos[name] = read_video_header(self.archive, name)
            except ScanFormatError as error:
                self.findings.extend(error.findings)
                self._videos[name] = None
        return self._videos[name]

    def image_size(self, refs: list[FileRef]) -> tuple[int, int] | None:
        """Return the width and height that most of a few images have; None if no image has a sound header.

        The check of each frame reports the images that differ or are broken.
        """
        sizes: Counter[tuple[int, int]] = Counter()
        for ref in refs:
            try:
                header = read_image_header(self.archive, ref)
            except ScanFormatError:
                continue
            sizes[header.width, header.height] += 1
            if sizes.total() == SIZE_VOTES:
                break
        return sizes.most_common(1)[0][0] if sizes else None

    def color_size(self, refs: list[FileRef]) -> tuple[int, int] | None:
        """Do as `image_size`; if no image is sound, no frame will be checked, so all of them are reported here."""
        size = self.image_size(refs)
        for ref in refs if size is None else ():
            try:
                read_image_header(self.archive, ref)
            except ScanFormatError as error:
                self.findings.extend(error.findings)
        return size

    def matrix_intrinsics(self, name: str, size: tuple[int, int] | None) -> Intrinsics | None:
        """Return intrinsics from a 3x3 or 4x4 matrix file that counts the first pixel's centre as (0, 0)."""
        values = self.numbers(name, (9, 16))
        if values is None or size is None:
            return None
        row = 3 if len(values) == 9 else 4
        return self.opencv_intrinsics((values[0], values[row + 1], values[2], values[row + 2]), size, name)

    def opencv_intrinsics(
        self, fx_fy_cx_cy: tuple[float, float, float, float], size: tuple[int, int], where: str
    ) -> Intrinsics | None:
        """Return intrinsics whose principal point counts the first pixel's centre as (0, 0)."""
        fx, fy, cx, cy = fx_fy_cx_cy
        return self.intrinsics((fx, fy, cx + OPENCV_OFFSET, cy + OPENCV_OFFSET), size, where)

    def intrinsics(
        self, fx_fy_cx_cy: tuple[float, float, float, float], size: tuple[int, int], where: str
    ) -> Intrinsics | None:
        """Return checked intrinsics; None, with a finding, if they describe no camera."""
        fx, fy, cx, cy = fx_fy_cx_cy
        width, height = size
        if not (all(map(math.isfinite, fx_fy_cx_cy)) and fx > 0 and fy > 0 and width > 0 and height > 0):
            message = f"describes no camera: fx {fx:g}, fy {fy:g}, cx {cx:g}, cy {cy:g} for {width}x{height} pixels"
            self.findings.error("bad_intrinsics", where, message, "give focal lengths and center in pixels")
            return None
        if not (0.25 < cx / width < 0.75 and 0.25 < cy / height < 0.75):
            message = f"its principal point ({cx:g}, {cy:g}) is far from the middle of {width}x{height} pixels"
            self.findings.warning("off_center", where, message, "check that the intrinsics are of this image size")
        return Intrinsics(fx, fy, cx, cy, width, height)


def parse_numbers(text: str) -> list[float] | None:
    """Return all numbers of a text, separated by blanks, commas or semicolons; None if anything else is in it."""
    text = re.sub(r"1\.#INF\d*", "inf", re.sub(r"1\.#(?:IND|QNAN|SNAN)\d*", "nan", text))  # as old Windows tools print
    try:
        return [float(word) for word in re.split(r"[\s,;]+", text.strip()) if word]
    except ValueError:
        return None


def parse_size(width: str, height: str) -> tuple[int, int] | None:
    """Return an image size from two words; None if they are no positive numbers of at most six digits."""
    if not all(word.isascii() and word.isdecimal() and len(word) <= 6 and int(word) > 0 for word in (width, height)):
        return None
    return int(width), int(height)


def parse_settings(text: str, separator: str = "=") -> dict[str, str]:
    """Read lines of the form `key = value`."""
    pairs = (line.split(separator, 1) for line in text.splitlines() if separator in line)
    return {key.strip(): value.strip() for key, value in pairs}

"""`<scene>.txt` of ScanNet: `key = value` lines beside the frames or the `.sens`.

Poses are the depth camera's. `colorToDepthExtrinsics` (16 floats, newer scenes) takes color-camera to depth-camera
coordinates. `axisAlignment` is ignored: mesh and poses are both unaligned.
"""

from __future__ import annotations

from dataclasses import dataclass

from advtex_scan.layouts._reader import TEXT_LIMIT, ScanReader, parse_numbers, parse_settings, parse_size
from advtex_scan.manifest import Matrix4
from advtex_scan.matrices import invert_rigid, matrix4, pose_problem

MARKS = ("colorToDepthExtrinsics", "axisAlignment", "numDepthFrames", "sceneType")
MESHES = ("_vh_clean_2.ply", "_vh_clean.ply")


@dataclass(frozen=True, slots=True)
class SceneInfo:
    """What is used of it: the color images' original size, and depth-camera to color-camera coordinates."""

    color_size: tuple[int, int] | None = None
    depth_to_color: Matrix4 | None = None


def read_scene_info(reader: ScanReader) -> SceneInfo:
    """Read the first text file at the top that holds one of MARKS; empty if there is none."""
    for name in reader.archive.names():
        if "/" in name or not name.endswith(".txt") or reader.archive.size(name) > TEXT_LIMIT:
            continue
        settings = parse_settings(reader.text(name) or "")
        if any(mark in settings for mark in MARKS):
            size = parse_size(settings.get("colorWidth", ""), settings.get("colorHeight", ""))
            return SceneInfo(size, _depth_to_color(reader, settings.get("colorToDepthExtrinsics"), name))
        reader.used.discard(name)
    return SceneInfo()


def documented_meshes(reader: ScanReader) -> tuple[str, ...]:
    """Return ScanNet's own mesh names, the decimated one first, since a texture needs no more of it."""
    return tuple(name for suffix in MESHES for name in reader.archive.names() if name.endswith(suffix))


def _depth_to_color(reader: ScanReader, text: str | None, name: str) -> Matrix4 | None:
    if text is None:
        return None
    values = parse_numbers(text)
    problem = pose_problem(matrix4(values)) if values and len(values) == 16 else "does not hold 16 numbers"
    if values is None or problem:
        message = f"colorToDepthExtrinsics: {problem}".replace("the pose", "the transform")
        reader.findings.error("bad_transform", name, message, "copy the file again from the data set")
        return None
    return invert_rigid(matrix4(values))

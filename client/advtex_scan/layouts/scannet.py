"""ScanNet as exported by its SensReader: `color/0.jpg`, `depth/0.png`, `pose/0.txt`, `intrinsic/intrinsic_*.txt`.

Poses are camera-to-world of the depth camera, OpenCV axes, metres; rows of -inf mark lost tracking. Depth is in
millimetres. Intrinsics are 4x4 and count the first pixel's centre as (0, 0); those of color are for the size that
`<scene>.txt` states, else for the images' own. `<scene>.txt` may place the color camera (see `_scannet_info`).
Mesh: `<scene>_vh_clean_2.ply`, `<scene>_vh_clean.ply`, else the one mesh that is there.
"""

from __future__ import annotations

import re

from advtex_scan.archive import ScanArchive
from advtex_scan.layouts._mesh_choice import choose_mesh
from advtex_scan.layouts._reader import Match, ScanReader
from advtex_scan.layouts._scannet_info import documented_meshes, read_scene_info
from advtex_scan.manifest import IDENTITY, FrameEntry, Intrinsics, Matrix4, ScanManifest
from advtex_scan.matrices import compose, invert_rigid, says_nothing

NAME = "scannet"
FRAME = re.compile(r"(color|depth|pose)/(\d{1,9})\.(jpg|jpeg|png|txt)")
COLOR_FILE = "intrinsic/intrinsic_color.txt"
DEPTH_FILE = "intrinsic/intrinsic_depth.txt"
EXTRINSIC_FILES = ("intrinsic/extrinsic_color.txt", "intrinsic/extrinsic_depth.txt")


def detect(archive: ScanArchive) -> Match | None:
    """Look for `color/N.jpg` with `pose/N.txt`; the intrinsic folder makes it surer."""
    kinds = {match[1] for name in archive.names() if (match := FRAME.fullmatch(name))}
    if not {"color", "pose"} <= kinds:
        return None
    if COLOR_FILE in archive:
        return Match(0.95, "there are color/, pose/ and intrinsic/ with ScanNet's names")
    return Match(0.6, "there are color/ and pose/ with numbered files")


def read(reader: ScanReader) -> ScanManifest | None:
    """Read all frames with color and a finite pose."""
    frames = _frames(reader.archive)
    reader.frames_found = len(frames)
    info = read_scene_info(reader)
    color_size = info.color_size or reader.color_size([files["color"] for files in frames.values() if "color" in files])
    depth_size = reader.image_size([files["depth"] for files in frames.values() if "depth" in files])
    color = _camera(reader, COLOR_FILE, color_size)
    depth = _camera(reader, DEPTH_FILE, depth_size)
    if COLOR_FILE not in reader.archive:
        remedy = f"export the intrinsics too, as {COLOR_FILE}"
        reader.findings.error("no_color_intrinsics", "", "there are no color intrinsics", remedy)
    for name in EXTRINSIC_FILES:
        if name in reader.archive:
            _check_identity(reader, name)
    entries = [_entry(reader, number, files, color, depth, info.depth_to_color) for number, files in frames.items()]
    return ScanManifest(
        layout=NAME,
        frames=tuple(entry for entry in entries if entry),
        mesh=choose_mesh(reader, documented_meshes(reader)),
        depth_to_color=info.depth_to_color or IDENTITY,
    )


def _frames(archive: ScanArchive) -> dict[int, dict[str, str]]:
    frames: dict[int, dict[str, str]] = {}
    for name in archive.names():
        match = FRAME.fullmatch(name)
        if match and (match[3] == "txt") == (match[1] == "pose"):
            frames.setdefault(int(match[2]), {}).setdefault(match[1], name)
    return dict(sorted(frames.items()))


def _camera(reader: ScanReader, name: str, size: tuple[int, int] | None) -> Intrinsics | None:
    return reader.matrix_intrinsics(name, size) if name in reader.archive else None


def _check_identity(reader: ScanReader, name: str) -> None:
    values = reader.numbers(name, (16,))
    if values and not says_nothing(values):
        remedy = "state the color camera by colorToDepthExtrinsics in the scene's .txt"
        reader.findings.warning("extrinsic_ignored", name, "is not the identity and is ignored", remedy)


def _entry(
    reader: ScanReader,
    number: int,
    files: dict[str, str],
    color: Intrinsics | None,
    depth: Intrinsics | None,
    depth_to_color: Matrix4 | None,
) -> FrameEntry | None:
    reader.used.update(files.values())
    if "color" not in files:
        remedy = "export the image too, or remove the frame's other files"
        reader.drop("missing_color", f"frame {number}", "has no color image; the frame is left out", remedy)
        return None
    if "pose" not in files:
        remedy = "export the pose too, or remove the frame"
        reader.drop("missing_pose", files["color"], "has no pose; the frame is left out", remedy)
        return None
    pose = reader.pose_file(files["pose"])
    if pose is None or color is None:
        return None
    if depth_to_color is not None:
        pose = compose(pose, invert_rigid(depth_to_color))
    return FrameEntry(f"{number:06d}", files["color"], files.get("depth"), pose, color, depth)

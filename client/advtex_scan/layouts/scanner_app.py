"""3D Scanner App (Laan Labs), "All Data": `frame_00000.json`, `frame_00000.jpg`, `depth_00000.png`, `conf_00000.png`.

Every frame has a JSON file, some an image, and those without are poses between the images. The JSON holds
cameraPoseARFrame (16 numbers, row by row, camera-to-world, OpenGL axes), intrinsics (9 numbers, row by row, for the
image) and motionQuality (0 to 1). Depth is in millimetres; confidence is 0 to 2.
Mesh, in the same world: `export_refined.obj`, `export.obj`, `textured_output.obj`, else the one mesh that is there.
"""

from __future__ import annotations

import re

from advtex_scan.archive import ScanArchive
from advtex_scan.images import EXR_REMEDY
from advtex_scan.layouts._arkit import CONFIDENCE_HIGH, LIDAR_METRES, UP_AXIS
from advtex_scan.layouts._json import json_number, json_numbers, json_object
from advtex_scan.layouts._mesh_choice import choose_mesh
from advtex_scan.layouts._reader import Match, ScanReader
from advtex_scan.layouts._sequences import by_name, fitted
from advtex_scan.manifest import FrameEntry, ScanManifest
from advtex_scan.matrices import opencv_axes

NAME = "scanner_app"
FILE = re.compile(r"(frame|depth|conf)_(\d{1,9})\.(json|jpg|png)")
EXR = re.compile(r"(frame|depth)_\d{1,9}\.exr")
KINDS = {("frame", "json"): "camera", ("frame", "jpg"): "color", ("depth", "png"): "depth", ("conf", "png"): "conf"}
MESHES = ("export_refined.obj", "export.obj", "textured_output.obj")

Frames = dict[int, dict[str, str]]  # number -> kind of file -> path


def detect(archive: ScanArchive) -> Match | None:
    """Look for `frame_NNNNN.jpg` with a `.json` of the same number."""
    found = sum(1 for files in _frames(archive).values() if {"camera", "color"} <= files.keys())
    return Match(0.9, f"{found} images frame_NNNNN.jpg have a .json of their number") if found else None


def read(reader: ScanReader) -> ScanManifest | None:
    """Read all frames with an image."""
    frames = _frames(reader.archive)
    reader.used.update(name for files in frames.values() for name in files.values())
    reader.frames_found = len(frames)
    color_size = reader.color_size([files["color"] for files in frames.values() if "color" in files])
    depth_size = reader.image_size([files["depth"] for files in frames.values() if "depth" in files])
    pictures = [name for name in reader.archive.names() if EXR.fullmatch(name)]
    if pictures and depth_size is None:
        message = f"and {len(pictures) - 1} more hold depth as OpenEXR; it is not used"
        reader.findings.warning("exr_image", pictures[0], message, EXR_REMEDY)
    entries = [_entry(reader, number, files, color_size, depth_size) for number, files in frames.items()]
    return ScanManifest(
        layout=NAME,
        frames=by_name(entry for entry in entries if entry),
        mesh=choose_mesh(reader, MESHES),
        up_axis=UP_AXIS,
        confidence_max=CONFIDENCE_HIGH,
        depth_farthest=LIDAR_METRES,
    )


def _frames(archive: ScanArchive) -> Frames:
    frames: Frames = {}
    for name in archive.names():
        match = FILE.fullmatch(name)
        if match and (match[1], match[3]) in KINDS:
            frames.setdefault(int(match[2]), {}).setdefault(KINDS[match[1], match[3]], name)
    return dict(sorted(frames.items()))


def _entry(
    reader: ScanReader,
    number: int,
    files: dict[str, str],
    size: tuple[int, int] | None,
    depth_size: tuple[int, int] | None,
) -> FrameEntry | None:
    where = f"frame {number}"
    if "color" not in files:
        reader.dropped["missing_color"] += 1
        reader.findings.info("missing_color", where, "has a pose but no image, as the app records them; it is left out")
        return None
    if "camera" not in files:
        reader.drop("missing_pose", where, "has no .json; the frame is left out", "export all data again")
        return None
    given = json_object(reader, files["camera"])
    if given is None or size is None:
        return None
    values, K = json_numbers(given.get("cameraPoseARFrame"), 16), json_numbers(given.get("intrinsics"), 9)
    if values is None or K is None:
        message = "does not hold cameraPoseARFrame (16 numbers) and intrinsics (9 numbers)"
        reader.findings.error("bad_value", files["camera"], message, "export all data again")
        return None
    pose = reader.pose(values, files["camera"])
    camera = reader.intrinsics((K[0], K[4], K[2], K[5]), size, files["camera"])
    if pose is None or camera is None:
        return None
    return FrameEntry(
        name=f"{number:06d}",
        color=files["color"],
        depth=files.get("depth"),
        camera_to_world=opencv_axes(pose),
        color_intrinsics=camera,
        depth_intrinsics=fitted(camera, depth_size),
        confidence=files.get("conf"),
        sharpness=json_number(given.get("motionQuality")),
    )

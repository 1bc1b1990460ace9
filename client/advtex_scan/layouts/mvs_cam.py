"""mvs-texturing and G2LTex: `color_07.jpg` with `color_07.cam`, and optionally `depth_07.png` beside it.

A `.cam` holds 12 numbers on its first line, `tx ty tz R00 .. R22`: world-to-camera, OpenCV axes, metres. Intrinsics
come from `intrinsics.txt` with one line per camera,

    color 640 480 fx 582.871 fy 582.871 cx 320 cy 240
    depth 640 480 fx 583 fy 583 cx 320 cy 240

(first pixel's centre at (0, 0)), else from G2LTex's `Config/config.yml`, which holds one number in a line,

    RGB_fx: 582.871        and RGB_fy, RGB_cx, RGB_cy, RGB_width, RGB_height; the same with depth_

(its sample counts the first pixel's centre as (0, 0) too), else from the second line of each `.cam`:
`f d0 d1 paspect ppx ppy` with f in units of the image's longer side and the principal point in units of its width and
height, as mvs-texturing defines them.
Depth is taken to be registered to color. Mesh: mesh.ply, else the one mesh that is there.
"""

from __future__ import annotations

import re
from pathlib import PurePosixPath

from advtex_scan.archive import ScanArchive
from advtex_scan.errors import ScanFormatError
from advtex_scan.images import read_image_header
from advtex_scan.layouts._mesh_choice import choose_mesh
from advtex_scan.layouts._reader import IMAGE_SUFFIXES, Match, ScanReader, parse_numbers, parse_settings, parse_size
from advtex_scan.layouts._sequences import padded
from advtex_scan.manifest import FrameEntry, Intrinsics, Matrix4, ScanManifest
from advtex_scan.matrices import invert_rigid, up_axis_of

NAME = "mvs_cam"
INTRINSICS_FILE = "intrinsics.txt"
CONFIG_FILE = "Config/config.yml"
CONFIG_PREFIXES = {"color": "RGB", "depth": "depth"}
CONFIG_KEYS = ("fx", "fy", "cx", "cy", "width", "height")
Cameras = dict[str, Intrinsics | None]  # "color", "depth"; None where what is stated is wrong, with a finding
CAMERA_LINE = re.compile(
    r"\s*(color|depth)\s+(\d{1,6})\s+(\d{1,6})\s+fx\s+(\S+)\s+fy\s+(\S+)\s+cx\s+(\S+)\s+cy\s+(\S+)\s*"
)


def detect(archive: ScanArchive) -> Match | None:
    """Look for any `.cam` file."""
    cams = [name for name in archive.names() if name.endswith(".cam")]
    return Match(0.8, f"{len(cams)} camera files end in .cam") if cams else None


def read(reader: ScanReader) -> ScanManifest | None:
    """Read all images with a `.cam`."""
    cameras = _cameras(reader) if INTRINSICS_FILE in reader.archive else _config_cameras(reader)
    images = [name for name in reader.archive.names() if name.lower().endswith(IMAGE_SUFFIXES)]
    by_stem = {name.rsplit(".", 1)[0]: name for name in images}
    cams = {name.removesuffix(".cam"): name for name in reader.archive.names() if name.endswith(".cam")}
    colors = sorted({stem for stem in by_stem if "color" in PurePosixPath(stem).name} | set(cams))
    reader.frames_found = len(colors)
    frames = [_frame(reader, stem, by_stem, cams.get(stem), cameras) for stem in colors]
    usable = tuple(sorted((frame for frame in frames if frame), key=lambda frame: frame.name))
    return ScanManifest(
        layout=NAME,
        frames=usable,
        mesh=choose_mesh(reader, ("mesh.ply",)),
        up_axis=up_axis_of(frame.camera_to_world for frame in usable),
    )


def _frame(
    reader: ScanReader, stem: str, images: dict[str, str], cam: str | None, cameras: Cameras
) -> FrameEntry | None:
    color = images.get(stem)
    folder, _, base = stem.rpartition("/")
    depth = images.get(f"{folder}/{base.replace('color', 'depth')}".lstrip("/")) if "color" in base else None
    reader.used.update(name for name in (color, depth, cam) if name)
    if color is None:
        remedy = "add the image, or remove the .cam"
        reader.drop("missing_color", stem, "has no color image; the frame is left out", remedy)
        return None
    if cam is None:
        reader.drop("missing_pose", stem, "has no .cam; the frame is left out", "add the image's .cam")
        return None
    lines = (reader.text(cam) or "").strip().splitlines()
    pose = _pose(reader, lines, cam)
    camera = cameras["color"] if "color" in cameras else _own_intrinsics(reader, lines, cam, color)
    if pose is None or camera is None:
        return None
    return FrameEntry(padded(stem), color, depth, pose, camera, cameras.get("depth"))


def _pose(reader: ScanReader, lines: list[str], cam: str) -> Matrix4 | None:
    values = parse_numbers(lines[0]) if lines else None
    if values is None or len(values) != 12:
        reader.findings.error(
            "bad_numbers", cam, "the first line does not hold 12 numbers", "write tx ty tz R00 .. R22"
        )
        return None
    shift, rotation = values[:3], values[3:]
    rows = [[*rotation[3 * row : 3 * row + 3], shift[row]] for row in range(3)]
    world_to_camera = reader.pose([value for row in rows for value in row], cam)
    return invert_rigid(world_to_camera) if world_to_camera else None


def _cameras(reader: ScanReader) -> Cameras:
    cameras: Cameras = {}
    for line in (reader.text(INTRINSICS_FILE) or "").splitlines():
        match = CAMERA_LINE.fullmatch(line)
        values = parse_numbers(" ".join(match.groups()[3:])) if match else None
        if match and values and len(values) == 4:
            size = (int(match[2]), int(match[3]))
            pinhole = (values[0], values[1], values[2], values[3])
            cameras[match[1]] = reader.opencv_intrinsics(pinhole, size, INTRINSICS_FILE)
        elif line.strip() and not line.lstrip().startswith("#"):
            message = f"a line is not understood: {line.strip()[:80]!r}"
            reader.findings.error(
                "bad_numbers", INTRINSICS_FILE, message, "write: color WIDTH HEIGHT fx F fy F cx C cy C"
            )
    return cameras


def _config_cameras(reader: ScanReader) -> Cameras:
    """Read what `Config/config.yml` says about each camera that it names; it is YAML of the flattest kind."""
    text = reader.text(CONFIG_FILE) if CONFIG_FILE in reader.archive else None
    lines = (line.partition("#")[0] for line in (text or "").splitlines())
    settings = parse_settings("\n".join(lines), ":")
    cameras: Cameras = {}
    for kind, prefix in CONFIG_PREFIXES.items():
        words = [settings.get(f"{prefix}_{key}", "") for key in CONFIG_KEYS]
        if not any(words):
            continue
        values, size = parse_numbers(" ".join(words[:4])), parse_size(words[4], words[5])
        if not all(words) or values is None or len(values) != 4 or size is None:
            remedy = "write fx, fy, cx, cy, width and height of each camera, in pixels"
            message = f"{prefix}_fx to {prefix}_height do not describe a camera"
            reader.findings.error("bad_numbers", CONFIG_FILE, message, remedy)
            cameras[kind] = None
        else:
            pinhole = (values[0], values[1], values[2], values[3])
            cameras[kind] = reader.opencv_intrinsics(pinhole, size, CONFIG_FILE)
    return cameras


def _own_intrinsics(reader: ScanReader, lines: list[str], cam: str, color: str) -> Intrinsics | None:
    """Read the second line of a `.cam`: (ppx, ppy) times the size are image coordinates, with the corner at (0, 0)."""
    values = parse_numbers(lines[1]) if len(lines) > 1 else None
    if not values:
        remedy = f"add {INTRINSICS_FILE} with a line: color WIDTH HEIGHT fx F fy F cx C cy C"
        reader.findings.error("no_color_intrinsics", cam, "there are no color intrinsics", remedy)
        return None
    try:
        header = read_image_header(reader.archive, color)
    except ScanFormatError as error:
        reader.findings.extend(error.findings)
        return None
    focal, d0, d1, aspect, ppx, ppy = [*values[:6], *(0.0, 0.0, 0.0, 1.0, 0.5, 0.5)[len(values[:6]) :]]
    if d0 or d1:
        message = f"has distortion ({d0:g}, {d1:g}), which is ignored"
        reader.findings.warning("distortion", cam, message, "undistort the images")
    if focal > 10 or ppx > 10:  # the longer side is never ten times the field of view: these are pixels
        remedy = f"add {INTRINSICS_FILE}, or divide f by the longer side and ppx, ppy by width and height"
        reader.findings.error("bad_intrinsics", cam, "gives its focal length in pixels", remedy)
        return None
    f, size = focal * max(header.width, header.height), (header.width, header.height)
    return reader.intrinsics((f, f * aspect, ppx * size[0], ppy * size[1]), size, cam)

"""Ingest: scans made here, and the sample scans where they are."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from advtex_engine.core.config import TextureConfig
from advtex_engine.core.errors import Problem, ScanError
from advtex_engine.core.monitor import Monitor
from advtex_engine.ingest.decode import decode_color, decode_depth
from advtex_engine.ingest.depth import DepthEncoding, depth_in_color_image
from advtex_engine.ingest.read import ingest
from advtex_engine.render.rasterize import rasterize
from advtex_scan.manifest import ByteRange, Intrinsics

WIDTH, HEIGHT, FOCAL = 96, 64, 90.0
SAMPLES = Path(os.environ.get("ADVTEX_DATA", Path(__file__).parents[3].parent / "shared" / "data")) / "scans"


class Listener(Monitor):
    def __init__(self) -> None:
        self.warnings: list[Problem] = []

    def warning(self, problem: Problem) -> None:
        self.warnings.append(problem)


def pose(x: float) -> np.ndarray:
    camera_to_world = np.eye(4)
    camera_to_world[0, 3] = x
    return camera_to_world


def picture(index: int) -> np.ndarray:
    """RGB: red grows to the right, green downwards, blue is the frame's."""
    red, green = np.meshgrid(np.linspace(0, 240, WIDTH), np.linspace(0, 240, HEIGHT))
    return np.stack([red, green, np.full_like(red, 10 * index)], axis=2).astype(np.uint8)


def wall_depth(scale: float = 1000.0) -> np.ndarray:
    return np.full((HEIGHT, WIDTH), round(2 * scale), np.uint16)


def write_frame(folder: Path, index: int, depth: np.ndarray | None = None) -> None:
    name = f"frame-{index:06d}"
    cv2.imwrite(str(folder / f"{name}.color.png"), picture(index)[:, :, ::-1])
    cv2.imwrite(str(folder / f"{name}.depth.png"), wall_depth() if depth is None else depth)
    np.savetxt(folder / f"{name}.pose.txt", pose(0.01 * index))


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    """Ten frames of a wall at z = 2 m, in the layout of 7-Scenes."""
    for index in range(10):
        write_frame(tmp_path, index)
    K = [[FOCAL, 0, WIDTH / 2 - 0.5], [0, FOCAL, HEIGHT / 2 - 0.5], [0, 0, 1]]  # files count pixel centers from 0
    np.savetxt(tmp_path / "camera-intrinsics.txt", K)
    write_wall(tmp_path, 2.0)
    return tmp_path


def write_wall(folder: Path, z: float) -> None:
    corners = "\n".join(f"v {x} {y} {z}" for x, y in ((-4, -4), (4, -4), (4, 4), (-4, 4)))
    (folder / "mesh.obj").write_text(corners + "\nf 1 2 3 4\n")


def test_views_are_scaled_frames_with_scaled_cameras(scan: Path) -> None:
    listener = Listener()
    scene = ingest(scan, TextureConfig(size=(64, 64)), listener)
    assert [view.name for view in scene.views] == [f"frame-{index:06d}" for index in range(10)]
    view = scene.views[3]
    assert (view.camera.width, view.camera.height) == (64, 64)
    # The axes scale apart: 96 -> 64 columns, 64 -> 64 rows. Corners stay corners.
    assert view.camera.K.tolist() == [[60, 0, 32], [0, 90, 32], [0, 0, 1]]
    assert view.camera.world_to_camera[:3, 3].tolist() == pytest.approx([-0.03, 0, 0])
    averaged = picture(3).astype(float).reshape(64, 32, 3, 3)  # 3 columns onto 2, weights 2:1 and 1:2
    left = (2 * averaged[:, :, 0] + averaged[:, :, 1]) / 3
    assert np.abs(view.color[:, ::2].numpy() - left).max() <= 1
    assert view.color.dtype == torch.uint8
    assert [problem for problem in listener.warnings if problem.code.startswith("depth")] == []


def test_without_a_size_the_scan_keeps_its_own(scan: Path) -> None:
    scene = ingest(scan, TextureConfig(), Listener())
    assert (scene.views[0].camera.width, scene.views[0].camera.height) == (WIDTH, HEIGHT)
    assert scene.views[7].color.numpy().tolist() == picture(7).tolist()
    assert scene.views[0].camera.K.tolist() == [[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]]


def test_depth_comes_in_metres_and_empty_readings_stay_empty(scan: Path) -> None:
    holes = wall_depth()
    holes[:10, :10], holes[10:20, :10] = 0, 65535
    write_frame(scan, 4, holes)
    scene = ingest(scan, TextureConfig(), Listener())
    depth = scene.views[4].depth
    assert depth is not None
    assert depth[:20, :10].sum() == 0
    assert torch.all(depth[20:] == 2)


def test_rotated_depth_is_found_out(scan: Path) -> None:
    units = wall_depth(10_000.0)
    for index in range(10):
        write_frame(scan, index, (units << 3) | (units >> 13))
    listener = Listener()
    scene = ingest(scan, TextureConfig(), listener)
    assert scene.views[0].depth is not None
    assert torch.all(scene.views[0].depth == 2)
    assert "bit-rotated tenths of a millimetre" in listener.warnings[0].message


@pytest.mark.parametrize(("holdout", "expected"), [(2, [1, 3, 5, 7, 9]), (3, [1, 4, 7]), (8, [4])])
def test_held_out_frames_are_every_nth_usable_one(scan: Path, holdout: int, expected: list[int]) -> None:
    scene = ingest(scan, TextureConfig(holdout=holdout), Listener())
    assert [int(view.name[-6:]) for view in scene.heldout] == expected
    assert len(scene.views) == 10 - len(expected)


def test_positions_count_usable_frames_only(scan: Path) -> None:
    np.savetxt(scan / "frame-000000.pose.txt", np.full((4, 4), -np.inf))
    scene = ingest(scan, TextureConfig(holdout=8), Listener())
    assert [view.name for view in scene.heldout] == ["frame-000005"]


def test_a_zip_gives_the_same_scene(scan: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.mktemp("zip") / "scan.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(scan.iterdir()):
            archive.write(file, f"top/{file.name}")
    a, b = ingest(scan, TextureConfig(), Listener()), ingest(path, TextureConfig(), Listener())
    assert [view.name for view in a.views] == [view.name for view in b.views]
    assert all(p.color.equal(q.color) for p, q in zip(a.views, b.views, strict=True))


def test_frames_that_look_away_are_left_out(scan: Path) -> None:
    turned = np.diag([-1.0, 1, -1, 1])
    np.savetxt(scan / "frame-000006.pose.txt", turned)
    listener = Listener()
    scene = ingest(scan, TextureConfig(), listener)
    assert "frame-000006" not in [view.name for view in scene.views]
    assert len(scene.views) == 9
    assert "frame-000006" in [problem.where for problem in listener.warnings if problem.code == "frame_sees_nothing"]


def test_a_view_inside_one_large_triangle_sees_the_mesh(scan: Path) -> None:
    """All vertices lie outside of every image; the surface fills them."""
    assert len(ingest(scan, TextureConfig(), Listener()).views) == 10


def damaged_png(scan: Path) -> str:
    path = scan / "frame-000002.color.png"
    data = bytearray(path.read_bytes())
    data[60:120] = bytes(60)
    path.write_bytes(data)
    return path.name


def cut_off_png(scan: Path) -> str:
    path = scan / "frame-000002.color.png"
    path.write_bytes(path.read_bytes()[:-300])
    return path.name


def cut_off_jpeg(scan: Path) -> str:
    for index in range(10):
        (scan / f"frame-{index:06d}.color.png").unlink()
        cv2.imwrite(str(scan / f"frame-{index:06d}.color.jpg"), picture(index))
    path = scan / "frame-000002.color.jpg"
    path.write_bytes(path.read_bytes()[:-200])
    return path.name


def text_image(scan: Path) -> str:
    (scan / "frame-000002.color.png").write_text("no image")
    return "frame-000002.color.png"


def png_header(width: int, height: int) -> bytes:
    """A PNG that claims a size and holds next to nothing."""
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunks = [(b"IHDR", header), (b"IDAT", zlib.compress(bytes(1 << 16))), (b"IEND", b"")]
    body = b"".join(struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in chunks)
    return b"\x89PNG\r\n\x1a\n" + body


def bomb(scan: Path) -> str:
    (scan / "frame-000002.color.png").write_bytes(png_header(15_000, 15_000))
    return "frame-000002.color.png"


def small_depth(scan: Path) -> str:
    write_frame(scan, 2, wall_depth()[::2])
    return "frame-000002.depth.png"


def eight_bit_depth(scan: Path) -> str:
    write_frame(scan, 2, wall_depth().astype(np.uint8))
    return "frame-000002.depth.png"


def no_faces(scan: Path) -> str:
    (scan / "mesh.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n")
    return "mesh.obj"


def far_mesh(scan: Path) -> str:
    write_wall(scan, -2.0)
    return "mesh.obj"


@pytest.mark.parametrize(
    "harm",
    [damaged_png, cut_off_png, cut_off_jpeg, text_image, bomb, small_depth, eight_bit_depth, no_faces, far_mesh],
)
def test_bad_scans_are_refused_by_file_with_a_remedy(scan: Path, harm: Callable[[Path], str]) -> None:
    name = harm(scan)
    with pytest.raises(ScanError) as caught:
        ingest(scan, TextureConfig(), Listener())
    named = [problem for problem in caught.value.problems if problem.where == name]
    assert len(named) == 1
    assert named[0].remedy


def test_every_broken_image_is_named_at_once(scan: Path) -> None:
    for index in (2, 7):
        path = scan / f"frame-{index:06d}.color.png"
        data = bytearray(path.read_bytes())
        data[60:120] = bytes(60)
        path.write_bytes(data)
    with pytest.raises(ScanError) as caught:
        ingest(scan, TextureConfig(), Listener())
    assert [problem.where for problem in caught.value.problems] == ["frame-000002.color.png", "frame-000007.color.png"]


def test_what_is_no_scan_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ScanError, match="neither a folder nor a file"):
        ingest(tmp_path / "none.zip", TextureConfig(), Listener())
    (tmp_path / "a.txt").write_text("nothing")
    with pytest.raises(ScanError):
        ingest(tmp_path, TextureConfig(), Listener())


# Decoding what streams hold

CAMERA = Intrinsics(1, 1, 1, 1, 4, 3)


def member(codec: str) -> ByteRange:
    return ByteRange("scan.sens", 64, 10, codec)  # type: ignore[arg-type]


def test_raw_color_is_rgb() -> None:
    pixels = np.arange(36, dtype=np.uint8).reshape(3, 4, 3)
    image = decode_color(pixels.tobytes(), member("raw_rgb8"), CAMERA, (4, 3))
    assert image.tolist() == pixels.tolist()
    image[0, 0] = 0  # writable: torch refuses to wrap memory that is not
    with pytest.raises(ScanError, match=r"scan\.sens .*does not hold 4x3 pixels"):
        decode_color(pixels.tobytes()[1:], member("raw_rgb8"), CAMERA, (4, 3))


@pytest.mark.parametrize("codec", ["raw_u16", "zlib_u16", "png"])
def test_depth_codecs_agree(codec: str) -> None:
    values = (np.arange(12, dtype="<u2") * 5000).reshape(3, 4)
    data = {
        "raw_u16": values.tobytes(),
        "zlib_u16": zlib.compress(values.tobytes()),
        "png": cv2.imencode(".png", values)[1].tobytes(),
    }[codec]
    assert decode_depth(data, member(codec), CAMERA).tolist() == values.tolist()
    with pytest.raises(ScanError, match=r"scan\.sens"):
        decode_depth(data[:-8], member(codec), CAMERA)


def test_rotation_in_metadata_is_ignored() -> None:
    """A camera writes the sensor's pixels and asks viewers to turn them; intrinsics and pose are the sensor's."""
    jpeg = cv2.imencode(".jpg", np.zeros((3, 4, 3), np.uint8))[1].tobytes()
    tiff = b"MM\0*" + struct.pack(">IHHHIHHI", 8, 1, 0x0112, 3, 1, 6, 0, 0)  # orientation 6: turn by 90 degrees
    exif = b"Exif\0\0" + tiff
    turned = jpeg[:2] + b"\xff\xe1" + struct.pack(">H", 2 + len(exif)) + exif + jpeg[2:]
    assert cv2.imdecode(np.frombuffer(turned, np.uint8), cv2.IMREAD_COLOR).shape[:2] == (4, 3)
    assert decode_color(turned, "a.jpg", CAMERA, (4, 3)).shape == (3, 4, 3)


def test_gray_and_transparent_images_become_rgb() -> None:
    for image in (
        np.full((3, 4), 77, np.uint8),
        np.full((3, 4, 4), 77, np.uint8),
        np.full((3, 4, 3), 77 * 257, np.uint16),
    ):
        data = cv2.imencode(".png", image)[1].tobytes()
        assert decode_color(data, "a.png", CAMERA, (4, 3)).tolist() == np.full((3, 4, 3), 77).tolist()


# The sample scans

needs_samples = [pytest.mark.data, pytest.mark.skipif(not SAMPLES.is_dir(), reason=f"no sample scans at {SAMPLES}")]


def median_error(scene_path: Path, views: int) -> float:
    """Median of |device depth - mesh depth| over a few views, metres."""
    scene = ingest(scene_path, TextureConfig(size=(160, 120)), Listener())
    errors = []
    for view in scene.views[:: max(1, len(scene.views) // views)]:
        assert view.depth is not None
        rendered = rasterize(scene.mesh, view.camera).depth
        both = (rendered > 0) & (view.depth > 0)
        errors.append((rendered - view.depth)[both].abs())
    return float(torch.cat(errors).median())


@pytest.mark.parametrize("name", [pytest.param("apt0_kitchen", marks=needs_samples)])
def test_kitchen_holds_out_the_frames_that_its_scores_are_for(name: str) -> None:
    scene = ingest(SAMPLES / name, TextureConfig(size=(64, 64), holdout=8), Listener())
    assert [int(view.name.split("_")[-1]) for view in scene.heldout] == list(range(34, 99, 8))
    assert len(scene.views) == 62


@pytest.mark.parametrize("name", [pytest.param("redkitchen_A", marks=needs_samples)])
def test_red_kitchen_holds_out_the_frames_that_its_scores_are_for(name: str) -> None:
    scene = ingest(SAMPLES / name, TextureConfig(size=(64, 64), holdout=8), Listener())
    assert [int(view.name.split("-")[-1]) for view in scene.heldout] == list(range(32, 353, 64))
    assert len(scene.views) == 44
    assert scene.views[0].camera.K[0, 0] == pytest.approx(521.5 / 10, rel=1e-3)  # the color camera's, not 585


@pytest.mark.parametrize(
    ("name", "limit"),
    [pytest.param(name, limit, marks=needs_samples) for name, limit in (("redkitchen_A", 0.012), ("shelf_bin", 0.008))],
)
def test_device_depth_lies_on_the_mesh_in_the_color_camera(name: str, limit: float) -> None:
    assert median_error(SAMPLES / name, 5) < limit


@pytest.mark.parametrize("name", [pytest.param("redkitchen_A", marks=needs_samples)])
def test_ignoring_the_depth_camera_would_show(name: str) -> None:
    """The control of the test above: as if color were registered, edges of depth and mesh part."""
    scene = ingest(SAMPLES / name, TextureConfig(size=(160, 120)), Listener())
    raw = decode_depth(
        (SAMPLES / name / "frame-000000.depth.png").read_bytes(), "d", Intrinsics(585, 585, 320.5, 240.5, 640, 480)
    )
    metres = torch.from_numpy(DepthEncoding("mm", 1000.0).metres(raw))
    view = scene.views[0]
    assert view.depth is not None
    wrong = depth_in_color_image(metres[2::4, 2::4].contiguous(), view.camera, view.camera)
    rendered = rasterize(scene.mesh, view.camera).depth
    off = []
    for depth in (view.depth, wrong):
        both = (rendered > 0) & (depth > 0)
        off.append(float(((rendered - depth).abs()[both] > 0.05).float().mean()))
    assert off[0] < 0.7 * off[1]


def test_opencv_refuses_what_claims_to_be_larger_than_any_texture() -> None:
    """The second line of defense, in a process of its own: OpenCV reads the limit once, when it is loaded."""
    program = (
        "import sys, advtex_engine.pipeline, cv2, numpy\n"
        "try: cv2.imdecode(numpy.frombuffer(sys.stdin.buffer.read(), numpy.uint8), cv2.IMREAD_COLOR)\n"
        "except cv2.error as error: sys.exit('CV_IO_MAX_IMAGE_PIXELS' not in str(error))\n"
        "sys.exit(2)"
    )
    completed = subprocess.run([sys.executable, "-c", program], input=png_header(30_000, 30_000), check=False)
    assert completed.returncode == 0

"""Each layout, written by the test from known cameras and read back."""

from __future__ import annotations

import json
import struct
import zlib

import numpy as np
import pytest

from advtex_scan import ByteRange, Intrinsics, open_scan, read_scan
from advtex_scan.matrices import matrix4, up_axis_of

K = (30.0, 31.0, 15.5, 11.5)  # as files write it: the first pixel's centre at (0, 0)
EXPECTED = Intrinsics(30.0, 31.0, 16.0, 12.0, 32, 24)
ANGLES = (0.0, 1.0, 2.0, 3.0)


def text(matrix) -> bytes:
    return "\n".join(" ".join(f"{value:.6f}" for value in row) for row in matrix).encode()


def matrix(size: int, fx: float, fy: float, cx: float, cy: float):
    full = np.eye(size)
    full[0, 0], full[1, 1], full[0, 2], full[1, 2] = fx, fy, cx, cy
    return full


def offset_transform():
    """Depth-camera to color-camera coordinates with some rotation and a baseline."""
    c, s = np.cos(0.1), np.sin(0.1)
    return np.array([[c, -s, 0, -0.02], [s, c, 0, 0.004], [0, 0, 1, 0.001], [0, 0, 0, 1]])


def reading(path):
    with open_scan(path) as archive:
        return read_scan(archive)


def check_cameras(manifest, make, transform=None):
    """Poses are the color camera's, and manifest's rule gives the depth camera's back."""
    transform = np.eye(4) if transform is None else transform
    assert len(manifest.frames) == len(ANGLES)
    for frame, angle in zip(manifest.frames, ANGLES, strict=True):
        depth_camera = np.array(make.look_at(angle))
        color_to_world = np.array(frame.camera_to_world)
        np.testing.assert_allclose(color_to_world, depth_camera @ np.linalg.inv(transform), atol=2e-5)
        np.testing.assert_allclose(color_to_world @ np.array(manifest.depth_to_color), depth_camera, atol=2e-5)
        assert frame.color_intrinsics == EXPECTED
        assert frame.depth_intrinsics == EXPECTED


@pytest.fixture
def scannet(maker, make):
    maker.files = {
        "intrinsic/intrinsic_color.txt": text(matrix(4, *K)),
        "intrinsic/intrinsic_depth.txt": text(matrix(4, *K)),
        "intrinsic/extrinsic_color.txt": text(np.eye(4)),
        "intrinsic/extrinsic_depth.txt": text(np.eye(4)),
        "scene0000_00_vh_clean_2.ply": make.ply(),
        "scene0000_00_vh_clean.ply": make.ply(),
        "scene0000_00_vh_clean_2.labels.ply": make.ply(),
    }
    for i, angle in enumerate(ANGLES):
        maker.files |= {f"color/{i + 9}.jpg": make.jpeg(), f"depth/{i + 9}.png": make.depth_png()}
        maker.files[f"pose/{i + 9}.txt"] = text(make.look_at(angle))
    return maker


@pytest.fixture
def seven(maker, make):
    maker.files = {"camera-intrinsics.txt": text(matrix(3, *K)), "mesh.ply": make.ply(), "notes.txt": b"a note"}
    for i, angle in enumerate(ANGLES):
        stem = f"frame-{i:06d}"
        maker.files |= {f"{stem}.color.png": make.png(), f"{stem}.depth.png": make.depth_png()}
        maker.files[f"{stem}.pose.txt"] = text(make.look_at(angle))
    return maker


@pytest.fixture
def cam(maker, make):
    maker.files = {
        "intrinsics.txt": b"color 32 24 fx 30 fy 31 cx 15.5 cy 11.5\ndepth 32 24 fx 30 fy 31 cx 15.5 cy 11.5\n"
    }
    maker.files["mesh.ply"] = make.ply()
    for i, angle in enumerate(ANGLES):
        world_to_camera = np.linalg.inv(make.look_at(angle))
        numbers = [*world_to_camera[:3, 3], *world_to_camera[:3, :3].ravel()]
        line = " ".join(f"{number:.6g}" for number in numbers)
        maker.files |= {f"color_{98 + i}.jpg": make.jpeg(), f"depth_{98 + i}.png": make.depth_png()}
        maker.files[f"color_{98 + i}.cam"] = f"{line}\n30 0 0 1 16 12\n".encode()
    return maker


def sens_bytes(make, color=2, depth=1, poses=None, count=None, version=4) -> bytes:
    poses = [make.look_at(angle) for angle in ANGLES] if poses is None else poses
    name = b"StructureSensor"
    data = struct.pack("<IQ", version, len(name)) + name
    for one in (matrix(4, *K), np.eye(4), matrix(4, *K), np.eye(4)):
        data += one.astype("<f4").tobytes()
    data += struct.pack("<2i4IfQ", color, depth, 32, 24, 32, 24, 1000.0, len(poses) if count is None else count)
    depth_blob = bytes(32 * 24 * 2) if depth == 0 else zlib.compress(bytes(32 * 24 * 2))
    color_blob = bytes(32 * 24 * 3) if color == 0 else make.jpeg()
    for i, pose in enumerate(poses):
        data += np.array(pose, "<f4").tobytes() + struct.pack("<4Q", i, i, len(color_blob), len(depth_blob))
        data += color_blob + depth_blob
    return data + struct.pack("<Q", 0)


@pytest.fixture
def sens(maker, make):
    maker.files = {"scene0001_00.sens": sens_bytes(make), "scene0001_00_vh_clean_2.ply": make.ply()}
    return maker


@pytest.mark.parametrize("layout", ["scannet", "seven", "cam", "sens"])
@pytest.mark.parametrize("form", ["folder", "zip"])
def test_a_layout_is_found_and_read(layout, form, make, request):
    maker = request.getfixturevalue(layout)
    manifest, report = (lambda r: (r.manifest, r.report))(reading(getattr(maker, form)()))
    assert report.ok, report.format_text()
    assert report.layout == {"scannet": "scannet", "seven": "seven_scenes", "cam": "mvs_cam", "sens": "sens"}[layout]
    assert report.why
    assert manifest.layout == report.layout
    assert manifest.depth_scale == 1000
    assert [frame.name for frame in manifest.frames] == sorted(frame.name for frame in manifest.frames)
    check_cameras(manifest, make)


def test_native_is_read_as_written(maker, make):
    maker.native(4)
    maker.scan |= {"kind": "scene", "up_axis": "-y", "depth_scale": 5000, "depth_to_color": offset_transform().tolist()}
    maker.scan["depth_intrinsics"] = {"fx": 15, "fy": 15.5, "cx": 8, "cy": 6, "width": 16, "height": 12}
    for i in range(4):
        maker.files[f"depth/{i}.png"] = make.depth_png(16, 12)
    own = {"fx": 31, "fy": 32, "cx": 15, "cy": 13, "width": 32, "height": 24}
    maker.scan["frames"][1] |= {"color_intrinsics": own, "name": "zebra"}
    maker.scan["frames"][2]["camera_to_world"] = [v for row in make.look_at(0.5) for v in row]
    del maker.scan["frames"][3]["depth"]
    manifest = reading(maker.zip()).manifest
    assert (manifest.kind, manifest.up_axis, manifest.depth_scale) == ("scene", "-y", 5000)
    np.testing.assert_array_equal(manifest.depth_to_color, offset_transform())
    assert [frame.name for frame in manifest.frames] == ["000000", "000002", "000003", "zebra"]
    first, third, fourth, zebra = manifest.frames
    assert first.color_intrinsics == Intrinsics(30, 30, 16, 12, 32, 24), "no half pixel is added here"
    assert first.depth_intrinsics == Intrinsics(15, 15.5, 8, 6, 16, 12)
    assert zebra.color_intrinsics == Intrinsics(**own)
    np.testing.assert_array_equal(third.camera_to_world, make.look_at(0.5))
    assert (first.color, first.depth, fourth.depth) == ("color/0.png", "depth/0.png", None)
    assert manifest.mesh.path == "mesh.ply"


def test_seven_scenes_color_camera_from_its_own_files(seven, make):
    seven.files |= {
        "camera-intrinsics.txt": text(matrix(3, 40, 41, 15.5, 11.5)),
        "color-intrinsics-estimated.txt": text(matrix(3, *K)),
        "depth-to-color-estimated.txt": text(offset_transform()),
    }
    manifest = reading(seven.folder()).manifest
    assert manifest.frames[0].depth_intrinsics == Intrinsics(40, 41, 16, 12, 32, 24)
    frames = [frame.camera_to_world for frame in manifest.frames]
    for pose, angle in zip(frames, ANGLES, strict=True):
        np.testing.assert_allclose(pose, make.look_at(angle) @ np.linalg.inv(offset_transform()), atol=2e-5)
    assert manifest.frames[0].color_intrinsics == EXPECTED


def test_bundlefusion_info_with_another_color_size(seven, make):
    del seven.files["camera-intrinsics.txt"]
    seven.files["info.txt"] = (
        "m_colorWidth = 64\nm_colorHeight = 48\nm_depthWidth = 32\nm_depthHeight = 24\nm_depthShift = 500\n"
        f"m_calibrationColorIntrinsic = {' '.join(map(str, matrix(4, 60, 62, 31.5, 23.5).ravel()))}\n"
        f"m_calibrationDepthIntrinsic = {' '.join(map(str, matrix(4, *K).ravel()))} \n"
    ).encode()
    found = reading(seven.folder())
    assert found.manifest.depth_scale == 500
    assert found.manifest.frames[0].color_intrinsics == EXPECTED, "scaled to the images, half pixel and all"
    assert [finding.code for finding in found.report.findings if finding.severity == "warning"] == ["color_scaled"]


@pytest.mark.parametrize("camera", ["Color", "Depth"])
def test_bundlefusion_extrinsics_are_ignored_with_a_warning(seven, camera):
    def warnings(matrix) -> list[str]:
        line = " ".join(str(value) for value in np.ravel(matrix))
        seven.files["info.txt"] = f"m_depthShift = 1000\nm_calibration{camera}Extrinsic = {line} \n".encode()
        report = reading(seven.folder()).report
        assert report.ok
        found = [finding for finding in report.findings if finding.severity == "warning"]
        assert all(finding.code == "extrinsic_ignored" and finding.remedy for finding in found)
        return [f"{finding.where}: {finding.message}" for finding in found]

    assert warnings(np.eye(4)) == warnings(np.zeros((4, 4))) == []
    ignored = f"info.txt: m_calibration{camera}Extrinsic is not the identity and is ignored"
    assert warnings(offset_transform()) == [ignored]
    assert warnings(np.eye(3)) == [f"info.txt: m_calibration{camera}Extrinsic does not hold 16 numbers and is ignored"]
    seven.files["depth-to-color.txt"] = text(offset_transform())
    assert warnings(offset_transform()) == [], "the remedy helps"


def test_depth_without_intrinsics_of_its_own_is_taken_as_registered(seven):
    seven.files["camera-intrinsics.color.txt"] = seven.files.pop("camera-intrinsics.txt")
    found = reading(seven.folder())
    assert found.report.ok
    assert found.manifest.frames[0].depth_intrinsics == EXPECTED
    assert "depth_as_color" in {finding.code for finding in found.report.findings}


def test_scannet_honors_the_color_camera_of_the_scene_file(scannet, make):
    color_to_depth = np.linalg.inv(offset_transform())
    line = " ".join(f"{value:.6f}" for value in color_to_depth.ravel())
    scannet.files["scene0000_00.txt"] = f"axisAlignment = 1 2 3\ncolorToDepthExtrinsics = {line}\n".encode()
    check_cameras(reading(scannet.folder()).manifest, make, offset_transform())


def test_scannet_color_that_was_resampled(scannet):
    scannet.files["scene0000_00.txt"] = b"colorWidth = 64\ncolorHeight = 48\nnumDepthFrames = 4\n"
    scannet.files["intrinsic/intrinsic_color.txt"] = text(matrix(4, 60, 62, 31.5, 23.5))
    assert reading(scannet.folder()).manifest.frames[0].color_intrinsics == EXPECTED


def test_scannet_meshes_and_lost_poses(scannet):
    scannet.files["pose/10.txt"] = text(np.full((4, 4), -np.inf))
    scannet.files["pose/11.txt"] = b"-1.#INF -1.#INF -1.#INF -1.#INF\n" * 3 + b"0 0 0 1\n"
    found = reading(scannet.zip())
    assert found.manifest.mesh.path == "scene0000_00_vh_clean_2.ply"
    assert [frame.name for frame in found.manifest.frames] == ["000009", "000012"]
    assert found.report.dropped == {"lost_tracking": 2}
    assert (found.report.frames_found, found.report.frames_usable) == (4, 2)


def test_cam_names_sort_as_their_numbers(cam):
    frames = reading(cam.folder()).manifest.frames
    assert [frame.color for frame in frames] == ["color_98.jpg", "color_99.jpg", "color_100.jpg", "color_101.jpg"]


def test_cam_second_line_stands_in_for_intrinsics(cam, make):
    del cam.files["intrinsics.txt"]
    for name in [name for name in cam.files if name.startswith("depth")]:
        del cam.files[name]
    for name in [name for name in cam.files if name.endswith(".cam")]:
        first = cam.files[name].splitlines()[0]
        cam.files[name] = first + b"\n%f 0 0 %f 0.5 0.5\n" % (30 / 32, 31 / 30)
    frame = reading(cam.folder()).manifest.frames[0].color_intrinsics
    np.testing.assert_allclose([frame.fx, frame.fy, frame.cx, frame.cy], [30, 31, 16, 12], atol=1e-4)


CONFIG = b"""%YAML:1.0
# cameras
depth_fx: 15
depth_fy: 15.5
depth_cx: 7.5
depth_cy: 5.5
depth_width: 16
depth_height: 12

RGB_fx: 30 # pixels
RGB_fy: 31
RGB_cx: 15.5
RGB_cy: 11.5
RGB_width: 32
RGB_height: 24

Global_Iterations: 300
"""


@pytest.mark.parametrize("form", ["folder", "zip"])
def test_cam_intrinsics_of_g2ltex(cam, make, form):
    del cam.files["intrinsics.txt"]
    cam.files |= {name: make.depth_png(16, 12) for name in cam.files if name.startswith("depth")}
    cam.files["Config/config.yml"] = CONFIG
    found = reading(getattr(cam, form)())
    assert found.report.ok, found.report.format_text()
    assert found.report.findings == ()
    for frame in found.manifest.frames:
        assert frame.color_intrinsics == EXPECTED
        assert frame.depth_intrinsics == Intrinsics(15, 15.5, 8, 6, 16, 12)


def test_cam_intrinsics_in_a_file_of_their_own_come_first(cam):
    cam.files["Config/config.yml"] = CONFIG.replace(b"RGB_fx: 30", b"RGB_fx: 99")
    found = reading(cam.folder())
    assert found.manifest.frames[0].color_intrinsics == EXPECTED
    assert [(finding.code, finding.where) for finding in found.report.findings] == [
        ("ignored_file", "Config/config.yml")
    ]


@pytest.mark.parametrize(
    ("line", "code", "message"),
    [
        (b"RGB_fx: wide", "bad_numbers", "RGB_fx to RGB_height"),
        (b"RGB_fx:", "bad_numbers", "RGB_fx to RGB_height"),
        (b"RGB_fx: -30", "bad_intrinsics", "fx -30"),
    ],
)
def test_bad_intrinsics_of_g2ltex_are_named(cam, line, code, message):
    del cam.files["intrinsics.txt"]
    cam.files["Config/config.yml"] = CONFIG.replace(b"RGB_fx: 30 # pixels", line)
    errors = [finding for finding in reading(cam.folder()).report.findings if finding.severity == "error"]
    assert [(error.code, error.where) for error in errors] == [(code, "Config/config.yml"), ("too_few_frames", "")]
    assert message in errors[0].message


def test_sens_frames_are_ranges_of_the_stream(sens, make):
    with open_scan(sens.zip()) as archive:
        frame = read_scan(archive).manifest.frames[1]
        assert isinstance(frame.color, ByteRange)
        assert (frame.color.codec, frame.depth.codec) == ("jpeg", "zlib_u16")
        assert archive.read(frame.color) == make.jpeg()
        assert zlib.decompress(archive.read(frame.depth)) == bytes(32 * 24 * 2)


def test_a_lone_sens_is_a_scan_whatever_it_is_called(sens, make, tmp_path):
    path = tmp_path / "as-a-server-stores-it.zip"
    path.write_bytes(sens.files["scene0001_00.sens"])
    del sens.files["scene0001_00_vh_clean_2.ply"]
    with open_scan(path) as lone, open_scan(sens.zip()) as packed:
        assert lone.names() == ("scan.sens",)
        assert lone.stamps()[0][1:] == packed.stamps()[0][1:]
        frames = [read_scan(archive).manifest.frames for archive in (lone, packed)]
        assert len(frames[0]) == len(frames[1]) > 0
        for one, same in zip(*frames, strict=True):
            assert one.camera_to_world == same.camera_to_world
            assert lone.read(one.color) == packed.read(same.color)
    path.write_bytes(path.read_bytes()[:-200])
    assert "truncated_file" in [one.code for one in reading(path).report.findings if one.severity == "error"]


def test_sens_of_raw_images(sens, make):
    sens.files["scene0001_00.sens"] = sens_bytes(make, color=0, depth=0)
    found = reading(sens.folder())
    assert found.report.ok
    assert (found.manifest.frames[0].color.codec, found.manifest.frames[0].depth.codec) == ("raw_rgb8", "raw_u16")
    assert found.manifest.frames[0].color.length == 32 * 24 * 3


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({"depth": 2}, "depth_format"),
        ({"version": 3}, "bad_sens"),
        ({"color": 7}, "bad_sens"),
        ({"count": 9}, "truncated_file"),
        ({"count": 10**15}, "bad_sens"),
    ],
)
def test_sens_that_is_refused(sens, make, changes, code):
    sens.files["scene0001_00.sens"] = sens_bytes(make, **changes)
    report = reading(sens.folder()).report
    assert code in {finding.code for finding in report.findings if finding.severity == "error"}


def test_truncated_sens_keeps_the_whole_frames(sens, make):
    sens.files["scene0001_00.sens"] = sens_bytes(make)[:-50]
    found = reading(sens.folder())
    assert "truncated_file" in {finding.code for finding in found.report.findings}
    assert [frame.name for frame in found.manifest.frames] == ["000000", "000001", "000002"]


def test_the_native_layout_wins_over_others(seven, make):
    native = {"version": 1, "color_intrinsics": make.intrinsics, "mesh": "mesh.ply", "frames": []}
    seven.files["scan.json"] = json.dumps(native).encode()
    assert reading(seven.folder()).report.layout == "native"


@pytest.mark.parametrize(
    ("names", "chosen"),
    [
        (["mesh.ply", "other.ply"], "mesh.ply"),
        (["mesh.obj", "other.ply"], "mesh.obj"),
        (["some/room.ply"], "some/room.ply"),
        (["a.ply", "b.ply"], None),
        (["mesh.obj", "mesh.glb"], None),
    ],
)
def test_which_mesh_is_taken(seven, make, names, chosen):
    content = seven.files.pop("mesh.ply")
    seven.files |= dict.fromkeys(names, content)
    found = reading(seven.folder())
    if chosen:
        assert found.manifest.mesh.path == chosen
    else:
        ambiguous = [finding for finding in found.report.findings if finding.code == "ambiguous_mesh"]
        assert all(name in ambiguous[0].message for name in names)
        assert "no_mesh" not in {finding.code for finding in found.report.findings}


@pytest.mark.parametrize("up", ["+x", "-x", "+y", "-y", "+z", "-z"])
def test_the_up_axis_of_a_world_without_one_is_where_cameras_have_their_upper_side(up: str) -> None:
    down = -np.eye(3)["xyz".index(up[1])] * (1 if up[0] == "+" else -1)
    side = np.roll(down, 1)
    poses = []
    for tilt in (-0.5, 0.1, 0.4):
        pose = np.eye(4)
        forward = np.cross(side, down)
        pose[:3, 1] = np.cos(tilt) * down + np.sin(tilt) * forward
        pose[:3, 0] = side
        pose[:3, 2] = np.cross(pose[:3, 0], pose[:3, 1])
        poses.append(matrix4(pose.flatten().tolist()))
    lost = matrix4([float("-inf")] * 16)
    assert up_axis_of([*poses, lost]) == up
    assert up_axis_of([lost]) == "+z"

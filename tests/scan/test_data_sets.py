"""The layouts of data sets, written by the test from known cameras and read back."""

from __future__ import annotations

import json
import math
import struct
import tracemalloc
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from advtex_scan import Intrinsics, open_scan, read_scan
from advtex_scan.layouts._sequences import Track, blend, by_place, natural_key, nearest, paired
from advtex_scan.manifest import Distortion
from advtex_scan.matrices import from_quaternion, from_rotation_vector, matrix4, pose_problem

Files = dict[str, bytes]
Pose = np.ndarray
WIDTH, HEIGHT = 32, 24
EXPECTED = Intrinsics(30.0, 31.0, 16.0, 12.0, WIDTH, HEIGHT)
MATRIX = b"30 0 15.5\n0 31 11.5\n0 0 1\n"
FEW = settings(
    max_examples=25, deadline=10_000, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)


def numbers(values) -> str:
    return " ".join(f"{value:.12g}" for value in np.ravel(values))


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """x y z w, w >= 0: the eigenvector of the largest eigenvalue of Bar-Itzhack's matrix."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    K = np.array(
        [
            [a - e - i, b + d, c + g, h - f],
            [b + d, e - a - i, f + h, c - g],
            [c + g, f + h, i - a - e, d - b],
            [h - f, c - g, d - b, a + e + i],
        ]
    )
    found = np.linalg.eigh(K)[1][:, -1]
    return found if found[3] >= 0 else -found


def rotation_vector(rotation: np.ndarray) -> np.ndarray:
    x, y, z, w = quaternion(rotation)
    length = math.hypot(x, y, z)
    return np.array([x, y, z]) * (2 * math.atan2(length, w) / length if length else 2.0)


def tum(poses: Sequence[Pose], make) -> Files:
    files, rgb, depth, truth = {}, "# color images\n", "# depth maps\n", "# ground truth\n"
    for i, pose in enumerate(poses):
        time = 1305031102.175304 + i / 30
        files[f"rgb/{time:.6f}.png"], files[f"depth/{time + 0.007:.6f}.png"] = make.png(), make.depth_png()
        rgb += f"{time:.6f} rgb/{time:.6f}.png\n"
        depth += f"{time + 0.007:.6f} depth/{time + 0.007:.6f}.png\n"
        truth += f"{time + 0.002:.4f} {numbers([*pose[:3, 3], *quaternion(pose[:3, :3])])}\n"
    lists = {"rgb.txt": rgb.encode(), "depth.txt": depth.encode(), "groundtruth.txt": truth.encode()}
    return files | lists | {"camera-intrinsics.txt": MATRIX}


def images(count: int, make, color: str, depth: str) -> Files:
    colors = {color.format(i): make.jpeg() if color.endswith("jpg") else make.png() for i in range(count)}
    return colors | {depth.format(i): make.depth_png() for i in range(count)}


def open3d_camera() -> dict:
    return {"width": WIDTH, "height": HEIGHT, "intrinsic_matrix": [30, 0, 0, 0, 31, 0, 15.5, 11.5, 1]}


def redwood(poses: Sequence[Pose], make) -> Files:
    files = images(len(poses), make, "color/{:05d}.jpg", "depth/{:05d}.png")
    blocks = [f"{i} {i} {i + 1}\n" + "\n".join(numbers(row) for row in pose) for i, pose in enumerate(poses)]
    log = "\n".join(blocks) + "\n"
    return files | {"trajectory.log": log.encode(), "intrinsic.json": json.dumps(open3d_camera()).encode()}


def open3d(poses: Sequence[Pose], make) -> Files:
    parameters = [{"intrinsic": open3d_camera(), "extrinsic": np.linalg.inv(pose).T.ravel().tolist()} for pose in poses]
    trajectory = {"class_name": "PinholeCameraTrajectory", "parameters": parameters}
    files = images(len(poses), make, "image/{:d}.png", "depth/{:d}.png")
    return files | {"camera.json": json.dumps(trajectory).encode()}


def sun3d(poses: Sequence[Pose], make) -> Files:
    files: Files = {"intrinsics.txt": MATRIX}
    for i in range(len(poses)):
        files[f"image/{i + 1:07d}-{i * 33_000:012d}.jpg"] = make.jpeg()
        files[f"depth/{i + 2:07d}-{i * 33_000 + 4_000:012d}.png"] = make.depth_png()
    files["depth/0000001-000009000000.png"] = make.depth_png()
    files["extrinsics/20130512130736.txt"] = "\n".join(numbers(pose[:3]) for pose in poses).encode()
    files["extrinsics/20120512130736.txt"] = b"1 2 3"
    return files


def replica(poses: Sequence[Pose], make) -> Files:
    camera = {"w": WIDTH, "h": HEIGHT, "fx": 30, "fy": 31, "cx": 15.5, "cy": 11.5, "scale": 6553.5}
    files = images(len(poses), make, "room0/results/frame{:06d}.jpg", "room0/results/depth{:06d}.png")
    files["room0/traj.txt"] = "\n".join(numbers(pose) for pose in poses).encode()
    return files | {"cam_params.json": json.dumps({"camera": camera}).encode()}


def arkitscenes(poses: Sequence[Pose], make) -> Files:
    files, half = {}, 0.5 * WIDTH / 1920
    trajectory = ""
    for i, pose in enumerate(poses):
        time = 4211.256 + i / 10
        stem = f"41069021_{time:.3f}"
        files[f"41069021_frames/lowres_wide/{stem}.png"] = make.png()
        files[f"41069021_frames/lowres_depth/{stem}.png"] = make.depth_png()
        files[f"41069021_frames/confidence/{stem}.png"] = make.png(bits=8, color_type=0)
        camera = f"{WIDTH} {HEIGHT} 30 31 {16 - half} {12 - half}"
        files[f"41069021_frames/lowres_wide_intrinsics/{stem}.pincam"] = camera.encode()
        inverse = np.linalg.inv(pose)
        trajectory += f"{time:.8f} {numbers([*rotation_vector(inverse[:3, :3]), *inverse[:3, 3]])}\n"
    return files | {"41069021_frames/lowres_wide.traj": trajectory.encode()}


def colmap_values(poses: Sequence[Pose]) -> list[tuple[np.ndarray, np.ndarray]]:
    """World-to-camera quaternions w x y z and translations."""
    inverse = [np.linalg.inv(pose) for pose in poses]
    return [(np.roll(quaternion(pose[:3, :3]), 1), pose[:3, 3]) for pose in inverse]


def colmap_text(poses: Sequence[Pose], make) -> Files:
    files = {f"images/cam {i}/{i}.jpg": make.jpeg() for i in range(len(poses))}
    lines = ["# Image list", "#   POINTS2D[] as (X, Y, POINT3D_ID)"]
    for i, (turn, shift) in enumerate(colmap_values(poses)):
        lines += [f"{i + 5} {numbers([*turn, *shift])} 3 cam {i}/{i}.jpg", "" if i % 2 else "1.5 2.5 -1 3.5 4.5 7"]
    files["sparse/0/images.txt"] = "\n".join(lines).encode() + b"\n"
    files["sparse/0/cameras.txt"] = b"# Camera list\n3 PINHOLE 32 24 30 31 16 12\n"
    return files | {"sparse/0/points3D.txt": b"# 3D points\n"}


def colmap_cameras(*cameras: tuple[int, int, Sequence[float]]) -> bytes:
    """cameras.bin of (id, number of the model, parameters)."""
    data = struct.pack("<Q", len(cameras))
    for identity, model, parameters in cameras:
        data += struct.pack(f"<IiQQ{len(parameters)}d", identity, model, WIDTH, HEIGHT, *parameters)
    return data


def colmap_images(poses: Sequence[Pose], points: int = 2) -> bytes:
    data = struct.pack("<Q", len(poses))
    for i, (turn, shift) in enumerate(colmap_values(poses)):
        data += struct.pack("<I7dI", i + 5, *turn, *shift, 3) + f"{i}.jpg".encode() + b"\0"
        data += struct.pack("<Q", points) + bytes(24 * points)
    return data


def colmap_binary(poses: Sequence[Pose], make) -> Files:
    files = {f"dense/images/{i}.jpg": make.jpeg() for i in range(len(poses))}
    files |= {"dense/sparse/cameras.bin": colmap_cameras((3, 1, (30, 31, 16, 12)))}
    return files | {"dense/sparse/images.bin": colmap_images(poses), "dense/sparse/points3D.bin": bytes(8)}


WRITERS: dict[str, tuple[Callable[[Sequence[Pose], object], Files], str, float]] = {
    "tum": (tum, "tum", 5000),
    "redwood": (redwood, "redwood", 1000),
    "open3d": (open3d, "redwood", 1000),
    "sun3d": (sun3d, "sun3d", 1000),
    "replica": (replica, "replica", 6553.5),
    "arkitscenes": (arkitscenes, "arkitscenes", 1000),
    "colmap text": (colmap_text, "colmap", 1000),
    "colmap binary": (colmap_binary, "colmap", 1000),
}


def reading(path):
    with open_scan(path) as archive:
        return read_scan(archive)


def circle(make, count: int = 12) -> list[Pose]:
    return [np.array(make.look_at(2 * math.pi * i / count)) for i in range(count)]


def check_cameras(manifest, poses, atol: float = 1e-6) -> None:
    """Poses as given, both cameras as EXPECTED; only COLMAP has no depth."""
    with_depth = manifest.layout != "colmap"
    assert len(manifest.frames) == len(poses)
    assert [frame.name for frame in manifest.frames] == sorted({frame.name for frame in manifest.frames})
    for frame, pose in zip(manifest.frames, poses, strict=True):
        np.testing.assert_allclose(frame.camera_to_world, pose, atol=atol)
        assert (frame.depth is not None) == with_depth
        for camera in [frame.color_intrinsics] + [frame.depth_intrinsics] * with_depth:
            assert (camera.width, camera.height) == (WIDTH, HEIGHT)
            np.testing.assert_allclose(
                [camera.fx, camera.fy, camera.cx, camera.cy],
                [EXPECTED.fx, EXPECTED.fy, EXPECTED.cx, EXPECTED.cy],
                rtol=1e-9,
            )


@pytest.mark.parametrize("form", ["folder", "zip"])
@pytest.mark.parametrize("name", WRITERS)
def test_a_data_set_is_found_and_read(maker, make, name, form):
    write, layout, scale = WRITERS[name]
    maker.files = write(circle(make), make) | {"mesh.ply": make.ply()}
    found = reading(getattr(maker, form)())
    assert found.report.ok, found.report.format_text()
    assert found.report.findings == (), "no other layout fits, and no file is left aside"
    assert (found.report.layout, found.manifest.layout) == (layout, layout)
    assert (found.manifest.depth_scale, found.manifest.depth_rotated) == (scale, layout == "sun3d")
    assert (found.report.frames_found, found.report.frames_usable) == (12, 12)
    check_cameras(found.manifest, circle(make))


parts = st.floats(-1, 1)


@st.composite
def rigid(draw) -> Pose:
    axis = np.array(draw(st.tuples(parts, parts, parts)))
    pose = np.array(from_rotation_vector(3.1 * axis, draw(st.tuples(*[st.floats(-50, 50)] * 3))))
    assert pose_problem(matrix4(pose.ravel().tolist())) is None
    return pose


@FEW
@given(poses=st.lists(rigid(), min_size=1, max_size=5), data=st.data())
@pytest.mark.parametrize("name", WRITERS)
def test_any_poses_read_back(maker, make, name, poses, data):
    write, _, _ = WRITERS[name]
    files = write(poses, make)
    maker.files = dict(data.draw(st.permutations(sorted(files.items()))))
    check_cameras(reading(maker.zip()).manifest, poses)


# What the data sets are like in detail --------------------------------------------------------------------------------


def report_of(maker):
    return reading(maker.folder()).report


def codes(report, *severities: str) -> set[str]:
    return {finding.code for finding in report.findings if finding.severity in (severities or ("error",))}


def test_tum_interpolates_motion_capture_and_takes_poses_of_frames_as_they_are(maker, make):
    """A camera that turns: motion capture at 100 Hz is read at each image's own time."""
    poses = [np.array(make.look_at(0.3 * i / 30)) for i in range(4)]
    maker.files = tum(poses, make)
    times = [1305031102.17 + i / 100 for i in range(14)]
    lines = []
    for time in times:
        pose = np.array(make.look_at(0.3 * (time - 1305031102.175304)))
        lines.append(f"{time:.4f} {numbers([*pose[:3, 3], *quaternion(pose[:3, :3])])}")
    maker.files["groundtruth.txt"] = "\n".join(lines).encode()
    check_cameras(reading(maker.folder()).manifest, poses, atol=3e-6)
    maker.files["groundtruth.txt"] = "\n".join(lines[:8]).encode()  # ends before the third image
    found = reading(maker.folder())
    assert found.report.dropped == {"missing_pose": 1}
    check_cameras(found.manifest, poses[:3], atol=1e-2)


@pytest.mark.parametrize(("name", "fx"), [("freiburg1", 517.3), ("freiburg2", 520.9), ("freiburg3", 535.4)])
def test_tum_knows_its_cameras_by_the_recording(maker, make, name, fx):
    maker.files = tum(circle(make), make)
    del maker.files["camera-intrinsics.txt"]
    assert codes(report_of(maker), "warning") == {"default_camera", "color_scaled"}
    maker.files["rgb.txt"] = (
        f"# color images\n# file: 'rgbd_dataset_{name}_desk.bag'\n".encode() + maker.files["rgb.txt"]
    )
    found = reading(maker.folder())
    assert codes(found.report, "warning") == {"color_scaled"}
    assert found.manifest.frames[0].color_intrinsics.fx == pytest.approx(fx * WIDTH / 640)
    assert found.manifest.frames[0].depth_intrinsics == found.manifest.frames[0].color_intrinsics
    assert (found.manifest.frames[0].color_intrinsics.distortion is None) == (name == "freiburg3")


def test_tum_images_without_a_partner(maker, make):
    maker.files = tum(circle(make), make)
    depths = sorted(name for name in maker.files if name.startswith("depth/"))
    colors = sorted(name for name in maker.files if name.startswith("rgb/"))
    del maker.files[depths[4]], maker.files[colors[2]]
    found = reading(maker.folder())
    assert found.report.dropped == {"missing_color": 1}
    assert [frame.depth for frame in found.manifest.frames].count(None) == 1
    assert len(found.manifest.frames) == 11


@pytest.mark.parametrize(
    ("file", "content", "code"),
    [
        ("rgb.txt", b"soon rgb/1.png\n", "bad_list"),
        ("rgb.txt", b"1305031102.1\n", "bad_list"),
        ("groundtruth.txt", b"1 2 3\n", "bad_list"),
        ("groundtruth.txt", b"1305031102.17 0 0 0 1 1 1 1\n", "bad_pose"),
        ("camera-intrinsics.txt", b"525", "bad_numbers"),
    ],
)
def test_tum_lists_that_are_wrong(maker, make, file, content, code):
    maker.files = tum(circle(make), make) | {file: content}
    errors = [finding for finding in report_of(maker).findings if finding.code == code]
    assert [(error.severity, error.where) for error in errors] == [("error", file)]
    assert errors[0].remedy


def test_redwood_trajectories_of_other_numbers(maker, make):
    maker.files = redwood(circle(make), make)
    blocks = maker.files["trajectory.log"].decode().splitlines()
    frames = [blocks[start : start + 5] for start in range(0, len(blocks), 5)]

    def trajectory(numbered) -> bytes:
        return "\n".join(line for number, lines in numbered for line in [f"{number} {number} 0", *lines[1:]]).encode()

    maker.files["trajectory.log"] = trajectory((i + 7, frames[i]) for i in reversed(range(12)))
    check_cameras(reading(maker.folder()).manifest, circle(make))
    maker.files["trajectory.log"] = trajectory((i, frames[i]) for i in (3, 8))
    found = reading(maker.folder())
    assert found.report.dropped == {"missing_pose": 10}
    check_cameras(found.manifest, [circle(make)[i] for i in (3, 8)])
    assert [frame.color for frame in found.manifest.frames] == ["color/00003.jpg", "color/00008.jpg"]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("0 0 1\n" + "1 0 0 0\n" * 4 + "1 1 2\n1 0 0 0\n", "no frame of a trajectory"),
        (("0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n") * 2, "two frames have the id 0"),
    ],
)
def test_redwood_trajectories_that_are_wrong(maker, make, content, message):
    maker.files = redwood(circle(make), make) | {"trajectory.log": content.encode()}
    errors = [finding for finding in report_of(maker).findings if finding.code == "bad_trajectory"]
    assert [error.where for error in errors] == ["trajectory.log"]
    assert message in errors[0].message


def test_redwood_lost_poses_and_the_default_camera(maker, make):
    maker.files = redwood(circle(make), make)
    del maker.files["intrinsic.json"]
    lines = maker.files["trajectory.log"].decode().splitlines()
    lines[16:19] = ["-inf -inf -inf -inf"] * 3
    maker.files["trajectory.log"] = "\n".join(lines).encode()
    found = reading(maker.folder())
    assert found.report.dropped == {"lost_tracking": 1}
    assert "default_camera" in codes(found.report, "warning")
    assert found.manifest.frames[0].color_intrinsics.fx == pytest.approx(525 * WIDTH / 640)


def test_redwood_camera_that_is_none(maker, make):
    maker.files = redwood(circle(make), make) | {"intrinsic.json": b'{"intrinsic_matrix": [1, 2]}'}
    assert codes(report_of(maker)) >= {"bad_intrinsics"}


def test_open3d_scene_with_its_mesh(maker, make):
    maker.files = redwood(circle(make), make)
    maker.files |= {"scene/integrated.ply": make.ply(), "fragments/fragment_000.ply": make.ply()}
    maker.files["scene/trajectory.log"] = maker.files.pop("trajectory.log")
    found = reading(maker.folder())
    assert found.manifest.mesh.path == "scene/integrated.ply"
    check_cameras(found.manifest, circle(make))


def test_sun3d_depth_goes_by_time_and_poses_end(maker, make):
    maker.files = sun3d(circle(make), make)
    maker.files["extrinsics/20130512130736.txt"] = b"1 0 0 0\n0 1 0 0\n0 0 1 0\n" * 11
    found = reading(maker.folder())
    assert found.report.dropped == {"missing_pose": 1}
    assert [frame.depth[:13] for frame in found.manifest.frames] == [f"depth/{i + 2:07d}" for i in range(11)]
    maker.files["extrinsics/20130512130736.txt"] = b"1 0 0 0\n0 1 0 0\n0 0 1\n"
    assert codes(report_of(maker)) >= {"bad_numbers"}


def test_replica_without_its_camera_file(maker, make):
    maker.files = replica(circle(make), make)
    del maker.files["cam_params.json"]
    found = reading(maker.folder())
    assert "default_camera" in codes(found.report, "warning")
    assert found.manifest.depth_scale == 6553.5
    assert codes(found.report) >= {"color_size"}, "1200x680 has another shape than the images"


@pytest.mark.parametrize("content", [b"{}", b"[]", b"{", b'{"camera": {"w": 32, "h": 24, "fx": 1}}', b'{"camera": 1}'])
def test_replica_cameras_that_are_none(maker, make, content):
    maker.files = replica(circle(make), make) | {"cam_params.json": content}
    assert codes(report_of(maker)) & {"bad_intrinsics", "bad_json"}


def test_arkitscenes_prefers_the_finer_images_and_interpolates_their_poses(maker, make):
    poses = [np.array(make.look_at(0.02 * i)) for i in range(8)]
    maker.files = arkitscenes(poses, make)
    for i in range(7):
        stem = f"41069021_{4211.256 + (i + 0.5) / 10:.3f}"
        maker.files[f"41069021_frames/vga_wide/{stem}.png"] = make.png(64, 48)
        camera = f"64 48 60 62 {32 - 1 / 60} {24 - 1 / 60}"
        maker.files[f"41069021_frames/vga_wide_intrinsics/{stem}.pincam"] = camera.encode()
        maker.files[f"41069021_frames/lowres_depth/41069021_{4211.256 + (i + 0.4) / 10:.3f}.png"] = make.depth_png()
    maker.files["41069021_3dod_mesh.ply"] = make.ply()
    maker.files["other.ply"] = make.ply()
    found = reading(maker.folder())
    assert found.report.ok, found.report.format_text()
    assert found.manifest.mesh.path == "41069021_3dod_mesh.ply"
    assert len(found.manifest.frames) == 7
    for i, frame in enumerate(found.manifest.frames):
        np.testing.assert_allclose(frame.camera_to_world, make.look_at(0.02 * (i + 0.5)), atol=2e-4)
        assert frame.color_intrinsics == Intrinsics(60, 62, 32, 24, 64, 48)
        assert frame.depth_intrinsics == EXPECTED
        assert frame.depth.endswith(f"{4211.256 + (i + 0.4) / 10:.3f}.png")


def test_arkitscenes_confidence_belongs_to_the_depth(maker, make):
    maker.files = arkitscenes(circle(make), make)
    del maker.files["41069021_frames/confidence/41069021_4211.556.png"]
    manifest = reading(maker.folder()).manifest
    assert (manifest.confidence_max, manifest.depth_farthest) == (2, 5.0)
    for i, frame in enumerate(manifest.frames):
        assert frame.confidence == (None if i == 3 else frame.depth.replace("lowres_depth", "confidence"))


def test_arkitscenes_frames_without_pose_or_camera(maker, make):
    maker.files = arkitscenes(circle(make), make)
    lines = maker.files["41069021_frames/lowres_wide.traj"].splitlines()
    maker.files["41069021_frames/lowres_wide.traj"] = b"\n".join(lines[:-2])
    del maker.files["41069021_frames/lowres_wide_intrinsics/41069021_4211.356.pincam"]
    maker.files["41069021_frames/lowres_wide_intrinsics/41069021_4211.456.pincam"] = b"32 24 x"
    report = report_of(maker)
    assert report.dropped == {"missing_pose": 2, "missing_intrinsics": 1}
    assert codes(report) >= {"bad_intrinsics"}


BENT = (0.1, -0.05, 0.001, -0.002)


@pytest.mark.parametrize(
    ("model", "parameters", "expected"),
    [
        (0, (30, 16, 12), (30, None)),
        (2, (30, 16, 12, 0.1), (30, Distortion(k1=0.1))),
        (3, (30, 16, 12, 0.1, -0.05), (30, Distortion(k1=0.1, k2=-0.05))),
        (4, (30, 31, 16, 12, *BENT), (31, Distortion(*BENT))),
        (4, (30, 31, 16, 12, 0, 0, 0, 0), (31, None)),
        (6, (30, 31, 16, 12, *BENT, 0.02, 0, 0, 0), (31, Distortion(*BENT, 0.02))),
    ],
)
def test_colmap_cameras(maker, make, model, parameters, expected):
    maker.files = colmap_binary(circle(make), make)
    maker.files["dense/sparse/cameras.bin"] = colmap_cameras((1, 5, [1] * 8), (3, model, parameters))
    cameras = {frame.color_intrinsics for frame in reading(maker.folder()).manifest.frames}
    assert cameras == {Intrinsics(30, expected[0], 16, 12, WIDTH, HEIGHT, expected[1])}


@pytest.mark.parametrize(
    ("model", "parameters", "message"),
    [
        (5, [1] * 8, "OPENCV_FISHEYE"),
        (7, [1] * 5, "FOV"),
        (17, [WIDTH, HEIGHT], "EQUIRECTANGULAR"),
        (6, [30, 31, 16, 12, 0, 0, 0, 0, 0, 0.1, 0, 0], "distortion beyond k3"),
    ],
)
def test_colmap_lenses_that_are_not_supported_say_how_to_go_on(maker, make, model, parameters, message):
    maker.files = colmap_binary(circle(make), make)
    maker.files["dense/sparse/cameras.bin"] = colmap_cameras((3, model, parameters))
    found = [finding for finding in report_of(maker).findings if finding.code == "camera_model"]
    assert [finding.where for finding in found] == ["sparse/cameras.bin: camera 3"]
    assert message in found[0].message
    assert "image_undistorter" in found[0].remedy


def test_colmap_takes_the_undistorted_model_else_the_largest(maker, make):
    maker.files = colmap_text(circle(make)[:4], make)
    maker.files |= {"sparse/1/cameras.txt": maker.files["sparse/0/cameras.txt"], "sparse/1/images.txt": b""}
    found = reading(maker.folder())
    assert found.manifest.frames[0].color.startswith("images/cam 0/")
    assert [finding.where for finding in found.report.findings if finding.code == "other_model"] == [
        "sparse/1/images.txt"
    ]
    maker.files |= colmap_binary(circle(make), make)
    assert len(reading(maker.folder()).manifest.frames) == 12


def test_colmap_meshes_are_not_point_clouds(maker, make):
    maker.files = colmap_binary(circle(make), make)
    maker.files |= {"dense/fused.ply": make.ply(faces=[]), "dense/meshed-delaunay.ply": make.ply()}
    maker.files |= {"dense/meshed-poisson.ply": make.ply()}
    found = reading(maker.folder())
    assert found.manifest.mesh.path == "meshed-poisson.ply"
    assert [finding.where for finding in found.report.findings if finding.code == "point_cloud"] == ["fused.ply"]
    assert found.report.ok, "depth is rendered from the mesh"
    for name in ("dense/meshed-poisson.ply", "dense/meshed-delaunay.ply"):
        del maker.files[name]
        (maker.root / "scan" / name).unlink()
    assert codes(report_of(maker)) == {"no_mesh"}


def test_colmap_images_that_are_not_there(maker, make):
    maker.files = colmap_binary(circle(make), make)
    del maker.files["dense/images/3.jpg"]
    assert report_of(maker).dropped == {"missing_color": 1}


def changed(data: bytes, at: int, layout: str, value: float) -> bytes:
    return data[:at] + struct.pack(layout, value) + data[at + struct.calcsize(layout) :]


IMAGE_AT = 8


@pytest.mark.parametrize(
    ("file", "at", "layout", "value", "code"),
    [
        ("cameras.bin", 0, "<Q", 2**63, "bad_colmap"),
        ("cameras.bin", 12, "<i", 99, "bad_colmap"),
        ("cameras.bin", 16, "<Q", 0, "bad_colmap"),
        ("cameras.bin", 32, "<d", math.nan, "bad_intrinsics"),
        ("images.bin", 0, "<Q", 10**9, "bad_colmap"),
        ("images.bin", 0, "<Q", 13, "bad_colmap"),
        ("images.bin", IMAGE_AT + 4, "<d", 9.0, "bad_pose"),
        ("images.bin", IMAGE_AT + 60, "<I", 77, "bad_colmap"),
        ("images.bin", IMAGE_AT + 64 + 6, "<Q", 2**64 - 1, "bad_colmap"),
    ],
)
def test_colmap_files_that_are_wrong(maker, make, file, at, layout, value, code):
    maker.files = colmap_binary(circle(make), make)
    name = f"dense/sparse/{file}"
    maker.files[name] = changed(maker.files[name], at, layout, value)
    errors = {finding.code: finding for finding in report_of(maker).findings if finding.severity == "error"}
    assert code in errors
    assert errors[code].remedy


# Helpers --------------------------------------------------------------------------------------------------------------


@given(st.lists(st.floats(-1e6, 1e6), max_size=20).map(sorted), st.floats(-1e6, 1e6), st.floats(0, 1e6))
def test_nearest_is_what_a_search_of_all_finds(times, time, tolerance):
    found = nearest(times, time, tolerance)
    best = min((abs(other - time) for other in times), default=math.inf)
    assert (found is not None) == (best <= tolerance)
    if found is not None:
        assert abs(times[found] - time) == best


@given(rigid(), st.tuples(parts, parts, parts), st.floats(0, 1))
def test_blending_stays_on_the_way(pose, axis, share):
    """A small turn by parts of it: what interpolation on the sphere gives, to the third order."""
    turn = 0.1 * np.array(axis)
    shift = np.array([0.3, -0.2, 0.1])
    step = np.array(from_rotation_vector(turn, shift))
    mixed = np.array(blend(matrix4(pose.ravel()), matrix4((pose @ step).ravel()), share))
    assert pose_problem(matrix4(mixed.ravel().tolist())) is None
    expected = pose @ np.array(from_rotation_vector(share * turn, share * shift))
    np.testing.assert_allclose(mixed, expected, atol=np.linalg.norm(turn) ** 2 / 8 + 1e-9)


def test_a_blend_that_is_no_rotation_gives_way_to_the_nearest_pose():
    start, opposite = matrix4(np.eye(4).ravel()), matrix4(np.diag([-1.0, -1, 1, 1]).ravel())
    track = Track([0.0, 1.0], [start, opposite], gap=2.0, tolerance=0.6)
    assert track.at(0.5) in (start, opposite)


@given(rigid())
def test_quaternions_and_rotation_vectors_give_the_matrices_they_were_made_of(pose):
    turn, shift = pose[:3, :3], pose[:3, 3].tolist()
    np.testing.assert_allclose(from_quaternion(*quaternion(turn), shift), pose, atol=1e-9)
    np.testing.assert_allclose(from_rotation_vector(rotation_vector(turn), shift), pose, atol=1e-6)


def test_rotation_vectors_without_a_length_are_no_pose():
    for value in (math.inf, math.nan, 1.7e308):
        assert pose_problem(from_rotation_vector((value, value, value), (0, 0, 0)))


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ([5, 6, 7], [5, 6, 7]),
        ([2, 0], [0, None, 2]),
        ([10, 30], [10, None, 30]),
        ([], [None, None, None]),
    ],
)
def test_poses_find_their_images(given, expected):
    assert by_place(["a/10.jpg", "a/20.jpg", "a/30.jpg"], given) == expected


def test_depth_images_find_their_images():
    colors = ["c/1-0.jpg", "c/2-33.jpg", "c/10-66.jpg"]
    assert paired(colors, ["d/7.png", "d/8.png", "d/9.png"]) == ["d/7.png", "d/8.png", "d/9.png"]
    assert paired(colors, ["d/10-70.png", "d/2-30.png"]) == [None, "d/2-30.png", "d/10-70.png"]
    assert paired(colors, ["d/x.png"]) == [None, None, None]
    assert sorted(["a10", "a9", "b"], key=natural_key) == ["a9", "a10", "b"]


# Whatever bytes come in -----------------------------------------------------------------------------------------------

MEMORY = 64 << 20  # bytes; the scans here have less than 50 kB
edits = st.lists(st.tuples(st.integers(0, 1 << 20), st.integers(0, 255)), max_size=6)
WORDS = (
    b"nan",
    b"-inf",
    b"1e999",
    b"1e308",
    b"0",
    b"1",
    b"-1",
    b"x",
    b"#",
    b'{"',
    b"\n",
    b"99999999999999999999",
    b" ",
)


@FEW
@given(data=st.data())
@pytest.mark.parametrize("name", WRITERS)
def test_damaged_files_give_findings_only(maker, make, name, data):
    """Files cut short, edited, with words exchanged, swapped with each other, or missing."""
    files = WRITERS[name][0](circle(make, 4), make)
    texts = sorted(path for path in files if not path.endswith((".png", ".jpg")))
    for _ in range(data.draw(st.integers(1, 3))):
        path = data.draw(st.sampled_from(texts + sorted(files)[:3]))
        content = bytearray(files.get(path, b""))
        match data.draw(st.sampled_from(["cut", "edit", "word", "swap", "lose"])):
            case "cut":
                files[path] = bytes(content[: data.draw(st.integers(0, len(content)))])
            case "edit":
                for at, value in data.draw(edits) if content else ():
                    content[at % len(content)] = value
                files[path] = bytes(content)
            case "word":
                words = bytes(content).split(b" ")
                words[data.draw(st.integers(0, len(words) - 1))] = data.draw(st.sampled_from(WORDS))
                files[path] = b" ".join(words)
            case "swap":
                other = data.draw(st.sampled_from(texts))
                files[path], files[other] = files.get(other, b""), bytes(content)
            case "lose":
                files.pop(path, None)
    maker.files = files
    tracemalloc.start()
    try:
        report = reading(maker.zip()).report
        assert tracemalloc.get_traced_memory()[1] < MEMORY
    finally:
        tracemalloc.stop()
    json.dumps(report.to_dict(), allow_nan=False)
    report.format_text()
    assert all(finding.remedy for finding in report.findings if finding.severity == "error")

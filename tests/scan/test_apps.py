"""The layouts of phone apps, written by the test from known cameras and read back."""

from __future__ import annotations

import json
import math
import tracemalloc

import numpy as np
import pytest
from app_captures import (
    DEPTH_HEIGHT,
    DEPTH_WIDTH,
    HEIGHT,
    LAYOUT,
    PINHOLE,
    WIDTH,
    WRITERS,
    Capture,
    Pose,
    check_cameras,
    circle,
    depth,
    gray,
    lzfse,
    mp4,
    npy,
    polycam,
    record3d,
    scanner_app,
    stray_scanner,
)
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from advtex_scan import ByteRange, Intrinsics, VideoFrame, open_scan, read_scan
from advtex_scan.matrices import from_quaternion, matrix4, pose_problem

FEW = settings(
    max_examples=25, deadline=10_000, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)


def reading(path):
    with open_scan(path) as archive:
        return read_scan(archive)


def codes(report, severity: str = "error") -> set[str]:
    return {finding.code for finding in report.findings if finding.severity == severity}


@pytest.mark.parametrize("form", ["folder", "zip"])
@pytest.mark.parametrize("name", WRITERS)
def test_an_export_is_found_and_read(maker, make, name, form):
    maker.files = WRITERS[name](circle(make), make) | {"mesh.ply": make.ply()}
    found = reading(getattr(maker, form)())
    assert found.report.ok, found.report.format_text()
    assert {finding.severity for finding in found.report.findings} <= {"info"}
    assert found.report.layout == found.manifest.layout == LAYOUT[name]
    assert found.report.sureness > 0.8
    assert (found.report.frames_found, found.report.frames_usable) == (12, 12)
    assert found.manifest.depth_scale == pytest.approx(1000)
    assert found.manifest.mesh.path == "mesh.ply"
    check_cameras(found.manifest, circle(make))


@pytest.mark.parametrize("name", WRITERS)
def test_no_mesh_is_needed_and_none_is_looked_for_elsewhere(maker, make, name):
    maker.files = WRITERS[name](circle(make), make)
    report = reading(maker.zip()).report
    assert report.ok
    assert "mesh_fused" in codes(report, "info")


@pytest.mark.parametrize("name", ["polycam", "record3d", "stray_scanner", "scanner_app"])
def test_what_arkit_says_of_its_depth(maker, make, name):
    maker.files = WRITERS[name](circle(make), make)
    manifest = reading(maker.folder()).manifest
    assert all(frame.confidence is not None for frame in manifest.frames)
    assert manifest.confidence_max == (255 if name == "polycam" else 2)
    assert manifest.depth_farthest == (math.inf if name == "record3d" else 5.0)
    assert manifest.up_axis == "+y"


parts = st.floats(-1, 1)
pinholes = st.tuples(st.floats(5, 500), st.floats(5, 500), st.floats(12, 20), st.floats(9, 15))


@st.composite
def rigid(draw) -> Pose:
    turn = np.array(draw(st.tuples(parts, parts, parts, parts)))
    length = np.linalg.norm(turn)
    turn = turn / length if length > 1e-3 else np.array([0.0, 0.0, 0.0, 1.0])
    pose = np.array(from_quaternion(*turn.tolist(), draw(st.tuples(*[st.floats(-50, 50)] * 3))))
    assert pose_problem(matrix4(pose.ravel().tolist())) is None
    return pose


@FEW
@given(poses=st.lists(rigid(), min_size=1, max_size=5), pinhole=pinholes, data=st.data())
@pytest.mark.parametrize("name", WRITERS)
def test_any_cameras_read_back(maker, make, name, poses, pinhole, data):
    capture = Capture(poses, pinhole)
    files = WRITERS[name](capture, make)
    maker.files = dict(data.draw(st.permutations(sorted(files.items()))))
    check_cameras(reading(maker.zip()).manifest, capture)


# What the apps are like in detail -------------------------------------------------------------------------------------


def test_polycam_takes_the_corrected_cameras_without_their_black_border(maker, make):
    maker.files = polycam(circle(make), make)
    found = reading(maker.folder())
    assert "uncorrected_ignored" in codes(found.report, "info")
    assert all("corrected_images" in frame.color for frame in found.manifest.frames)
    assert [frame.sharpness for frame in found.manifest.frames] == [100.0 + i for i in range(12)]
    assert {frame.border for frame in found.manifest.frames} == {round(WIDTH * 15 / 1024)}


def test_polycam_without_corrected_cameras_takes_the_others_and_says_so(maker, make):
    maker.files = {name: data for name, data in polycam(circle(make), make).items() if "corrected_" not in name}
    found = reading(maker.folder())
    assert found.report.ok
    assert codes(found.report, "warning") == {"uncorrected"}
    assert {frame.border for frame in found.manifest.frames} == {0}
    np.testing.assert_allclose(found.manifest.frames[0].camera_to_world[0][3], circle(make).poses[0][0, 3] + 1)


def test_polycam_frames_that_were_not_corrected_are_left_out(maker, make):
    maker.files = polycam(circle(make), make)
    del maker.files["keyframes/corrected_cameras/824048931094.json"]
    del maker.files["keyframes/corrected_images/824049331094.jpg"]
    found = reading(maker.folder())
    assert found.report.dropped == {"missing_camera": 1, "missing_image": 1}
    assert (found.report.frames_found, len(found.manifest.frames)) == (12, 10)


def test_polycam_moves_its_mesh_to_the_cameras(maker, make):
    alignment = np.array(make.look_at(0.7))
    maker.files = polycam(circle(make), make)
    maker.files["raw.glb"] = b""
    maker.files["mesh_info.json"] = json.dumps({"alignmentTransform": alignment.T.ravel().tolist()}).encode()
    mesh = reading(maker.folder()).manifest.mesh
    assert mesh.path == "raw.glb"
    np.testing.assert_allclose(mesh.mesh_to_world, np.linalg.inv(alignment), atol=1e-12)
    for values in ([1] * 15, (2 * np.eye(4)).ravel().tolist(), "eye", None):
        maker.files["mesh_info.json"] = json.dumps({"alignmentTransform": values}).encode()
        assert "bad_transform" in codes(reading(maker.folder()).report)


def test_record3d_of_older_apps(maker, make):
    """One matrix for all frames, and a depth size that is known by the number of values."""
    maker.files = record3d(circle(make), make)
    metadata = json.loads(maker.files["metadata"])
    del metadata["perFrameIntrinsicCoeffs"], metadata["dw"], metadata["dh"]
    metadata["K"] = [30, 0, 0, 0, 31, 0, 16.25, 11.75, 1]
    maker.files["metadata"] = json.dumps(metadata).encode()
    for i in range(12):
        maker.files |= {f"rgbd/{i}.depth": lzfse(bytes(4 * 256 * 192)), f"rgbd/{i}.conf": lzfse(bytes(256 * 192))}
    found = reading(maker.folder())
    assert found.report.ok, found.report.format_text()
    assert found.manifest.frames[0].depth_intrinsics == Intrinsics(*PINHOLE, WIDTH, HEIGHT).scaled(256, 192)
    size = maker.files["rgbd/0.depth"]
    assert found.manifest.frames[0].depth == ByteRange("rgbd/0.depth", 0, len(size), "lzfse_f32")
    for i in range(12):
        maker.files[f"rgbd/{i}.depth"] = lzfse(bytes(4 * 100))
    report = reading(maker.folder()).report
    assert "depth_ignored" in codes(report, "warning")
    assert codes(report) == {"no_mesh"}


def test_record3d_held_upright(maker, make):
    maker.files = record3d(circle(make), make)
    metadata = json.loads(maker.files["metadata"]) | {"w": HEIGHT, "h": WIDTH}
    del metadata["dw"], metadata["dh"]
    maker.files["metadata"] = json.dumps(metadata).encode()
    for i in range(12):
        maker.files |= {f"rgbd/{i}.jpg": make.jpeg(HEIGHT, WIDTH), f"rgbd/{i}.depth": lzfse(bytes(4 * 256 * 192))}
        del maker.files[f"rgbd/{i}.conf"]
    camera = reading(maker.folder()).manifest.frames[0].depth_intrinsics
    assert (camera.width, camera.height) == (192, 256)


@pytest.mark.parametrize(
    "content", [b"", b"bvx-", lzfse(bytes(7)), lzfse(bytes(4 * DEPTH_WIDTH * DEPTH_HEIGHT))[:-4], bytes(900)]
)
def test_record3d_depth_that_is_damaged_is_named(maker, make, content):
    maker.files = record3d(circle(make), make) | {"rgbd/3.depth": content}
    errors = [finding for finding in reading(maker.folder()).report.findings if finding.severity == "error"]
    assert [(error.code, error.where) for error in errors] == [("bad_numbers", "rgbd/3.depth")]


def test_a_folder_around_an_r3d_says_to_give_the_file(maker, make):
    maker.files = {"capture.r3d": b"PK"}
    (finding,) = reading(maker.folder()).report.findings
    assert (finding.code, finding.where, finding.remedy) == (
        "unknown_layout",
        "capture.r3d",
        "give this file, not its folder",
    )


def test_stray_scanner_names_frames_of_the_video(maker, make):
    maker.files = stray_scanner(circle(make), make)
    manifest = reading(maker.folder()).manifest
    assert [frame.color for frame in manifest.frames] == [VideoFrame("rgb.mp4", i) for i in range(12)]


def test_stray_scanner_of_older_apps(maker, make):
    """One camera for all frames, depth as NumPy arrays, and frames without a line."""
    maker.files = stray_scanner(circle(make), make)
    lines = [line.split(b", ")[:9] for line in maker.files["odometry.csv"].splitlines()]
    maker.files["odometry.csv"] = b"\n".join(b", ".join(line) for line in lines[:4] + lines[6:])
    maker.files["camera_matrix.csv"] = b"30,0,16.25\n0,31,11.75\n0,0,1\n"
    for i in range(12):
        del maker.files[f"depth/{i:06d}.png"]
        maker.files[f"depth/{i:06d}.npy"] = npy(np.zeros((DEPTH_HEIGHT, DEPTH_WIDTH), np.uint16))
    found = reading(maker.folder())
    assert found.report.ok, found.report.format_text()
    assert found.report.dropped == {"missing_pose": 2}
    capture = circle(make)
    check_cameras(found.manifest, Capture([*capture.poses[:3], *capture.poses[5:]]))
    assert found.manifest.frames[3].depth.path == "depth/000005.npy"
    assert found.manifest.frames[3].depth.codec == "npy"


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"rgb.mp4": b""}, "bad_video"),
        ({"rgb.mp4": mp4(12)[:-5]}, "bad_video"),
        ({"rgb.mp4": mp4(12)[:60]}, "bad_video"),
        ({"rgb.mp4": mp4(12, first=b"text")}, "bad_video"),
        ({"rgb.mp4": mp4(0)}, "bad_video"),
        ({"rgb.mp4": mp4(7)}, "missing_color"),
        ({"odometry.csv": b""}, "bad_list"),
        ({"odometry.csv": b"frame, x\n0, 1\n"}, "bad_list"),
    ],
)
def test_stray_scanner_captures_that_are_broken(maker, make, change, code):
    maker.files = stray_scanner(circle(make), make) | change
    report = reading(maker.folder()).report
    assert code in codes(report)
    assert all(finding.remedy for finding in report.findings if finding.severity == "error")


def test_stray_scanner_without_any_camera(maker, make):
    maker.files = stray_scanner(circle(make), make)
    lines = [line.split(b", ")[:9] for line in maker.files["odometry.csv"].splitlines()]
    maker.files["odometry.csv"] = b"\n".join(b", ".join(line) for line in lines)
    del maker.files["camera_matrix.csv"]
    assert "no_color_intrinsics" in codes(reading(maker.folder()).report)


def test_scanner_app_poses_without_an_image_are_counted_and_no_fault(maker, make):
    maker.files = scanner_app(circle(make), make)
    for i in (0, 5, 6):
        del maker.files[f"frame_{i:05d}.jpg"]
    del maker.files["frame_00007.json"]
    found = reading(maker.folder())
    assert found.report.ok
    assert found.report.dropped == {"missing_color": 3, "missing_pose": 1}
    assert codes(found.report, "warning") == {"missing_pose"}
    assert [frame.name for frame in found.manifest.frames] == [f"{i:06d}" for i in (1, 2, 3, 4, 8, 9, 10, 11)]
    assert found.manifest.frames[0].depth == "depth_00001.png"
    assert found.manifest.frames[0].sharpness == 0.5


def test_depth_in_openexr_is_named_with_its_remedy(maker, make):
    maker.files = scanner_app(circle(make), make)
    for name in [name for name in maker.files if name.startswith("depth_")]:
        maker.files[name.replace(".png", ".exr")] = b"\x76\x2f\x31\x01" + bytes(20)
        del maker.files[name]
    maker.files |= {"mesh.ply": make.ply()}
    report = reading(maker.folder()).report
    assert report.ok, report.format_text()
    (warning,) = [one for one in report.findings if one.code == "exr_image"]
    assert (warning.severity, warning.where[:6]) == ("warning", "depth_")
    maker.files = {"rgb/0.jpg": make.jpeg(), "depth/0.exr": b"\x76\x2f\x31\x01", "metadata.json": b"{}"}
    (error,) = [one for one in reading(maker.folder("exported")).report.findings if one.severity == "error"]
    assert (error.code, error.where) == ("exr_image", "depth/0.exr")
    assert ".r3d" in error.remedy


def test_scanner_app_prefers_its_refined_mesh(maker, make):
    maker.files = scanner_app(circle(make), make)
    maker.files |= dict.fromkeys(("export.obj", "export_refined.obj", "textured_output.obj"), make.ply())
    assert reading(maker.folder()).manifest.mesh.path == "export_refined.obj"


def test_confidence_that_does_not_fit_is_left_out(maker, make):
    maker.files = scanner_app(circle(make), make)
    maker.files |= {"conf_00001.png": gray(make, 8, 8), "conf_00002.png": b"", "conf_00003.png": depth(make)}
    found = reading(maker.folder())
    assert found.report.ok
    assert codes(found.report, "warning") == {"confidence_ignored"}
    assert [frame.confidence is None for frame in found.manifest.frames[:5]] == [False, True, True, True, False]


# Whatever bytes come in -----------------------------------------------------------------------------------------------

MEMORY = 64 << 20  # bytes; the scans here have less than 50 kB
edits = st.lists(st.tuples(st.integers(0, 1 << 20), st.integers(0, 255)), max_size=6)
WORDS = (b"NaN", b"-Infinity", b"1e999", b"1e308", b"0", b"-1", b'"x"', b"null", b"[]", b"{}", b"\n", b",", b"9" * 20)


@FEW
@given(data=st.data())
@pytest.mark.parametrize("name", WRITERS)
def test_damaged_files_give_findings_only(maker, make, name, data):
    """Files cut short, edited, with words exchanged, swapped with each other, or missing."""
    files = WRITERS[name](circle(make, 4), make)
    spoiled = data.draw(st.lists(st.sampled_from(sorted(files)), min_size=1, max_size=4, unique=True))
    for path in spoiled:
        content = bytearray(files[path])
        match data.draw(st.sampled_from(["cut", "edit", "word", "swap", "drop"])):
            case "cut":
                content = content[: data.draw(st.integers(0, len(content)))]
            case "edit":
                for position, value in data.draw(edits):
                    content[position % len(content)] = value
            case "word":
                words = bytes(content).split(b" ")
                words[data.draw(st.integers(0, len(words) - 1))] = data.draw(st.sampled_from(WORDS))
                content = bytearray(b" ".join(words))
            case "swap":
                content = bytearray(files[data.draw(st.sampled_from(sorted(files)))])
            case "drop":
                del files[path]
                continue
        files[path] = bytes(content)
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

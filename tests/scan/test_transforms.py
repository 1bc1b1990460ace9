"""`transforms.json`: what nerfstudio, instant-ngp and NeRFCapture write each in their own way."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from app_captures import HEIGHT, WIDTH, Capture, check_cameras, circle, gray, instant_ngp, nerfstudio, npy

from advtex_scan import Distortion, open_scan, read_scan


def reading(path):
    with open_scan(path) as archive:
        return read_scan(archive)


def codes(report, severity: str = "error") -> set[str]:
    return {finding.code for finding in report.findings if finding.severity == severity}


def transforms(maker, **changes) -> None:
    scan = json.loads(maker.files["transforms.json"])
    maker.files["transforms.json"] = json.dumps(scan | changes).encode()


def test_transforms_applied_to_the_poses_are_undone(maker, make):
    """nerfstudio turns the world; meshes are those of the world before, but for the one that it names."""
    applied = np.array([[0, 1.0, 0, 0.5], [-1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
    capture = circle(make)
    turned = Capture([applied @ pose for pose in capture.poses])
    maker.files = nerfstudio(turned, make) | {"mesh.ply": make.ply()}
    transforms(maker, applied_transform=applied[:3].tolist())
    manifest = reading(maker.folder()).manifest
    check_cameras(manifest, capture)
    np.testing.assert_array_equal(manifest.mesh.mesh_to_world, np.eye(4))
    transforms(maker, ply_file_path="./mesh.ply")
    np.testing.assert_allclose(reading(maker.folder()).manifest.mesh.mesh_to_world, np.linalg.inv(applied), atol=1e-12)
    transforms(maker, applied_transform=(2 * applied[:3]).tolist())
    assert "bad_transform" in codes(reading(maker.folder()).report)


def test_transforms_with_a_lens(maker, make):
    maker.files = nerfstudio(circle(make), make)
    transforms(maker, k1=0.1, k2=-0.05, p1=0.001, p2=-0.002)
    frame = reading(maker.folder()).manifest.frames[0]
    assert frame.color_intrinsics.distortion == Distortion(0.1, -0.05, 0.001, -0.002)
    assert frame.depth_intrinsics.distortion == frame.color_intrinsics.distortion


@pytest.mark.parametrize("change", [{"camera_model": "OPENCV_FISHEYE"}, {"is_fisheye": True}])
def test_transforms_with_a_lens_that_is_not_supported(maker, make, change):
    maker.files = nerfstudio(circle(make), make)
    transforms(maker, **change)
    report = reading(maker.folder()).report
    assert "camera_model" in codes(report)
    assert "undistort" in report.findings[0].remedy


def test_transforms_by_the_angle_of_view(maker, make):
    maker.files = instant_ngp(circle(make), make)
    scan = json.loads(maker.files["transforms.json"])
    for frame in scan["frames"]:
        for key in ("fl_x", "fl_y", "cx", "cy"):
            del frame[key]
    maker.files["transforms.json"] = json.dumps(scan | {"camera_angle_x": 2 * math.atan(16 / 40)}).encode()
    camera = reading(maker.folder()).manifest.frames[0].color_intrinsics
    np.testing.assert_allclose([camera.fx, camera.fy, camera.cx, camera.cy], [40, 40, 16, 12])


def test_transforms_depth_of_any_scale(maker, make):
    maker.files = instant_ngp(circle(make), make)
    scan = json.loads(maker.files["transforms.json"])
    scan["depth_integer_scale"] = 10 / 65535
    del scan["integer_depth_scale"]
    maker.files["transforms.json"] = json.dumps(scan).encode()
    assert reading(maker.folder()).manifest.depth_scale == pytest.approx(6553.5)
    for value in (0, -1, "mm", 1e99):
        transforms(maker, depth_integer_scale=value)
        assert "bad_value" in codes(reading(maker.folder()).report)


def test_transforms_depth_of_8_bits_is_left_out(maker, make):
    maker.files = instant_ngp(circle(make), make) | {"mesh.ply": make.ply()}
    maker.files |= {name: gray(make) for name in maker.files if name.endswith(".depth.png")}
    found = reading(maker.folder())
    assert found.report.ok
    assert codes(found.report, "info") == {"depth_ignored"}
    assert {frame.depth for frame in found.manifest.frames} == {None}


def test_transforms_with_arrays_and_masks(maker, make):
    maker.files = nerfstudio(circle(make), make)
    scan = json.loads(maker.files["transforms.json"])
    for i, frame in enumerate(scan["frames"]):
        maker.files |= {f"d/{i}.npy": npy(np.zeros((6, 8), np.float32)), f"masks/{i}.png": gray(make, WIDTH, HEIGHT)}
        frame |= {"depth_file_path": f"d/{i}.npy", "mask_path": f"./masks/{i}.png"}
    maker.files["transforms.json"] = json.dumps(scan).encode()
    found = reading(maker.folder())
    assert found.report.ok, found.report.format_text()
    assert found.manifest.frames[4].mask == "masks/4.png"
    assert (found.manifest.frames[4].depth_intrinsics.width, found.manifest.frames[4].depth.codec) == (8, "npy")
    maker.files["masks/4.png"] = gray(make)
    assert codes(reading(maker.folder()).report) == {"mask_size"}


def test_transforms_frames_without_their_image(maker, make):
    maker.files = nerfstudio(circle(make), make)
    del maker.files["images/frame_00003.jpg"]
    found = reading(maker.folder())
    assert found.report.dropped == {"missing_color": 1}
    assert len(found.manifest.frames) == 11


@pytest.mark.parametrize("content", [b"{", b"[]", b"{}", b'{"frames": 3}', b'{"frames": [1, null, {"file_path": 3}]}'])
def test_transforms_that_are_none(maker, make, content):
    maker.files = nerfstudio(circle(make), make) | {"transforms.json": content}
    assert codes(reading(maker.folder()).report)

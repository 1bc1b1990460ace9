"""The real scans and the sample formats."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest

from advtex_scan import ByteRange, check_scan, open_scan, read_scan

pytestmark = pytest.mark.data
SCANS = {
    "scans/apt0_kitchen": ("mvs_cam", 71, 71, 299778),
    "scans/redkitchen_A": ("seven_scenes", 50, 50, 203248),
    "scans/shelf_bin": ("seven_scenes", 15, 15, 26506),
    "formats/bundlefusion_7scenes": ("seven_scenes", 6, 6, None),
    "formats/scannet_export": ("scannet", 7, 6, None),
    "formats/scannet_sens": ("sens", 6, 6, None),
    "formats/tum_rgbd": ("tum", 6, 6, None),
    "formats/redwood_open3d": ("redwood", 6, 6, None),
    "formats/replica_niceslam": ("replica", 6, 6, None),
    "formats/arkitscenes": ("arkitscenes", 6, 6, None),
    "formats/polycam_raw": ("polycam", 6, 6, None),
    "formats/stray_scanner": ("stray_scanner", 6, 6, None),
    "formats/3d_scanner_app": ("scanner_app", 6, 5, None),
    "formats/nerfstudio": ("nerfstudio", 6, 6, None),
}


def manifest_of(path):
    with open_scan(path) as archive:
        return read_scan(archive).manifest


@pytest.mark.parametrize("name", SCANS)
@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED], ids=["stored", "deflated"])
def test_a_folder_and_its_zip_give_the_same_report(data, tmp_path, name, method):
    layout, found, usable, faces = SCANS[name]
    report = check_scan(data / name)
    assert (report.layout, report.frames_found, report.frames_usable) == (layout, found, usable)
    assert report.ok
    assert ("mesh_fused" in {finding.code for finding in report.findings}) == (faces is None)
    assert report.mesh is None if faces is None else report.mesh.faces == faces
    with zipfile.ZipFile(tmp_path / "scan.zip", "w", method, compresslevel=1) as archive:
        for path in sorted((data / name).rglob("*")):
            archive.write(path, Path("top") / path.relative_to(data / name))
    assert check_scan(tmp_path / "scan.zip") == report
    assert manifest_of(tmp_path / "scan.zip") == manifest_of(data / name)


def test_an_r3d_is_a_scan_by_itself(data):
    report = check_scan(data / "formats/record3d/tiny.r3d")
    assert report.ok
    assert (report.layout, report.frames_found, report.frames_usable) == ("record3d", 6, 6)


@pytest.mark.parametrize("name", ["apt0_kitchen", "redkitchen_A"])
def test_color_cameras_are_those_of_the_judge(data, name):
    views = data / "judge" / name / "views"
    frames = manifest_of(data / "scans" / name).frames
    K = np.loadtxt(views / "intrinsics.txt")
    held_out = [frame for position, frame in enumerate(frames) if position % 8 == 4]
    poses = sorted(views.glob("*.pose.txt"))
    assert len(poses) == len(held_out)
    for frame, path in zip(held_out, poses, strict=True):
        assert int("".join(filter(str.isdigit, frame.name))) == int(path.name[6:12])
        np.testing.assert_allclose(frame.camera_to_world, np.loadtxt(path), atol=2e-5)
        camera = frame.color_intrinsics
        expected = [K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5]
        np.testing.assert_allclose([camera.fx, camera.fy, camera.cx, camera.cy], expected)


def test_one_scan_in_three_layouts_gives_the_same_cameras(data):
    manifests = [
        manifest_of(data / "formats" / name) for name in ("bundlefusion_7scenes", "scannet_export", "scannet_sens")
    ]
    for manifest in manifests[1:]:
        for frame, first in zip(manifest.frames, manifests[0].frames, strict=True):
            np.testing.assert_allclose(frame.camera_to_world, first.camera_to_world, atol=1e-6)
            for one, other in (
                (frame.color_intrinsics, first.color_intrinsics),
                (frame.depth_intrinsics, first.depth_intrinsics),
            ):
                np.testing.assert_allclose([one.fx, one.fy, one.cx, one.cy], [other.fx, other.fy, other.cx, other.cy])


def test_the_stream_holds_the_images_of_the_folder(data):
    with open_scan(data / "formats/scannet_sens") as stream, open_scan(data / "formats/scannet_export") as folder:
        pairs = zip(read_scan(stream).manifest.frames, read_scan(folder).manifest.frames, strict=True)
        for from_stream, from_folder in pairs:
            assert isinstance(from_stream.color, ByteRange)
            assert stream.read(from_stream.color) == folder.read(from_folder.color)


def test_unused_files_are_listed(data):
    ignored = [finding for finding in check_scan(data / "scans/shelf_bin").findings if finding.code == "ignored_file"]
    assert len(ignored) == 1
    assert "segm.png" in ignored[0].where
    assert "16 in all" in ignored[0].message

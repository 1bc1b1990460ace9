"""One scan's six frames in the layouts of many apps and data sets: the same cameras and the same depth from each."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from advtex_engine.ingest.decode import decode_depth
from advtex_engine.ingest.depth import DepthEncoding
from advtex_scan import Intrinsics, ScanManifest, open_scan, read_scan

FORMATS = Path(os.environ.get("ADVTEX_DATA", Path(__file__).parents[3].parent / "shared" / "data")) / "formats"
REFERENCE = "bundlefusion_7scenes"
HALF_PIXEL = 0.5  # some writers count pixels' centres from 0, some of the samples mix that up when they scale

pytestmark = [
    pytest.mark.data,
    pytest.mark.skipif(not FORMATS.is_dir(), reason="the sample formats are not there; point ADVTEX_DATA at them"),
]


@dataclass(frozen=True)
class Sample:
    """A scan beside the others: its layout, whether it states its cameras, and which of the frames it holds."""

    folder: str
    layout: str
    with_camera: bool = True
    frames: tuple[int, ...] = (0, 1, 2, 3, 4, 5)


SAMPLES = (
    Sample("bundlefusion_7scenes", "seven_scenes"),
    Sample("scannet_export", "scannet"),
    Sample("scannet_sens", "sens"),
    Sample("tum_rgbd", "tum", with_camera=False),
    Sample("redwood_open3d", "redwood"),
    Sample("replica_niceslam", "replica"),
    Sample("arkitscenes", "arkitscenes"),
    Sample("polycam_raw", "polycam"),
    Sample("record3d/tiny.r3d", "record3d"),
    Sample("stray_scanner", "stray_scanner"),
    Sample("3d_scanner_app", "scanner_app", frames=(0, 1, 2, 3, 5)),  # frame 4 has a pose but no image
    Sample("nerfstudio", "nerfstudio"),
)


def read(folder: str) -> tuple[ScanManifest, list[npt.NDArray[np.float32]]]:
    """The manifest and each frame's depth in metres."""
    with open_scan(FORMATS / folder) as archive:
        manifest = read_scan(archive).manifest
        assert manifest is not None
        encoding = DepthEncoding("", manifest.depth_scale, manifest.depth_rotated)
        depths = []
        for frame in manifest.frames:
            assert frame.depth is not None
            assert frame.depth_intrinsics is not None
            data = archive.read(frame.depth)
            raw = decode_depth(data, frame.depth, frame.depth_intrinsics, manifest.depth_scale)
            depths.append(encoding.metres(raw))
        return manifest, depths


@pytest.mark.parametrize("sample", SAMPLES, ids=lambda sample: sample.folder)
def test_the_same_cameras_and_depth(sample: Sample) -> None:
    reference, expected = read(REFERENCE)
    manifest, depths = read(sample.folder)
    assert manifest.layout == sample.layout
    assert [frame.name for frame in manifest.frames] == sorted(frame.name for frame in manifest.frames)
    for frame, same in zip(manifest.frames, [reference.frames[index] for index in sample.frames], strict=True):
        np.testing.assert_allclose(frame.camera_to_world, same.camera_to_world, atol=1e-4)
        if sample.with_camera:
            check_camera(frame.color_intrinsics, same.color_intrinsics)
            check_camera(frame.depth_intrinsics, same.depth_intrinsics)
    for depth, full in zip(depths, [expected[index] for index in sample.frames], strict=True):
        rows, columns = (np.arange(n) * whole // n for n, whole in zip(depth.shape, full.shape, strict=True))
        np.testing.assert_allclose(depth, full[rows[:, None], columns], atol=1e-3)


def check_camera(found: Intrinsics | None, expected: Intrinsics | None) -> None:
    assert found is not None
    assert expected is not None
    scaled = found.scaled(expected.width, expected.height)
    np.testing.assert_allclose([scaled.fx, scaled.fy], [expected.fx, expected.fy], rtol=1e-3)
    np.testing.assert_allclose([scaled.cx, scaled.cy], [expected.cx, expected.cy], atol=HALF_PIXEL)

"""Decoding of packed depth, confidence and masks, and rectification against plain formulas."""

from __future__ import annotations

import io
import json
import tracemalloc
from dataclasses import asdict
from pathlib import Path

import cv2
import imagecodecs
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from advtex_engine.core.config import TextureConfig
from advtex_engine.core.errors import ScanError
from advtex_engine.core.monitor import Monitor
from advtex_engine.ingest.decode import (
    decode_color,
    decode_confidence,
    decode_depth,
    decode_mask,
    fill_masked,
    rectified,
    rectify,
    shrink_mask,
)
from advtex_engine.ingest.read import ingest
from advtex_scan.manifest import ByteRange, Codec, Distortion, Intrinsics

CAMERA = Intrinsics(4, 4, 2, 1.5, 4, 3)
LENS = Distortion(k1=-0.2, k2=0.05, p1=0.003, p2=-0.002, k3=0.01)


def whole(codec: Codec) -> ByteRange:
    return ByteRange("depth/7", 0, 10, codec)


def npy(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


METRES = np.array([[0, np.nan, 1.2344, 1.2346], [0.0001, 65.534, 65.535, 70], [-1, np.inf, 3, 0.5]], "<f4")
STORED = [[0, 0, 1234, 1235], [0, 65534, 0, 0], [0, 0, 3000, 500]]


def test_depth_in_floats_becomes_the_scans_units() -> None:
    packed = imagecodecs.lzfse_encode(METRES.tobytes())
    assert decode_depth(packed, whole("lzfse_f32"), CAMERA).tolist() == STORED
    for kind in ("<f4", "<f8"):
        assert decode_depth(npy(METRES.astype(kind)), whole("npy"), CAMERA).tolist() == STORED
    fifths = decode_depth(npy(METRES), whole("npy"), CAMERA, units_per_metre=5000)
    assert (fifths[0, 2], fifths[1, 1]) == (6172, 0)


@pytest.mark.parametrize("kind", ["<u2", "<i8"])
def test_depth_in_whole_numbers_stays_as_it_is(kind: str) -> None:
    values = np.array([[0, 1, 2, 3], [1000, 5000, 65534, 65535], [7, 8, 9, 10]]).astype(kind)
    expected = np.where(values == 65535, 0, values)
    assert decode_depth(npy(values), whole("npy"), CAMERA, 5000).tolist() == expected.tolist()


@pytest.mark.parametrize(
    ("codec", "data"),
    [
        ("lzfse_f32", b""),
        ("lzfse_f32", b"garbage"),
        ("lzfse_f32", imagecodecs.lzfse_encode(bytes(44))),
        ("lzfse_f32", imagecodecs.lzfse_encode(bytes(52))),
        ("lzfse_f32", imagecodecs.lzfse_encode(METRES.tobytes())[:-6]),
        ("npy", b""),
        ("npy", npy(METRES)[:-1]),
        ("npy", npy(METRES[:2])),
        ("npy", npy(METRES[0])),
        ("npy", npy(METRES.astype("U4"))),
        ("npy", npy(np.array([[{}]], object))),
    ],
)
def test_packed_depth_that_is_damaged_is_named(codec: Codec, data: bytes) -> None:
    with pytest.raises(ScanError, match="depth/7"):
        decode_depth(data, whole(codec), CAMERA)


def test_a_stream_that_unpacks_to_more_than_it_should_is_stopped() -> None:
    bomb = imagecodecs.lzfse_encode(bytes(8 << 20))
    assert len(bomb) < 16 << 10
    tracemalloc.start()
    try:
        with pytest.raises(ScanError, match="does not hold 4x3"):
            decode_depth(bomb, whole("lzfse_f32"), CAMERA)
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()


def test_confidence_is_a_share() -> None:
    levels = np.array([[0, 1, 2, 2], [0, 0, 1, 1], [2, 2, 2, 9]], np.uint8)
    expected = np.minimum(levels / 2, 1).tolist()
    packed = imagecodecs.lzfse_encode(levels.tobytes())
    assert decode_confidence(packed, whole("lzfse_u8"), CAMERA, 2).tolist() == expected
    png = cv2.imencode(".png", levels)[1].tobytes()
    assert decode_confidence(png, "conf.png", CAMERA, 2).tolist() == expected
    wide = cv2.imencode(".png", levels.astype(np.uint16))[1].tobytes()
    with pytest.raises(ScanError, match=r"conf\.png.*8-bit"):
        decode_confidence(wide, "conf.png", CAMERA, 2)


def test_a_pixel_of_a_mask_counts_if_all_that_it_averages_does() -> None:
    mask = np.full((6, 8), 255, np.uint8)
    mask[1, 2] = 0
    camera = Intrinsics(8, 8, 4, 3, 8, 6)
    expected = np.ones((3, 4), bool)
    expected[0, 1] = False
    for image in (mask, np.stack([mask] * 3, 2), np.stack([mask] * 3 + [np.full_like(mask, 255)], 2)):
        png = cv2.imencode(".png", image)[1].tobytes()
        stored = decode_mask(png, "mask.png", camera)
        assert stored.tolist() == (mask > 0).tolist()
        assert shrink_mask(stored, camera, (4, 3)).tolist() == expected.tolist()
    assert shrink_mask(mask > 0, camera, (4, 2), border=2).all()


def test_what_a_mask_leaves_out_is_filled_from_around_it() -> None:
    image = np.tile(np.arange(0, 160, 10, np.uint8)[:, None, None], (1, 20, 3))
    mask = np.ones((16, 20), bool)
    mask[5:9, 6:12] = False
    spoiled = image.copy()
    spoiled[~mask] = 255
    filled = fill_masked(spoiled, mask)
    assert (filled[mask] == image[mask]).all()
    assert np.abs(filled[~mask].astype(int) - image[~mask]).max() < 40
    assert (fill_masked(image, np.zeros_like(mask)) == 128).all()


def test_a_border_is_cut_off_and_the_camera_knows() -> None:
    pixels = np.arange(6 * 8 * 3, dtype=np.uint8).reshape(6, 8, 3)
    camera = Intrinsics(8, 9, 4.5, 3.25, 8, 6)
    inner = rectified(camera, 2)
    assert inner == Intrinsics(8, 9, 2.5, 1.25, 4, 2)
    image = decode_color(pixels.tobytes(), whole("raw_rgb8"), camera, (4, 2), border=2)
    assert image.tolist() == pixels[2:4, 2:6].tolist()


# Undistortion, against the formulas -----------------------------------------------------------------------------------


def bend(x: np.ndarray, y: np.ndarray, lens: Distortion) -> tuple[np.ndarray, np.ndarray]:
    """Where a lens shows the ray (x, y, 1): Brown's model as OpenCV's documentation prints it."""
    r2 = x * x + y * y
    radial = 1 + lens.k1 * r2 + lens.k2 * r2**2 + lens.k3 * r2**3
    return (
        x * radial + 2 * lens.p1 * x * y + lens.p2 * (r2 + 2 * x * x),
        y * radial + lens.p1 * (r2 + 2 * y * y) + 2 * lens.p2 * x * y,
    )


def coordinates(width: int, height: int) -> np.ndarray:
    """[height,width,2] float32: each pixel holds where its centre is."""
    return np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), 2).astype(np.float32)


bends = st.builds(
    Distortion, st.floats(-0.25, 0.25), st.floats(-0.05, 0.05), st.floats(-0.003, 0.003), st.floats(-0.003, 0.003)
)


@settings(max_examples=30, deadline=None)
@given(bends, st.floats(70, 120), st.floats(46, 50), st.floats(34, 38))
def test_undistorted_pixels_come_from_where_the_lens_put_them(lens: Distortion, f: float, cx: float, cy: float) -> None:
    width, height = 96, 72
    camera = Intrinsics(f, 1.02 * f, cx, cy, width, height, lens)
    plain = rectified(camera)
    assert plain.distortion is None
    source = rectify(coordinates(width, height), camera, 0, cv2.INTER_LINEAR)
    pixels = coordinates(width, height).astype(np.float64)
    x, y = bend((pixels[..., 0] - plain.cx) / plain.fx, (pixels[..., 1] - plain.cy) / plain.fy, lens)
    expected = np.stack([x * camera.fx + camera.cx, y * camera.fy + camera.cy], 2)
    margin = 1.0  # at the very edge the nearest pixel is repeated
    assert expected.min() > -margin
    assert (expected < [width + margin, height + margin]).all()
    inside = ((expected > 0.5) & (expected < [width - 0.5, height - 0.5])).all(2)
    assert inside.mean() > 0.9
    np.testing.assert_allclose(source[inside], expected[inside], atol=0.05)


def bent_picture(camera: Intrinsics) -> np.ndarray:
    """What a lens shows of a wall that is red to the right and green downwards: 100 levels per unit of the ray."""
    assert camera.distortion is not None
    pixels = coordinates(camera.width, camera.height).astype(np.float64)
    seen = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    rays = seen.copy()
    for _ in range(50):  # a fixed point: what the lens moved is moved back
        rays += seen - np.stack(bend(rays[..., 0], rays[..., 1], camera.distortion), 2)
    shown = 128 + 100 * rays
    return np.dstack([np.full(shown.shape[:2], 7), shown[..., 1], shown[..., 0]]).round().astype(np.uint8)


def test_a_scan_with_a_lens_becomes_pinhole_views(tmp_path: Path) -> None:
    """The wall's colors are where the views' own cameras see them, and masks and depth follow."""
    camera = Intrinsics(90, 91, 50, 37, 96, 72, LENS)
    flat = {name: value for name, value in asdict(camera).items() if name != "distortion"} | asdict(LENS)
    half = np.where(np.arange(96) < 48, 255, 0).astype(np.uint8)[None].repeat(72, 0)
    frames = []
    for index in range(3):
        cv2.imwrite(str(tmp_path / f"{index}.png"), bent_picture(camera))
        cv2.imwrite(str(tmp_path / f"mask{index}.png"), half)
        cv2.imwrite(str(tmp_path / f"depth{index}.png"), np.full((72, 96), 2000, np.uint16))
        frame = {"color": f"{index}.png", "mask": f"mask{index}.png", "depth": f"depth{index}.png"}
        frames.append(frame | {"camera_to_world": np.eye(4).tolist()})
    scan = {"version": 1, "color_intrinsics": flat, "depth_intrinsics": flat, "mesh": "mesh.obj", "frames": frames}
    (tmp_path / "scan.json").write_text(json.dumps(scan))
    (tmp_path / "mesh.obj").write_text("v -4 -4 2\nv 4 -4 2\nv 4 4 2\nv -4 4 2\nf 1 2 3 4\n")
    for size in (None, (80, 64)):
        for view in ingest(tmp_path, TextureConfig(size=size), Monitor()).views:
            fx, fy, cx, cy = (float(view.camera.K[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
            pixels = coordinates(view.camera.width, view.camera.height)
            expected = 128 + 100 * (pixels - [cx, cy]) / [fx, fy]
            assert view.mask is not None
            assert np.abs(view.color[..., :2].numpy() - expected)[view.mask.numpy()].max() < 2
            assert view.mask.float().mean() == pytest.approx(0.5, abs=0.1)
            assert view.depth is not None
            assert (view.depth == 2)[view.mask].float().mean() > 0.95
            assert (view.depth == 0)[~view.mask].float().mean() > 0.95


def test_without_distortion_nothing_is_resampled() -> None:
    image = np.random.default_rng(0).integers(0, 255, (12, 16, 3), dtype=np.uint8)
    camera = Intrinsics(20, 20, 8, 6, 16, 12)
    assert rectified(camera) == camera
    assert rectify(image, camera, 0, cv2.INTER_LINEAR).tolist() == image.tolist()


def test_depth_is_undistorted_without_mixing_readings() -> None:
    depth = np.where(np.arange(96)[None] < 48, 1.0, 3.0).astype(np.float32).repeat(72, 0)
    camera = Intrinsics(90, 90, 48, 36, 96, 72, LENS)
    assert np.unique(rectify(depth, camera, 0, cv2.INTER_NEAREST)).tolist() == [1.0, 3.0]

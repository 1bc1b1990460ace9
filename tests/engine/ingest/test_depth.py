"""Depth images: encodings, measuring them, and the color camera's view."""

from __future__ import annotations

import math
import zlib
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from advtex_engine.core.errors import Problem
from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import Camera, Mesh
from advtex_engine.ingest.depth import (
    PLAIN,
    ROTATED,
    DepthEncoding,
    Raw,
    depth_in_color_image,
    inflate,
    measure_depth,
)
from advtex_engine.render.rasterize import rasterize

MILLIMETRES = DepthEncoding("1000 units per metre", 1000.0)


class Listener(Monitor):
    def __init__(self) -> None:
        self.warnings: list[Problem] = []

    def warning(self, problem: Problem) -> None:
        self.warnings.append(problem)


def camera(width: int = 64, height: int = 48, focal: float = 60.0, x: float = 0.0) -> Camera:
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float64)
    world_to_camera = torch.eye(4, dtype=torch.float64)
    world_to_camera[0, 3] = -x
    return Camera(K, world_to_camera, width, height)


def wall(z: float = 2.0, tilt: float = 0.3) -> Mesh:
    """A large rectangle at depth z + tilt x."""
    positions = torch.tensor([(x, y, z + tilt * x) for x, y in ((-3.0, -3), (3, -3), (3, 3), (-3, 3))])
    return Mesh(positions, torch.tensor([[0, 1, 2], [0, 2, 3]]))


def corner() -> Mesh:
    """Of a room: two walls and a floor that meet beyond (0, 0.6, 2.6)."""
    a, b, c, d = (0.0, 0.6, 2.6), (-3.0, 0.6, 0.8), (3.0, 0.6, 1.2), (0.0, -4.0, 2.6)
    positions = torch.tensor([a, b, c, d, (-3.0, -4, 0.8), (3.0, -4, 1.2), (0.0, 0.6, -3)])
    return Mesh(positions, torch.tensor([[0, 1, 4], [0, 4, 3], [0, 3, 5], [0, 5, 2], [0, 6, 1], [0, 2, 6]]))


def corner_depth(of: Camera) -> np.ndarray:
    return rasterize(corner(), of).depth.numpy()


def wall_depth(of: Camera, z: float = 2.0, tilt: float = 0.3) -> np.ndarray:
    """Closed form: on the ray (u, v, 1) the wall lies at z / (1 - tilt u), from a camera at the origin."""
    u = (np.arange(of.width) + 0.5 - of.width / 2) / float(of.K[0, 0])
    return np.broadcast_to(z / (1 - tilt * u), (of.height, of.width))


def stored(depth: np.ndarray, encoding: DepthEncoding) -> Raw:
    units = np.round(depth * encoding.units_per_metre).astype(np.uint16)
    return (units << 3) | (units >> 13) if encoding.rotated else units


@given(st.integers(1, 65534), st.booleans())
def test_metres_invert_what_sensors_store(units: int, rotated: bool) -> None:
    encoding = DepthEncoding("any", 1000.0, rotated)
    raw = stored(np.array([[units / 1000.0]]), encoding)
    if raw[0, 0] != 65535:
        assert encoding.metres(raw)[0, 0] == pytest.approx(units / 1000.0, rel=1e-6)


@pytest.mark.parametrize("rotated", [False, True])
def test_zero_and_all_ones_are_no_reading(rotated: bool) -> None:
    metres = DepthEncoding("any", 1000.0, rotated).metres(np.array([[0, 65535]], np.uint16))
    assert metres.tolist() == [[0, 0]]
    assert metres.dtype == np.float32


def test_rotated_tenths_of_a_millimetre_end_at_six_metres() -> None:
    tenths = next(encoding for encoding in ROTATED if encoding.units_per_metre == 10_000)
    depth = np.array([[0.5, 5.9999, 6.0, 6.0001, 6.5534]])
    np.testing.assert_allclose(tenths.metres(stored(depth, tenths)), [[0.5, 5.9999, 6.0, 0, 0]], rtol=1e-6)


@pytest.mark.parametrize("true", [*PLAIN, *ROTATED], ids=lambda encoding: encoding.name)
@pytest.mark.parametrize("declared", [MILLIMETRES, PLAIN[1], ROTATED[0]], ids=lambda encoding: encoding.name)
def test_the_encoding_is_measured(true: DepthEncoding, declared: DepthEncoding) -> None:
    listener = Listener()
    noise = np.random.default_rng(0).normal(1, 0.01, (48, 64))
    samples = [(camera(), stored(wall_depth(camera()) * noise, true))]
    found = measure_depth(wall(), samples, declared, listener)
    warns = (true.units_per_metre, true.rotated) != (declared.units_per_metre, declared.rotated)
    assert found is not None
    assert (found.units_per_metre, found.rotated) == (true.units_per_metre, true.rotated)
    assert [problem.code for problem in listener.warnings] == (["depth_encoding"] if warns else [])


def test_depth_that_fits_nothing_is_ignored_with_a_warning() -> None:
    listener = Listener()
    samples = [(camera(), stored(wall_depth(camera()) * 1.2, MILLIMETRES))]
    assert measure_depth(wall(), samples, MILLIMETRES, listener) is None
    assert [problem.code for problem in listener.warnings] == ["depth_ignored"]


def turned(of: Camera, degrees: float) -> Camera:
    """About the point at depth 2 before it."""
    turn = torch.linalg.matrix_exp(math.radians(degrees) * torch.tensor([[0.0, -0.4, 1], [0.4, 0, -0.6], [-1, 0.6, 0]]))
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, :3] = turn
    motion[:3, 3] = torch.tensor([0, 0, 2.0]) - turn @ torch.tensor([0, 0, 2.0])
    return replace(of, world_to_camera=of.world_to_camera @ motion)


@pytest.mark.parametrize(("may_move", "code"), [(True, "poses_off"), (False, "depth_ignored")])
def test_depth_that_fits_from_other_poses_is_kept_where_poses_may_move(may_move: bool, code: str) -> None:
    listener = Listener()
    true = camera(160, 120, 150)
    samples = [(turned(true, 20), stored(corner_depth(true), MILLIMETRES))]
    found = measure_depth(corner(), samples, MILLIMETRES, listener, poses_may_move=may_move)
    assert found is (MILLIMETRES if may_move else None)
    assert [problem.code for problem in listener.warnings] == [code]


def test_depth_in_a_wrong_unit_is_no_matter_of_poses() -> None:
    listener = Listener()
    true = camera(160, 120, 150)
    samples = [(true, stored(corner_depth(true) * 1.08, MILLIMETRES))]
    assert measure_depth(corner(), samples, MILLIMETRES, listener, poses_may_move=True) is None
    assert [problem.code for problem in listener.warnings] == ["depth_ignored"]


@pytest.mark.parametrize("filled", [0, 100])
def test_too_few_readings_prove_nothing(filled: int) -> None:
    raw = np.zeros((48, 64), np.uint16)
    raw.reshape(-1)[:filled] = 9_999
    listener = Listener()
    assert measure_depth(wall(), [(camera(), raw)], MILLIMETRES, listener) is MILLIMETRES
    assert measure_depth(wall(), [], MILLIMETRES, listener) is MILLIMETRES
    assert listener.warnings == []


def test_inflate_reads_what_zlib_wrote_and_no_more() -> None:
    values = np.arange(12, dtype="<u2").reshape(3, 4)
    assert inflate(zlib.compress(values.tobytes()), 4, 3).tolist() == values.tolist()
    with pytest.raises(ValueError, match="does not hold 4x2"):
        inflate(zlib.compress(bytes(1 << 28)), 4, 2)
    with pytest.raises(ValueError, match="does not hold 4x4"):
        inflate(zlib.compress(values.tobytes()), 4, 4)
    with pytest.raises(ValueError, match="no zlib stream"):
        inflate(b"depth", 4, 3)


@pytest.mark.parametrize(
    ("width", "height", "focal"), [(64, 48, 60.0), (32, 24, 30.0), (160, 120, 150.0), (64, 24, 45.0)]
)
def test_depth_of_a_shifted_camera_lands_on_the_wall(width: int, height: int, focal: float) -> None:
    """The depth camera at x = 0.1 sees the tilted wall; the color camera at the origin has a closed form for it."""
    depth_camera, color_camera = camera(x=0.1), camera(width, height, focal)
    depth = torch.from_numpy(wall_depth(depth_camera, 2.0 + 0.3 * 0.1).copy()).float()
    seen = depth_in_color_image(depth, depth_camera, color_camera).numpy()
    # 0.1 m at 2 m are 3 of 64 columns that the depth camera does not see.
    middle = np.s_[2:-2, : int(width * 0.9)] if width == 64 and height == 48 else np.s_[4:-4, 8 : int(width * 0.9)]
    assert (seen[middle] > 0).mean() > 0.93
    expected = wall_depth(color_camera)
    valid = seen > 0
    # A reading falls somewhere in its pixel, or is repeated over several: a pixel's width of the wall's slope.
    slope = np.abs(np.gradient(expected, axis=1)).max() * max(1.0, focal / 60.0)
    assert np.abs(seen - expected)[valid].max() < 1.5 * slope + 1e-5


@given(st.floats(0.4, 5.0), st.floats(0.4, 5.0))
@example(1.2, 1.2)
@example(2.2, 1.0)
def test_a_finer_color_image_has_no_gaps_in_its_depth(wider: float, higher: float) -> None:
    """However much finer it is: what the depth image shows has a depth in nearly every pixel."""
    depth_camera = camera()
    color_camera = camera(round(64 * wider), round(48 * higher))
    K = color_camera.K.clone()
    K[0, 0], K[1, 1] = 60.0 * wider, 60.0 * higher
    seen = depth_in_color_image(torch.full((48, 64), 2.0), depth_camera, replace(color_camera, K=K))
    assert set(seen.unique().tolist()) <= {0.0, 2.0}
    inside = seen[2:-2, 2:-2]
    assert float((inside > 0).float().mean()) > 0.97


def test_the_nearest_of_two_readings_wins() -> None:
    coarse = camera(2, 2, 2.0)
    depth = torch.full((48, 64), 3.0)
    depth[:, ::2] = 1.5
    assert depth_in_color_image(depth, camera(), coarse).tolist() == [[1.5, 1.5], [1.5, 1.5]]


def test_without_readings_nothing_is_seen() -> None:
    assert depth_in_color_image(torch.zeros(48, 64), camera(), camera()).sum() == 0


def test_the_same_camera_gets_its_depth_back() -> None:
    depth = torch.rand(48, 64) + 1
    depth[::3] = 0
    assert depth_in_color_image(depth, camera(), camera()).equal(depth)

"""Depth sensors: steps, fattened edges and holes of structured light; what a phone's LiDAR makes of edges."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent))
from small_room import WALL, pinhole, striped_wall

from advtex_engine.core.scene import Camera
from advtex_engine.synthetic import sensor as module
from advtex_engine.synthetic.patches import look_at
from advtex_engine.synthetic.sensor import Seen, depth_camera, look, measure

CAMERA = pinhole(320, 240, 275.0)
STRENGTH = module.BASELINE * module.FOCAL_640


def facing(depth: np.ndarray | float, reflectivity: float = 0.5, gloss: float = 0.0, clear: float = 0.0) -> Seen:
    """Surfaces that face the sensor, but not so squarely that they mirror."""
    whole = np.broadcast_to(np.float32(depth), (240, 320)).astype(np.float32)
    infrared = np.broadcast_to(np.float32([reflectivity, gloss, clear]), (240, 320, 3))
    return Seen(whole, np.full((240, 320), 0.9, np.float32), infrared)


def structured(seen: Seen, frame: int = 0) -> np.ndarray:
    return measure(seen, CAMERA, "structured", 0, frame)


def steps(depth: np.ndarray) -> float:
    """The mean distance in metres between the values that a depth image holds."""
    return float(np.diff(np.unique(depth[depth > 0])).mean())


def test_depth_is_quantized_in_steps_that_grow_with_its_square() -> None:
    near, far = structured(facing(1.0)), structured(facing(3.0))
    shifts = STRENGTH / far[far > 0] / module.SHIFT_STEP
    assert np.abs(shifts - np.rint(shifts)).max() < 1e-3
    assert steps(far) == pytest.approx(3.0**2 / STRENGTH * module.SHIFT_STEP, rel=0.15)
    assert steps(far) / steps(near) == pytest.approx(9, rel=0.2)


def test_bias_belongs_to_the_device_and_noise_to_the_frame() -> None:
    frames = np.stack([structured(facing(2.0), frame) for frame in range(12)])
    off = frames - 2.0
    unit = 2.0**2 / STRENGTH
    bias = off.mean(0)
    assert bias.std() == pytest.approx(unit * module.SHIFT_BIAS, rel=0.6)
    assert 0.5 < (off - bias).std() / (unit * module.SHIFT_NOISE) < 1.5
    other = measure(facing(2.0), CAMERA, "structured", 1, 0) - 2.0
    assert abs(np.corrcoef(other.ravel(), bias.ravel())[0, 1]) < 0.6
    assert np.array_equal(frames[3], structured(facing(2.0), 3))


def test_the_nearer_surface_fattens_by_up_to_half_a_window() -> None:
    depth = np.full((240, 320), 2.5, np.float32)
    depth[:, 100:200] = 1.2
    found = structured(facing(depth))
    rim = (found > 1.0) & (found < 1.4)
    wide = rim[:, 150:].sum(1) - 50
    window = 3  # of 320 columns
    assert wide.min() >= 0
    assert wide.max() <= window
    assert 0 < wide.mean() < window
    assert np.ptp(wide) > 0


@pytest.mark.parametrize(
    ("words", "seen"),
    [
        ("dark", facing(2.0, reflectivity=0.01)),
        ("clear", facing(2.0, clear=1.0)),
        ("too near", facing(0.2)),
        ("too far", facing(6.0)),
        ("nothing", facing(0.0)),
    ],
)
def test_what_does_not_answer_is_a_hole(words: str, seen: Seen) -> None:
    assert (structured(seen) == 0).all(), words


def test_angles_decide_too() -> None:
    seen = facing(2.0, gloss=1.0)
    assert (structured(seen) > 0).all()
    assert (structured(Seen(seen.depth, np.full_like(seen.depth, 0.99), seen.infrared)) == 0).all()
    assert (structured(Seen(seen.depth, np.full_like(seen.depth, 0.1), seen.infrared)) == 0).all()


def test_a_near_surface_throws_a_shadow_to_the_left() -> None:
    depth = np.full((240, 320), 3.0, np.float32)
    depth[:, 150:200] = 1.0
    found = structured(facing(depth))
    width = 275 * module.BASELINE * (1 / 1.0 - 1 / 3.0)
    assert (found[:, 100:150] == 0).sum(1).mean() == pytest.approx(width, abs=4)
    assert (found[:, 200:] > 0).all()


def test_lidar_has_no_holes_but_runs_edges_together_and_loses_thin_things() -> None:
    depth = np.full((240, 320), 3.0, np.float32)
    depth[:, 150:] = 1.5
    depth[:, 40] = 1.0
    found = measure(facing(depth), CAMERA, "lidar", 0, 0)
    assert (found > 0).all()
    between = ((found > 1.8) & (found < 2.7)).mean(0)
    assert between[140:160].sum() > 2
    assert between[200:].sum() == 0
    assert found[:, 40].min() > 2.3


def test_the_lidar_s_errors_grow_with_the_distance() -> None:
    for distance in (0.4, 3.0):
        off = np.stack([measure(facing(distance), CAMERA, "lidar", 0, frame) for frame in range(8)]) / distance - 1
        assert 0.5 < (off - off.mean(0)).std() / module.LIDAR_NOISE < 1.5
        assert 0.2 < off.mean(0).std() / module.LIDAR_SCALE < 2


def test_the_lidar_s_image_is_small() -> None:
    big = pinhole(640, 480, 550.0)
    small = depth_camera(big, "lidar")
    assert (small.width, small.height) == (256, 192)
    assert float(small.K[0, 0]) == pytest.approx(220)
    assert depth_camera(big, "structured") is big


def test_the_sensor_looks_along_its_axis_and_tells_angles() -> None:
    world_to_camera = look_at(np.zeros(3), np.array([np.tan(0.5), 1.0, 0.0]))
    camera = Camera(CAMERA.K, torch.from_numpy(world_to_camera), 320, 240)
    seen = look(striped_wall(), camera)
    assert seen.depth[120, 160] == pytest.approx(WALL / np.cos(0.5), rel=0.01)
    assert seen.cosine[120, 160] == pytest.approx(np.cos(0.5), abs=0.01)
    assert np.allclose(seen.infrared[120, 160], [0.5, 0, 0])

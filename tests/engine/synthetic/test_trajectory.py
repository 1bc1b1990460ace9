"""Paths are smooth, trackers drift smoothly and within bounds, and the fridge's door is smeared from close by."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest
import torch

from advtex_engine.core.scene import Camera
from advtex_engine.synthetic import object as synthetic_object
from advtex_engine.synthetic import room, trajectory
from advtex_engine.synthetic.camera import SHUTTER, Exposure, blur_pixels
from advtex_engine.synthetic.real import FOCAL
from advtex_engine.synthetic.sensor import NEAREST
from advtex_engine.synthetic.trajectory import drift, moved, object_path, object_widening, room_path, rotations

TIMES = 18.0 * (np.arange(60) + 0.5) / 60


@cache
def still_life() -> np.ndarray:
    """[N,3] metres; only its prints depend on the seed."""
    return np.concatenate([patch.surface(patch.grid).reshape(-1, 3) for patch in synthetic_object.patches()]) / 1000


@pytest.mark.parametrize("make", [room_path, object_path])
def test_a_path_is_rigid_and_smooth(make: object) -> None:
    path = make(np.random.default_rng(0))  # type: ignore[operator]
    fine = np.arange(0, path.duration, 1 / 60)
    poses = path.poses(fine)
    assert np.allclose(poses[:, :3, :3] @ np.swapaxes(poses[:, :3, :3], 1, 2), np.eye(3), atol=1e-9)
    speed = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) * 60
    assert speed.max() < 1.6
    assert np.abs(np.diff(speed)).max() < 0.4
    assert speed.mean() > 0.1


@pytest.mark.parametrize("seed", range(5))
def test_a_camera_keeps_its_sensors_distance_from_all_of_an_object(seed: int) -> None:
    nearest = NEAREST["structured"]
    points = still_life()
    for widening, kept in ((object_widening(nearest), True), (object_widening(0.0), False)):
        path = object_path(np.random.default_rng([seed, 4]), widening)
        places = path.poses(np.arange(0, path.duration, 1 / 30))[:, :3, 3]
        assert (min(np.linalg.norm(points - place, axis=1).min() for place in places) > nearest) == kept


@pytest.mark.parametrize("seed", range(5))
def test_two_frames_smear_the_door_from_close_by_though_earlier_ones_show_it_sharp(seed: int) -> None:
    path = room_path(np.random.default_rng([seed, 4]))
    focal = FOCAL["room"] * 640
    K = torch.tensor([[focal, 0, 320], [0, focal, 240], [0, 0, 1]], dtype=torch.float64)
    camera = Camera(K, torch.eye(4, dtype=torch.float64), 640, 480)
    x, y, wide, _, _ = room.FRIDGE
    spread = np.linspace(0.1, 0.9, 9)
    door = np.stack([(x + spread * wide) / 1000, np.full(9, y / 1000), np.full(9, 1.2)], -1)
    blurs, distances, seen = [], [], []
    for time in TIMES:
        blurs.append(np.median(blur_pixels(path, camera, Exposure(float(time), SHUTTER, 1.0), door)))
        place = np.linalg.inv(path.poses(np.array([time])))[0]
        there = door @ place[:3, :3].T + place[:3, 3]
        pixel = there[:, :2] / there[:, 2:] * focal + [320, 240]
        distances.append(there[:, 2].mean())
        seen.append((((pixel > 0) & (pixel < [640, 480])).all(1) & (there[:, 2] > 0)).mean())
    smeared = [i for i in range(60) if blurs[i] > 8 and distances[i] < 0.8 and seen[i] > 0.5]
    assert len(smeared) >= 2
    earlier = smeared[0] - 5
    assert seen[earlier] == 1
    assert blurs[earlier] < 2
    assert distances[earlier] > 1.4 * distances[smeared[0]]


def test_drift_has_its_size_is_smooth_and_moves_the_scan_nowhere() -> None:
    metres, radians = drift(TIMES, 1.6, np.random.default_rng(0))
    for off, size in ((metres, 1.6 * trajectory.DRIFT_SHARE), (radians, trajectory.DRIFT_TURN)):
        assert np.sqrt((off**2).mean()) == pytest.approx(size, rel=0.1)
        assert np.abs(off).max() < 3.5 * size
        assert np.abs(off.mean(0)).max() < 0.05 * size
        # Neighbors in time share it.
        assert np.sqrt((np.diff(off, axis=0) ** 2).mean()) < 0.35 * size
        assert np.corrcoef(off[:-1, 0], off[1:, 0])[0, 1] > 0.9


def test_closing_the_loop_leaves_a_rest() -> None:
    gaps = [drift(TIMES, 1.0, np.random.default_rng(seed))[0] for seed in range(20)]
    ends = np.mean([np.linalg.norm(off[-1] - off[0]) for off in gaps])
    spread = np.mean([np.linalg.norm(np.ptp(off, axis=0)) for off in gaps])
    assert 0 < ends < 0.6 * spread


def test_poses_are_moved_in_the_world_and_turned_in_place() -> None:
    poses = room_path(np.random.default_rng(0)).poses(TIMES)
    still = np.zeros((60, 3))
    turned = moved(poses, still, still + np.array([0.0, 0.1, 0.0]))
    assert np.array_equal(turned[:, :3, 3], poses[:, :3, 3])
    turn = np.swapaxes(poses[:, :3, :3], 1, 2) @ turned[:, :3, :3]
    assert np.allclose(np.arccos((np.trace(turn, axis1=1, axis2=2) - 1) / 2), 0.1)
    shifted = moved(poses, still + np.array([0.0, 0.0, 0.3]), still)
    assert np.allclose(shifted[:, :3, 3] - poses[:, :3, 3], [0, 0, 0.3])
    assert np.allclose(rotations(still), np.eye(3))


def test_another_seed_is_another_hand() -> None:
    first, second = (room_path(np.random.default_rng(seed)).poses(TIMES) for seed in (0, 1))
    assert not np.allclose(first, second)
    path = room_path(np.random.default_rng(0))
    calm = dataclasses.replace(path, turns=np.zeros_like(path.turns))
    assert 0.001 < np.abs(calm.poses(TIMES) - first)[:, :3, :3].max() < 0.05

"""How a hand carries a camera through a synthetic scene, and how the poses that a tracker finds drift from it.

Times in seconds, lengths in metres, world +z up. A path is smooth and known at every instant, so that an exposure has
a beginning and an end.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from advtex_engine.synthetic.patches import Array, look_at

RATE = 240.0
"""Samples per second of a path; in between it is straight."""
MARGIN = 1.0
"""Seconds that a path goes on before its first and after its last frame."""
SMOOTHING = 0.08
"""Standard deviation in seconds of the filter that rounds the corners of a path."""
SHAKE_TURN, SHAKE_MOVE = 0.005, 0.003
"""Root mean square per axis of what a hand adds: radians, metres."""
SHAKE_HERTZ = 1.3
"""A hand's tremor falls off beyond."""
DRIFT_TURN, DRIFT_SHARE = 0.0025, 0.0035
"""Root mean square per axis of a tracker's drift: radians, and metres per metre of distance to the scene."""
DRIFT_SECONDS = 1.0
"""Drift changes over such times: neighbors in time share it."""
CLOSURE = 0.7
"""Share of the drift between first and last frame that closing the loop takes away."""
JITTER = 0.08
"""Of each frame alone, as a share of the drift."""

Waypoint = tuple[float, tuple[float, float, float], tuple[float, float, float]]

ROOM_PATH: tuple[Waypoint, ...] = (
    (0.0, (3.0, 0.5, 1.55), (0.3, 2.2, 0.9)),
    (2.5, (2.6, 0.6, 1.5), (0.4, 1.2, 1.0)),
    (4.5, (1.9, 0.8, 1.5), (0.5, 1.6, 0.8)),
    # The fridge's door from 1.3 m, sharp; then from 0.7 m, in a hasty turn that smears it.
    (6.3, (1.3, 1.0, 1.35), (0.95, 2.35, 1.25)),
    (7.5, (1.15, 1.02, 1.33), (0.93, 2.35, 1.2)),
    (8.5, (1.0, 1.64, 1.28), (0.62, 2.35, 1.25)),
    (9.3, (1.0, 1.66, 1.26), (1.28, 2.35, 1.2)),
    (10.2, (1.5, 1.1, 1.45), (1.8, 2.9, 1.0)),
    (11.5, (1.9, 0.9, 1.5), (2.0, 2.9, 0.9)),
    (13.0, (2.3, 0.8, 1.5), (2.9, 3.0, 1.5)),
    (14.5, (2.2, 0.9, 1.5), (3.6, 2.0, 1.4)),
    (16.0, (2.6, 0.45, 1.6), (2.0, 1.4, 0.6)),
    (18.0, (3.0, 0.5, 1.55), (0.9, 1.8, 0.5)),
)
"""Seconds, where the camera is, where it looks."""
OBJECT_RINGS = ((16.0, 0.36), (36.0, 0.40), (58.0, 0.38))
"""Elevation in degrees and distance in metres of the rings of a path around the object."""
OBJECT_TARGET = (0.0, 0.0, 0.085)
OBJECT_REACH = 0.173
"""Metres from the target that the object reaches."""
OBJECT_SECONDS = 18.0
OBJECT_STEPS = 12
"""Waypoints per turn around the object."""
OBJECT_SPREAD = 0.15
"""By what share at most the distance of a waypoint is more or less than its ring's."""


@dataclass(frozen=True)
class Path:
    """A camera's path: at `seconds` [N] its place, what it looks at and the hand's turn, each [N,3]."""

    seconds: Array
    places: Array
    targets: Array
    turns: Array
    duration: float

    def poses(self, times: Array) -> Array:
        """camera_to_world [T,4,4] at `times` [T], with OpenCV's axes."""
        place, target, turn = (self._at(values, times) for values in (self.places, self.targets, self.turns))
        poses = np.stack([np.linalg.inv(look_at(eye, at)) for eye, at in zip(place, target, strict=True)])
        poses[:, :3, :3] = poses[:, :3, :3] @ rotations(turn)
        return poses

    def _at(self, values: Array, times: Array) -> Array:
        return np.stack([np.interp(times, self.seconds, axis) for axis in values.T], -1)


def room_path(rng: np.random.Generator) -> Path:
    """Through the room, past the fridge's door."""
    seconds = np.array([waypoint[0] for waypoint in ROOM_PATH])
    places = np.array([waypoint[1] for waypoint in ROOM_PATH]) + rng.uniform(-0.02, 0.02, (len(seconds), 3))
    targets = np.array([waypoint[2] for waypoint in ROOM_PATH]) + rng.uniform(-0.02, 0.02, (len(seconds), 3))
    return _path(seconds, places, targets, 1.0, rng)


def object_widening(nearest: float) -> float:
    """By what factor the rings are wider for a sensor that measures nothing nearer than so many metres; 1 or more."""
    # Between two waypoints a path is straight, and comes nearer.
    least = min(distance for _, distance in OBJECT_RINGS) * (1 - OBJECT_SPREAD) * np.cos(np.pi / OBJECT_STEPS)
    return float(max(1.0, (nearest + OBJECT_REACH) / least))


def object_path(rng: np.random.Generator, widening: float = 1.0) -> Path:
    """Around the object in rings, one above the other. widening: of `object_widening`."""
    turns = len(OBJECT_RINGS)
    seconds = np.linspace(0, OBJECT_SECONDS, OBJECT_STEPS * turns + 1)
    round_trip = np.linspace(0, turns, len(seconds))
    rings = np.array(OBJECT_RINGS)
    elevation, distance = (np.interp(round_trip, np.arange(turns) + 0.5, values) for values in rings.T)
    angle, lift = 2 * np.pi * round_trip, np.radians(elevation)
    towards = np.stack([np.cos(angle) * np.cos(lift), np.sin(angle) * np.cos(lift), np.sin(lift)], -1)
    spread = rng.uniform(1 - OBJECT_SPREAD, 1 + OBJECT_SPREAD, (len(seconds), 1))
    away = widening * distance[:, None] * spread
    targets = np.array(OBJECT_TARGET) + rng.uniform(-0.012, 0.012, (len(seconds), 3))
    return _path(seconds, np.array(OBJECT_TARGET) + away * towards, targets, 0.4, rng)


def _path(seconds: Array, places: Array, targets: Array, shake: float, rng: np.random.Generator) -> Path:
    """Waypoints joined, rounded, and carried by a hand. shake: of its moves, 1 for a room."""
    samples = np.arange(seconds[0] - MARGIN, seconds[-1] + MARGIN, 1 / RATE)
    lines = np.stack([np.interp(samples, seconds, axis) for axis in np.concatenate([places, targets], 1).T], -1)
    smooth = gaussian_filtered(lines, SMOOTHING * RATE)
    moves = SHAKE_MOVE * shake * _tremor(len(samples), rng)
    turns = SHAKE_TURN * _tremor(len(samples), rng)
    return Path(samples, smooth[:, :3] + moves, smooth[:, 3:], turns, float(seconds[-1]))


def _tremor(count: int, rng: np.random.Generator) -> Array:
    """Noise [count,3] of unit deviation, slow but for what a hand adds."""
    frequency = np.fft.rfftfreq(count, 1 / RATE)[:, None]
    spectrum = np.fft.rfft(rng.standard_normal((count, 3)), axis=0) / (1 + (frequency / SHAKE_HERTZ) ** 4)
    noise = np.fft.irfft(spectrum, count, axis=0)
    return np.asarray(noise / noise.std(0), np.float64)


def gaussian_filtered(values: Array, deviation: float) -> Array:
    """Columns of `values` [N,D] under a Gaussian of `deviation` samples; the ends are held."""
    reach = int(np.ceil(4 * deviation))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / deviation) ** 2)
    padded = np.pad(values, ((reach, reach), (0, 0)), mode="edge")
    return np.stack([np.convolve(axis, kernel / kernel.sum(), mode="valid") for axis in padded.T], -1)


def drift(times: Array, distance: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """How far a tracker's poses are off at `times` [T]: metres [T,3], and rotation vectors [T,3] in radians.

    A smooth random walk, most of whose end is taken back by closing the loop; over all frames its mean is 0, so that
    the scan as a whole stays where the scene is. distance: metres to the scene, for the size.
    """
    first, last = float(times.min()), float(times.max())
    fine = np.linspace(first, last, 20 * len(times))
    walk = np.cumsum(rng.standard_normal((len(fine), 6)), axis=0)
    walk = gaussian_filtered(walk, DRIFT_SECONDS * len(fine) / (last - first))
    share = np.linspace(0, 1, len(fine))[:, None]
    walk = walk - CLOSURE * share * (walk[-1] - walk[0])
    found = np.stack([np.interp(times, fine, axis) for axis in walk.T], -1)
    found -= found.mean(0)
    found = found / np.sqrt((found**2).mean(0)) + JITTER * rng.standard_normal(found.shape)
    return DRIFT_SHARE * distance * found[:, :3], DRIFT_TURN * found[:, 3:]


def moved(poses: Array, metres: Array, radians: Array) -> Array:
    """camera_to_world [T,4,4] moved by [T,3] in the world and turned by rotation vectors [T,3] about their places."""
    result = poses.copy()
    result[:, :3, :3] = poses[:, :3, :3] @ rotations(radians)
    result[:, :3, 3] += metres
    return result


def rotations(vectors: Array) -> Array:
    """Rotation matrices [T,3,3] of rotation vectors [T,3] in radians (Rodrigues)."""
    angle = np.linalg.norm(vectors, axis=1)[:, None, None]
    x, y, z = (vectors / np.maximum(angle[:, 0], 1e-12)).T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 3, 3)
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross), np.float64)

"""Depth images of a drawn scene as sensors measure them: structured light, and the LiDAR of a phone.

Structured light (the first Kinect, PrimeSense) finds by matching windows how far a projected pattern is shifted: its
errors are of the shift, so they grow with the square of the distance (Khoshelham & Elberink 2012), the nearer surface
fattens by the window, and there is nothing where the pattern does not fall or come back. A phone's LiDAR has few
points, between which an image is interpolated: it has no holes, but edges run into each other, and thin things are
not there.

Depth is in metres along the axis, 0 where there is none.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from advtex_engine.core.cameras import pixel_centers, scaled_camera
from advtex_engine.core.scene import Camera
from advtex_engine.render.rasterize import rasterize
from advtex_engine.render.render_view import gbuffer, shade
from advtex_engine.synthetic.patches import DrawnScene

Depth = NDArray[np.float32]
SensorName = Literal["structured", "lidar"]

DEPTH_SCALE = 1000.0
"""Stored units per metre."""
BASELINE = 0.075
"""Metres between projector and camera."""
FOCAL_640 = 580.0
"""Focal length of the sensor's camera in pixels of a picture 640 wide, for which the steps of the shift are known."""
SHIFT_STEP = 1 / 8
"""Pixels: the finest shift that matching tells."""
SHIFT_NOISE = 0.04
"""Standard deviation in pixels, the same over a window."""
WINDOW = 7
"""Pixels of a picture 640 wide: the side of the windows that are matched."""
SHIFT_BIAS = 0.1
"""Pixels, root mean square: what calibration leaves, smooth over the picture and the same in every frame."""
NEAREST: dict[SensorName, float] = {"structured": 0.35, "lidar": 0.0}
"""Metres that a surface must be away."""
FARTHEST = 4.5
GRAZING = 0.17
"""Cosine: what is seen at a more grazing angle sends nothing back."""
DARKEST = 0.004
"""Reflectivity over squared metres of distance that is still seen, times 1 m^2; black surfaces are lost from afar."""
MIRRORING = 0.985
"""Cosine: glossy surfaces that face the sensor more squarely send its own light into it."""
POINTS = (64, 48)
"""The points of a phone's LiDAR, in columns and rows."""
LIDAR_SIZE = 256
"""Columns of its depth image."""
LIDAR_SCALE, LIDAR_NOISE = 0.006, 0.0045
"""Root mean square of its smooth errors as shares of the distance: the same in every frame, and of each frame."""
LIDAR_FARTHEST = 5.0


@dataclass(frozen=True)
class Seen:
    """What a depth camera's rays meet: depth [H,W]; cosine of the angle there; infrared [H,W,3], see `DrawnScene`."""

    depth: Depth
    cosine: Depth
    infrared: Depth


def depth_camera(camera: Camera, sensor: SensorName) -> Camera:
    """The sensor's camera for a color camera: the same place, and the same picture in the sensor's size."""
    if sensor == "structured" or camera.width <= LIDAR_SIZE:
        return camera
    return scaled_camera(camera, LIDAR_SIZE, round(LIDAR_SIZE * camera.height / camera.width))


def look(scene: DrawnScene, camera: Camera) -> Seen:
    """What the depth camera sees, without any error."""
    mesh = scene.atlas.mesh
    fragments = rasterize(mesh, camera)
    a, b, c = (mesh.v_pos[corner].double() for corner in mesh.t_pos_idx.T)
    normal = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=1) @ camera.world_to_camera[:3, :3].T
    rays = torch.nn.functional.pad(pixel_centers(camera), (0, 1), value=1.0) @ torch.linalg.inv(camera.K).T
    rays = torch.nn.functional.normalize(rays, dim=-1)
    face = fragments.face_index.long()
    cosine = (normal[face.clamp(min=0)] * rays).sum(-1).abs() * (face >= 0)
    infrared = shade(gbuffer(scene.atlas, camera, 1), scene.infrared, 0.0)
    return Seen(fragments.depth.numpy(), cosine.float().numpy(), infrared.numpy())


def measure(seen: Seen, camera: Camera, sensor: SensorName, seed: int, frame: int) -> Depth:
    """The depth image [H,W] that the sensor makes of what it sees.

    The same seed is the same device: its smooth errors are the same in every frame; the rest is of the frame.
    """
    device, noise = np.random.default_rng([seed, 2]), np.random.default_rng([seed, 3, frame])
    return _structured(seen, camera, device, noise) if sensor == "structured" else _lidar(seen, device, noise)


def stored(depth: Depth) -> NDArray[np.uint16]:
    """The depth image as it is written: units of 1/DEPTH_SCALE metres."""
    return np.asarray(np.rint(depth * DEPTH_SCALE), np.uint16)


def _structured(seen: Seen, camera: Camera, device: np.random.Generator, noise: np.random.Generator) -> Depth:
    scale = camera.width / 640
    strength = np.float32(BASELINE * FOCAL_640)
    window = max(3, 2 * round(WINDOW * scale / 2) + 1)
    # The nearer surface wins the windows that it reaches into, to a rim that is uneven.
    near = np.where(seen.depth > 0, seen.depth, np.float32(np.inf))
    fat = cv2.erode(near, np.ones((window, window), np.uint8))
    wins = _smooth(seen.depth.shape, noise, window) > 0
    depth = np.where(wins, fat, near)
    shift = np.where(np.isfinite(depth), strength / np.maximum(depth, 1e-3), 0)
    shift = shift + SHIFT_BIAS * _smooth(depth.shape, device, 160 * scale)
    shift = shift + SHIFT_NOISE * _smooth(depth.shape, noise, window)
    shift = np.maximum(np.rint(shift / SHIFT_STEP) * SHIFT_STEP, SHIFT_STEP)
    measured = strength / shift
    lost = ~np.isfinite(depth) | (measured < NEAREST["structured"]) | (measured > FARTHEST) | _unanswered(seen)
    lost |= _shadow(near, camera)
    return np.asarray(np.where(lost, 0, measured), np.float32)


def _unanswered(seen: Seen) -> NDArray[np.bool_]:
    """Where the sensor's light does not come back: grazing, dark, mirroring or clear surfaces."""
    reflectivity, gloss, clear = np.moveaxis(seen.infrared, -1, 0)
    dark = reflectivity * seen.cosine < DARKEST * seen.depth**2
    mirrors = (gloss > 0.3) & (seen.cosine > MIRRORING)
    return np.asarray((seen.cosine < GRAZING) | dark | mirrors | (clear > 0.5), np.bool_)


def _shadow(near: Depth, camera: Camera) -> NDArray[np.bool_]:
    """Where a nearer surface keeps the pattern from falling: the projector stands to the right of the camera."""
    focal = float(camera.K[0, 0])
    columns = np.arange(near.shape[1], dtype=np.float32)
    # Where a ray's end lies in the projector's picture; from right to left it must go down, or something hides it.
    falls = columns - focal * BASELINE / near
    ahead = np.minimum.accumulate(falls[:, ::-1], axis=1)[:, ::-1]
    return np.asarray(falls > ahead + 1.5, np.bool_)


def _lidar(seen: Seen, device: np.random.Generator, noise: np.random.Generator) -> Depth:
    shape = seen.depth.shape
    there = ((seen.depth > 0) & (seen.depth < LIDAR_FARTHEST) & (seen.infrared[..., 2] < 0.5)).astype(np.float32)
    columns, rows = min(POINTS[0], shape[1]), min(POINTS[1], shape[0])
    # A point is the mean over what its spot covers; the image between the points is interpolated.
    weight = cv2.resize(there, (columns, rows), interpolation=cv2.INTER_AREA)
    sparse = cv2.resize(seen.depth * there, (columns, rows), interpolation=cv2.INTER_AREA) / np.maximum(weight, 1e-6)
    size = (shape[1], shape[0])
    share = cv2.resize(weight, size, interpolation=cv2.INTER_LINEAR)
    depth = cv2.resize(sparse * weight, size, interpolation=cv2.INTER_LINEAR) / np.maximum(share, 1e-6)
    off = LIDAR_SCALE * _smooth(shape, device, shape[1] / 3) + LIDAR_NOISE * _smooth(shape, noise, shape[1] / 16)
    depth = depth * (1 + off)
    return np.asarray(np.where(share > 0.5, np.maximum(depth, 1 / DEPTH_SCALE), 0), np.float32)


def _smooth(shape: tuple[int, ...], rng: np.random.Generator, feature: float) -> Depth:
    """Noise [H,W] of unit deviation with features of so many pixels."""
    deviation = max(feature / 3, 0.5)
    # Worked out coarsely where it is very smooth.
    step = max(1, int(deviation / 4))
    coarse = rng.standard_normal((-(-shape[0] // step) + 2, -(-shape[1] // step) + 2)).astype(np.float32)
    noise = cv2.GaussianBlur(coarse, (0, 0), deviation / step, borderType=cv2.BORDER_REFLECT)
    if step > 1:
        noise = cv2.resize(noise, (noise.shape[1] * step, noise.shape[0] * step), interpolation=cv2.INTER_CUBIC)
    # The deviation of white noise under a Gaussian, at the places where a border has not raised it.
    usual = 1 / (2 * np.sqrt(np.pi) * deviation / step)
    return np.asarray(noise[: shape[0], : shape[1]] / usual, np.float32)

"""Photographs of a drawn scene as a hand-held camera takes them, error by error in the order of physics.

Light: the scene's radiance, seen through a lens that bends lines, row after row while the camera moves, gathered over
the exposure. Sensor: vignetting, exposure, noise, the clip of a full pixel. Processing: white balance, the response
curve, 8 bits, JPEG. Pictures are linear in light until the response curve.

An exposure is several renders at instants of it, each with pixel centres shifted by a part of a pixel: their mean is
anti-aliased and blurred by the motion at once (Cook et al. 1984, "Distributed Ray Tracing"). In each, lens and rolling
shutter move the vertices to where the camera sees them; triangles are small.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from advtex_engine.core.scene import Camera, Mesh
from advtex_engine.render.render_view import gbuffer, shade
from advtex_engine.synthetic.patches import GAMMA, Array, DrawnScene
from advtex_engine.synthetic.trajectory import Path, gaussian_filtered

SUBFRAMES = 16
# The plastic sequence (Roberts 2018) fills the square evenly; it must not move the picture.
_SEQUENCE = np.arange(SUBFRAMES)[:, None] * np.array([0.7548776662, 0.5698402910]) % 1
SHIFTS = _SEQUENCE - _SEQUENCE.mean(0)
"""Pixels [SUBFRAMES,2] by which the pixel centres of each render lie beside the middle."""
SHUTTER = 1 / 45
"""Seconds that the median frame is exposed."""
READOUT = 1 / 40
"""Seconds from the first row to the last."""
DISTORTION = (0.06, -0.12)
"""k1 and k2 of the lens, as OpenCV counts them; the scan does not tell of them."""
VIGNETTING = 0.5
"""Share of the cosine-fourth law that is left in the corners."""
KEY = 0.34
"""The light to which automatic exposure brings the mean of a picture, 1 being white."""
METER_CLIP = 2.0
METER_STRENGTH, METER_LAG = 0.75, 0.4
"""How much of a change automatic exposure follows, and over how many seconds."""
EXPOSURE_DRIFT = 0.05
BALANCE_STRENGTH, BALANCE_DRIFT = 0.3, 0.035
"""How much of the picture's mean color automatic white balance takes away, and its wandering (logarithms)."""
SHOT_NOISE, READ_NOISE = 1 / 4000, 0.0015
"""Variance per light, and standard deviation in the dark, at the median exposure; white is 1."""
NOISE_GRAIN = 0.6
"""Pixels: demosaicing spreads the noise of a pixel so far."""
JPEG_QUALITY = 88
BACKDROP = 0.6
"""Light of what is no surface."""
NEAR = 0.05


@dataclass(frozen=True)
class Errors:
    """Which errors of real scans are made; each can be measured alone.

    fused: the mesh is made from the depth images, not the true one. depth: what the sensor adds to them. drift: of the
    poses, and with them of the fused mesh. distortion: of the lens; the scan does not tell of it.
    """

    blur: bool = True
    rolling_shutter: bool = True
    distortion: bool = True
    vignetting: bool = True
    exposure: bool = True
    white_balance: bool = True
    noise: bool = True
    jpeg: bool = True
    fused: bool = True
    depth: bool = True
    drift: bool = True

    @classmethod
    def none(cls) -> Errors:
        """No error at all; `replace` adds those that are wanted."""
        return cls(**dict.fromkeys(cls.__dataclass_fields__, False))


@dataclass(frozen=True)
class Exposure:
    """How one frame was taken: its middle and its length in seconds, the gain of light, and that of red, green, blue.

    sensitivity: the part of the gain that is not exposure time, over that of the median frame; noise grows with it.
    """

    middle: float
    seconds: float
    gain: float
    balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    sensitivity: float = 1.0

    def to_dict(self) -> dict[str, Any]:
        """As it is written to the truth."""
        return {
            "seconds": self.middle,
            "exposure_seconds": self.seconds,
            "gain": self.gain,
            "white_balance": list(self.balance),
        }


def expose(scene: DrawnScene, path: Path, camera: Camera, exposure: Exposure, errors: Errors) -> NDArray[np.float32]:
    """The light [H,W,3] that falls on the sensor, 1 for white at gain 1. camera: its K and size; the path places it."""
    readout = READOUT if errors.rolling_shutter else 0.0
    lens = DISTORTION if errors.distortion else (0.0, 0.0)
    total = torch.zeros((camera.height, camera.width, 3))
    for index in range(SUBFRAMES):
        instant = exposure.middle + exposure.seconds * ((index + 0.5) / SUBFRAMES - 0.5)
        atlas = replace(scene.atlas, mesh=as_seen(scene.atlas.mesh, path, camera, instant, readout, lens))
        K = camera.K.clone()
        K[:2, 2] += torch.from_numpy(SHIFTS[index])
        there = Camera(K, torch.eye(4, dtype=torch.float64), camera.width, camera.height)
        total += shade(gbuffer(atlas, there, 1), scene.radiance, BACKDROP)
    return (total / SUBFRAMES).numpy()


def as_seen(mesh: Mesh, path: Path, camera: Camera, instant: float, readout: float, lens: tuple[float, float]) -> Mesh:
    """The mesh in the coordinates of the camera, moved so that a pinhole sees it where this camera does.

    instant: when the middle row is exposed. readout: seconds from the first row to the last. lens: k1 and k2.
    """
    points = mesh.v_pos.double().numpy()
    steps = np.linspace(-0.75, 0.75, 7) if readout else np.zeros(1)
    world_to_camera = np.linalg.inv(path.poses(instant + readout * steps))
    seen = np.einsum("kij,nj->kni", world_to_camera[:, :3, :3], points) + world_to_camera[:, None, :3, 3]
    middle = len(steps) // 2
    place = seen[middle]
    if readout:
        for _ in range(2):
            row = _distorted(place, camera, lens)[:, 1] / np.maximum(place[:, 2], NEAR)
            late = (float(camera.K[1, 1]) * row + float(camera.K[1, 2])) / camera.height - 0.5
            place = _between(seen, np.where(place[:, 2] > NEAR, np.clip(late, -0.75, 0.75), 0.0))
    return replace(mesh, v_pos=torch.from_numpy(_distorted(place, camera, lens).astype(np.float32)))


def _between(seen: Array, late: Array) -> Array:
    """Places [N,3] at `late` [N] in [-0.75, 0.75], of places [7,N,3] at even steps between."""
    at = (late + 0.75) / 1.5 * (len(seen) - 1)
    first = np.minimum(at.astype(np.int64), len(seen) - 2)
    number, share = np.arange(len(late)), (at - first)[:, None]
    between: Array = seen[first, number] * (1 - share) + seen[first + 1, number] * share
    return between


def _distorted(place: Array, camera: Camera, lens: tuple[float, float]) -> Array:
    """Points [N,3] of the camera moved sideways as the lens does; beyond 1.3 times the corner, no further."""
    corner = (camera.width / float(camera.K[0, 0])) ** 2 / 4 + (camera.height / float(camera.K[1, 1])) ** 2 / 4
    ahead = np.maximum(place[:, 2:], NEAR)
    square = np.minimum((place[:, :2] ** 2).sum(1, keepdims=True) / ahead**2, 1.7 * corner)
    factor = 1 + lens[0] * square + lens[1] * square**2
    return np.concatenate([place[:, :2] * factor, place[:, 2:]], 1)


def vignette(camera: Camera) -> NDArray[np.float32]:
    """The share [H,W] of the light that reaches each pixel."""
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    K = camera.K.numpy()
    square = ((u - K[0, 2]) / K[0, 0]) ** 2 + ((v - K[1, 2]) / K[1, 1]) ** 2
    return np.asarray(1 - VIGNETTING * (1 - (1 + square) ** -2), np.float32)


def develop(
    light: NDArray[np.float32], camera: Camera, exposure: Exposure, errors: Errors, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """The photograph [H,W,3] uint8 of light on the sensor, before JPEG."""
    charge = light * np.float32(exposure.gain)
    if errors.vignetting:
        charge = charge * vignette(camera)[..., None]
    if errors.noise:
        grain = cv2.GaussianBlur(rng.standard_normal(light.shape).astype(np.float32), (0, 0), NOISE_GRAIN)
        read = READ_NOISE * exposure.sensitivity
        charge = charge + grain / grain.std() * np.sqrt(SHOT_NOISE * exposure.sensitivity * charge + read**2)
    balanced = np.clip(charge, 0, 1) * np.array(exposure.balance, np.float32)
    return np.asarray(np.rint(255 * np.clip(balanced, 0, 1) ** (1 / GAMMA)), np.uint8)


def compressed(photo: NDArray[np.uint8]) -> bytes:
    """The photograph as JPEG."""
    done, data = cv2.imencode(".jpg", photo[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    assert done
    return data.tobytes()


def meter(scene: DrawnScene, path: Path, camera: Camera, times: Array) -> Array:
    """The mean light [T,3] of the picture at each time, lamps cut off: what the automatics see."""
    small = Camera(
        camera.K * torch.tensor([[0.125], [0.125], [1.0]]),
        camera.world_to_camera,
        camera.width // 8 + 1,
        camera.height // 8 + 1,
    )
    rows = []
    for world_to_camera in np.linalg.inv(path.poses(times)):
        there = replace(small, world_to_camera=torch.from_numpy(world_to_camera))
        rows.append(shade(gbuffer(scene.atlas, there, 2), scene.radiance, BACKDROP).clamp(max=METER_CLIP).mean((0, 1)))
    return torch.stack(rows).double().numpy()


def automatics(metered: Array, times: Array, errors: Errors, rng: np.random.Generator) -> tuple[list[Exposure], float]:
    """How each frame is taken, and the median gain.

    Exposure and white balance follow the picture's mean, late, and wander; switched off, every frame is taken as the
    median one. metered: [T,3], from `meter`.
    """
    lag = METER_LAG * len(times) / max(times[-1] - times[0], 1e-9)
    wander = gaussian_filtered(rng.standard_normal((len(times), 3)), max(2.0, 2 * lag))
    wander = wander / np.maximum(wander.std(0), 1e-9)
    late = _lagging(np.log(metered), lag)
    brightness = late.mean(1)
    usual = float(np.exp(np.log(KEY) - np.median(brightness)))
    wanted = EXPOSURE_DRIFT * wander[:, 0] - METER_STRENGTH * brightness
    wanted = wanted - np.median(wanted)
    color = BALANCE_STRENGTH * (late[:, 1:2] - late)[:, [0, 2]] + BALANCE_DRIFT * wander[:, 1:]
    color = color - np.median(color, axis=0)
    exposures = []
    for time, more, (red, blue) in zip(times, wanted, color, strict=True):
        stops = float(more) if errors.exposure else 0.0
        balance = (float(np.exp(red)), 1.0, float(np.exp(blue))) if errors.white_balance else (1.0, 1.0, 1.0)
        # A change is met half by the time and half by the sensitivity.
        half = float(np.exp(stops / 2))
        seconds = SHUTTER * half if errors.blur else 0.0
        exposures.append(Exposure(float(time), seconds, usual * half**2, balance, half))
    return exposures, usual


def _lagging(values: Array, lag: float) -> Array:
    """Rows of `values` [T,D] as a filter of `lag` samples has them that knows only the past."""
    keep = np.exp(-1 / max(lag, 1e-9))
    result = values.copy()
    for index in range(1, len(values)):
        result[index] = keep * result[index - 1] + (1 - keep) * values[index]
    return result


def blur_pixels(path: Path, camera: Camera, exposure: Exposure, points: Array) -> Array:
    """How many pixels [N] points [N,3] of the world move in the picture while a frame is exposed."""
    ends = exposure.middle + exposure.seconds * np.array([-0.5, 0.5])
    world_to_camera = np.linalg.inv(path.poses(ends))
    seen = np.einsum("kij,nj->kni", world_to_camera[:, :3, :3], points) + world_to_camera[:, None, :3, 3]
    image = seen @ camera.K.numpy().T
    image = image[..., :2] / image[..., 2:]
    return np.asarray(np.linalg.norm(image[1] - image[0], axis=-1), np.float64)

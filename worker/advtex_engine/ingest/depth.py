"""Device depth: stored values -> metres -> the color camera's image; and which encoding the values really have."""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from advtex_engine.core.cameras import scaled_camera
from advtex_engine.core.errors import Problem
from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import Camera, DepthFrame, Mesh
from advtex_engine.mesh.registration import register_camera
from advtex_engine.render.rasterize import rasterize
from advtex_scan.manifest import ScanManifest

Raw = npt.NDArray[np.uint16]

NO_READING = (0, 65535)
# Encodings are judged on images of at most this width, by readings within AGREEMENT of the mesh's depth; an encoding
# fits if FITTING_SHARE of the readings agree, and nothing is judged on fewer than MIN_READINGS.
JUDGED_WIDTH = 160
AGREEMENT = 0.05
FITTING_SHARE = 0.5
MIN_READINGS = 500
FINER_BY_NOTHING = 0.01  # an image that is finer by a hundredth has gaps in two pixels of a hundred: as good as none
CLEARLY = 0.8  # of the share that agrees from other poses may agree in another unit, for the poses to be what is wrong


@dataclass(frozen=True)
class DepthEncoding:
    """How metres are stored in 16 bits: units per metre, after rotating the bits left by 3 places if `rotated`.

    farthest: metres; what is stored beyond is no reading.
    SUN3D and its kin store d as (d << 3) | (d >> 13), so that viewers show something: d = (v >> 3) | (v << 13).
    """

    name: str
    units_per_metre: float
    rotated: bool = False
    farthest: float = math.inf

    def metres(self, raw: Raw) -> npt.NDArray[np.float32]:
        """[H,W] uint16 -> [H,W] float32 metres, 0 = no reading."""
        units = (raw >> 3) | (raw << 13) if self.rotated else raw
        empty = np.isin(raw, NO_READING) | np.isin(units, NO_READING)
        metres = units.astype(np.float32) / np.float32(self.units_per_metre)
        return np.where(empty | (metres > self.farthest), np.float32(0), metres)


PLAIN = (
    DepthEncoding("millimetres", 1_000.0),
    DepthEncoding("fifths of a millimetre, as TUM stores it", 5_000.0),
    DepthEncoding("6553.5 units per metre, as Replica stores it", 6_553.5),
    DepthEncoding("tenths of a millimetre", 10_000.0),
)
ROTATED = (
    DepthEncoding("bit-rotated millimetres", 1_000.0, rotated=True),
    # 16 bits end at 6.55 m here; what stands close to that end is a mark or an overflow, no reading.
    DepthEncoding("bit-rotated tenths of a millimetre", 10_000.0, rotated=True, farthest=6.0),
)


def declared_encoding(manifest: ScanManifest) -> DepthEncoding:
    """How a scan says that its depth is stored."""
    name = f"{'bit-rotated, ' if manifest.depth_rotated else ''}{manifest.depth_scale:g} units per metre"
    return DepthEncoding(name, manifest.depth_scale, manifest.depth_rotated, manifest.depth_farthest)


def inflate(data: bytes, width: int, height: int) -> Raw:
    """zlib-compressed little-endian uint16 [height,width]; ValueError if it is anything else."""
    size = 2 * width * height
    stream = zlib.decompressobj()
    try:
        values = stream.decompress(data, size + 1)
    except zlib.error as error:
        raise ValueError(f"is no zlib stream ({error})") from error
    if len(values) != size:
        raise ValueError(f"does not hold {width}x{height} readings")
    return np.frombuffer(values, "<u2").reshape(height, width)


def measure_depth(
    mesh: Mesh,
    samples: Sequence[tuple[Camera, Raw]],
    declared: DepthEncoding,
    monitor: Monitor,
    *,
    poses_may_move: bool = False,
) -> DepthEncoding | None:
    """The encoding whose depth agrees with the mesh; None, with a warning, if none does.

    samples: depth cameras at the stored images' size, and those images. The declared encoding is taken if it fits or
    if too few readings meet the mesh to judge; another one brings a warning. poses_may_move: it is also taken if it
    fits from other poses, which brings a warning too.
    """
    pairs = [_readings(mesh, camera, raw) for camera, raw in samples]
    stored = np.concatenate([raw for raw, _ in pairs]) if pairs else np.zeros(0, np.uint16)
    rendered = np.concatenate([depth for _, depth in pairs]) if pairs else np.zeros(0, np.float32)
    if len(stored) < MIN_READINGS:
        return declared
    shares = {encoding: agreement(encoding, stored, rendered) for encoding in (declared, *PLAIN, *ROTATED)}
    best = max(shares, key=lambda encoding: shares[encoding])
    if shares[declared] >= FITTING_SHARE:
        return declared
    if shares[best] >= FITTING_SHARE:
        monitor.warning(
            Problem(
                "depth_encoding",
                "depth",
                f"the depth images hold {best.name}, not {declared.name}: so read, {shares[best]:.0%} of the readings "
                f"agree with the mesh, otherwise {shares[declared]:.0%}",
                "none needed; the depth is read that way",
            )
        )
        return best
    moved = _agreement_elsewhere(mesh, samples, declared) if poses_may_move else 0.0
    if moved >= FITTING_SHARE and _agreement_scaled(declared, stored, rendered) < CLEARLY * moved:
        monitor.warning(
            Problem(
                "poses_off",
                "poses",
                f"the poses are off: {shares[declared]:.0%} of the depth readings agree with the mesh, and {moved:.0%} "
                "do from poses that fit them",
                "none needed; cameras are refined from there. Look into the app's tracking",
            )
        )
        return declared
    monitor.warning(
        Problem(
            "depth_ignored",
            "depth",
            f"the depth images disagree with the mesh however they are read (at best {shares[best]:.0%} of the "
            f"readings are within {AGREEMENT:.0%}); they are ignored",
            "check the depth scale, the depth camera's intrinsics and the depth-to-color transform",
        )
    )
    return None


def agreement(encoding: DepthEncoding, raw: Raw, rendered: npt.NDArray[np.float32]) -> float:
    """Share of the readings [N] within AGREEMENT of the mesh's depth [N] (metres, > 0)."""
    metres = encoding.metres(raw)
    return float((np.abs(metres - rendered) < AGREEMENT * rendered).mean())


def _agreement_scaled(encoding: DepthEncoding, raw: Raw, rendered: npt.NDArray[np.float32]) -> float:
    """The `agreement` of depth in the unit that fits best: wrong poses are no matter of units."""
    metres = encoding.metres(raw)
    ratio = rendered[metres > 0] / metres[metres > 0]
    scale = float(np.median(ratio)) if len(ratio) else 1.0
    return float((np.abs(scale * metres - rendered) < AGREEMENT * rendered).mean())


def _agreement_elsewhere(mesh: Mesh, samples: Sequence[tuple[Camera, Raw]], encoding: DepthEncoding) -> float:
    """The `agreement` from the poses at which each image fits the mesh, where there are such."""
    pairs = []
    for camera, raw in samples:
        pose = register_camera(mesh, DepthFrame(camera, torch.from_numpy(encoding.metres(raw))))
        pairs.append(_readings(mesh, camera if pose is None else replace(camera, world_to_camera=pose), raw))
    stored, rendered = (np.concatenate(column) for column in zip(*pairs, strict=True))
    return agreement(encoding, stored, rendered) if len(stored) >= MIN_READINGS else 0.0


def _readings(mesh: Mesh, camera: Camera, raw: Raw) -> tuple[Raw, npt.NDArray[np.float32]]:
    """Stored values [N] and the mesh's depth [N] where both exist, on a grid of at most JUDGED_WIDTH columns."""
    width = min(JUDGED_WIDTH, camera.width)
    height = max(1, round(camera.height * width / camera.width))
    rendered = rasterize(mesh, scaled_camera(camera, width, height)).depth.numpy()
    rows = ((np.arange(height) + 0.5) * raw.shape[0] / height).astype(np.int64)
    columns = ((np.arange(width) + 0.5) * raw.shape[1] / width).astype(np.int64)
    stored = raw[rows[:, None], columns]
    both = (rendered > 0) & ~np.isin(stored, NO_READING)
    return stored[both], rendered[both]


def depth_in_color_image(depth: Tensor, depth_camera: Camera, color_camera: Camera) -> Tensor:
    """Depth [h,w] (metres, 0 = none) of one camera as [H,W] seen by another.

    Every reading is projected into the pixel it falls in; the nearest one wins. Where the color image is the finer
    one, readings are repeated so that they leave no gaps. Not differentiable.
    """
    assert depth.shape == (depth_camera.height, depth_camera.width)
    finer = max(float(color_camera.K[axis, axis] / depth_camera.K[axis, axis]) for axis in (0, 1))
    repeat = max(1, math.ceil(finer - FINER_BY_NOTHING))
    if repeat > 1:
        depth = depth.repeat_interleave(repeat, 0).repeat_interleave(repeat, 1)
        depth_camera = scaled_camera(depth_camera, depth_camera.width * repeat, depth_camera.height * repeat)
    index, z, _ = _landing(depth, depth_camera, color_camera)
    nearest = torch.full((color_camera.height * color_camera.width,), torch.inf)
    nearest.scatter_reduce_(0, index, z, "amin")
    nearest[nearest.isinf()] = 0
    return nearest.view(color_camera.height, color_camera.width)


def outside_mask(depth: Tensor, depth_camera: Camera, mask: Tensor, color_camera: Camera) -> Tensor:
    """Which readings [h,w] of one camera fall on pixels that another one's mask [H,W] bool leaves out: [h,w] bool.

    Of what falls beside the mask's image it says nothing.
    """
    assert depth.shape == (depth_camera.height, depth_camera.width)
    assert mask.shape == (color_camera.height, color_camera.width)
    index, _, inside = _landing(depth, depth_camera, color_camera)
    left_out = torch.zeros_like(inside)
    left_out[inside] = ~mask.flatten()[index]
    return left_out


def _landing(depth: Tensor, depth_camera: Camera, color_camera: Camera) -> tuple[Tensor, Tensor, Tensor]:
    """Where the N readings of depth [h,w] land that land in another camera's image.

    Flat pixels [N] int64 and depths [N] there, and which readings these are, [h,w] bool.
    """
    to_color = color_camera.world_to_camera @ torch.linalg.inv(depth_camera.world_to_camera)
    # A reading z at the pixel (u, v) lands at H (u, v, 1) z + h, undivided: two small outer sums per coordinate.
    H = (color_camera.K @ to_color[:3, :3] @ torch.linalg.inv(depth_camera.K)).tolist()
    h = (color_camera.K @ to_color[:3, 3]).tolist()
    u = torch.arange(depth_camera.width) + 0.5
    v = torch.arange(depth_camera.height)[:, None] + 0.5
    x, y, z = ((H[k][0] * u + (H[k][1] * v + H[k][2])) * depth + h[k] for k in range(3))
    column, row = (x / z).floor(), (y / z).floor()
    inside = (depth > 0) & (z > 0) & (column >= 0) & (row >= 0)
    inside &= (column < color_camera.width) & (row < color_camera.height)
    return (row[inside] * color_camera.width + column[inside]).long(), z[inside], inside

"""Depth images -> a mesh, for scans that bring none: a signed distance field on sparse voxels, and its zero level.

Positions in world metres; nothing here is differentiable. The steps: the voxel size is chosen, blocks are found where
there are readings, every frame is integrated (`voxels`), the surface is extracted (`marching_cubes`), floaters are
removed. What no camera saw stays open; the face budget is met by `geometry.decimate`, as for every mesh.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

from advtex_engine.core.errors import Problem, ScanError
from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import DepthFrame, Mesh
from advtex_engine.mesh.marching_cubes import extract_surface
from advtex_engine.mesh.pieces import pieces
from advtex_engine.mesh.tsdf import VOXELS, Sampling, find_blocks, integrate

# Metres. A room is seen from 1.5 m and more, where sensors and poses are no better than the coarsest. What is scanned
# from nearer is smaller, and its depth is better in proportion: a voxel is this share of the median distance.
COARSEST, FINEST = 0.010, 0.001
VOXEL_SHARE = 1 / 150
# Distances and weights of all voxels, and the surface that comes of them. 1 GiB holds 270 square metres of surface at
# 1 cm, about three large rooms; for more, voxels grow.
MAX_VOXEL_BYTES = 1 << 30
VOXEL_BYTES = 12
GROWTH = 1.25
# In readings straight on at the median distance: what one frame saw well, or one in 500 did.
MIN_WEIGHT, MIN_WEIGHT_SHARE = 0.1, 0.002
FLOATER_SHARE = 0.001  # of all faces; separate pieces below it are noise
SAMPLED_PIXELS = 4_096  # of each frame, to find the median distance


@dataclass(frozen=True)
class FusionReport:
    """What the fusion did. seconds_per_frame: of integration. extraction_seconds: of the surface, floaters included."""

    voxel_size_mm: float
    frames: int
    blocks: int
    faces: int
    removed_floaters: int
    removed_faces: int
    seconds_per_frame: float
    extraction_seconds: float


def fuse(frames: Sequence[DepthFrame], device: torch.device, monitor: Monitor) -> tuple[Mesh, dict[str, Any]]:
    """The surface that depth images saw, on the CPU, counter-clockwise seen from outside; and what was done, as a dict.

    Work and voxels are on `device`: at most MAX_VOXEL_BYTES. Raises ScanError when the readings make no surface.
    """
    reference = median_depth(frames)
    if reference is None:
        raise _no_surface("no depth image has a reading")
    sampling, keys = _voxels(frames, reference, device, monitor)
    if len(keys) == 0:
        raise _no_surface("no depth image shows a surface")
    started = time.monotonic()
    blocks = integrate(frames, keys, sampling, max(MIN_WEIGHT, MIN_WEIGHT_SHARE * len(frames)), monitor)
    integrated = time.monotonic()
    whole = extract_surface(blocks)
    if len(whole.t_pos_idx) == 0:
        raise _no_surface("the depth images agree on no surface")
    mesh, floaters = remove_floaters(whole)
    report = FusionReport(
        voxel_size_mm=round(1000 * sampling.voxel_size, 3),
        frames=len(frames),
        blocks=len(keys),
        faces=len(mesh.t_pos_idx),
        removed_floaters=floaters,
        removed_faces=len(whole.t_pos_idx) - len(mesh.t_pos_idx),
        seconds_per_frame=round((integrated - started) / len(frames), 4),
        extraction_seconds=round(time.monotonic() - integrated, 3),
    )
    return Mesh(mesh.v_pos.cpu(), mesh.t_pos_idx.cpu()), asdict(report)


def median_depth(frames: Sequence[DepthFrame]) -> float | None:
    """Metres, over a sample of every frame's readings; None without readings."""
    samples = [frame.readings.view(-1)[:: max(1, frame.depth.numel() // SAMPLED_PIXELS)] for frame in frames]
    readings = torch.cat([sample[sample > 0] for sample in samples]) if samples else torch.empty(0)
    return float(readings.median()) if len(readings) else None


def choose_voxel_size(reference: float) -> float:
    """Metres per voxel for a scan whose readings lie at about `reference` metres."""
    return min(max(VOXEL_SHARE * reference, FINEST), COARSEST)


def remove_floaters(mesh: Mesh) -> tuple[Mesh, int]:
    """The mesh without pieces of fewer than FLOATER_SHARE of its faces and without loose vertices; how many went."""
    label = pieces(mesh)
    of_face = label[mesh.t_pos_idx[:, 0]]
    faces = torch.bincount(of_face, minlength=len(mesh.v_pos))
    floats = (faces > 0) & (faces < FLOATER_SHARE * len(of_face))
    kept = mesh.t_pos_idx[~floats[of_face]]
    used = torch.zeros(len(mesh.v_pos), dtype=torch.bool, device=label.device)
    used[kept.view(-1)] = True
    return Mesh(mesh.v_pos[used], (used.cumsum(0) - 1)[kept]), int(floats.sum())


def _voxels(
    frames: Sequence[DepthFrame], reference: float, device: torch.device, monitor: Monitor
) -> tuple[Sampling, Tensor]:
    """How the frames are sampled, and the keys of the blocks: as fine as memory allows."""
    wanted = size = choose_voxel_size(reference)
    while True:
        sampling = Sampling(size, reference)
        keys = find_blocks(frames, sampling, device)
        if len(keys) * VOXELS * VOXEL_BYTES <= MAX_VOXEL_BYTES:
            break
        size *= GROWTH
    if size > wanted:
        monitor.warning(
            Problem(
                "voxels_coarsened",
                "depth",
                f"the scan is too large for voxels of {1000 * wanted:.1f} mm; they are {1000 * size:.1f} mm",
                "split the scan into rooms for a finer mesh, or add a mesh to it",
            )
        )
    return sampling, keys


def _no_surface(message: str) -> ScanError:
    remedy = "check the depth images, their scale and the poses, or add a mesh to the scan"
    return ScanError(Problem("no_surface", "depth", message, remedy))

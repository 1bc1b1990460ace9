"""A few frames of a scan, small, as its files state them: what conventions are judged on."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from advtex_engine.conventions.readings import Reading
from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import Mesh
from advtex_engine.ingest.decode import (
    Color,
    Mask,
    check_size,
    color_image,
    decode_confidence,
    decode_depth,
    decode_mask,
    fill_masked,
    prepare_color,
    rectified,
    rectify,
    shrink_mask,
)
from advtex_engine.ingest.depth import DepthEncoding, Raw, declared_encoding, outside_mask
from advtex_engine.ingest.frame_cameras import depth_camera, frame_camera, inverse_pose
from advtex_engine.ingest.video import VideoReader
from advtex_engine.mesh.clean import collapse_edges
from advtex_scan.archive import ScanArchive
from advtex_scan.manifest import FrameEntry, Intrinsics, ScanManifest, VideoFrame

LONGER_SIDE = 160
"""Pixels of the grid on which frames are compared."""
ANCHORS = 8
"""Frames spread over the scan, each of which is compared with a neighbor."""
TURN = 12.0
"""Degrees between a frame and the neighbor that is taken: little enough to overlap, enough to tell cameras apart."""
NEIGHBORS = 30
"""Frames after an anchor among which its neighbor is looked for."""
VIDEO_PICTURES = 240
"""Pictures that are looked at from the start of a video: the last one asked for costs decoding all before it."""
MESH_FACES = 20_000
"""Faces of the mesh that is rendered: its triangles need not be finer than the grid."""
MAX_FILE_BYTES = 256 << 20


@dataclass(frozen=True)
class Sample:
    """N frames on one grid of H x W pixels, as the manifest describes them.

    raw: [N,H,W] depth as stored, of the nearest pixel, 0 where the device has no confidence or a mask leaves it out;
    None without depth.
    encoding: how the manifest says that it is stored. reading: the frames so read; its mesh is a coarse one.
    color_camera, depth_camera: of the first frame, for its stored size.
    """

    raw: Raw | None
    encoding: DepthEncoding
    reading: Reading
    color_camera: Intrinsics
    depth_camera: Intrinsics | None

    def metres(self, encoding: DepthEncoding) -> Tensor:
        """[N,H,W] float32, 0 = no reading."""
        assert self.raw is not None
        return torch.from_numpy(np.stack([encoding.metres(raw) for raw in self.raw]))


def coarse_mesh(mesh: Mesh) -> Mesh:
    """The mesh with at most about MESH_FACES faces; borders and degenerate faces do not matter here."""
    if len(mesh.t_pos_idx) <= MESH_FACES:
        return Mesh(mesh.v_pos, mesh.t_pos_idx)
    return collapse_edges(mesh, MESH_FACES, Monitor())


def take_sample(archive: ScanArchive, manifest: ScanManifest, mesh: Mesh | None) -> Sample:
    """Neighboring frames from all over the scan. mesh: in world coordinates.

    Raises ScanError for files that do not decode.
    """
    frames, pairs = _choose(manifest.frames)
    first = rectified(frames[0].color_intrinsics, frames[0].border)
    scale = min(1.0, LONGER_SIDE / max(first.width, first.height))
    size = (max(1, round(first.width * scale)), max(1, round(first.height * scale)))
    videos: dict[str, VideoReader] = {}
    masks = [_mask(archive, entry) for entry in frames]
    colors = [_gray(_color(archive, entry, size, videos, mask)) for entry, mask in zip(frames, masks, strict=True)]
    raw = None
    depth_cameras = [entry.depth_intrinsics for entry in frames if entry.depth is not None and entry.depth_intrinsics]
    if len(depth_cameras) == len(frames):
        stored = [_depth(archive, entry, size, manifest) for entry in frames]
        raw = np.stack([_unmasked(*one, size, manifest) for one in zip(stored, frames, masks, strict=True)])
    encoding = declared_encoding(manifest)
    color_intrinsics = _intrinsics([rectified(entry.color_intrinsics, entry.border) for entry in frames], size)
    reading = Reading(
        pairs=torch.tensor(pairs),
        camera_to_world=torch.tensor([entry.camera_to_world for entry in frames], dtype=torch.float64),
        color=torch.from_numpy(np.stack(colors)),
        color_intrinsics=color_intrinsics,
        depth=None,
        depth_intrinsics=color_intrinsics
        if raw is None
        else _intrinsics([rectified(camera) for camera in depth_cameras], size),
        depth_to_color=torch.tensor(manifest.depth_to_color, dtype=torch.float64),
        mesh=None if mesh is None else coarse_mesh(mesh),
    )
    first_depth = None if raw is None else depth_cameras[0]
    sample = Sample(raw, encoding, reading, frames[0].color_intrinsics, first_depth)
    return sample if raw is None else replace(sample, reading=replace(reading, depth=sample.metres(encoding)))


def _choose(frames: Sequence[FrameEntry]) -> tuple[list[FrameEntry], list[tuple[int, int]]]:
    """The frames, in order, and which of them are neighbors."""
    near = [frame for frame in frames if not isinstance(frame.color, VideoFrame) or frame.color.index < VIDEO_PICTURES]
    with_depth = [frame for frame in near if frame.depth is not None and frame.depth_intrinsics is not None]
    usable = with_depth if len(with_depth) >= 2 else near
    chosen = set[tuple[int, int]]()
    for anchor in np.linspace(0, len(usable) - 2, min(len(usable) - 1, ANCHORS)).round().astype(int).tolist():
        others = range(anchor + 1, min(len(usable), anchor + 1 + NEIGHBORS))
        partner = min(others, key=lambda other: abs(_turn(usable[anchor], usable[other]) - TURN))
        chosen.add((anchor, partner))
    kept = sorted({index for pair in chosen for index in pair})
    place = {index: position for position, index in enumerate(kept)}
    return [usable[index] for index in kept], [(place[a], place[b]) for a, b in sorted(chosen)]


def _turn(one: FrameEntry, other: FrameEntry) -> float:
    """Degrees by which the camera turns; the same whether poses are inverted, and whatever the axes are called."""
    a, b = (np.array(entry.camera_to_world)[:3, :3] for entry in (one, other))
    return math.degrees(math.acos(float(np.clip((np.trace(a.T @ b) - 1) / 2, -1, 1))))


def _mask(archive: ScanArchive, entry: FrameEntry) -> Mask | None:
    """Where the stored color image may be used; None if everywhere."""
    if entry.mask is None:
        return None
    return decode_mask(archive.read(entry.mask, MAX_FILE_BYTES), entry.mask, entry.color_intrinsics)


def _color(
    archive: ScanArchive,
    entry: FrameEntry,
    size: tuple[int, int],
    videos: dict[str, VideoReader],
    mask: Mask | None,
) -> Color:
    stored = entry.color_intrinsics
    if isinstance(entry.color, VideoFrame):
        path = entry.color.path
        picture = videos.setdefault(path, VideoReader(archive, path)).read(entry.color)
    else:
        picture = color_image(archive.read(entry.color, MAX_FILE_BYTES), entry.color, stored)
    check_size(entry.color, picture, stored)
    if mask is not None:
        picture = fill_masked(picture, mask)
    return prepare_color(picture, entry.color, stored, size, entry.border)


def _gray(color: Color) -> npt.NDArray[np.float32]:
    return np.asarray(color @ np.array([0.299, 0.587, 0.114], np.float32), np.float32)


def _depth(archive: ScanArchive, entry: FrameEntry, size: tuple[int, int], manifest: ScanManifest) -> Raw:
    """The stored values of the pixels nearest to the grid's."""
    camera = _depth_intrinsics(entry)
    assert entry.depth is not None
    raw = decode_depth(archive.read(entry.depth, MAX_FILE_BYTES), entry.depth, camera, manifest.depth_scale)
    if entry.confidence is not None:
        data = archive.read(entry.confidence, MAX_FILE_BYTES)
        trust = decode_confidence(data, entry.confidence, camera, manifest.confidence_max)
        raw = np.where(trust > 0, raw, np.uint16(0))
    raw = rectify(raw, camera, 0, cv2.INTER_NEAREST)
    rows = ((np.arange(size[1]) + 0.5) * raw.shape[0] / size[1]).astype(np.int64)
    columns = ((np.arange(size[0]) + 0.5) * raw.shape[1] / size[0]).astype(np.int64)
    return np.asarray(raw[rows[:, None], columns], np.uint16)


def _unmasked(raw: Raw, entry: FrameEntry, mask: Mask | None, size: tuple[int, int], manifest: ScanManifest) -> Raw:
    """The grid's stored values without those that, as the manifest says, fall where the color's mask leaves out."""
    if mask is None:
        return raw
    stored = entry.color_intrinsics
    camera = frame_camera(rectified(stored, entry.border).scaled(*size), inverse_pose(entry.camera_to_world))
    beside = depth_camera(entry, rectified(_depth_intrinsics(entry)).scaled(*size), manifest.depth_to_color)
    metres = torch.from_numpy(declared_encoding(manifest).metres(raw))
    left_out = outside_mask(metres, beside, torch.from_numpy(shrink_mask(mask, stored, size, entry.border)), camera)
    return np.where(left_out.numpy(), np.uint16(0), raw)


def _depth_intrinsics(entry: FrameEntry) -> Intrinsics:
    assert entry.depth_intrinsics is not None
    return entry.depth_intrinsics


def _intrinsics(cameras: Sequence[Intrinsics], size: tuple[int, int]) -> Tensor:
    scaled = [camera.scaled(*size) for camera in cameras]
    return torch.tensor([[one.fx, one.fy, one.cx, one.cy] for one in scaled], dtype=torch.float64)

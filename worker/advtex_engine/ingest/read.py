"""Scan files -> Capture: check, decode, shrink to the working size.

Frames are read in order on the calling thread and decoded in a few others, each shrunk at once and stored, so that
memory holds no more than a few full images.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch

from advtex_engine.core.config import TextureConfig
from advtex_engine.core.errors import Problem, ScanError, Stopped, few_of
from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import Camera, DepthFrame, Mesh, Scene
from advtex_engine.ingest.decode import (
    Color,
    check_size,
    color_image,
    decode_confidence,
    decode_depth,
    decode_mask,
    fill_masked,
    rectified,
    rectify,
    rectify_color,
    shrink_color,
    shrink_mask,
)
from advtex_engine.ingest.depth import DepthEncoding, Raw, declared_encoding, measure_depth, outside_mask
from advtex_engine.ingest.frame_cameras import depth_camera, frame_camera, inverse_pose
from advtex_engine.ingest.frames import Capture, Frame, FrameStore, StoredFrame, view_budget
from advtex_engine.ingest.thumbnails import thumbnail_of
from advtex_engine.ingest.video import VideoReader
from advtex_engine.mesh.fusion import fuse
from advtex_engine.mesh.read import NUMPY, to_mesh
from advtex_engine.runtime.threads import in_threads
from advtex_scan.archive import ScanArchive, open_scan
from advtex_scan.check import read_scan
from advtex_scan.errors import Finding, ScanFormatError
from advtex_scan.manifest import (
    FileRef,
    FrameEntry,
    Matrix4,
    MeshRefinement,
    ScanManifest,
    UpAxis,
    VideoFrame,
)

OnMesh = Callable[[Mesh, MeshRefinement, UpAxis], None]
"""Mesh in world coordinates, how it may still be moved, and the world's up axis."""

MAX_IMAGE_BYTES = 256 << 20
# Frames whose depth is compared with the mesh to find out how it is encoded.
DEPTH_SAMPLES = 5


def ingest(scan: Path, config: TextureConfig, monitor: Monitor) -> Scene:
    """Read a scan (folder or zip) into views at the working size, and its mesh; one is fused where there is none.

    Of the usable frames in order, those whose position % config.holdout == config.holdout // 2 become
    `Scene.heldout` and no stage sees them. Frames that do not see the mesh are left out, which the monitor is told;
    all others become views, however many they are.

    Raises ScanError with one problem per finding, naming file and remedy; Stopped when the monitor asks for it.
    """
    with FrameStore() as store:
        return _with_mesh(read_capture(scan, config, store, monitor), monitor)


def read_capture(
    scan: Path, config: TextureConfig, store: FrameStore, monitor: Monitor, on_mesh: OnMesh | None = None
) -> Capture:
    """`ingest` before a mesh is fused and views are left out. The capture's frames are in the store.

    on_mesh: told the scan's own mesh, if it brings one, before its frames are decoded.
    """
    with opened(scan) as archive:
        manifest, mesh, warnings = sound_scan(archive, config.layout)
        for warning in warnings:
            monitor.warning(warning)
        return _capture(archive, manifest, mesh, config, store, monitor, on_mesh)


def sound_scan(archive: ScanArchive, layout: str | None) -> tuple[ScanManifest, Mesh | None, list[Problem]]:
    """A scan's manifest, its mesh as it lies in the file, and warnings. Raises ScanError with one problem per error."""
    reading = read_scan(archive, layout, NUMPY)
    errors = [_problem(finding) for finding in reading.report.findings if finding.severity == "error"]
    if errors or reading.manifest is None:
        raise ScanError(*errors)
    warnings = [_problem(finding) for finding in reading.report.findings if finding.severity == "warning"]
    return reading.manifest, None if reading.mesh is None else to_mesh(reading.mesh), warnings


@contextmanager
def opened(scan: Path) -> Iterator[ScanArchive]:
    """A scan's files. Raises ScanError, also for what is found to be wrong with them while they are open."""
    try:
        with open_scan(scan) as archive:
            yield archive
    except ScanFormatError as error:
        raise ScanError(*map(_problem, error.findings)) from error


def load_scene(
    archive: ScanArchive, manifest: ScanManifest, mesh: Mesh | None, config: TextureConfig, monitor: Monitor
) -> Scene:
    """`ingest` for a scan that is open and sound. mesh: as it lies in the file that the manifest names."""
    with FrameStore() as store:
        return _with_mesh(_capture(archive, manifest, mesh, config, store, monitor), monitor)


def _with_mesh(capture: Capture, monitor: Monitor) -> Scene:
    mesh = capture.mesh or fuse(capture.measured(), torch.device("cpu"), monitor)[0]
    return capture.scene(mesh, monitor)


def _capture(
    archive: ScanArchive,
    manifest: ScanManifest,
    mesh: Mesh | None,
    config: TextureConfig,
    store: FrameStore,
    monitor: Monitor,
    on_mesh: OnMesh | None = None,
) -> Capture:
    entry = manifest.mesh
    if entry is not None and mesh is not None:
        mesh = _placed(mesh, entry.mesh_to_world)
        if on_mesh is not None:
            on_mesh(mesh, entry.refinement, manifest.up_axis)
    # A mesh that is placed roughly, to be moved onto the depth, says nothing about the depth.
    placed = None if entry is None or entry.refinement != "none" else mesh
    encoding = _depth_encoding(archive, manifest, placed, config.refines, monitor)
    first = rectified(manifest.frames[0].color_intrinsics, manifest.frames[0].border)
    size = config.size or (first.width, first.height)
    every = config.holdout
    held = [every is not None and place % every == every // 2 for place in range(len(manifest.frames))]
    thumbnails = held.count(False) > view_budget(config.max_views, *size)
    job = _Decoding(size, encoding, manifest, thumbnails)
    frames = _decode_all(archive, job, store, monitor)
    return Capture(
        store=store,
        size=size,
        mesh=mesh,
        mesh_path="depth" if entry is None else entry.path,
        mesh_refinement="none" if entry is None else entry.refinement,
        training=tuple(frame for frame, out in zip(frames, held, strict=True) if frame and not out),
        heldout=tuple(frame for frame, out in zip(frames, held, strict=True) if frame and out),
        kind=manifest.kind,
        up_axis=manifest.up_axis,
        manifest=manifest,
    )


def _placed(mesh: Mesh, mesh_to_world: Matrix4) -> Mesh:
    """The mesh with its vertices in world coordinates."""
    transform = torch.tensor(mesh_to_world, dtype=torch.float64)
    v_pos = mesh.v_pos.double() @ transform[:3, :3].T + transform[:3, 3]
    return replace(mesh, v_pos=v_pos.to(mesh.v_pos.dtype))


def _problem(finding: Finding) -> Problem:
    return Problem(finding.code, finding.where, finding.message, finding.remedy)


# Frames ---------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Decoding:
    """What is the same for all frames: working size (width, height), and depth encoding (None: no depth).

    thumbnails: whether a thumbnail is made of each frame, because there are more than can become views.
    """

    size: tuple[int, int]
    encoding: DepthEncoding | None
    manifest: ScanManifest
    thumbnails: bool


@dataclass(frozen=True)
class _FrameData:
    """A frame's files as they are stored; a video's picture comes decoded."""

    entry: FrameEntry
    color: bytes | Color
    depth: bytes | None = None
    confidence: bytes | None = None
    mask: bytes | None = None


def _decode_all(archive: ScanArchive, job: _Decoding, store: FrameStore, monitor: Monitor) -> list[StoredFrame | None]:
    """All frames, in order, None for one whose mask leaves nothing of it, which the monitor is told.

    ScanError with one problem per broken file, or where nothing is left of any frame.
    """
    frames, problems, hidden = list[StoredFrame | None](), list[Problem](), list[str]()
    videos: dict[str, VideoReader] = {}
    files = (_read(archive, entry, videos, job.encoding is not None) for entry in job.manifest.frames)
    for outcome in in_threads(partial(_frame, job=job), files):
        if monitor.stop_requested():
            raise Stopped("stopped while frames are decoded; resume begins with the first one")
        if not isinstance(outcome, Frame):
            problems += outcome
        elif outcome.mask is not None and not bool(outcome.mask.any()):
            frames.append(None)
            hidden.append(outcome.name)
        else:
            frames.append(store.put(outcome))
    if problems:
        raise ScanError(*problems)
    if hidden:
        share = "all" if len(hidden) == len(frames) else f"{len(hidden)} of {len(frames)}"
        remedy = "masks are 255 where the image may be used and 0 elsewhere: invert them, or leave them out"
        problem = Problem("masked_out", few_of(hidden), f"masks leave no pixel of {share} frames", remedy)
        if share == "all":
            raise ScanError(problem)
        monitor.warning(problem)
    return frames


def _read(archive: ScanArchive, entry: FrameEntry, videos: dict[str, VideoReader], with_depth: bool) -> _FrameData:
    def data(ref: FileRef | None) -> bytes | None:
        return None if ref is None else archive.read(ref, MAX_IMAGE_BYTES)

    if isinstance(entry.color, VideoFrame):
        path = entry.color.path
        color: bytes | Color = videos.setdefault(path, VideoReader(archive, path)).read(entry.color)
    else:
        color = archive.read(entry.color, MAX_IMAGE_BYTES)
    if not with_depth:
        return _FrameData(entry, color, mask=data(entry.mask))
    return _FrameData(entry, color, data(entry.depth), data(entry.confidence), data(entry.mask))


def _frame(data: _FrameData, job: _Decoding) -> Frame | tuple[Problem, ...]:
    """The decoded frame, or what is wrong with its files."""
    entry, stored = data.entry, data.entry.color_intrinsics
    try:
        if isinstance(data.color, bytes):
            assert not isinstance(entry.color, VideoFrame)
            image = color_image(data.color, entry.color, stored)
        else:
            image = data.color
        check_size(entry.color, image, stored)
        usable = None
        if data.mask is not None and entry.mask is not None:
            usable = decode_mask(data.mask, entry.mask, stored)
            image = fill_masked(image, usable)
        image = rectify_color(image, entry.color, stored, entry.border)
        camera = frame_camera(rectified(stored, entry.border).scaled(*job.size), inverse_pose(entry.camera_to_world))
        measured, mask = _depth_frame(data, job), None
        if usable is not None:
            mask = torch.from_numpy(shrink_mask(usable, stored, job.size, entry.border))
            measured = None if measured is None else _masked(measured, mask, camera)
        return Frame(
            name=entry.name,
            camera=camera,
            color=torch.from_numpy(shrink_color(image, job.size)),
            mask=mask,
            measured=measured,
            thumbnail=thumbnail_of(image, None if mask is None else mask.numpy()) if job.thumbnails else None,
            sharpness=entry.sharpness,
        )
    except ScanFormatError as error:
        return tuple(map(_problem, error.findings))
    except ScanError as error:
        return error.problems


def _depth_frame(data: _FrameData, job: _Decoding) -> DepthFrame | None:
    """The depth image in metres, undistorted, with its camera and confidence; None if there is none."""
    entry, stored = data.entry, data.entry.depth_intrinsics
    if data.depth is None or entry.depth is None or stored is None or job.encoding is None:
        return None
    raw = decode_depth(data.depth, entry.depth, stored, job.manifest.depth_scale)
    metres = rectify(job.encoding.metres(raw), stored, 0, cv2.INTER_NEAREST)
    confidence = None
    if data.confidence is not None and entry.confidence is not None:
        levels = decode_confidence(data.confidence, entry.confidence, stored, job.manifest.confidence_max)
        confidence = torch.from_numpy(rectify(levels, stored, 0, cv2.INTER_NEAREST))
    camera = depth_camera(entry, rectified(stored), job.manifest.depth_to_color)
    return DepthFrame(camera, torch.from_numpy(metres), confidence)


def _masked(frame: DepthFrame, mask: torch.Tensor, camera: Camera) -> DepthFrame:
    """The readings without those of what the color camera's mask leaves out: someone who walks by, a window."""
    left_out = outside_mask(frame.depth, frame.camera, mask, camera)
    return replace(frame, depth=torch.where(left_out, 0.0, frame.depth))


# Depth ----------------------------------------------------------------------------------------------------------------


def _depth_encoding(
    archive: ScanArchive, manifest: ScanManifest, mesh: Mesh | None, refines: bool, monitor: Monitor
) -> DepthEncoding | None:
    """How the scan's depth is stored, measured on a few frames; None if there is none that can be used.

    Without a mesh to compare it with, it is taken as the manifest describes it.
    """
    frames = [frame for frame in manifest.frames if frame.depth is not None and frame.depth_intrinsics is not None]
    if not frames:
        return None
    declared = declared_encoding(manifest)
    if mesh is None:
        return declared
    chosen = np.linspace(0, len(frames) - 1, min(len(frames), DEPTH_SAMPLES)).round().astype(int)
    samples = list[tuple[Camera, Raw]]()
    for entry in (frames[index] for index in chosen):
        assert entry.depth is not None
        assert entry.depth_intrinsics is not None
        data = archive.read(entry.depth, MAX_IMAGE_BYTES)
        raw = decode_depth(data, entry.depth, entry.depth_intrinsics, manifest.depth_scale)
        if entry.confidence is not None:
            levels = archive.read(entry.confidence, MAX_IMAGE_BYTES)
            trust = decode_confidence(levels, entry.confidence, entry.depth_intrinsics, manifest.confidence_max)
            raw = np.where(trust > 0, raw, np.uint16(0))
        samples.append((depth_camera(entry, entry.depth_intrinsics, manifest.depth_to_color), raw))
    return measure_depth(mesh, samples, declared, monitor, poses_may_move=refines)

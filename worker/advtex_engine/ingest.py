"""Scan files -> Scene: check, decode, shrink to the working size, choose the views.

Frames are read in order on the calling thread and decoded in a few others, each shrunk at once, so that memory holds
the views and no more than a few full images.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch

from advtex_engine.cameras import scaled_camera
from advtex_engine.config import TextureConfig
from advtex_engine.depth import DepthEncoding, Raw, depth_in_color_image, inflate, measure_depth
from advtex_engine.errors import Problem, ScanError
from advtex_engine.meshio import load_mesh
from advtex_engine.monitor import Monitor
from advtex_engine.rasterize import rasterize
from advtex_engine.scene import Camera, Mesh, Scene, View
from advtex_scan.archive import ScanArchive, open_scan
from advtex_scan.check import read_scan
from advtex_scan.errors import Finding, ScanFormatError
from advtex_scan.images import MAX_PIXELS, cut_off, has_end, parse_image_header, place
from advtex_scan.manifest import ByteRange, FileRef, FrameEntry, Intrinsics, Matrix4, ScanManifest

MAX_IMAGE_BYTES = 256 << 20
DECODERS = 4
# Frames whose depth is compared with the mesh to find out how it is encoded.
DEPTH_SAMPLES = 5
# Vertices looked at to see whether a view sees the mesh, before the mesh is rasterized to be sure.
SEEN_VERTICES = 20_000
SEEN_WIDTH = 80


def ingest(scan: Path, config: TextureConfig, monitor: Monitor) -> Scene:
    """Read a scan (folder or zip) into views at the working size.

    Of the usable frames in order, those whose position % config.holdout == config.holdout // 2 become
    `Scene.heldout` and no stage sees them. Frames that do not see the mesh are left out, which the monitor is told.

    Raises ScanError with one problem per finding, naming file and remedy.
    """
    with opened(scan) as archive:
        reading = read_scan(archive)
        errors = [_problem(finding) for finding in reading.report.findings if finding.severity == "error"]
        if errors or reading.manifest is None:
            raise ScanError(*errors)
        for finding in reading.report.findings:
            if finding.severity == "warning":
                monitor.warning(_problem(finding))
        return load_scene(archive, reading.manifest, config, monitor)


@contextmanager
def opened(scan: Path) -> Iterator[ScanArchive]:
    """A scan's files. Raises ScanError, also for what is found to be wrong with them while they are open."""
    try:
        with open_scan(scan) as archive:
            yield archive
    except ScanFormatError as error:
        raise ScanError(*map(_problem, error.findings)) from error


def load_scene(archive: ScanArchive, manifest: ScanManifest, config: TextureConfig, monitor: Monitor) -> Scene:
    """`ingest` for a scan that is open and described by a sound manifest."""
    if manifest.mesh is None:
        raise ScanError(Problem("no_mesh", archive.path.name, "the scan has no mesh", "add a PLY, OBJ or GLB mesh"))
    mesh = load_mesh(archive, manifest.mesh.path)
    encoding = _depth_encoding(archive, manifest, mesh, monitor)
    first = manifest.frames[0].color_intrinsics
    job = _Decoding(config.size or (first.width, first.height), encoding, manifest.depth_to_color)
    views = _decode_all(archive, manifest.frames, job)
    training, heldout = _split(views, config.holdout)
    training = _seeing(training, mesh, monitor)
    heldout = _seeing(heldout, mesh, monitor)
    if not training:
        raise ScanError(
            Problem(
                "mesh_not_seen",
                manifest.mesh.path,
                "no frame sees the mesh",
                "bring poses and mesh into one world frame, both in metres",
            )
        )
    return Scene(mesh, training, heldout, manifest.kind, manifest.up_axis)


def _problem(finding: Finding) -> Problem:
    return Problem(finding.code, finding.where, finding.message, finding.remedy)


def _split(views: Sequence[View], holdout: int | None) -> tuple[tuple[View, ...], tuple[View, ...]]:
    """Training and held-out views."""
    if holdout is None:
        return tuple(views), ()
    held = [position % holdout == holdout // 2 for position in range(len(views))]
    return (
        tuple(view for view, out in zip(views, held, strict=True) if not out),
        tuple(view for view, out in zip(views, held, strict=True) if out),
    )


# Frames ---------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Decoding:
    """What is the same for all frames: working size (width, height), depth encoding (None: no depth), transform."""

    size: tuple[int, int]
    encoding: DepthEncoding | None
    depth_to_color: Matrix4


@dataclass(frozen=True)
class _FrameBytes:
    entry: FrameEntry
    color: bytes
    depth: bytes | None


def _decode_all(archive: ScanArchive, frames: Sequence[FrameEntry], job: _Decoding) -> list[View]:
    """All frames as views, in order; ScanError with one problem per broken file."""
    views, problems = list[View](), list[Problem]()
    for outcome in _in_order(archive, frames, job):
        if isinstance(outcome, View):
            views.append(outcome)
        else:
            problems += outcome
    if problems:
        raise ScanError(*problems)
    return views


def _in_order(
    archive: ScanArchive, frames: Sequence[FrameEntry], job: _Decoding
) -> Iterator[View | tuple[Problem, ...]]:
    """Views, or what is wrong with their files. Reads ahead by as many frames as are decoded at a time."""
    workers = min(DECODERS, os.cpu_count() or 1)
    pending = deque[Future[View | tuple[Problem, ...]]]()
    with ThreadPoolExecutor(workers, thread_name_prefix="decode") as pool:
        for entry in frames:
            with_depth = job.encoding is not None and entry.depth is not None and entry.depth_intrinsics is not None
            color = archive.read(entry.color, MAX_IMAGE_BYTES)
            depth = archive.read(entry.depth, MAX_IMAGE_BYTES) if with_depth and entry.depth is not None else None
            pending.append(pool.submit(_view, _FrameBytes(entry, color, depth), job))
            if len(pending) > workers:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()


def _view(frame: _FrameBytes, job: _Decoding) -> View | tuple[Problem, ...]:
    entry = frame.entry
    try:
        color = torch.from_numpy(decode_color(frame.color, entry.color, entry.color_intrinsics, job.size))
        camera = _camera(entry.color_intrinsics.scaled(*job.size), _world_to_camera(entry.camera_to_world))
        if frame.depth is None or entry.depth is None or entry.depth_intrinsics is None or job.encoding is None:
            return View(entry.name, camera, color)
        raw = decode_depth(frame.depth, entry.depth, entry.depth_intrinsics)
        depth_camera = _depth_camera(entry, entry.depth_intrinsics, job.depth_to_color)
        metres = torch.from_numpy(job.encoding.metres(raw))
        return View(entry.name, camera, color, depth_in_color_image(metres, depth_camera, camera))
    except ScanFormatError as error:
        return tuple(map(_problem, error.findings))
    except ScanError as error:
        return error.problems


def decode_color(data: bytes, ref: FileRef, intrinsics: Intrinsics, size: tuple[int, int]) -> npt.NDArray[np.uint8]:
    """A frame's color image as [height,width,3] uint8 sRGB, R first, at `size` = (width, height).

    Shrunk by averaging over areas; the axes scale apart when the aspect ratio differs. Any rotation that the file's
    metadata asks for is ignored: intrinsics and poses belong to the stored pixels.
    """
    if isinstance(ref, ByteRange) and ref.codec == "raw_rgb8":
        if len(data) != 3 * intrinsics.width * intrinsics.height:
            raise ScanError(_broken(ref, f"does not hold {intrinsics.width}x{intrinsics.height} pixels"))
        image = np.frombuffer(data, np.uint8).reshape(intrinsics.height, intrinsics.width, 3)
    else:
        bgr = _imdecode(data, ref, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        image = cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)
    _check_size(ref, image, intrinsics)
    if (intrinsics.width, intrinsics.height) == size:
        return np.array(image)
    shrinks = size[0] <= intrinsics.width and size[1] <= intrinsics.height
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR), np.uint8)


def decode_depth(data: bytes, ref: FileRef, intrinsics: Intrinsics) -> Raw:
    """A frame's stored depth values, [height,width] uint16."""
    codec = ref.codec if isinstance(ref, ByteRange) else "png"
    width, height = intrinsics.width, intrinsics.height
    if codec == "raw_u16" and len(data) == 2 * width * height:
        return np.frombuffer(data, "<u2").reshape(height, width)
    if codec == "raw_u16":
        raise ScanError(_broken(ref, f"does not hold {width}x{height} readings"))
    if codec == "zlib_u16":
        try:
            return inflate(data, width, height)
        except ValueError as error:
            raise ScanError(_broken(ref, str(error))) from error
    image = _imdecode(data, ref, cv2.IMREAD_UNCHANGED)
    if image.dtype != np.uint16 or image.ndim != 2:
        raise ScanError(_broken(ref, "is not a depth image of one 16-bit channel"))
    _check_size(ref, image, intrinsics)
    return image.astype(np.uint16, copy=False)


def _imdecode(data: bytes, ref: FileRef, flags: int) -> npt.NDArray[Any]:
    """Decode a PNG or JPEG whose header claims a bearable size."""
    header = parse_image_header(data, place(ref))
    if header is None:
        raise ScanError(_broken(ref, "is cut off: its size is missing"))
    if header.width * header.height > MAX_PIXELS:
        raise ScanError(
            Problem(
                "image_too_large",
                place(ref),
                f"claims {header.width}x{header.height} pixels; at most {MAX_PIXELS // 10**6} megapixels are accepted",
                "scale the images down",
            )
        )
    if not has_end(data, header):
        raise ScanError(*map(_problem, cut_off(place(ref)).findings))
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise ScanError(_broken(ref, "cannot be decoded")) from error
    if image is None:
        raise ScanError(_broken(ref, "cannot be decoded"))
    return image


def _check_size(ref: FileRef, image: npt.NDArray[Any], intrinsics: Intrinsics) -> None:
    height, width = image.shape[:2]
    if (width, height) != (intrinsics.width, intrinsics.height):
        raise ScanError(
            Problem(
                "image_size",
                place(ref),
                f"has {width}x{height} pixels, its intrinsics are for {intrinsics.width}x{intrinsics.height}",
                "give the intrinsics of the stored images",
            )
        )


def _broken(ref: FileRef, message: str) -> Problem:
    return Problem("not_an_image", place(ref), message, "replace it by a sound image, or leave the frame out")


# Cameras --------------------------------------------------------------------------------------------------------------


def _camera(intrinsics: Intrinsics, world_to_camera: torch.Tensor) -> Camera:
    K = torch.tensor(
        [[intrinsics.fx, 0, intrinsics.cx], [0, intrinsics.fy, intrinsics.cy], [0, 0, 1]], dtype=torch.float64
    )
    return Camera(K, world_to_camera, intrinsics.width, intrinsics.height)


def _world_to_camera(camera_to_world: Matrix4) -> torch.Tensor:
    """The inverse of a pose, its rotation replaced by the nearest true one (files round to few digits)."""
    pose = torch.tensor(camera_to_world, dtype=torch.float64)
    u, _, vt = torch.linalg.svd(pose[:3, :3])
    rotation = (u @ vt).T
    world_to_camera = torch.eye(4, dtype=torch.float64)
    world_to_camera[:3, :3] = rotation
    world_to_camera[:3, 3] = -rotation @ pose[:3, 3]
    return world_to_camera


def _depth_camera(entry: FrameEntry, intrinsics: Intrinsics, depth_to_color: Matrix4) -> Camera:
    to_depth = _world_to_camera(depth_to_color)
    return _camera(intrinsics, to_depth @ _world_to_camera(entry.camera_to_world))


def _depth_encoding(archive: ScanArchive, manifest: ScanManifest, mesh: Mesh, monitor: Monitor) -> DepthEncoding | None:
    """How the scan's depth is stored, measured on a few frames; None if there is none that can be used."""
    frames = [frame for frame in manifest.frames if frame.depth is not None and frame.depth_intrinsics is not None]
    if not frames:
        return None
    chosen = np.linspace(0, len(frames) - 1, min(len(frames), DEPTH_SAMPLES)).round().astype(int)
    samples = list[tuple[Camera, Raw]]()
    for entry in (frames[index] for index in chosen):
        assert entry.depth is not None
        assert entry.depth_intrinsics is not None
        raw = decode_depth(archive.read(entry.depth, MAX_IMAGE_BYTES), entry.depth, entry.depth_intrinsics)
        samples.append((_depth_camera(entry, entry.depth_intrinsics, manifest.depth_to_color), raw))
    declared = DepthEncoding(f"{manifest.depth_scale:g} units per metre", manifest.depth_scale)
    return measure_depth(mesh, samples, declared, monitor)


def _seeing(views: Sequence[View], mesh: Mesh, monitor: Monitor) -> tuple[View, ...]:
    """The views that see the mesh; the monitor is told of the others."""
    every = max(1, len(mesh.v_pos) // SEEN_VERTICES)
    points = mesh.v_pos[torch.from_numpy(np.unique(mesh.t_pos_idx[:, 0].numpy()))][::every].double()
    kept, blind = list[View](), list[str]()
    for view in views:
        if _sees(view.camera, points, mesh):
            kept.append(view)
        else:
            blind.append(view.name)
    if blind:
        named = ", ".join(blind[:3]) + (f" and {len(blind) - 3} more" if len(blind) > 3 else "")
        monitor.warning(Problem("frame_sees_nothing", named, "does not see the mesh and is left out", "check the pose"))
    return tuple(kept)


def _sees(camera: Camera, points: torch.Tensor, mesh: Mesh) -> bool:
    """Some vertex falls into the image, or, where triangles are larger than it, some pixel sees a face."""
    seen = points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    x, y, z = (seen @ camera.K.T).unbind(1)
    if bool(((z > 0) & (x > 0) & (y > 0) & (x < camera.width * z) & (y < camera.height * z)).any()):
        return True
    width = min(SEEN_WIDTH, camera.width)
    height = max(1, round(camera.height * width / camera.width))
    return bool((rasterize(mesh, scaled_camera(camera, width, height)).face_index >= 0).any())

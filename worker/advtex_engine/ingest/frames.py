"""A scan, decoded: its frames wait until it is known which of them become views.

Each frame is decoded once. What was decoded lies, as it is, in a file: of a long scan, thousands of frames wait for a
mesh to be fused from their depth and for the choice of views, and memory holds none of them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import SpooledTemporaryFile
from types import TracebackType
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from advtex_engine.core.cameras import scaled_camera
from advtex_engine.core.errors import Problem, ScanError, few_of
from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import Camera, DepthFrame, Mesh, Scene, View, evenly_spread
from advtex_engine.ingest.depth import depth_in_color_image
from advtex_engine.ingest.thumbnails import Thumbnail
from advtex_engine.ingest.view_choice import Candidate, choose_views
from advtex_engine.render.rasterize import rasterize
from advtex_engine.render.view_maps import BYTES_PER_PIXEL
from advtex_engine.runtime.threads import in_threads
from advtex_scan.manifest import MeshRefinement, ScanKind, ScanManifest, UpAxis

SPOOL_BYTES = 256 << 20  # frames of a short scan stay in memory
MAX_MEASURED_BYTES = 1 << 30  # of depth as measured, 870 frames of 640x480; a mesh is fused from no more
# Of view maps, which the host holds as a whole also where the device cannot: 3,100 views of 640x480, more than a long
# scan of a room has, 760 of 1296x968, 79 of 12 megapixels.
MAX_MAP_BYTES = 8 << 30
MAX_HELDOUT = 50
# Vertices looked at to see whether a view sees the mesh, before the mesh is rasterized to be sure.
SEEN_VERTICES = 20_000
SEEN_WIDTH = 80


@dataclass(frozen=True)
class Frame:
    """A decoded frame: color [H,W,3] uint8 and mask [H,W] bool at the working size, depth as it was measured.

    thumbnail: what the choice of views goes by; None where nothing is to be chosen. sharpness: the app's own measure.
    """

    name: str
    camera: Camera
    color: Tensor
    mask: Tensor | None = None
    measured: DepthFrame | None = None
    thumbnail: Thumbnail | None = None
    sharpness: float | None = None

    def view(self) -> View:
        """The frame as a view, its depth as the color camera sees it."""
        frame = self.measured
        depth = None if frame is None else depth_in_color_image(frame.readings, frame.camera, self.camera)
        return View(self.name, self.camera, self.color, depth, self.mask)


@dataclass(frozen=True)
class _Stored:
    """Where in the file an array lies."""

    offset: int
    shape: tuple[int, ...]
    dtype: torch.dtype


@dataclass(frozen=True)
class StoredFrame:
    """What memory holds of a frame in a FrameStore."""

    name: str
    camera: Camera
    depth_camera: Camera | None
    thumbnail: Thumbnail | None
    sharpness: float | None
    arrays: Mapping[str, _Stored]


class FrameStore:
    """Decoded frames in a file without a name, in memory while they are few: it is gone with the process.

    For one thread at a time.
    """

    def __init__(self, folder: Path | None = None) -> None:
        """folder: where there is room, 5 MB for a frame of 1296x968; None is the system's folder for such files."""
        self._file = SpooledTemporaryFile(SPOOL_BYTES, dir=None if folder is None else str(folder))  # noqa: SIM115 - closed by __exit__
        self._end = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self._file.close()

    def put(self, frame: Frame) -> StoredFrame:
        """Raises OSError when the disk is full."""
        given = {"color": frame.color, "mask": frame.mask}
        if frame.measured is not None:
            given |= {"depth": frame.measured.depth, "confidence": frame.measured.confidence}
        arrays = {name: self._write(array) for name, array in given.items() if array is not None}
        depth_camera = None if frame.measured is None else frame.measured.camera
        return StoredFrame(frame.name, frame.camera, depth_camera, frame.thumbnail, frame.sharpness, arrays)

    def get(self, frame: StoredFrame, color: Tensor | None = None) -> Frame:
        """color: [H,W,3] uint8, contiguous, that the frame's color is read into."""
        color = self._read(frame.arrays["color"], color)
        mask = self._read(frame.arrays["mask"]) if "mask" in frame.arrays else None
        return Frame(frame.name, frame.camera, color, mask, self.measured(frame), frame.thumbnail, frame.sharpness)

    def measured(self, frame: StoredFrame) -> DepthFrame | None:
        """The frame's depth as it was measured; its color stays in the file."""
        if frame.depth_camera is None:
            return None
        confidence = self._read(frame.arrays["confidence"]) if "confidence" in frame.arrays else None
        return DepthFrame(frame.depth_camera, self._read(frame.arrays["depth"]), confidence)

    def _write(self, array: Tensor) -> _Stored:
        stored = _Stored(self._end, tuple(array.shape), array.dtype)
        self._file.seek(self._end)
        self._end += self._file.write(np.ascontiguousarray(array.numpy()).reshape(-1).view(np.uint8).data)
        return stored

    def _read(self, stored: _Stored, into: Tensor | None = None) -> Tensor:
        array = torch.empty(stored.shape, dtype=stored.dtype) if into is None else into
        assert array.shape == stored.shape and array.dtype == stored.dtype and array.is_contiguous()
        self._file.seek(stored.offset)
        read = self._file.readinto(array.numpy().data)
        assert read == array.nbytes
        return array


@dataclass(frozen=True)
class Capture:
    """A scan's decoded frames, in the order of capture, and its mesh if it brings one.

    size: working size (width, height). mesh: None if it is to be fused from what the frames measured. mesh_path: where
    it came from, for messages.
    mesh_refinement: how the mesh may be moved onto the depth, as the manifest says.
    """

    store: FrameStore
    size: tuple[int, int]
    mesh: Mesh | None
    mesh_path: str
    mesh_refinement: MeshRefinement
    training: tuple[StoredFrame, ...]
    heldout: tuple[StoredFrame, ...]
    kind: ScanKind
    up_axis: UpAxis
    manifest: ScanManifest

    def measured(self, most: int | None = None) -> list[DepthFrame]:
        """Depth of training frames, of no more than `most`: of a long scan every so many: neighbors see the same."""
        measured = [frame for frame in self.training if frame.depth_camera is not None]
        arrays = [frame.arrays[name] for frame in measured for name in ("depth", "confidence") if name in frame.arrays]
        held = sum(math.prod(array.shape) * array.dtype.itemsize for array in arrays)
        every = max(1, -(-held // MAX_MEASURED_BYTES), -(-len(measured) // (most or len(measured) or 1)))
        found = (self.store.measured(frame) for frame in measured[::every])
        return [frame for frame in found if frame is not None]

    def choose(self, mesh: Mesh, max_views: int, monitor: Monitor) -> tuple[Capture, dict[str, Any] | None]:
        """The capture with no more frames than can become views, and the report of the choice.

        A scan within the budget keeps all its frames, and there is no report. Held-out frames are never trained on, and
        MAX_HELDOUT of them tell enough.
        """
        heldout = evenly_spread(self.heldout, MAX_HELDOUT)
        seeing = _seeing(self.training, mesh, monitor)
        budget = view_budget(max_views, *self.size)
        if len(seeing) <= budget:
            return replace(self, training=seeing, heldout=heldout), None
        choice = choose_views(mesh, [_candidate(frame) for frame in seeing], budget)
        reasons = ", ".join(f"{len(names)} {reason}" for reason, names in choice.report["left_out"].items())
        monitor.note(f"{len(choice.kept)} of {len(self.training)} frames become views; left out: {reasons or 'none'}")
        training = tuple(seeing[index] for index in choice.kept)
        return replace(self, training=training, heldout=heldout), choice.report

    def scene(self, mesh: Mesh, monitor: Monitor) -> Scene:
        """The scene with this mesh: frames that do not see it are left out, which the monitor is told."""
        training, heldout = (_seeing(frames, mesh, monitor) for frames in (self.training, self.heldout))
        if not training:
            raise ScanError(
                Problem(
                    "mesh_not_seen",
                    self.mesh_path,
                    "no frame sees the mesh",
                    "bring poses and mesh into one world frame, both in metres",
                )
            )
        return Scene(mesh, self._views(training), self._views(heldout), self.kind, self.up_axis)

    def _views(self, frames: Sequence[StoredFrame]) -> tuple[View, ...]:
        """The frames as views, whose colors and depths lie in one array each: arrays that come and go among those that
        stay would leave holes in memory, half as large as all views."""
        width, height = self.size
        colors = torch.empty((len(frames), height, width, 3), dtype=torch.uint8)
        depths = torch.empty((len(frames), height, width))
        stored = (self.store.get(frame, color) for frame, color in zip(frames, colors, strict=True))
        return tuple(in_threads(_view_with, zip(stored, depths, strict=True)))


def _view_with(given: tuple[Frame, Tensor]) -> View:
    """The frame as a view, its depth, if it has any, copied into the given array [H,W]."""
    frame, depth = given
    view = frame.view()
    return view if view.depth is None else replace(view, depth=depth.copy_(view.depth))


def view_budget(max_views: int, width: int, height: int) -> int:
    """How many views of this size may be used: the host holds their maps as a whole."""
    return max(1, min(max_views, MAX_MAP_BYTES // (BYTES_PER_PIXEL * width * height)))


def _candidate(frame: StoredFrame) -> Candidate:
    assert frame.thumbnail is not None
    return Candidate(frame.name, frame.camera, frame.thumbnail, frame.sharpness)


def _seeing(frames: Sequence[StoredFrame], mesh: Mesh, monitor: Monitor) -> tuple[StoredFrame, ...]:
    """The frames that see the mesh; the monitor is told of the others."""
    every = max(1, len(mesh.v_pos) // SEEN_VERTICES)
    points = mesh.v_pos[torch.from_numpy(np.unique(mesh.t_pos_idx[:, 0].numpy()))][::every].double()
    kept, blind = list[StoredFrame](), list[str]()
    for frame in frames:
        if _sees(frame.camera, points, mesh):
            kept.append(frame)
        else:
            blind.append(frame.name)
    if blind:
        told = "does not see the mesh and is left out"
        monitor.warning(Problem("frame_sees_nothing", few_of(blind), told, "check the pose"))
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

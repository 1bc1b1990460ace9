"""What a scan is, whatever layout it came in.

Frames: a camera pose is `camera_to_world`, 4x4, row-major nested tuples, OpenCV axes (x right, y down, z
forward), metres.
Pixels: the centre of the first pixel is (0.5, 0.5), the image corner (0, 0); layouts whose files count the first
pixel's centre as (0, 0) add 0.5 to the principal point when they read it.
Both cameras are modelled: `FrameEntry.camera_to_world` is the color camera's, and the depth camera's is
`camera_to_world @ depth_to_color`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Matrix4 = tuple[
    tuple[float, float, float, float],
    tuple[float, float, float, float],
    tuple[float, float, float, float],
    tuple[float, float, float, float],
]
IDENTITY: Matrix4 = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))

UpAxis = Literal["+x", "-x", "+y", "-y", "+z", "-z"]
ScanKind = Literal["object", "scene"]


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """A pinhole camera for an image of width x height: focal lengths and principal point in pixels."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    def __post_init__(self) -> None:
        if not (self.fx > 0 and self.fy > 0 and self.width > 0 and self.height > 0):
            raise ValueError(f"focal lengths and sizes must be positive: {self}")

    def scaled(self, width: int, height: int) -> Intrinsics:
        """The same camera with its image resampled to width x height pixels."""
        sx, sy = width / self.width, height / self.height
        return Intrinsics(self.fx * sx, self.fy * sy, self.cx * sx, self.cy * sy, width, height)


@dataclass(frozen=True, slots=True)
class ByteRange:
    """A member of the scan that lies inside a larger file (a `.sens` stream): `length` bytes from `offset`.

    `codec` names what the bytes are: `jpeg`, `png`, `raw_rgb8`, `raw_u16` or `zlib_u16`.
    """

    path: str
    offset: int
    length: int
    codec: Literal["jpeg", "png", "raw_rgb8", "raw_u16", "zlib_u16"]


FileRef = str | ByteRange


@dataclass(frozen=True, slots=True)
class FrameEntry:
    """One captured image with its pose. `name` is unique and orders the frames."""

    name: str
    color: FileRef
    depth: FileRef | None
    camera_to_world: Matrix4
    color_intrinsics: Intrinsics
    depth_intrinsics: Intrinsics | None = None


@dataclass(frozen=True, slots=True)
class MeshEntry:
    """The scan's mesh in world coordinates (metres): a path inside the scan, `.ply`, `.obj`, `.glb` or `.gltf`."""

    path: str


@dataclass(frozen=True, slots=True)
class ScanManifest:
    """A scan that can be textured.

    depth_scale: stored depth units per metre (1000 for millimetres); a stored 0 or 65535 means no reading.
    depth_to_color: rigid transform from depth-camera to color-camera coordinates, identity when registered.
    up_axis: the world direction that points up, used on export.
    """

    layout: str
    frames: tuple[FrameEntry, ...]
    mesh: MeshEntry | None
    kind: ScanKind = "scene"
    up_axis: UpAxis = "+z"
    depth_scale: float = 1000.0
    depth_to_color: Matrix4 = IDENTITY

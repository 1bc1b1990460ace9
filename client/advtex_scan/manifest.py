"""What a scan is, whatever layout it came in.

Frames: a camera pose is `camera_to_world`, 4x4, row-major nested tuples, OpenCV axes (x right, y down, z
forward), metres.
Pixels: the centre of the first pixel is (0.5, 0.5), the image corner (0, 0); layouts whose files count the first
pixel's centre as (0, 0) add 0.5 to the principal point when they read it.
Both cameras are modelled: `FrameEntry.camera_to_world` is the color camera's, and the depth camera's is
`camera_to_world @ depth_to_color`.
"""

from __future__ import annotations

import math
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
MeshRefinement = Literal["none", "rigid", "scaled"]


@dataclass(frozen=True, slots=True)
class Distortion:
    """How a lens bends the image of a pinhole, as OpenCV counts it: radial k1, k2, k3 and tangential p1, p2."""

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """A pinhole camera for an image of width x height: focal lengths and principal point in pixels.

    distortion: of the image as it is stored, which is undistorted once, on ingest; None for none.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: Distortion | None = None

    def __post_init__(self) -> None:
        if not (self.fx > 0 and self.fy > 0 and self.width > 0 and self.height > 0):
            raise ValueError(f"focal lengths and sizes must be positive: {self}")

    def scaled(self, width: int, height: int) -> Intrinsics:
        """Return the same camera with its image resampled to width x height pixels."""
        sx, sy = width / self.width, height / self.height
        return Intrinsics(self.fx * sx, self.fy * sy, self.cx * sx, self.cy * sy, width, height, self.distortion)


Codec = Literal["jpeg", "png", "raw_rgb8", "raw_u16", "zlib_u16", "lzfse_f32", "lzfse_u8", "npy"]


@dataclass(frozen=True, slots=True)
class ByteRange:
    """`length` bytes from `offset` of a file, whose name does not say what they are.

    A member of a larger file (a `.sens` stream), or a whole file that holds plain numbers, row by row. `codec` names
    what the bytes are: an image (`jpeg`, `png`), or numbers (the others; f32 are metres, NaN or 0 for no reading).
    """

    path: str
    offset: int
    length: int
    codec: Codec


@dataclass(frozen=True, slots=True)
class VideoFrame:
    """One picture of a video: its number in the order of presentation, from 0."""

    path: str
    index: int


FileRef = str | ByteRange


@dataclass(frozen=True, slots=True)
class FrameEntry:
    """One captured image with its pose. `name` is unique and orders the frames.

    confidence: how far each pixel of the depth image is to be trusted, of its size and camera; see `confidence_max`.
    mask: 8-bit image of the color image's size; 0 where it must not be used.
    border: pixels along each edge of the color image that hold no picture.
    sharpness: the app's own measure, higher is sharper; it compares frames of one scan only.
    """

    name: str
    color: FileRef | VideoFrame
    depth: FileRef | None
    camera_to_world: Matrix4
    color_intrinsics: Intrinsics
    depth_intrinsics: Intrinsics | None = None
    confidence: FileRef | None = None
    mask: FileRef | None = None
    border: int = 0
    sharpness: float | None = None


@dataclass(frozen=True, slots=True)
class MeshEntry:
    """The scan's mesh: a path inside the scan, `.ply`, `.obj`, `.glb` or `.gltf`.

    mesh_to_world: rigid transform from the file's coordinates to the world's, both metres.
    refinement: whether that is a rough placement which the depth images may mend: not at all, by a rigid motion, or
        by one with a change of scale.
    """

    path: str
    mesh_to_world: Matrix4 = IDENTITY
    refinement: MeshRefinement = "none"


@dataclass(frozen=True, slots=True)
class ScanManifest:
    """A scan that can be textured.

    mesh: None if it is to be fused from the depth images.
    depth_scale: stored depth units per metre (1000 for millimetres) of whole numbers; a stored 0 or 65535 means no
        reading. Depth that is stored as floats is in metres.
    depth_rotated: whole numbers are stored with their bits rotated left by 3 places, as SUN3D does.
    depth_farthest: metres; readings beyond are guesses of the device and count as none.
    depth_to_color: rigid transform from depth-camera to color-camera coordinates, identity when registered.
    confidence_max: the value in confidence images that means full trust; 0 means none.
    up_axis: the world direction that points up, used on export.
    """

    layout: str
    frames: tuple[FrameEntry, ...]
    mesh: MeshEntry | None
    kind: ScanKind = "scene"
    up_axis: UpAxis = "+z"
    depth_scale: float = 1000.0
    depth_to_color: Matrix4 = IDENTITY
    confidence_max: int = 255
    depth_rotated: bool = False
    depth_farthest: float = math.inf

"""The frozen data that the engine's stages hand to each other.

Coordinates: world in metres; camera axes OpenCV (x right, y down, z forward); pixels with the first centre at
(0.5, 0.5); uv in [0, 1] with the origin at the texture's first row and first column (top left of the PNG), so texel
(row i, column j) has its centre at u = (j + 0.5) / width, v = (i + 0.5) / height. Exporters flip v where a format asks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True)
class Camera:
    """A pinhole camera: K [3,3] float64 in pixels, world_to_camera [4,4] float64, image size in pixels."""

    K: Tensor
    world_to_camera: Tensor
    width: int
    height: int

    def __post_init__(self) -> None:
        assert self.K.shape == (3, 3) and self.world_to_camera.shape == (4, 4)
        assert self.width > 0 and self.height > 0


@dataclass(frozen=True)
class DepthFrame:
    """What a depth camera measured: depth [H,W] float32 metres along z, 0 = no reading.

    confidence: [H,W] float32 in [0, 1], 0 = not to be used; None where the device tells none.
    """

    camera: Camera
    depth: Tensor
    confidence: Tensor | None = None

    def __post_init__(self) -> None:
        assert self.depth.shape == (self.camera.height, self.camera.width)
        assert self.confidence is None or self.confidence.shape == self.depth.shape

    @property
    def readings(self) -> Tensor:
        """The depth [H,W] that may be used: 0 also where there is no confidence in it."""
        return self.depth if self.confidence is None else torch.where(self.confidence > 0, self.depth, 0.0)


@dataclass(frozen=True)
class View:
    """A frame that the engine uses: color [H,W,3] uint8 sRGB at the working size, its camera, and device depth.

    depth: [H,W] float32 metres along z, seen by the color camera, 0 = no reading; None when the scan has none.
    mask: [H,W] bool, False where the view must not be used; None when all of it may. Readers of scans fill such pixels
    with the colors around them, so that no filter brings in what they showed.
    """

    name: str
    camera: Camera
    color: Tensor
    depth: Tensor | None = None
    mask: Tensor | None = None

    def __post_init__(self) -> None:
        assert self.color.shape == (self.camera.height, self.camera.width, 3) and self.color.dtype == torch.uint8
        assert self.depth is None or self.depth.shape == (self.camera.height, self.camera.width)
        assert self.mask is None or self.mask.shape == (self.camera.height, self.camera.width)


@dataclass(frozen=True)
class Mesh:
    """Triangles in world coordinates: v_pos [V,3] float32 metres, t_pos_idx [T,3] int64; uv optional.

    v_uv: [U,2] float32, t_uv_idx: [T,3] int64 (indices into v_uv); both or neither.
    """

    v_pos: Tensor
    t_pos_idx: Tensor
    v_uv: Tensor | None = None
    t_uv_idx: Tensor | None = None

    def __post_init__(self) -> None:
        assert self.v_pos.ndim == 2 and self.v_pos.shape[1] == 3
        assert self.t_pos_idx.ndim == 2 and self.t_pos_idx.shape[1] == 3
        assert (self.v_uv is None) == (self.t_uv_idx is None)
        assert self.t_uv_idx is None or self.t_uv_idx.shape == self.t_pos_idx.shape

    def to(self, device: torch.device) -> Mesh:
        """The mesh on another device."""
        uv = None if self.v_uv is None or self.t_uv_idx is None else (self.v_uv.to(device), self.t_uv_idx.to(device))
        return Mesh(self.v_pos.to(device), self.t_pos_idx.to(device), *(uv or ()))


def face_areas(mesh: Mesh) -> Tensor:
    """[T] float64, square metres."""
    a, b, c = mesh.v_pos.double()[mesh.t_pos_idx].unbind(1)
    area: Tensor = torch.linalg.vector_norm(torch.linalg.cross(b - a, c - a), dim=1) / 2
    return area


@dataclass(frozen=True)
class Atlas:
    """A mesh with an injective parameterization and the texture's size in texels.

    mesh.v_uv and mesh.t_uv_idx are set; `source` says where the uv came from: "xatlas" or "scan". The texture is a grid
    of pages x pages equal pages, each exported as an image of its own: every face lies within one of them.
    """

    mesh: Mesh
    width: int
    height: int
    source: str
    charts: int
    pages: int = 1

    def __post_init__(self) -> None:
        assert self.mesh.v_uv is not None


@dataclass(frozen=True)
class Fragments:
    """What a camera sees of a mesh, per pixel centre.

    face_index:  [H,W] int32, -1 = nothing hit (pad).
    barycentric: [H,W,3] float32, perspective-correct weights of the triangle's corners in t_pos_idx order; 0 where pad.
    depth:       [H,W] float32, metres along the camera's z axis; 0 where pad.
    """

    face_index: Tensor
    barycentric: Tensor
    depth: Tensor


@dataclass(frozen=True)
class Scene:
    """All that texturing needs: a mesh, the training views, the held-out views and what export must honour."""

    mesh: Mesh
    views: tuple[View, ...]
    heldout: tuple[View, ...] = ()
    kind: str = "scene"
    up_axis: str = "+z"
    notes: tuple[str, ...] = field(default=())


T = TypeVar("T")


def evenly_spread(views: Sequence[T], count: int) -> tuple[T, ...]:
    """At most `count` of the views or frames, from all over the capture."""
    positions = np.linspace(0, len(views) - 1, min(count, len(views)))
    return tuple(views[round(position)] for position in positions)


QUARTER = 0.5**0.5
TO_Y_UP: dict[str, tuple[float, float, float, float]] = {
    "+y": (0.0, 0.0, 0.0, 1.0),
    "-y": (1.0, 0.0, 0.0, 0.0),
    "+z": (-QUARTER, 0.0, 0.0, QUARTER),
    "-z": (QUARTER, 0.0, 0.0, QUARTER),
    "+x": (0.0, 0.0, QUARTER, QUARTER),
    "-x": (0.0, 0.0, -QUARTER, QUARTER),
}
"""Rotation (x, y, z, w) that turns each axis to +y."""

"""The atlas as files have it: an image and its faces for each page, and a vertex for each pair of position and uv."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from advtex_engine.core.scene import Atlas, Mesh

Array = NDArray[Any]


@dataclass(frozen=True)
class Page:
    """An image [h,w,3] and the faces that it covers. mesh: all vertices, and all uv as they lie on their own page.

    normal_map: [h',w',3] uint8 of the same part of the surface, if there is one.
    """

    mesh: Mesh
    image: Tensor
    suffix: str
    normal_map: Tensor | None = None

    @property
    def material(self) -> str:
        return f"textured{self.suffix}"


def split_pages(atlas: Atlas, texture: Tensor, normal_map: Tensor | None = None) -> list[Page]:
    """normal_map: over the whole atlas as the texture is, of any size."""
    mesh, count = on_cpu(atlas.mesh), atlas.pages
    assert mesh.v_uv is not None
    assert mesh.t_uv_idx is not None
    assert atlas.width % count == 0
    assert atlas.height % count == 0
    cell = (mesh.v_uv * count).floor().clamp(0, count - 1)  # column and row
    v_uv = mesh.v_uv * count - cell
    page_of_uv = (cell[:, 1] * count + cell[:, 0]).long()
    face_page = page_of_uv[mesh.t_uv_idx]
    assert bool((face_page == face_page[:, :1]).all()), "a face crosses the border of its page"
    pages = list[Page]()
    for number in torch.unique(face_page[:, 0]).tolist():
        row, column = divmod(number, count)
        image = _cell(texture, count, row, column)
        normals = None if normal_map is None else _cell(normal_map, count, row, column)
        mine = face_page[:, 0] == number
        part = Mesh(mesh.v_pos, mesh.t_pos_idx[mine], v_uv, mesh.t_uv_idx[mine])
        pages.append(Page(part, image, f"_{len(pages) + 1}" if pages else "", normals))
    return pages


def _cell(image: Tensor, count: int, row: int, column: int) -> Tensor:
    """One of count x count equal parts of an image [h,w,3]."""
    height, width = image.shape[0] // count, image.shape[1] // count
    return image[row * height : (row + 1) * height, column * width : (column + 1) * width]


def on_cpu(mesh: Mesh) -> Mesh:
    assert mesh.v_uv is not None
    assert mesh.t_uv_idx is not None
    return Mesh(mesh.v_pos.cpu(), mesh.t_pos_idx.cpu(), mesh.v_uv.cpu(), mesh.t_uv_idx.cpu())


def split_at_seams(mesh: Mesh, normals: Tensor) -> tuple[Array, Array, Array, Array]:
    """Vertices that have one position and one uv each: glTF knows no separate indices.

    Returns indices [3T] (uint16 where they fit: 65535 is reserved), positions [N,3], normals [N,3], uv [N,2] float32.
    """
    assert mesh.v_uv is not None
    assert mesh.t_uv_idx is not None
    uv_count = len(mesh.v_uv)
    key = (mesh.t_pos_idx * uv_count + mesh.t_uv_idx).flatten()
    pairs, index = torch.unique(key, return_inverse=True)
    position, corner = pairs // uv_count, pairs % uv_count
    dtype = np.uint16 if len(pairs) < 65535 else np.uint32
    return (
        index.numpy().astype(dtype),
        mesh.v_pos[position].numpy().astype("<f4"),
        normals[position].numpy().astype("<f4"),
        mesh.v_uv[corner].numpy().astype("<f4"),
    )

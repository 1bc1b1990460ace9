"""The files of a result read back by programs that others wrote: trimesh, and usd-core for USDZ."""

from __future__ import annotations

import io
import json
import math
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from PIL import Image
from pxr import Usd, UsdGeom, UsdShade
from torch import Tensor

from advtex_engine.core.scene import TO_Y_UP, Atlas, Mesh

Part = tuple[NDArray[Any], NDArray[Any], NDArray[Any], Image.Image]
"""Positions [V,3], faces [T,3], uv [V,2] whose v counts from the image's bottom row, and the image."""


class Unread(Exception):
    """No reader here knows the file; the message says why."""


def read_model(path: Path, up_axis: str) -> tuple[Atlas, Tensor]:
    """The model in the scan's world, and its texture [H,W,3] uint8 sRGB. Raises Unread.

    up_axis: of the scan; all files but the OBJ are +Y up. Several images are laid out in a grid.
    """
    readers = {".obj": _with_trimesh, ".glb": _with_trimesh, ".usdz": _with_usd, ".3tz": _leaves}
    if path.suffix not in readers:
        raise Unread(f"no reader of {path.suffix} files")
    parts = readers[path.suffix](path)
    if path.suffix != ".obj":
        x, y, z, w = TO_Y_UP[up_axis]
        turn = trimesh.transformations.quaternion_matrix([w, x, y, z])[:3, :3]
        parts = [(position @ turn, faces, uv, image) for position, faces, uv, image in parts]
    return _joined(parts)


def _leaves(path: Path) -> list[Part]:
    """The finest tiles of a tileset of GLB tiles without transforms, as they lie in the GLBs."""
    with zipfile.ZipFile(path) as archive:
        waiting, parts = [json.loads(archive.read("tileset.json"))["root"]], list[Part]()
        while waiting:
            tile = waiting.pop()
            waiting += tile.get("children", [])
            if "transform" in tile:
                raise Unread("its tiles are moved")
            if "children" not in tile:
                parts += _with_trimesh(io.BytesIO(archive.read(tile["content"]["uri"])))
    return parts


def _with_trimesh(file: Path | BinaryIO) -> list[Part]:
    try:
        kind = None if isinstance(file, Path) else "glb"
        scene = trimesh.load_scene(file, file_type=kind, process=False)
    except Exception as error:  # whatever the readers of formats and images raise
        raise Unread(f"trimesh: {error}") from error
    parts = []
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph[node]
        mesh = scene.geometry[name]
        material = mesh.visual.material
        image = material.baseColorTexture if hasattr(material, "baseColorTexture") else material.image
        if image is None:
            raise Unread("trimesh finds no image")
        parts.append((trimesh.transform_points(mesh.vertices, matrix), mesh.faces, mesh.visual.uv, image))
    return parts


def _with_usd(path: Path) -> list[Part]:
    parts = []
    stage = Usd.Stage.Open(str(path))
    for prim in stage.Traverse():
        if not prim.IsA(UsdGeom.Mesh):
            continue
        mesh = UsdGeom.Mesh(prim)
        matrix = np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(Usd.TimeCode.Default()))
        position = np.array(mesh.GetPointsAttr().Get()) @ matrix[:3, :3] + matrix[3, :3]
        faces = np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
        uv = np.array(UsdGeom.PrimvarsAPI(prim).GetPrimvar("st").Get())
        material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
        surface, _, _ = material.ComputeSurfaceSource()
        source = UsdShade.Shader(surface.GetInput("diffuseColor").GetConnectedSources()[0][0].source)
        with zipfile.ZipFile(path) as archive:
            data = archive.read(source.GetInput("file").Get().path.removeprefix("./"))
        parts.append((position, faces, uv, Image.open(io.BytesIO(data))))
    return parts


def _joined(parts: Sequence[Part]) -> tuple[Atlas, Tensor]:
    columns = math.ceil(math.sqrt(len(parts)))
    width, height = (max(part[3].size[side] for part in parts) for side in (0, 1))
    texture = np.zeros((height * columns, width * columns, 3), np.uint8)
    positions, faces, corners, first = list[Any](), list[Any](), list[Any](), 0
    for number, (position, index, uv, image) in enumerate(parts):
        row, column = divmod(number, columns)
        pixels = np.asarray(image.convert("RGB"))
        top, left = row * height, column * width
        texture[top : top + image.height, left : left + image.width] = pixels
        place = np.stack((uv[:, 0], 1 - uv[:, 1]), 1) * image.size + [left, top]
        corners.append(place / [width * columns, height * columns])
        positions.append(position)
        faces.append(index + first)
        first += len(position)
    joined = torch.from_numpy(np.concatenate(faces).astype(np.int64))
    v_pos, v_uv = (torch.from_numpy(np.concatenate(some).astype(np.float32)) for some in (positions, corners))
    atlas = Atlas(Mesh(v_pos, joined, v_uv, joined), width * columns, height * columns, "scan", 0, 1)
    return atlas, torch.from_numpy(texture)

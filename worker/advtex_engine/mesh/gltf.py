"""glTF 2.0 and GLB -> Polygons: all triangles of the default scene, moved by their nodes.

glTF counts v from the image's top row, as scene.py does.
"""

from __future__ import annotations

import base64
import json
import math
import posixpath
import struct
from collections.abc import Callable
from dataclasses import replace
from typing import Any
from urllib.parse import unquote

import numpy as np
import numpy.typing as npt

from advtex_engine.mesh.polygons import MAX_FACES, Floats, Integers, MeshFormatError, Polygons

MAGIC, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942
COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
COLUMNS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
TRIANGLES, STRIP, FAN = 4, 5, 6
# A node may be drawn many times over by its parents; what a scene of this size draws is bounded.
MAX_NODES = 20_000
COMPRESSED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression")

Fetch = Callable[[str], bytes]


def read_gltf(data: bytes, path: str, fetch: Fetch) -> Polygons:
    """A .glb or .gltf file. `path`: its place in the scan; `fetch` reads the files beside it that it names.

    uv are those of TEXCOORD_0, kept if every triangle has them. Raises MeshFormatError.
    """
    try:
        document, binary = _split_glb(data) if data[:4] == b"glTF" else (json.loads(data), None)
        return _Document(document, binary, path, fetch).polygons()
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError, RecursionError, struct.error) as error:
        if isinstance(error, MeshFormatError):
            raise
        raise MeshFormatError(f"is no glTF 2.0 that can be read ({type(error).__name__}: {error})") from error


def _split_glb(data: bytes) -> tuple[Any, bytes | None]:
    magic, version, _ = struct.unpack_from("<III", data)
    if magic != MAGIC or version != 2:
        raise MeshFormatError("is no GLB of version 2")
    chunks, offset = dict[int, bytes](), 12
    while offset + 8 <= len(data):
        length, kind = struct.unpack_from("<II", data, offset)
        if offset + 8 + length > len(data):
            raise MeshFormatError("is shorter than its chunks say; the file is incomplete")
        chunks.setdefault(kind, data[offset + 8 : offset + 8 + length])
        offset += 8 + length
    return json.loads(chunks[JSON_CHUNK]), chunks.get(BINARY_CHUNK)


class _Document:
    def __init__(self, document: dict[str, Any], binary: bytes | None, path: str, fetch: Fetch) -> None:
        self._document, self._binary, self._folder, self._fetch = document, binary, posixpath.dirname(path), fetch
        self._buffers: dict[int, bytes] = {}
        compressed = [name for name in COMPRESSED if name in document.get("extensionsRequired", [])]
        if compressed:
            raise MeshFormatError(f"is compressed ({compressed[0]}), which is not supported")

    def polygons(self) -> Polygons:
        positions, faces, uvs = list[Floats](), list[Integers](), list[Floats | None]()
        materials, count = list[Integers](), 0
        for mesh, transform in self._instances():
            for primitive in self._document["meshes"][mesh]["primitives"]:
                if primitive.get("mode", TRIANGLES) not in (TRIANGLES, STRIP, FAN):
                    continue
                attributes = primitive["attributes"]
                position = self._accessor(attributes["POSITION"], 3) @ transform[:3, :3].T + transform[:3, 3]
                triangles = self._triangles(primitive, len(position))
                if np.linalg.det(transform[:3, :3]) < 0:
                    triangles = triangles[:, ::-1]
                if len(triangles) and triangles.max() >= len(position):
                    raise MeshFormatError(f"has face index {triangles.max()} out of range for {len(position)} vertices")
                uvs.append(self._accessor(attributes["TEXCOORD_0"], 2) if "TEXCOORD_0" in attributes else None)
                faces.append(triangles + count)
                materials.append(np.full(len(triangles), int(primitive.get("material", -1)) + 1))
                positions.append(position)
                count += len(position)
                if sum(map(len, faces)) > MAX_FACES:
                    raise MeshFormatError(f"has more than {MAX_FACES:,} faces")
        if not faces:
            raise MeshFormatError("has no faces")
        corners = np.concatenate(faces).reshape(-1)
        sizes = np.full(len(corners) // 3, 3)
        names = ("", *map(str, range(len(self._document.get("materials", [])))))
        found = Polygons(np.concatenate(positions), corners, sizes, material=np.concatenate(materials), materials=names)
        uv = [each for each in uvs if each is not None]
        if len(uv) < len(uvs) or [len(each) for each in uv] != [len(each) for each in positions]:
            return found
        return replace(found, uv=np.concatenate(uv), uv_corners=corners)

    def _instances(self) -> list[tuple[int, Floats]]:
        """(mesh, mesh-to-world transform) of every mesh node of the default scene, depth first."""
        nodes = self._document.get("nodes", [])
        if not nodes:
            return [(mesh, np.eye(4)) for mesh in range(len(self._document.get("meshes", [])))]
        scenes = self._document.get("scenes")
        if scenes:
            roots = scenes[self._document.get("scene", 0)].get("nodes", [])
        else:
            children = {child for node in nodes for child in node.get("children", [])}
            roots = [index for index in range(len(nodes)) if index not in children]
        found, visited = list[tuple[int, Floats]](), 0
        stack = [(index, np.eye(4)) for index in reversed(roots)]
        while stack:
            index, parent = stack.pop()
            visited += 1
            if visited > MAX_NODES:
                raise MeshFormatError(f"has more than {MAX_NODES:,} nodes, or nodes that contain themselves")
            transform = parent @ _local_transform(nodes[index])
            if "mesh" in nodes[index]:
                found.append((nodes[index]["mesh"], transform))
            stack += [(child, transform) for child in reversed(nodes[index].get("children", []))]
        return found

    def _triangles(self, primitive: dict[str, Any], vertices: int) -> Integers:
        """[T,3]"""
        mode = primitive.get("mode", TRIANGLES)
        if "indices" in primitive:
            flat = self._accessor(primitive["indices"], 1)[:, 0].astype(np.int64)
        else:
            flat = np.arange(vertices)
        if mode == TRIANGLES:
            return flat[: len(flat) // 3 * 3].reshape(-1, 3)
        step = np.arange(max(len(flat) - 2, 0))
        if mode == FAN:
            return flat[np.stack([np.zeros_like(step), step + 1, step + 2], axis=1)]
        odd = step % 2  # every other triangle of a strip runs the other way round
        return flat[np.stack([step, step + 1 + odd, step + 2 - odd], axis=1)]

    def _accessor(self, index: int, columns: int) -> Floats:
        """[count,columns] float64, integers scaled to [0, 1] or [-1, 1] if they are normalized."""
        accessor = self._document["accessors"][index]
        if "sparse" in accessor or "bufferView" not in accessor:
            raise MeshFormatError("stores sparse or compressed data, which is not supported")
        if COLUMNS[accessor["type"]] != columns:
            raise MeshFormatError(f"stores {accessor['type']} where {columns} columns are needed")
        view = self._document["bufferViews"][accessor["bufferView"]]
        dtype = np.dtype(COMPONENTS[accessor["componentType"]])
        count, row = int(accessor["count"]), columns * dtype.itemsize
        stride = int(view.get("byteStride", row))
        first, length = int(view.get("byteOffset", 0)), int(view["byteLength"])
        start = int(accessor.get("byteOffset", 0))
        buffer = self._buffer(view["buffer"])
        if min(first, start, count, length) < 0 or stride < row or first + length > len(buffer):
            raise MeshFormatError("refers to bytes outside of its buffers; the file is incomplete")
        if count and start + (count - 1) * stride + row > length:
            raise MeshFormatError("has an accessor that is longer than its buffer view")
        values = np.ndarray((count, columns), dtype, buffer, first + start, (stride, dtype.itemsize))
        return _normalized(values) if accessor.get("normalized", False) else values.astype(np.float64)

    def _buffer(self, index: int) -> bytes:
        if index not in self._buffers:
            self._buffers[index] = self._load_buffer(self._document["buffers"][index].get("uri"), index)
        return self._buffers[index]

    def _load_buffer(self, uri: str | None, index: int) -> bytes:
        if uri is None:
            if index != 0 or self._binary is None:
                raise MeshFormatError("refers to a binary chunk that is not there")
            return self._binary
        if uri.startswith("data:"):
            return base64.b64decode(uri.partition(",")[2], validate=True)
        return self._fetch(posixpath.normpath(posixpath.join(self._folder, unquote(uri))))


def _normalized(values: npt.NDArray[Any]) -> Floats:
    if values.dtype.kind == "f":
        return values.astype(np.float64)
    scaled: Floats = np.maximum(values / np.iinfo(values.dtype).max, -1.0)
    return scaled


def _local_transform(node: dict[str, Any]) -> Floats:
    """[4,4]: `matrix` (column-major), or translation, rotation (x y z w) and scale."""
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    x, y, z, w = np.array(node.get("rotation", (0, 0, 0, 1)), dtype=np.float64) / math.hypot(
        *node.get("rotation", (0, 0, 0, 1))
    )
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    transform = np.eye(4)
    transform[:3, :3] = rotation * np.array(node.get("scale", (1, 1, 1)), dtype=np.float64)
    transform[:3, 3] = node.get("translation", (0, 0, 0))
    return transform

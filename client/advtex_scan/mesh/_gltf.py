"""glTF 2.0, `.glb` or `.gltf` with embedded or neighboring buffers: the triangles of the default scene.

Strips and fans become triangles, points and lines are passed over, quantized positions (KHR_mesh_quantization) are
read. Each node that draws a mesh gives parts of its own, with the transform to the world as the file places it.
"""

from __future__ import annotations

import json
import math
import struct
from array import array
from collections.abc import Iterator
from typing import Any

from advtex_scan.errors import MeshError
from advtex_scan.manifest import IDENTITY, Matrix4
from advtex_scan.matrices import from_quaternion, matrix4
from advtex_scan.mesh._arithmetic import Arithmetic
from advtex_scan.mesh._gltf_buffers import Buffers, item
from advtex_scan.mesh._part import DAMAGED, MeshPart, MeshSource, broken, check_counts

MAX_JSON = 16 << 20  # bytes; parsed, it takes some thirty times as much
MAX_NODES = 100_000  # also of primitives drawn; both are counted each time that they are drawn
HEADER, CHUNK = struct.Struct("<4s2I"), struct.Struct("<2I")
JSON_CHUNK, BINARY_CHUNK = 0x4E4F534A, 0x004E4942
TRIANGLES, STRIP, FAN = 4, 5, 6
COMPRESSED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression")
Json = dict[str, Any]


def read_gltf(source: MeshSource, arithmetic: Arithmetic) -> tuple[list[MeshPart], tuple[str, ...]]:
    """The parts of a `.glb` or `.gltf`, and the other files that it refers to. Raises MeshError."""
    path = source.path
    try:
        document, binary = open_gltf(source)
        _refuse_compression(document, path)
        buffers = Buffers(document, binary, source)
        return list(_parts(document, buffers, arithmetic, path)), tuple(buffers.files)
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, struct.error) as error:
        # A file of this kind is a graph of indices; whatever does not resolve ends here.
        raise MeshError(broken(path, f"is damaged: its parts do not fit together ({error})"[:200])) from error
    except RecursionError as error:
        raise MeshError(broken(path, "is nested too deeply")) from error


def open_gltf(source: MeshSource) -> tuple[Json, bytes | None]:
    """The document, and the binary part of a GLB that has one. Raises MeshError, and ValueError for what is no JSON."""
    head = source.stream.read(HEADER.size + CHUNK.size)
    if head[:4] != b"glTF" and not source.path.lower().endswith(".glb"):
        if source.size > MAX_JSON:
            message = f"holds more than {MAX_JSON} bytes of JSON"
            raise MeshError(broken(source.path, message, "export it as GLB", "mesh_too_large"))
        return json.loads(head + source.stream.read(source.size)), None
    if len(head) < HEADER.size + CHUNK.size:
        raise MeshError(broken(source.path, "is cut off", DAMAGED, "mesh_truncated"))
    magic, version, length = HEADER.unpack_from(head)
    if magic != b"glTF" or version != 2:
        raise MeshError(broken(source.path, "is no GLB of version 2"))
    if length > source.size:
        message = f"claims {length} bytes, but holds {source.size}"
        raise MeshError(broken(source.path, message, DAMAGED, "mesh_truncated"))
    json_length, kind = CHUNK.unpack_from(head, HEADER.size)
    if kind != JSON_CHUNK or json_length > min(MAX_JSON, length - len(head)):
        raise MeshError(broken(source.path, "its JSON part is missing, cut off or too large"))
    document = json.loads(source.stream.read(json_length))
    left = length - len(head) - json_length
    if left < CHUNK.size:
        return document, None
    binary_length, kind = CHUNK.unpack(source.stream.read(CHUNK.size))
    if kind != BINARY_CHUNK:
        return document, None
    if binary_length > left - CHUNK.size:
        raise MeshError(broken(source.path, "its binary part is longer than the file", DAMAGED, "mesh_truncated"))
    return document, source.stream.read(binary_length)


def _refuse_compression(document: Json, path: str) -> None:
    required = [str(name) for name in document.get("extensionsRequired", [])]
    found = [name for name in COMPRESSED if name in required]
    if found:
        message = f"is compressed with {found[0]}, which is not read"
        remedy = "export it again without compression, or as PLY"
        raise MeshError(broken(path, message, remedy, "mesh_compressed"))


def _parts(document: Json, buffers: Buffers, arithmetic: Arithmetic, path: str) -> Iterator[MeshPart]:
    drawn = vertices = faces = 0
    for mesh, transform in _instances(document, arithmetic):
        for primitive in item(document, "meshes", mesh).get("primitives", []):
            drawn += 1
            if drawn > MAX_NODES:
                raise ValueError(f"more than {MAX_NODES} primitives")
            if primitive.get("mode", TRIANGLES) in (TRIANGLES, STRIP, FAN):
                part = _part(buffers, primitive, transform)
                vertices += len(part.positions) // 3
                faces += len(part.triangles) // 3
                check_counts(path, vertices, faces)
                yield part


def _instances(document: Json, arithmetic: Arithmetic) -> Iterator[tuple[int, Any]]:
    """Index and transform of each mesh that the default scene draws, depth first."""
    nodes = document.get("nodes", [])
    if not nodes:
        yield from ((mesh, IDENTITY) for mesh in range(len(document.get("meshes", []))))
        return
    if document.get("scenes"):
        roots = item(document, "scenes", document.get("scene", 0)).get("nodes", [])
    else:
        children = {child for node in nodes for child in node.get("children", [])}
        roots = [index for index in range(len(nodes)) if index not in children]
    waiting = [(root, IDENTITY) for root in reversed(roots)]
    visited = 0
    while waiting:
        index, parent = waiting.pop()
        visited += 1
        node = item(document, "nodes", index)
        children = node.get("children", [])
        if visited + len(waiting) + len(children) > MAX_NODES:
            raise ValueError(f"more than {MAX_NODES} nodes, or nodes that contain themselves")
        transform = arithmetic.compose(parent, _local(node))
        if node.get("mesh") is not None:
            yield node["mesh"], transform
        waiting.extend((child, transform) for child in reversed(children))


def _local(node: Json) -> Matrix4:
    """A node's transform: `matrix` (column by column), or translation, rotation (x, y, z, w; scaled to 1) and scale."""
    if "matrix" in node:
        columns = [float(value) for value in node["matrix"]]
        return matrix4([columns[4 * column + row] for row in range(4) for column in range(4)])
    rotation = [float(value) for value in node.get("rotation", (0, 0, 0, 1))]
    length = math.hypot(*rotation)
    x, y, z, w = (value / length for value in rotation)
    scale = [float(value) for value in node.get("scale", (1, 1, 1))]
    shift = [float(value) for value in node.get("translation", (0, 0, 0))]
    rows = from_quaternion(x, y, z, w, (0, 0, 0))
    if len(scale) != 3 or len(shift) != 3:
        raise ValueError("a scale or translation that is no three numbers")
    return matrix4([
        value
        for row, moved in zip(rows, shift, strict=False)
        for value in (row[0] * scale[0], row[1] * scale[1], row[2] * scale[2], moved)
    ])  # fmt: skip


def _part(buffers: Buffers, primitive: Json, transform: Any) -> MeshPart:
    attributes = primitive["attributes"]
    positions = buffers.vectors(attributes["POSITION"], 3)
    if "indices" in primitive:
        indices = buffers.indices(primitive["indices"])
    else:
        indices = array("q", range(len(positions) // 3))
    triangles = _triangles(indices, primitive.get("mode", TRIANGLES))
    if _mirrors(transform):
        triangles = array("q", triangles)
        triangles[0::3], triangles[2::3] = triangles[2::3], triangles[0::3]
    uv = buffers.vectors(attributes["TEXCOORD_0"], 2) if "TEXCOORD_0" in attributes else None
    if uv is not None and len(uv) // 2 != len(positions) // 3:
        uv = None
    material = str(int(primitive["material"])) if "material" in primitive else ""
    return MeshPart(positions, triangles, uv, v_up=False, transform=transform, materials=[(0, material)])


def _triangles(indices: array[int], mode: int) -> array[int]:
    if mode == TRIANGLES:
        return indices[: len(indices) // 3 * 3] if len(indices) % 3 else indices
    count = max(len(indices) - 2, 0)
    triangles = array("q", bytes(24 * count))
    triangles[0::3] = indices[:count] if mode == STRIP else array("q", [*indices[:1]] * count)
    triangles[1::3] = indices[1 : count + 1]
    triangles[2::3] = indices[2:]
    if mode == STRIP:  # every other triangle of a strip runs the other way round
        triangles[4::6], triangles[5::6] = triangles[5::6], triangles[4::6]
    return triangles


def _mirrors(transform: Any) -> bool:
    (a, b, c, _), (d, e, f, _), (g, h, i, _) = transform[:3]
    return bool(a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) < 0)

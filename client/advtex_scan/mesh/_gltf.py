"""glTF 2.0, `.glb` or `.gltf` with embedded or neighboring buffers: the triangles of the default scene.

Node transforms are applied, so that positions are in world coordinates as the file places them.
"""

from __future__ import annotations

import base64
import binascii
import json
import struct
from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from posixpath import dirname, join, normpath
from typing import Any, cast
from urllib.parse import unquote

from advtex_scan.archive import ScanArchive
from advtex_scan.errors import MeshError
from advtex_scan.manifest import IDENTITY, Matrix4
from advtex_scan.matrices import compose, matrix4
from advtex_scan.mesh._surface import RawMesh, broken, check_counts

MAX_JSON = 16 << 20
MAX_BUFFER = 1 << 30
MAX_NODES = 100_000  # also of primitives drawn, repeated ones counted
HEADER = struct.Struct("<4s2I")
CHUNK = struct.Struct("<2I")
JSON_CHUNK, BINARY_CHUNK = 0x4E4F534A, 0x004E4942
FLOAT, INDEX_KINDS = 5126, {5121: "B", 5123: "H", 5125: "I"}
TRIANGLES = 4
COMPRESSED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_mesh_quantization")
Json = dict[str, Any]


@dataclass(slots=True)
class _File:
    archive: ScanArchive
    path: str
    document: Json
    binary: tuple[int, int] | None  # offset and length of the GLB's binary chunk
    buffers: dict[int, bytes]
    files: list[str]


def read_gltf(archive: ScanArchive, path: str) -> RawMesh:
    """World positions and triangles of a `.glb` or `.gltf`. Raises MeshError."""
    try:
        file = _open_glb(archive, path) if path.lower().endswith(".glb") else _open_json(archive, path)
        _refuse_compression(file)
        mesh = RawMesh()
        drawn = 0
        for node, transform in _nodes(file.document):
            index = node.get("mesh")
            if index is not None:
                for primitive in _item(file.document, "meshes", index).get("primitives", []):
                    drawn += 1
                    if drawn > MAX_NODES:
                        raise ValueError(f"more than {MAX_NODES} primitives")
                    _add_primitive(file, primitive, transform, mesh)
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError, struct.error) as error:
        # A file of this kind is a graph of indices; whatever does not resolve ends here.
        raise MeshError(broken(path, f"is damaged: its parts do not fit together ({error})"[:200])) from error
    except RecursionError as error:
        raise MeshError(broken(path, "is nested too deeply")) from error
    mesh.files = tuple(file.files)
    return mesh


def _open_glb(archive: ScanArchive, path: str) -> _File:
    size = archive.size(path)
    if size < HEADER.size + CHUNK.size:
        raise MeshError(broken(path, "is cut off", "copy the file again in full", "mesh_truncated"))
    magic, version, length = HEADER.unpack(archive.read_range(path, 0, HEADER.size))
    if magic != b"glTF" or version != 2:
        raise MeshError(broken(path, "is no GLB of version 2"))
    if length > size:
        message = f"claims {length} bytes, but holds {size}"
        raise MeshError(broken(path, message, "copy the file again in full", "mesh_truncated"))
    json_length, kind = CHUNK.unpack(archive.read_range(path, HEADER.size, CHUNK.size))
    at = HEADER.size + CHUNK.size
    if kind != JSON_CHUNK or json_length > min(MAX_JSON, length - at):
        raise MeshError(broken(path, "its JSON part is missing, cut off or too large"))
    document = json.loads(archive.read_range(path, at, json_length))
    at += json_length
    binary = None
    if at + CHUNK.size <= length:
        binary_length, kind = CHUNK.unpack(archive.read_range(path, at, CHUNK.size))
        if kind == BINARY_CHUNK:
            binary = (at + CHUNK.size, binary_length)
            if binary[0] + binary_length > size:
                message = "its binary part is longer than the file"
                raise MeshError(broken(path, message, "copy the file again in full", "mesh_truncated"))
    return _File(archive, path, document, binary, {}, [])


def _open_json(archive: ScanArchive, path: str) -> _File:
    return _File(archive, path, json.loads(archive.read(path, MAX_JSON)), None, {}, [])


def _refuse_compression(file: _File) -> None:
    required = [str(name) for name in file.document.get("extensionsRequired", [])]
    found = [name for name in COMPRESSED if name in required]
    if found:
        message = f"is compressed with {found[0]}, which is not read"
        remedy = "export it again without compression, or as PLY"
        raise MeshError(broken(file.path, message, remedy, "mesh_compressed"))


def _item(document: Json, key: str, index: Any) -> Json:
    if not isinstance(index, int) or index < 0:
        raise IndexError(f"{key}[{index}]")
    return cast(Json, document[key][index])


def _nodes(document: Json) -> list[tuple[Json, Matrix4]]:
    """Nodes of the default scene with their world transforms; all nodes count if there is no scene."""
    nodes = document.get("nodes", [])
    if len(nodes) > MAX_NODES:
        raise ValueError(f"more than {MAX_NODES} nodes")
    roots = list(range(len(nodes)))
    if document.get("scenes"):
        roots = _item(document, "scenes", document.get("scene", 0)).get("nodes", [])
    found: list[tuple[Json, Matrix4]] = []
    waiting = [(root, IDENTITY) for root in roots]
    seen: set[int] = set()
    while waiting:
        index, parent = waiting.pop()
        if index in seen:
            raise ValueError("a node has two parents")
        seen.add(index)
        node = _item(document, "nodes", index)
        transform = compose(parent, _local(node))
        found.append((node, transform))
        waiting.extend((child, transform) for child in node.get("children", []))
    return found


def _local(node: Json) -> Matrix4:
    if "matrix" in node:
        columns = [float(value) for value in node["matrix"]]
        return matrix4([columns[4 * column + row] for row in range(4) for column in range(4)])
    x, y, z, w = (float(value) for value in node.get("rotation", (0, 0, 0, 1)))
    sx, sy, sz = (float(value) for value in node.get("scale", (1, 1, 1)))
    tx, ty, tz = (float(value) for value in node.get("translation", (0, 0, 0)))
    return matrix4([
        (1 - 2 * (y * y + z * z)) * sx, 2 * (x * y - z * w) * sy, 2 * (x * z + y * w) * sz, tx,
        2 * (x * y + z * w) * sx, (1 - 2 * (x * x + z * z)) * sy, 2 * (y * z - x * w) * sz, ty,
        2 * (x * z - y * w) * sx, 2 * (y * z + x * w) * sy, (1 - 2 * (x * x + y * y)) * sz, tz,
    ])  # fmt: skip


def _add_primitive(file: _File, primitive: Json, transform: Matrix4, mesh: RawMesh) -> None:
    if primitive.get("mode", TRIANGLES) != TRIANGLES:
        raise MeshError(broken(file.path, "holds points, lines or strips", "export plain triangles"))
    attributes = primitive["attributes"]
    base = len(mesh.positions) // 3
    positions = _accessor(file, attributes["POSITION"], "VEC3", {FLOAT: "f"})
    check_counts(file.path, base + len(positions) // 3, 0)
    if "indices" in primitive:
        indices: Sequence[float] = _accessor(file, primitive["indices"], "SCALAR", INDEX_KINDS)
    else:
        indices = range(len(positions) // 3)
    check_counts(file.path, 0, (len(mesh.triangles) + len(indices)) // 3)
    if len(indices) % 3:
        raise ValueError(f"{len(indices)} indices are no triangles")
    if len(indices) and max(indices) >= len(positions) // 3:
        message = f"a face names vertex {max(indices)} of {len(positions) // 3}, counted from 0"
        raise MeshError(broken(file.path, message, code="mesh_index"))
    mesh.positions.extend(positions if transform == IDENTITY else _moved(positions, transform))
    mesh.triangles.extend(base + int(index) for index in indices)
    mesh.has_uv = mesh.has_uv or "TEXCOORD_0" in attributes


def _moved(positions: array[float], transform: Matrix4) -> array[float]:
    moved = array("f")
    (a, b, c, d), (e, f, g, h), (i, j, k, m) = transform[:3]
    for x, y, z in zip(positions[0::3], positions[1::3], positions[2::3], strict=True):
        moved.extend((a * x + b * y + c * z + d, e * x + f * y + g * z + h, i * x + j * y + k * z + m))
    return moved


def _accessor(file: _File, index: Any, shape: str, kinds: dict[int, str]) -> array[Any]:
    """Values of an accessor as one flat array, its bounds checked against the buffer first."""
    accessor = _item(file.document, "accessors", index)
    kind, count = kinds.get(accessor["componentType"]), accessor["count"]
    if kind is None or accessor["type"] != shape or "sparse" in accessor or "bufferView" not in accessor:
        raise MeshError(broken(file.path, "stores positions or indices in a way that is not read", "export it as PLY"))
    view = _item(file.document, "bufferViews", accessor["bufferView"])
    width = 3 if shape == "VEC3" else 1
    item = struct.calcsize(f"<{width}{kind}")
    stride, offset = view.get("byteStride", item), accessor.get("byteOffset", 0)
    start, length = view.get("byteOffset", 0), view["byteLength"]
    if not all(type(value) is int and value >= 0 for value in (count, stride, offset, start, length)):
        raise ValueError("a negative or fractional size")
    buffer = _buffer(file, view["buffer"])
    needed = offset + (count - 1) * stride + item if count else 0
    if not item <= stride <= 252 or needed > length or start + length > len(buffer):
        message = f"claims {count} values, more than its buffer holds"
        raise MeshError(broken(file.path, message, "export it again", "mesh_truncated"))
    check_counts(file.path, count // 3, 0)
    data = memoryview(buffer)[start + offset : start + needed]
    values = array(kind)
    if stride == item:
        values.extend(value for row in struct.iter_unpack(f"<{width}{kind}", data) for value in row)
    else:
        unpack = struct.Struct(f"<{width}{kind}").unpack_from
        for at in range(count):
            values.extend(unpack(data, at * stride))
    return values


def _buffer(file: _File, index: Any) -> bytes:
    if index not in file.buffers:
        buffer = _item(file.document, "buffers", index)
        file.buffers[index] = _load_buffer(file, buffer)
    return file.buffers[index]


def _load_buffer(file: _File, buffer: Json) -> bytes:
    uri = buffer.get("uri")
    if uri is None:
        if file.binary is None:
            raise MeshError(broken(file.path, "its binary part is missing", code="mesh_truncated"))
        if file.binary[1] > MAX_BUFFER:
            raise MeshError(broken(file.path, "its binary part is too large", "decimate the mesh", "mesh_too_large"))
        return file.archive.read_range(file.path, *file.binary)
    if not isinstance(uri, str):
        raise TypeError("a buffer's uri is no text")
    if uri.startswith("data:"):
        try:
            return base64.b64decode(uri.partition(",")[2], validate=True)
        except binascii.Error as error:
            raise ValueError("an embedded buffer is no base64") from error
    name = normpath(join(dirname(file.path), unquote(uri)))
    if name not in file.archive:
        message = f"refers to {uri[:100]!r}, which is not in the scan"
        raise MeshError(broken(file.path, message, "add the file, or export a GLB", "missing_file"))
    file.files.append(name)
    return file.archive.read(name, MAX_BUFFER)

"""Mesh files -> Mesh: PLY and OBJ here, glTF in `gltf.py`.

Own readers, because a scan is hostile or odd input: every count is checked against the bytes that are there before
anything is allocated, polygons may mix, face order is kept, uv with seams stay indexed apart from positions, and a
glTF keeps its uv without a material. trimesh is the independent twin in the tests.

PLY and OBJ count v from the image's bottom row, scene.py from its top row: v is flipped here, once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import PurePosixPath
from typing import Any

import numpy as np
import numpy.typing as npt

from advtex_engine.core.errors import Problem, ScanError
from advtex_engine.core.scene import Mesh
from advtex_engine.mesh.gltf import read_gltf
from advtex_engine.mesh.polygons import MeshFormatError, Polygons, flip_v, triangulate
from advtex_scan.archive import ScanArchive

MAX_MESH_BYTES = 1 << 30
EXPORT_AGAIN = "export the mesh again as PLY, OBJ or GLB, in triangles and without compression"


def load_mesh(archive: ScanArchive, path: str) -> Mesh:
    """Read the mesh file `path` of a scan; polygons become triangle fans, in file order.

    Raises ScanError, naming the file and the remedy, for a file that is broken, too large or of another format, and
    for coordinates that are not finite, indices out of range or a mesh without faces.
    """
    data = archive.read(path, MAX_MESH_BYTES)
    suffix = PurePosixPath(path).suffix.lower()
    try:
        if suffix == ".ply":
            polygons = read_ply(data)
        elif suffix == ".obj":
            polygons = read_obj(data)
        elif suffix in (".glb", ".gltf"):
            polygons = read_gltf(data, path, lambda name: archive.read(name, MAX_MESH_BYTES))
        else:
            raise MeshFormatError(f"has the ending {suffix!r}, which is not supported")
        return triangulate(polygons)
    except MeshFormatError as error:
        raise ScanError(Problem("bad_mesh", path, f"the mesh {error}", EXPORT_AGAIN)) from error


# PLY ------------------------------------------------------------------------------------------------------------------

PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
PLY_VERTEX_UV = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))


@dataclass(frozen=True)
class PlyProperty:
    """`count_type` is set for a list: its length's type."""

    name: str
    type: str
    count_type: str | None = None


@dataclass(frozen=True)
class PlyElement:
    name: str
    count: int
    properties: list[PlyProperty]


def read_ply(data: bytes) -> Polygons:
    """ASCII and binary PLY 1.0; uv per vertex (s t, u v, texture_u texture_v) or per corner (texcoord)."""
    byte_order, elements, body = _ply_header(data)
    read = _PlyAscii(body) if byte_order == "" else _PlyBinary(body, byte_order)
    columns: dict[str, dict[str, Any]] = {element.name: read.element(element) for element in elements}
    vertex, face = columns.get("vertex", {}), columns.get("face", {})
    vertex = {name: column for name, column in vertex.items() if isinstance(column, np.ndarray)}
    face = {name: column for name, column in face.items() if isinstance(column, tuple)}
    if not {"x", "y", "z"} <= vertex.keys():
        raise MeshFormatError("has no vertices with x, y and z")
    position = np.stack([vertex[axis].astype(np.float64) for axis in "xyz"], axis=1)
    lists = face.get("vertex_indices", face.get("vertex_index"))
    if lists is None:
        raise MeshFormatError("has no faces")
    with np.errstate(invalid="ignore"):  # what is no number becomes an index out of range
        sizes, corners = lists[0], lists[1].astype(np.int64)
    if "texcoord" in face and np.array_equal(face["texcoord"][0], 2 * sizes):
        uv = flip_v(face["texcoord"][1].astype(np.float64).reshape(-1, 2))
        return Polygons(position, corners, sizes, uv, np.arange(len(uv)))
    for u, v in PLY_VERTEX_UV:
        if {u, v} <= vertex.keys():
            uv = flip_v(np.stack([vertex[u], vertex[v]], axis=1).astype(np.float64))
            return Polygons(position, corners, sizes, uv, corners)
    return Polygons(position, corners, sizes)


def _ply_header(data: bytes) -> tuple[str, list[PlyElement], bytes]:
    """The byte order ("<", ">", "" for ASCII), the elements and what follows the header."""
    end = data.find(b"end_header", 0, 1 << 16)
    if not data.startswith(b"ply") or end < 0:
        raise MeshFormatError("is not a PLY file")
    body = data[data.find(b"\n", end) + 1 :]
    orders = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
    byte_order, elements = "", list[PlyElement]()
    try:
        for line in data[:end].decode("latin-1").splitlines():
            words = line.split()
            if words[:1] == ["format"]:
                byte_order = orders[words[1]]
            elif words[:1] == ["element"]:
                elements.append(PlyElement(words[1], int(words[2]), []))
            elif words[:2] == ["property", "list"]:
                elements[-1].properties.append(PlyProperty(words[4], PLY_TYPES[words[3]], PLY_TYPES[words[2]]))
            elif words[:1] == ["property"]:
                elements[-1].properties.append(PlyProperty(words[2], PLY_TYPES[words[1]]))
    except (LookupError, ValueError) as error:
        raise MeshFormatError(f"has a PLY header that cannot be read (near {line!r})") from error
    if any(len({prop.name for prop in element.properties}) < len(element.properties) for element in elements):
        raise MeshFormatError("has a PLY header that names a property twice")
    if any(not 0 <= element.count <= len(body) for element in elements):
        raise MeshFormatError("is shorter than its header says; the file is incomplete")
    return byte_order, elements, body


class _PlyBinary:
    def __init__(self, body: bytes, byte_order: str) -> None:
        self._body, self._order, self._offset = body, byte_order, 0

    def element(self, element: PlyElement) -> dict[str, Any]:
        """Columns by property name: an array, or (lengths, values) for a list."""
        if element.count == 0 or not element.properties:
            return {}
        # Nearly every file has lists of one length: read the first row's lengths and try them on all rows.
        lengths = self._row_lengths(element)
        fields: list[tuple[str, str, tuple[int, ...]]] = []
        for index, prop in enumerate(element.properties):
            if prop.count_type is None:
                fields.append((prop.name, self._order + prop.type, ()))
            else:
                fields.append((f"count of {prop.name}", self._order + prop.count_type, ()))
                fields.append((prop.name, self._order + prop.type, (lengths[index],)))
        dtype = np.dtype(fields)
        if dtype.itemsize * element.count <= len(self._body) - self._offset:
            rows = np.frombuffer(self._body, dtype, element.count, self._offset)
            lists = [(index, prop) for index, prop in enumerate(element.properties) if prop.count_type]
            if all((rows[f"count of {prop.name}"] == lengths[index]).all() for index, prop in lists):
                self._offset += dtype.itemsize * element.count
                return {
                    prop.name: rows[prop.name]
                    if prop.count_type is None
                    else (np.full(element.count, lengths[index]), rows[prop.name].reshape(-1))
                    for index, prop in enumerate(element.properties)
                }
        return self._element_row_by_row(element)

    def _row_lengths(self, element: PlyElement) -> list[int]:
        offset, lengths = self._offset, []
        for prop in element.properties:
            length = 1
            if prop.count_type is not None:
                length = int(self._take(prop.count_type, 1, offset)[0])
                offset += np.dtype(prop.count_type).itemsize
            offset += np.dtype(prop.type).itemsize * length
            if length < 0 or offset > len(self._body):
                raise MeshFormatError("is shorter than its header says; the file is incomplete")
            lengths.append(length)
        return lengths

    def _element_row_by_row(self, element: PlyElement) -> dict[str, Any]:
        values: list[list[npt.NDArray[Any]]] = [[] for _ in element.properties]
        for _ in range(element.count):
            for index, length in enumerate(self._row_lengths(element)):
                prop = element.properties[index]
                if prop.count_type is not None:
                    self._offset += np.dtype(prop.count_type).itemsize
                values[index].append(self._take(prop.type, length, self._offset))
                self._offset += np.dtype(prop.type).itemsize * length
        return {
            prop.name: np.concatenate(rows)
            if prop.count_type is None
            else (np.array([len(row) for row in rows], dtype=np.int64), np.concatenate(rows))
            for prop, rows in zip(element.properties, values, strict=True)
        }

    def _take(self, type_: str, count: int, offset: int) -> npt.NDArray[Any]:
        dtype = np.dtype(self._order + type_)
        if offset + count * dtype.itemsize > len(self._body):
            raise MeshFormatError("is shorter than its header says; the file is incomplete")
        return np.frombuffer(self._body, dtype, count, offset)


class _PlyAscii:
    def __init__(self, body: bytes) -> None:
        self._lines, self._line = body.decode("latin-1").splitlines(), 0

    def element(self, element: PlyElement) -> dict[str, Any]:
        """Columns by property name: an array, or (lengths, values) for a list."""
        lines = self._lines[self._line : self._line + element.count]
        self._line += element.count
        if len(lines) < element.count:
            raise MeshFormatError("is shorter than its header says; the file is incomplete")
        values: list[list[float]] = [[] for _ in element.properties]
        lengths: list[list[int]] = [[] for _ in element.properties]
        for line in lines:
            words, at = line.split(), 0
            try:
                for index, prop in enumerate(element.properties):
                    length = 1
                    if prop.count_type is not None:
                        length, at = int(words[at]), at + 1
                    row = [float(word) for word in words[at : at + length]]
                    if len(row) != length:
                        raise IndexError(length)
                    values[index] += row
                    lengths[index].append(length)
                    at += length
            except (IndexError, ValueError) as error:
                raise MeshFormatError(f"has a line that cannot be read: {line[:80]!r}") from error
        return {
            prop.name: np.array(values[index])
            if prop.count_type is None
            else (np.array(lengths[index], dtype=np.int64), np.array(values[index]))
            for index, prop in enumerate(element.properties)
        }


# OBJ ------------------------------------------------------------------------------------------------------------------


def read_obj(data: bytes) -> Polygons:
    """Wavefront OBJ: v, vt and f (v, v/vt, v//vn, v/vt/vn, relative indices); uv are kept if every corner has one."""
    position, uv = list[list[float]](), list[list[float]]()
    corners, uv_corners, sizes = list[int](), list[int](), list[int]()
    material, materials = list[int](), {"": 0}
    used = 0
    for line in data.decode("latin-1").replace("\\\n", " ").splitlines():
        words = line.split()
        try:
            if not words:
                continue
            if words[0] == "v":
                position.append([float(words[1]), float(words[2]), float(words[3])])
            elif words[0] == "vt":
                uv.append([float(words[1]), float(words[2])])
            elif words[0] == "f":
                sizes.append(len(words) - 1)
                material.append(used)
                for word in words[1:]:
                    parts = word.split("/")
                    corners.append(_obj_index(parts[0], len(position)))
                    if len(parts) > 1 and parts[1]:
                        uv_corners.append(_obj_index(parts[1], len(uv)))
            elif words[0] == "usemtl":
                used = materials.setdefault(" ".join(words[1:]), len(materials))
        except (IndexError, ValueError) as error:
            raise MeshFormatError(f"has a line that cannot be read: {line[:80]!r}") from error
    polygons = Polygons(
        np.array(position).reshape(-1, 3),
        np.array(corners, dtype=np.int64),
        np.array(sizes, dtype=np.int64),
        material=np.array(material, dtype=np.int64),
        materials=tuple(materials),
    )
    if not uv_corners or len(uv_corners) != len(corners):
        return polygons
    return replace(polygons, uv=flip_v(np.array(uv).reshape(-1, 2)), uv_corners=np.array(uv_corners, dtype=np.int64))


def _obj_index(word: str, count: int) -> int:
    """OBJ counts from 1, and backwards from the newest entry with negative numbers; 0 is no index (-> -1, refused)."""
    index = int(word)
    return index - 1 if index >= 0 else (count + index if count + index >= 0 else -1)

"""The numbers that a glTF's accessors stand for, out of its buffers."""

from __future__ import annotations

import base64
import binascii
import struct
from array import array
from itertools import repeat
from operator import truediv
from posixpath import dirname, join, normpath
from typing import Any, cast
from urllib.parse import unquote

from advtex_scan.errors import MeshError
from advtex_scan.mesh._packed import gather
from advtex_scan.mesh._part import MAX_BYTES, MeshSource, broken, check_counts

UNSIGNED = {5121: "B", 5123: "H", 5125: "I"}
NUMBERS = {5120: "b", 5121: "B", 5122: "h", 5123: "H", 5126: "f"}  # also what KHR_mesh_quantization allows
LARGEST = {"b": 127, "B": 255, "h": 32767, "H": 65535}  # stands for 1 where integers are normalized
TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3"}
Json = dict[str, Any]


def item(document: Json, key: str, index: Any) -> Json:
    """An entry of one of the document's lists. Raises IndexError for what is no place in it."""
    if not isinstance(index, int) or index < 0:
        raise IndexError(f"{key}[{index}]")
    return cast(Json, document[key][index])


class Buffers:
    """Accessors of a document, read once each; binary: the buffer that is part of a GLB.

    files: the other files that were read.
    """

    def __init__(self, document: Json, binary: bytes | None, source: MeshSource) -> None:
        self.files: list[str] = []
        self._document, self._binary, self._source = document, binary, source
        self._left = MAX_BYTES - source.size
        self._buffers: dict[int, bytes] = {}
        self._read: dict[tuple[int, int], array[Any]] = {}

    def vectors(self, index: Any, width: int) -> array[float]:
        """`width` numbers of each element in turn: "f", or "d" of integers, in [0, 1] or [-1, 1] if normalized."""
        if (index, width) not in self._read:
            accessor = item(self._document, "accessors", index)
            values = self._values(accessor, width, NUMBERS)
            if values.typecode != "f" and accessor.get("normalized"):
                kind = NUMBERS[accessor["componentType"]]
                values = array("d", map(truediv, values, repeat(LARGEST[kind])))
                if kind in "bh":
                    values = array("d", map(max, values, repeat(-1.0)))
            self._read[index, width] = values if values.typecode == "f" else array("d", values)
        return self._read[index, width]

    def indices(self, index: Any) -> array[int]:
        """Indices, "q", not to be changed."""
        if (index, 1) not in self._read:
            self._read[index, 1] = self._values(item(self._document, "accessors", index), 1, UNSIGNED)
        return self._read[index, 1]

    def _values(self, accessor: Json, width: int, kinds: dict[int, str]) -> array[Any]:
        """The numbers of an accessor, whose bounds are checked against the buffer first."""
        path = self._source.path
        kind, count = kinds.get(accessor["componentType"]), accessor["count"]
        if kind is None or accessor["type"] != TYPES[width] or "sparse" in accessor or "bufferView" not in accessor:
            message = "stores positions, uv or indices in a way that is not read"
            raise MeshError(broken(path, message, "export it as PLY"))
        view = item(self._document, "bufferViews", accessor["bufferView"])
        size = struct.calcsize(f"<{width}{kind}")
        stride, offset = view.get("byteStride", size), accessor.get("byteOffset", 0)
        start, length = view.get("byteOffset", 0), view["byteLength"]
        if not all(type(value) is int and value >= 0 for value in (count, stride, offset, start, length)):
            raise ValueError("a negative or fractional size")
        buffer = self._buffer(view["buffer"])
        needed = offset + (count - 1) * stride + size if count else 0
        if stride < size or needed > length or start + length > len(buffer):
            message = f"claims {count} values, more than its buffer holds"
            raise MeshError(broken(path, message, "export it again", "mesh_truncated"))
        check_counts(path, count // 3, 0)
        if not count:
            return array("f" if kind == "f" else "q")
        first = start + offset
        rows = buffer[first : first + count * stride]
        if len(rows) < count * stride:  # the last row ends with its number
            rows += bytes(count * stride - len(rows))
        return gather(rows, stride, 0, kind, width, "<")

    def _buffer(self, index: Any) -> bytes:
        if index not in self._buffers:
            uri = item(self._document, "buffers", index).get("uri")
            self._buffers[index] = self._load(index, uri)
        return self._buffers[index]

    def _load(self, index: int, uri: Any) -> bytes:
        path = self._source.path
        if uri is None:
            if self._binary is None or index != 0:
                raise MeshError(broken(path, "its binary part is missing", code="mesh_truncated"))
            return self._binary
        if not isinstance(uri, str):
            raise TypeError("a buffer's uri is no text")
        if uri.startswith("data:"):
            try:
                return base64.b64decode(uri.partition(",")[2], validate=True)
            except binascii.Error as error:
                raise ValueError("an embedded buffer is no base64") from error
        name = normpath(join(dirname(path), unquote(uri)))
        data = self._source.fetch(name, self._left)
        self._left -= len(data)
        self.files.append(name)
        return data

"""PLY: ascii, binary little endian, binary big endian. Elements before the faces are skipped by their size."""

from __future__ import annotations

import struct
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import chain, islice
from typing import BinaryIO

from advtex_scan.archive import ScanArchive
from advtex_scan.errors import MeshError
from advtex_scan.mesh._surface import RawMesh, broken, check_counts

MAX_HEADER_LINES = 500
MAX_LINE = 1 << 16
BLOCK = 1 << 15  # elements that are read at a time
MAX_CORNERS = 255
FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
TYPES = {
    **dict.fromkeys(("char", "int8"), "b"),
    **dict.fromkeys(("uchar", "uint8"), "B"),
    **dict.fromkeys(("short", "int16"), "h"),
    **dict.fromkeys(("ushort", "uint16"), "H"),
    **dict.fromkeys(("int", "int32"), "i"),
    **dict.fromkeys(("uint", "uint32"), "I"),
    **dict.fromkeys(("float", "float32"), "f"),
    **dict.fromkeys(("double", "float64"), "d"),
}
INTEGERS = "bBhHiI"
FACE_LISTS = ("vertex_indices", "vertex_index")
UV_NAMES = ({"s", "t"}, {"u", "v"}, {"texture_u", "texture_v"})


@dataclass(frozen=True, slots=True)
class _Property:
    name: str
    kind: str  # struct code of the value
    count: str = ""  # struct code of a list's length, empty for a scalar


@dataclass(slots=True)
class _Element:
    name: str
    count: int
    properties: list[_Property] = field(default_factory=list)

    def least_size(self, ascii_format: bool) -> int:
        """Bytes that each element takes at least."""
        if ascii_format:
            return 2 * len(self.properties)
        return sum(struct.calcsize("<" + (one.count or one.kind)) for one in self.properties)


def read_ply(archive: ScanArchive, path: str) -> RawMesh:
    """Vertices and fan-split faces of a PLY file. Raises MeshError."""
    with archive.open(path) as stream:
        order, elements = _header(stream, path)
        by_name = {element.name: element for element in elements}
        if len(by_name) != len(elements) or "vertex" not in by_name:
            raise MeshError(broken(path, "its header lists no vertices, or an element twice"))
        faces = by_name.get("face", _Element("face", 0))
        check_counts(path, by_name["vertex"].count, faces.count)
        if any(element.count and not element.properties for element in elements):
            raise MeshError(broken(path, "its header lists an element without properties"))
        least = sum(element.count * element.least_size(order == "") for element in elements)
        if least > archive.size(path):
            message = f"claims more vertices and faces than its {archive.size(path)} bytes can hold"
            raise MeshError(broken(path, message, "copy the file again in full", "mesh_truncated"))
        mesh = RawMesh()
        scalars = {one.name for one in by_name["vertex"].properties}
        mesh.has_uv = any(names <= scalars for names in UV_NAMES)
        mesh.has_uv |= any(one.name == "texcoord" and one.count for one in faces.properties)
        for element in elements:
            if element.name == "vertex":
                _check_vertex(element, path)
            _read_element(stream, order, element, mesh, path)
            if element.name == "face":
                break
    return mesh


def _header(stream: BinaryIO, path: str) -> tuple[str, list[_Element]]:
    if stream.readline(MAX_LINE).strip() != b"ply":
        raise MeshError(broken(path, "is no PLY file"))
    order: str | None = None
    elements: list[_Element] = []
    for _ in range(MAX_HEADER_LINES):
        words = stream.readline(MAX_LINE).decode("ascii", "replace").split()
        try:
            match words:
                case ["format", kind, _]:
                    order = FORMATS[kind]
                case ["element", name, count]:
                    elements.append(_Element(name, _count(count)))
                case ["property", "list", count, kind, name]:
                    elements[-1].properties.append(_Property(name, TYPES[kind], TYPES[count]))
                case ["property", kind, name]:
                    elements[-1].properties.append(_Property(name, TYPES[kind]))
                case ["end_header"]:
                    break
                case ["comment" | "obj_info", *_]:
                    pass
                case _:
                    raise ValueError("unknown line")
        except (KeyError, IndexError, ValueError) as error:
            line = " ".join(words)[:80]
            raise MeshError(broken(path, f"its header has a line that is not understood: {line!r}")) from error
    else:
        raise MeshError(broken(path, f"its header is longer than {MAX_HEADER_LINES} lines"))
    if order is None:
        raise MeshError(broken(path, "its header states no format"))
    return order, elements


def _count(word: str) -> int:
    if not word.isascii() or not word.isdecimal() or len(word) > 18:
        raise ValueError("no count")
    return int(word)


def _check_vertex(element: _Element, path: str) -> None:
    names = [one.name for one in element.properties]
    if not {"x", "y", "z"} <= set(names) or len(set(names)) != len(names):
        raise MeshError(broken(path, "its vertices have no x, y, z, or a property twice"))
    if any(one.count for one in element.properties):
        raise MeshError(broken(path, "its vertices hold lists"))


def _read_element(stream: BinaryIO, order: str, element: _Element, mesh: RawMesh, path: str) -> None:
    try:
        if element.name == "vertex":
            rows = _ascii_rows(stream, element) if order == "" else _binary_rows(stream, order, element)
            _read_vertices(rows, element, mesh.positions)
        elif element.name == "face":
            _read_faces(stream, order, element, mesh.triangles)
        else:
            for _ in _lists(stream, order, element, ""):
                pass
    except (ValueError, OverflowError, struct.error, EOFError) as error:
        message = f"its {element.name} data are cut off or damaged ({error})"
        raise MeshError(broken(path, message, "copy the file again in full", "mesh_truncated")) from error


def _read_vertices(rows: Iterator[tuple[float, ...]], element: _Element, positions: array[float]) -> None:
    if not element.properties:
        return
    names = [one.name for one in element.properties]
    x, y, z = names.index("x"), names.index("y"), names.index("z")
    if (x, y, z) == (0, 1, 2) and len(names) == 3:
        positions.extend(chain.from_iterable(rows))
    else:
        positions.extend(value for row in rows for value in (row[x], row[y], row[z]))


def _binary_rows(stream: BinaryIO, order: str, element: _Element) -> Iterator[tuple[float, ...]]:
    layout = struct.Struct(order + "".join(one.kind for one in element.properties))
    for start in range(0, element.count, BLOCK):
        yield from layout.iter_unpack(_exactly(stream, layout.size * min(BLOCK, element.count - start)))


def _ascii_rows(stream: BinaryIO, element: _Element) -> Iterator[tuple[float, ...]]:
    for _ in range(element.count):
        words = stream.readline(MAX_LINE).split()
        if len(words) < len(element.properties):
            raise EOFError("a line is too short")
        yield tuple(map(float, words))


def _exactly(stream: _Rewound | BinaryIO, length: int) -> bytes:
    data = stream.read(length)
    if len(data) != length:
        raise EOFError("the file ends too early")
    return data


def _read_faces(stream: BinaryIO, order: str, element: _Element, triangles: array[int]) -> None:
    names = [one.name for one in element.properties if one.name in FACE_LISTS and one.count and one.kind in INTEGERS]
    if not names:
        if element.count:
            raise ValueError("no list of vertex_indices")
        return
    done = 0
    rest = b""
    if order and len(element.properties) == 1 and element.properties[0].count in INTEGERS:
        done, rest = _read_triangles(stream, order, element, triangles)
    if done < element.count:
        remaining = _Element(element.name, element.count - done, element.properties)
        for corners in _lists(_Rewound(rest, stream), order, remaining, names[0]):
            for k in range(1, len(corners) - 1):
                triangles.extend((int(corners[0]), int(corners[k]), int(corners[k + 1])))


def _read_triangles(stream: BinaryIO, order: str, element: _Element, triangles: array[int]) -> tuple[int, bytes]:
    """Blocks of nothing but triangles, the usual case; stops before the first block with another polygon.

    Returns how many faces were read, and the bytes that were taken from the stream beyond them.
    """
    layout = struct.Struct(f"{order}{element.properties[0].count}3{element.properties[0].kind}")
    for start in range(0, element.count, BLOCK):
        count = min(BLOCK, element.count - start)
        data = stream.read(layout.size * count)
        if len(data) != layout.size * count:
            return start, data
        flat = array("q", chain.from_iterable(layout.iter_unpack(data)))
        if flat[0::4].count(3) != count:
            return start, data
        del flat[0::4]
        triangles.extend(flat)
    return element.count, b""


class _Rewound:
    """A stream with bytes put back in front of it."""

    def __init__(self, head: bytes, stream: BinaryIO) -> None:
        self._head = head
        self._at = 0
        self._stream = stream

    def read(self, length: int) -> bytes:
        data = self._head[self._at : self._at + length]
        self._at += len(data)
        return data if len(data) == length else data + self._stream.read(length - len(data))

    def readline(self, limit: int) -> bytes:
        return self._stream.readline(limit)


def _lists(stream: _Rewound | BinaryIO, order: str, element: _Element, wanted: str) -> Iterator[tuple[int, ...]]:
    """The list of indices named `wanted` of each element, read one by one; empty where there is none."""
    for _ in range(element.count):
        words = iter(stream.readline(MAX_LINE).split()) if order == "" else None
        found: tuple[int, ...] = ()
        for one in element.properties:
            count = int(_values(stream, order, words, one.count, 1)[0]) if one.count else 1
            if not 0 <= count <= MAX_CORNERS:
                raise ValueError(f"a list of {count} values")
            values = _values(stream, order, words, one.kind, count)
            if one.name == wanted:
                found = tuple(map(int, values))
        yield found


def _values(
    stream: _Rewound | BinaryIO, order: str, words: Iterator[bytes] | None, kind: str, count: int
) -> tuple[float, ...]:
    if words is None:
        layout = struct.Struct(f"{order}{count}{kind}")
        return layout.unpack(_exactly(stream, layout.size))
    values = tuple(map(float, islice(words, count)))
    if len(values) < count:
        raise EOFError("a line is too short")
    return values

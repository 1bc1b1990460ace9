"""PLY: ascii, binary little endian, binary big endian. Vertices and faces are read, other elements skipped."""

from __future__ import annotations

import struct
from array import array
from collections.abc import Sequence
from typing import Literal

from advtex_scan.errors import MeshError
from advtex_scan.mesh._part import DAMAGED, MeshPart, MeshSource, add_fans, broken, check_counts
from advtex_scan.mesh._ply_rows import BinaryRows, Element, Property, Run, TextRows

MAX_HEADER = 1 << 16
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
FACE_LISTS = ("vertex_indices", "vertex_index")
TEXCOORD = "texcoord"
UV_NAMES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))


def read_ply(source: MeshSource) -> MeshPart:
    """Vertices, fan-split faces and uv (of vertices, or `texcoord` of corners) of a PLY file. Raises MeshError."""
    order, elements, size = _header(source)
    _check_elements(source, order, elements)
    rows = BinaryRows(source.stream, size, order) if order else TextRows(source.stream)
    contents = _Contents(source.path)
    needed = {"vertex", *(element.name for element in elements if element.name == "face")}
    for element in elements:
        if not needed:
            break
        needed.discard(element.name)
        wanted = _wanted(element)
        try:
            for run in rows.runs(element, wanted):
                if element.name == "vertex":
                    contents.add_vertices(run, wanted)
                elif element.name == "face":
                    contents.add_faces(run, wanted[0])
        except (ValueError, OverflowError, struct.error, EOFError) as error:
            message = f"its {element.name} data are cut off or damaged ({error})"
            raise MeshError(broken(source.path, message, DAMAGED, "mesh_truncated")) from error
    return contents.part()


def _header(source: MeshSource) -> tuple[str, list[Element], int]:
    """The order of bytes ("<", ">", "" for ascii), the elements, and how many bytes follow."""
    path = source.path
    line = source.stream.readline(MAX_HEADER)
    left = MAX_HEADER - len(line)
    if line.strip() != b"ply":
        raise MeshError(broken(path, "is no PLY file"))
    order: str | None = None
    elements: list[Element] = []
    while line := source.stream.readline(left):
        left -= len(line)
        words = line.decode("ascii", "replace").split()
        try:
            match words:
                case ["format", kind, _]:
                    order = FORMATS[kind]
                case ["element", name, count]:
                    elements.append(Element(name, _count(count), []))
                case ["property", "list", count, kind, name]:
                    elements[-1].properties.append(Property(name, TYPES[kind], TYPES[count]))
                case ["property", kind, name]:
                    elements[-1].properties.append(Property(name, TYPES[kind]))
                case ["end_header"]:
                    break
                case ["format" | "element" | "property", *_]:
                    raise ValueError("words too many or too few")
        except (KeyError, IndexError, ValueError) as error:
            shown = " ".join(words)[:80]
            raise MeshError(broken(path, f"its header has a line that is not understood: {shown!r}")) from error
    else:
        raise MeshError(broken(path, f"its header is cut off, or longer than {MAX_HEADER} bytes"))
    if order is None:
        raise MeshError(broken(path, "its header states no format"))
    return order, elements, source.size - (MAX_HEADER - left)


def _count(word: str) -> int:
    if not word.isascii() or not word.isdecimal() or len(word) > 18:
        raise ValueError("no count")
    return int(word)


def _check_elements(source: MeshSource, order: str, elements: list[Element]) -> None:
    """Raises MeshError if the header's elements cannot be what the file holds."""
    path, by_name = source.path, {element.name: element for element in elements}
    if len(by_name) != len(elements) or "vertex" not in by_name:
        raise MeshError(broken(path, "its header lists no vertices, or an element twice"))
    check_counts(path, by_name["vertex"].count, by_name["face"].count if "face" in by_name else 0)
    if any(element.count and not element.properties for element in elements):
        raise MeshError(broken(path, "its header lists an element without properties"))
    least = sum(element.count * element.least_size(order == "") for element in elements)
    if least > source.size:
        message = f"claims more vertices and faces than its {source.size} bytes can hold"
        raise MeshError(broken(path, message, DAMAGED, "mesh_truncated"))
    for element in elements:
        if len({one.name for one in element.properties}) < len(element.properties):
            raise MeshError(broken(path, f"its header names a property of {element.name[:80]!r} twice"))
    if by_name["vertex"].count and not set("xyz") <= set(_wanted(by_name["vertex"])):
        raise MeshError(broken(path, "its vertices have no x, y and z"))
    if "face" in by_name and by_name["face"].count and not _wanted(by_name["face"]):
        raise MeshError(broken(path, "its faces have no list of vertex_indices"))


def _wanted(element: Element) -> list[str]:
    """The properties that are read: of vertices x, y, z and uv, of faces the corners and their uv."""
    if element.name == "vertex":
        scalars = {one.name for one in element.properties if not one.count}
        uv = next((names for names in UV_NAMES if scalars.issuperset(names)), ())
        return [*(axis for axis in "xyz" if axis in scalars), *uv]
    if element.name == "face":
        indices = [one.name for one in element.properties if one.whole]
        corners = [name for name in FACE_LISTS if name in indices][:1]
        texcoord = [one.name for one in element.properties if one.name == TEXCOORD and one.count]
        return [*corners, *texcoord] if corners else []
    return []


class _Contents:
    """The mesh as far as it is read."""

    def __init__(self, path: str) -> None:
        self._path = path
        self._mesh = MeshPart()
        self._vertex_uv: array[float] | None = None
        self._corner_uv: array[float] | None = array("d")  # None once a face has none
        self._corner_triangles = array("q")

    def part(self) -> MeshPart:
        mesh = self._mesh
        if self._corner_uv:
            mesh.uv, mesh.uv_triangles = self._corner_uv, self._corner_triangles
        else:
            mesh.uv = self._vertex_uv
        return mesh

    def add_vertices(self, run: Run, wanted: list[str]) -> None:
        columns = [run.values[name] for name in wanted]
        self._mesh.positions.extend(_interleaved("f", columns[:3]))
        if len(columns) > 3:
            self._vertex_uv = self._vertex_uv or array("d")
            self._vertex_uv.extend(_interleaved("d", columns[3:]))

    def add_faces(self, run: Run, indices: str) -> None:
        sides, corners = run.lengths[indices], run.values[indices]
        fans = run.rows * max(sides - 2, 0) if isinstance(sides, int) else sum(max(each - 2, 0) for each in sides)
        check_counts(self._path, 0, len(self._mesh.triangles) // 3 + fans)
        add_fans(self._mesh.triangles, corners, sides)
        doubled = 2 * sides if isinstance(sides, int) else [2 * each for each in sides]
        if self._corner_uv is not None and run.lengths.get(TEXCOORD) == doubled and TEXCOORD in run.values:
            first = len(self._corner_uv) // 2
            self._corner_uv.extend(array("d", run.values[TEXCOORD]))
            add_fans(self._corner_triangles, range(first, first + len(corners)), sides)
        else:
            self._corner_uv = None


def _interleaved(kind: Literal["f", "d"], columns: list[Sequence[float]]) -> array[float]:
    """The columns' first numbers, then the second ones, and so on."""
    width = len(columns)
    rows = array(kind, bytes(array(kind).itemsize * width * len(columns[0])))
    for place, column in enumerate(columns):
        rows[place::width] = array(kind, column)
    return rows

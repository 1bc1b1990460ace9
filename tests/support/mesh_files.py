"""Mesh files of all kinds that the readers take, made by hypothesis, with what must come out of them."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from hypothesis import strategies as st

CODES = {"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I", "float": "f", "double": "d"}
TRIANGLE = [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)]  # keeps a mesh from having no area
coordinates = st.floats(-1000, 1000, width=32)
points = st.lists(st.tuples(coordinates, coordinates, coordinates), max_size=5).map(lambda more: TRIANGLE + more)


@dataclass(frozen=True)
class MeshFile:
    """A sound file. positions: [V,3] float32; triangles: [T,3]; uv: [T,3,2] of their corners as the file has them."""

    name: str
    data: bytes
    positions: np.ndarray
    triangles: list[tuple[int, ...]]
    uv: np.ndarray | None = None


def fans(polygons: list[Any]) -> list[tuple[int, ...]]:
    return [(face[0], face[k], face[k + 1]) for face in polygons for k in range(1, len(face) - 1)]


@st.composite
def polygons(draw: st.DrawFn, vertices: int, least: int = 0) -> list[list[int]]:
    index = st.integers(0, vertices - 1)
    kind = draw(st.sampled_from([(3, 3), (4, 4), (least, 6)]))
    faces = draw(st.lists(st.lists(index, min_size=kind[0], max_size=kind[1]), max_size=30))
    return [[0, 1, 2], *faces]


# PLY ------------------------------------------------------------------------------------------------------------------


@dataclass
class _Column:
    """A property and its values; a list's are lists, and `count` is its length's type."""

    name: str
    kind: str
    values: list[Any]
    count: str = ""

    def header(self) -> str:
        return (
            f"property list {self.count} {self.kind} {self.name}" if self.count else f"property {self.kind} {self.name}"
        )

    def binary(self, order: str, row: int) -> bytes:
        value, code = self.values[row], CODES[self.kind]
        if not self.count:
            return struct.pack(order + code, value)
        return struct.pack(f"{order}{CODES[self.count]}{len(value)}{code}", len(value), *value)

    def text(self, row: int) -> str:
        value = self.values[row]
        return " ".join(map(repr, [len(value), *value])) if self.count else repr(value)


@st.composite
def _extra(draw: st.DrawFn, rows: int, name: str) -> _Column:
    if draw(st.booleans()):
        return _Column(name, "uchar", draw(st.lists(st.integers(0, 255), min_size=rows, max_size=rows)))
    sizes = st.lists(coordinates, min_size=1, max_size=2)
    return _Column(name, "float", draw(st.lists(sizes, min_size=rows, max_size=rows)), "uchar")


@st.composite
def ply_files(draw: st.DrawFn) -> MeshFile:
    vertices = draw(points)
    faces = draw(polygons(len(vertices)))
    real = draw(st.sampled_from(["float", "double"]))
    columns = [_Column(axis, real, [point[k] for point in vertices]) for k, axis in enumerate("xyz")]
    uv = None
    if draw(st.booleans()):
        names = draw(st.sampled_from([("s", "t"), ("u", "v"), ("texture_u", "texture_v")]))
        uv = np.array(vertices)[:, :2]
        columns += [_Column(name, "float", uv[:, k].tolist()) for k, name in enumerate(names)]
    columns += draw(st.lists(_extra(len(vertices), "quality"), max_size=1))
    columns = draw(st.permutations(columns))
    name = draw(st.sampled_from(["vertex_indices", "vertex_index"]))
    counts = st.sampled_from(["uchar", "ushort", "int", "uint"])
    rows = [_Column(name, draw(st.sampled_from(sorted(set(CODES) - {"float", "double"}))), faces, draw(counts))]
    uv = None if uv is None else uv[fans(faces)]
    if draw(st.booleans()):
        texcoord = [
            [float(corner) / 8 for pair in zip(face, face[::-1], strict=True) for corner in pair] for face in faces
        ]
        uv = np.array(fans([list(zip(row[::2], row[1::2], strict=True)) for row in texcoord]))
        rows.append(_Column("texcoord", "float", texcoord, "uchar"))
    rows += draw(st.lists(_extra(len(faces), "flags"), max_size=1))
    elements = [("vertex", len(vertices), columns), ("face", len(faces), draw(st.permutations(rows)))]
    elements.insert(draw(st.integers(0, 2)), ("edge", 2, [draw(_extra(2, "other"))]))
    order = draw(st.sampled_from(["", "<", ">"]))
    if draw(st.booleans()):
        elements.reverse()
    data = ply(order, elements, "\r\n" if not order and draw(st.booleans()) else "\n")
    return MeshFile("m.ply", data, np.array(vertices, np.float32), fans(faces), uv)


def ply(order: str, elements: list[tuple[str, int, list[_Column]]], end: str = "\n") -> bytes:
    kind = {"": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[order]
    lines = ["ply", f"format {kind} 1.0", "comment made by a test"]
    for name, count, columns in elements:
        lines += [f"element {name} {count}", *(column.header() for column in columns)]
    data = (end.join([*lines, "end_header"]) + end).encode()
    for _, count, columns in elements:
        for row in range(count):
            if order:
                data += b"".join(column.binary(order, row) for column in columns)
            else:
                data += (" ".join(column.text(row) for column in columns) + end).encode()
    return data


# OBJ ------------------------------------------------------------------------------------------------------------------


@st.composite
def obj_files(draw: st.DrawFn) -> MeshFile:
    vertices, textured = draw(points), draw(st.booleans())
    faces = draw(polygons(len(vertices), least=1))
    uv = [(0.25, 0.5), (0.75, 1.0), (0.0, 0.125)]
    forms = ["{v}/{t}", "{v}/{t}/1"] if textured else ["{v}", "{v}//1"]
    form, relative = draw(st.sampled_from(forms)), draw(st.booleans())
    color, gap = draw(st.sampled_from(["", " 1", " 0.5 0.5 1"])), draw(st.sampled_from([" ", "  ", "\t"]))
    head = ["# a comment", "mtllib a.mtl", *(f"vt {u} {v}" for u, v in uv), "vn 0 0 1"]
    lines = [f"v{gap}{gap.join(map(repr, point))}{color}" for point in vertices]
    for face in faces:
        words = [
            form.format(
                v=corner - len(vertices) if relative else corner + 1, t=corner % 3 - 3 if relative else corner % 3 + 1
            )
            for corner in face
        ]
        lines.append("f" + gap + draw(st.sampled_from([gap, " \\\n"])).join(words))
        lines += draw(st.sampled_from([[], [], ["o another"], ["usemtl b"], ["g", "s off"], [""], ["# f 1 2 3"]]))
    text = "\n".join(head + lines) + draw(st.sampled_from(["", "\n"]))
    text = text.replace("\n", draw(st.sampled_from(["\n", "\r\n", " \n"])))
    corners = fans(faces)
    expected = np.array([[uv[corner % 3] for corner in face] for face in corners]) if textured else None
    return MeshFile("m.obj", text.replace("\\ \n", "\\\n").encode(), np.array(vertices, np.float32), corners, expected)


# GLB ------------------------------------------------------------------------------------------------------------------

EXACT = [  # products and sums of these with small numbers are exact, in whatever order they are taken
    {},
    {"translation": [1, -2, 4], "scale": [2, 2, 0.5]},
    {"matrix": [0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 1, 0, 5, 6, 7, 1]},
    {"scale": [-1, 1, 1]},
]
MODES = {4: "triangles", 5: "strip", 6: "fan"}
POSITIONS = {5120: ("b", 127), 5121: ("B", 255), 5122: ("h", 32767), 5123: ("H", 65535), 5126: ("f", 1)}


class GlbMaker:
    """A document whose accessors are put behind each other in the binary part."""

    def __init__(self) -> None:
        self.document: dict[str, Any] = {"asset": {"version": "2.0"}, "accessors": [], "bufferViews": [], "meshes": []}
        self.binary = b""

    def accessor(self, rows: list[Any], component: int, kind: str, gap: int = 0, normalized: bool = False) -> int:
        code = {**{key: code for key, (code, _) in POSITIONS.items()}, 5125: "I"}[component]
        flat = [row if isinstance(row, tuple | list) else (row,) for row in rows]
        data = b"".join(struct.pack(f"<{len(row)}{code}", *row) + bytes(gap) for row in flat)
        view: dict[str, Any] = {"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(data)}
        if gap and flat:
            view["byteStride"] = len(data) // len(flat)
        accessor = {"bufferView": len(self.document["bufferViews"]), "componentType": component, "count": len(flat)}
        self.document["bufferViews"].append(view)
        self.document["accessors"].append({**accessor, "type": kind, **({"normalized": True} if normalized else {})})
        self.binary += data + bytes(-len(data) % 4)
        return len(self.document["accessors"]) - 1

    def glb(self, **changes: Any) -> bytes:
        document = {**self.document, "buffers": [{"byteLength": len(self.binary)}], **changes}
        text = json.dumps(document).encode()
        text += b" " * (-len(text) % 4)
        parts = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(self.binary), 0x004E4942)
        return struct.pack("<4sII", b"glTF", 2, 12 + len(parts) + len(self.binary)) + parts + self.binary


def drawn(indices: list[int], mode: int) -> list[tuple[int, ...]]:
    """The triangles of the indices, by the words of glTF's specification."""
    if mode == 4:
        return [tuple(indices[k : k + 3]) for k in range(0, len(indices) - len(indices) % 3, 3)]
    if mode == 6:
        return [(indices[0], indices[k + 1], indices[k + 2]) for k in range(len(indices) - 2)]
    return [(indices[k], indices[k + 1 + k % 2], indices[k + 2 - k % 2]) for k in range(len(indices) - 2)]


@st.composite
def glb_files(draw: st.DrawFn) -> MeshFile:
    maker = GlbMaker()
    textured = draw(st.booleans())
    positions, triangles, uv = list[np.ndarray](), list[tuple[int, ...]](), list[np.ndarray]()
    nodes: list[dict[str, Any]] = []
    for mesh in range(draw(st.integers(1, 3))):
        node = draw(st.sampled_from(EXACT))
        primitives = []
        for _ in range(draw(st.integers(1, 2))):
            component = draw(st.sampled_from(sorted(POSITIONS)))
            code, one = POSITIONS[component]
            normalized = code != "f" and draw(st.booleans())
            low = -one if code in "bh" else 0
            number = st.integers(low, one) if code != "f" else st.integers(-64, 64).map(float)
            more = draw(st.lists(st.tuples(number, number, number), max_size=5))
            points = [(0, 0, 0), (one, 0, 0), (0, one, 0), *more]
            indices = [0, 1, 2, *draw(st.lists(st.integers(0, len(points) - 1), max_size=9))]
            mode = draw(st.sampled_from(sorted(MODES)))
            width = draw(st.sampled_from([5121, 5123, 5125]))
            attributes = {
                "POSITION": maker.accessor(points, component, "VEC3", draw(st.sampled_from([0, 4])), normalized)
            }
            primitive: dict[str, Any] = {"attributes": attributes, "mode": mode}
            if draw(st.booleans()):
                primitive["indices"] = maker.accessor(indices, width, "SCALAR")
            else:
                indices = list(range(len(points)))
            if textured:
                coordinates_ = [(k, 255 - k) for k in range(len(points))]
                attributes["TEXCOORD_0"] = maker.accessor(coordinates_, 5121, "VEC2", normalized=True)
            values = np.array(points, np.float64) / (one if normalized else 1)
            faces = drawn(indices, mode)
            mirrored = node.get("scale") == [-1, 1, 1]
            first = sum(map(len, positions))
            positions.append(moved(values, node).astype(np.float32))
            if textured:
                uv += [np.array(coordinates_)[list(face)][:: -1 if mirrored else 1] / 255 for face in faces]
            triangles += [tuple(first + corner for corner in (face[::-1] if mirrored else face)) for face in faces]
            primitives.append(primitive)
        maker.document["meshes"].append({"primitives": primitives})
        nodes.append({"mesh": mesh, **node})
    nodes.append({"mesh": 0, "translation": [99, 99, 99]})  # in another scene
    scenes = [{"nodes": [len(nodes) - 1]}, {"nodes": list(range(len(nodes) - 1))}]
    data = maker.glb(nodes=nodes, scenes=scenes, scene=1, extensionsRequired=["KHR_mesh_quantization"])
    return MeshFile("m.glb", data, np.concatenate(positions), triangles, np.array(uv) if textured else None)


def moved(values: np.ndarray, node: dict[str, Any]) -> np.ndarray:
    if "matrix" in node:
        matrix = np.array(node["matrix"], np.float64).reshape(4, 4).T
        return values @ matrix[:3, :3].T + matrix[:3, 3]
    return values * np.array(node.get("scale", [1, 1, 1])) + np.array(node.get("translation", [0, 0, 0]))


mesh_files = ply_files() | obj_files() | glb_files()


@st.composite
def damaged(draw: st.DrawFn) -> MeshFile:
    """A file of which bytes or whole numbers were changed, or the end is missing; what it holds is not known."""
    file = draw(mesh_files)
    data = bytearray(file.data)
    for _ in range(draw(st.integers(0, 3))):
        data[draw(st.integers(0, len(data) - 1))] = draw(st.sampled_from(b"0123456789-. \n\\/xfv\x00\x03\x80\xff"))
    digits = [at for at in range(len(data)) if chr(data[at]) in "123456789"]
    for _ in range(draw(st.integers(0, 2)) if digits else 0):
        at = draw(st.sampled_from(digits))  # counts that lie, indices out of range, numbers that are none
        data[at : at + 1] = draw(st.sampled_from([b"0", b"9", b"99", b"-1", b"nan", b"1e60", b"1_0", b"4294967295"]))
    return MeshFile(file.name, bytes(data[: draw(st.integers(1, len(data)) | st.just(len(data)))]), file.positions, [])

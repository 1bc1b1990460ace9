"""Mesh files: values of hand-written files, trimesh as an independent twin, and what is refused."""

from __future__ import annotations

import base64
import io
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from advtex_engine.core.scene import Mesh
from advtex_engine.mesh.read import NUMPY, to_mesh
from advtex_scan.archive import open_scan
from advtex_scan.errors import ArchiveError, MeshError
from advtex_scan.mesh import read_mesh

CUBE_QUADS = "4 0 3 2 1\n4 4 5 6 7\n4 0 1 5 4\n4 1 2 6 5\n4 2 3 7 6\n4 3 0 4 7\n"
CUBE_CORNERS = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]


def load(folder: Path, name: str, data: bytes | str) -> Mesh:
    (folder / name).write_bytes(data.encode() if isinstance(data, str) else data)
    with open_scan(folder) as archive:
        return to_mesh(read_mesh(archive, name, NUMPY))


def corners(mesh: Mesh) -> np.ndarray:
    return mesh.v_pos[mesh.t_pos_idx].numpy()


def uv_corners(mesh: Mesh) -> np.ndarray:
    assert mesh.v_uv is not None
    assert mesh.t_uv_idx is not None
    return mesh.v_uv[mesh.t_uv_idx].numpy()


def ascii_ply(vertices: list[Any], faces: str, properties: str = "x y z") -> str:
    header = ["ply", "format ascii 1.0", "comment hand-written", f"element vertex {len(vertices)}"]
    header += [f"property float {name}" for name in properties.split()]
    header += [f"element face {len(faces.splitlines())}", "property list uchar int vertex_indices", "end_header"]
    return "\n".join(header + [" ".join(map(str, vertex)) for vertex in vertices]) + "\n" + faces


def binary_ply(order: str, vertices: np.ndarray, faces: list[list[int]], texcoord: list[list[float]] | None) -> bytes:
    name = {"<": "little", ">": "big"}[order]
    header = f"ply\nformat binary_{name}_endian 1.0\nelement vertex {len(vertices)}\n"
    header += "property double x\nproperty uchar tag\nproperty double y\nproperty double z\n"
    header += f"element face {len(faces)}\nproperty list uchar uint vertex_index\n"
    header += "property list uchar float texcoord\n" if texcoord is not None else ""
    body = b"".join(struct.pack(order + "dBdd", x, 7, y, z) for x, y, z in vertices)
    for index, face in enumerate(faces):
        body += struct.pack(f"{order}B{len(face)}I", len(face), *face)
        if texcoord is not None:
            body += struct.pack(f"{order}B{len(texcoord[index])}f", len(texcoord[index]), *texcoord[index])
    return (header + "end_header\n").encode() + body


def glb(document: dict[str, Any], binary: bytes) -> bytes:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(binary), 0x004E4942) + binary
    return struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks


def triangle_document(**extra: Any) -> tuple[dict[str, Any], bytes]:
    """One triangle with uv, drawn by node 0."""
    position = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0)], "<f4").tobytes()
    uv = np.array([(0.1, 0.2), (0.9, 0.2), (0.1, 0.7)], "<f4").tobytes()
    index = np.array([0, 1, 2], "<u2").tobytes()
    document: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": len(position + uv + index)}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": 36},
            {"buffer": 0, "byteOffset": 36, "byteLength": 24},
            {"buffer": 0, "byteOffset": 60, "byteLength": 6},
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5126, "count": 3, "type": "VEC2"},
            {"bufferView": 2, "componentType": 5123, "count": 3, "type": "SCALAR"},
        ],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2}]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
        "scene": 0,
    }
    return document | extra, position + uv + index


def test_ascii_ply_quads_become_fans_in_file_order(tmp_path: Path) -> None:
    mesh = load(tmp_path, "mesh.ply", ascii_ply(CUBE_CORNERS, CUBE_QUADS))
    assert mesh.t_pos_idx[:3].tolist() == [[0, 3, 2], [0, 2, 1], [4, 5, 6]]
    assert len(mesh.t_pos_idx) == 12
    assert mesh.v_uv is None


@pytest.mark.parametrize("order", ["<", ">"])
def test_binary_ply_mixes_polygons_and_keeps_corner_uv(tmp_path: Path, order: str) -> None:
    vertices = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (2, 0, 0.5)])
    texcoord = [[0, 0, 0.5, 0, 0.5, 1, 0, 1], [0.5, 0.25, 1, 0, 0.75, 1]]
    mesh = load(tmp_path, "mesh.ply", binary_ply(order, vertices, [[0, 1, 2, 3], [1, 4, 2]], texcoord))
    assert mesh.t_pos_idx.tolist() == [[0, 1, 2], [0, 2, 3], [1, 4, 2]]
    # PLY counts v upwards.
    assert uv_corners(mesh)[0].tolist() == [[0, 1], [0.5, 1], [0.5, 0]]
    assert uv_corners(mesh)[2].tolist() == [[0.5, 0.75], [1, 1], [0.75, 0]]
    assert mesh.v_pos.numpy() == pytest.approx(vertices)


@pytest.mark.parametrize("names", ["s t", "u v", "texture_u texture_v"])
def test_ply_vertex_uv(tmp_path: Path, names: str) -> None:
    vertices = [(0, 0, 0, 0, 0.25), (1, 0, 0, 1, 0.25), (0, 1, 0, 0, 1)]
    mesh = load(tmp_path, "mesh.ply", ascii_ply(vertices, "3 0 1 2\n", f"x y z {names}"))
    assert uv_corners(mesh)[0].tolist() == [[0, 0.75], [1, 0.75], [0, 0]]


def test_obj_uv_seams_relative_indices_and_quads(tmp_path: Path) -> None:
    text = (
        "mtllib none.mtl\nv 0 0 0\nv 1 0 0 0.5 0.5 0.5\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
        "vn 0 0 1\nusemtl a\nf 1/1/1 2/2/1 3/3/1 4/4/1\nv 0 0 1\nvt 0.5 0.75\nusemtl b\nf -5/-5 -4/3 \\\n -1/-1\n"
    )
    mesh = load(tmp_path, "mesh.obj", text)
    assert mesh.t_pos_idx.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 4]]
    assert len(mesh.v_pos) == 5
    assert uv_corners(mesh)[0].tolist() == [[0, 1], [1, 1], [1, 0]]
    assert uv_corners(mesh)[2].tolist() == [[0, 1], [1, 0], [0.5, 0.25]]  # vertex 1 has another uv here: a seam


def test_obj_with_some_uv_missing_has_none(tmp_path: Path) -> None:
    mesh = load(tmp_path, "mesh.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 3/1\nf 1//1 3 2\n")
    assert mesh.v_uv is None
    assert len(mesh.t_pos_idx) == 2


def test_one_image_is_addressed_alike_by_obj_ply_and_glb(tmp_path: Path) -> None:
    """The same corner points at the same texel whatever file it came from: OBJ and PLY count v upwards, glTF down."""
    obj = load(tmp_path, "a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt .1 .8\nvt .9 .8\nvt .1 .3\nf 1/1 2/2 3/3\n")
    ply = load(
        tmp_path,
        "a.ply",
        ascii_ply([(0, 0, 0, 0.1, 0.8), (1, 0, 0, 0.9, 0.8), (0, 1, 0, 0.1, 0.3)], "3 0 1 2\n", "x y z s t"),
    )
    gltf = load(tmp_path, "a.glb", glb(*triangle_document()))
    for mesh in (obj, ply, gltf):
        assert uv_corners(mesh)[0] == pytest.approx(np.array([(0.1, 0.2), (0.9, 0.2), (0.1, 0.7)]))
        assert corners(mesh) == pytest.approx(corners(gltf))


def test_glb_node_transforms_are_applied_and_instances_flattened(tmp_path: Path) -> None:
    half = float(np.sqrt(0.5))
    nodes = [
        {"translation": [10, 0, 0], "children": [1, 2]},
        {"mesh": 0, "rotation": [0, 0, half, half], "scale": [2, 3, 1]},  # x -> y, y -> -x
        {"mesh": 0, "matrix": [-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 5, 1]},  # mirrored, 5 up
    ]
    mesh = load(tmp_path, "mesh.glb", glb(*triangle_document(nodes=nodes)))
    assert corners(mesh)[0] == pytest.approx(np.array([(10, 0, 0), (10, 2, 0), (7, 0, 0)]), abs=1e-6)
    # A mirroring node turns the winding round, so that the outside stays outside.
    assert corners(mesh)[1] == pytest.approx(np.array([(10, 1, 5), (9, 0, 5), (10, 0, 5)]), abs=1e-6)
    assert uv_corners(mesh)[1] == pytest.approx(np.array([(0.1, 0.7), (0.9, 0.2), (0.1, 0.2)]))


@pytest.mark.parametrize(
    ("mode", "expected"),
    [(5, [[0, 1, 2], [1, 3, 2], [2, 3, 4]]), (6, [[0, 1, 2], [0, 2, 3], [0, 3, 4]]), (4, [[0, 1, 2]])],
)
def test_gltf_strips_fans_and_lists_without_indices(tmp_path: Path, mode: int, expected: list[list[int]]) -> None:
    document, _ = triangle_document()
    points = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0), (0, 2, 1)], "<f4")
    document["buffers"] = [{"byteLength": 60, "uri": "data:;base64," + base64.b64encode(points.tobytes()).decode()}]
    document["bufferViews"] = [{"buffer": 0, "byteLength": 60}]
    document["accessors"] = [{"bufferView": 0, "componentType": 5126, "count": 5, "type": "VEC3"}]
    document["meshes"] = [{"primitives": [{"attributes": {"POSITION": 0}, "mode": mode}]}]
    mesh = load(tmp_path, "mesh.gltf", json.dumps(document))
    assert mesh.t_pos_idx.tolist() == expected


def test_gltf_reads_buffers_beside_it_with_stride_and_normalized_uv(tmp_path: Path) -> None:
    rows = b"".join(
        struct.pack("<3f2Hxxxx", x, y, 0, round(65535 * u), round(65535 * v))
        for (x, y, u, v) in [(0, 0, 0.1, 0.2), (1, 0, 0.9, 0.2), (0, 1, 0.1, 0.7)]
    )
    document, _ = triangle_document()
    document["buffers"] = [{"byteLength": len(rows), "uri": "parts/a%20b.bin"}]
    document["bufferViews"] = [{"buffer": 0, "byteLength": len(rows), "byteStride": 20}]
    document["accessors"] = [
        {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
        {"bufferView": 0, "byteOffset": 12, "componentType": 5123, "normalized": True, "count": 3, "type": "VEC2"},
    ]
    document["meshes"] = [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}}]}]
    (tmp_path / "models" / "parts").mkdir(parents=True)
    (tmp_path / "models" / "parts" / "a b.bin").write_bytes(rows)
    (tmp_path / "other.txt").write_text("keeps the folder `models` from being taken for the scan's top")
    mesh = load(tmp_path, "models/mesh.gltf", json.dumps(document))
    assert uv_corners(mesh)[0] == pytest.approx(np.array([(0.1, 0.2), (0.9, 0.2), (0.1, 0.7)]), abs=1e-5)


@pytest.mark.parametrize("kind", ["ply", "obj", "glb"])
def test_agrees_with_trimesh(tmp_path: Path, kind: str) -> None:
    sphere = trimesh.creation.icosphere(subdivisions=2)
    data = sphere.export(file_type=kind)
    mesh = load(tmp_path, f"mesh.{kind}", data)
    twin = trimesh.load_mesh(io.BytesIO(data if isinstance(data, bytes) else data.encode()), file_type=kind)
    assert corners(mesh) == pytest.approx(twin.vertices[twin.faces], abs=1e-6)


def bad_documents() -> dict[str, tuple[dict[str, Any], str]]:
    loop = triangle_document(nodes=[{"mesh": 0, "children": [0]}])[0]
    draco = triangle_document(extensionsRequired=["KHR_draco_mesh_compression"])[0]
    long_accessor = triangle_document()[0]
    long_accessor["accessors"][0]["count"] = 10**12
    negative = triangle_document()[0]
    negative["bufferViews"][0]["byteOffset"] = -4
    index = triangle_document()[0]
    index["accessors"][0]["count"] = 2
    return {
        "loop": (loop, "contain themselves"),
        "draco": (draco, "is compressed with KHR_draco_mesh_compression, which is not read"),
        "long accessor": (long_accessor, "more than its buffer holds"),
        "negative offset": (negative, "a negative or fractional size"),
        "index": (index, "a face names vertex 2, but there are 2"),
        "no nodes drawn": (triangle_document(nodes=[{"name": "camera"}])[0], "has no faces"),
        "nonsense": ({"meshes": 3, "nodes": {"a": 1}}, "do not fit together"),
    }


@pytest.mark.parametrize("case", bad_documents())
def test_bad_glb_is_refused(tmp_path: Path, case: str) -> None:
    document, message = bad_documents()[case]
    with pytest.raises(MeshError, match=message) as caught:
        load(tmp_path, "mesh.glb", glb(document, triangle_document()[1]))
    assert caught.value.findings[0].where == "mesh.glb"
    assert caught.value.findings[0].remedy


TRIANGLE = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("m.ply", ascii_ply(TRIANGLE, ""), "has no faces"),
        ("m.ply", ascii_ply(TRIANGLE, "2 0 1\n"), "has no faces"),
        ("m.ply", ascii_ply(TRIANGLE, "3 0 1 3\n"), "a face names vertex 3, but there are 3"),
        ("m.ply", ascii_ply(TRIANGLE, "3 0 1 -1\n"), "a face names vertex -1"),
        ("m.ply", ascii_ply([("nan", 0, 0), *TRIANGLE[1:]], "3 0 1 2\n"), "NaN or infinite"),
        ("m.ply", ascii_ply([("1e60", 0, 0), *TRIANGLE[1:]], "3 0 1 2\n"), "NaN or infinite"),
        ("m.ply", ascii_ply(TRIANGLE, "3 0 1\n"), "face data are cut off or damaged"),
        ("m.ply", ascii_ply(TRIANGLE, "3 0 1 x\n"), "face data are cut off or damaged"),
        (
            "m.ply",
            ascii_ply(TRIANGLE, "3 0 1 2\n").replace("vertex 3", "vertex 99999999999"),
            "at most 10000000 of each",
        ),
        (
            "m.ply",
            ascii_ply(TRIANGLE, "3 0 1 2\n").replace("float x", "float17 x"),
            "header has a line that is not understood",
        ),
        ("m.ply", ascii_ply(TRIANGLE, "3 0 1 2\n", "x y w"), "vertices have no x, y and z"),
        ("m.ply", binary_ply("<", np.eye(3), [[0, 1, 2]], None)[:-3], "face data are cut off"),
        ("m.ply", ascii_ply(TRIANGLE, "3 0 1 2\n", "x y z z"), "names a property of 'vertex' twice"),
        ("m.ply", ascii_ply(TRIANGLE, "3 0 1 2\n").replace("list uchar int", "int"), "no list of vertex_indices"),
        ("m.ply", ascii_ply(TRIANGLE, "3 0 1 2\n").replace("float x", "list uchar float x"), "no x, y and z"),
        ("m.ply", b"solid mesh", "is no PLY file"),
        ("m.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n", "has no faces"),
        ("m.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", "a face names vertex 3, but there are 3"),
        ("m.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n", "a face names vertex -1"),
        ("m.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -4 1 2\n", "a face names vertex -1"),
        ("m.obj", "v 0 0\n", "line 1 is not understood"),
        (
            "m.obj",
            "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1/1 2/2 3/1\n",
            "a face names texture coordinate 1, but there are 1",
        ),
        ("m.glb", b"glTF\x02", "is cut off"),
        ("m.gltf", b"[]", "do not fit together"),
        ("m.stl", b"solid", "of no known kind"),
    ],
)
def test_bad_files_are_refused_with_file_and_remedy(tmp_path: Path, name: str, data: bytes | str, message: str) -> None:
    with pytest.raises(MeshError, match=message) as caught:
        load(tmp_path, name, data)
    assert caught.value.findings[0].where == name
    assert caught.value.findings[0].remedy


def test_gltf_cannot_reach_outside_of_the_scan(tmp_path: Path) -> None:
    (tmp_path / "secret.bin").write_bytes(triangle_document()[1])
    (tmp_path / "scan").mkdir()
    document = triangle_document()[0]
    document["buffers"][0]["uri"] = "../secret.bin"
    with pytest.raises(MeshError, match=r"secret\.bin.*not in the scan"):
        load(tmp_path / "scan", "mesh.gltf", json.dumps(document))


@given(st.lists(st.integers(3, 6), min_size=1, max_size=8), st.integers(0, 2**31))
@settings(max_examples=50, deadline=None)
def test_triangulation_keeps_each_polygons_area(
    tmp_path_factory: pytest.TempPathFactory, sizes: list[int], seed: int
) -> None:
    """Regular polygons: the fan's triangles sum to the closed form n/2 sin(2 pi / n), in file order."""
    rng = np.random.default_rng(seed)
    angles = [np.arange(n) * 2 * np.pi / n for n in sizes]
    position = np.concatenate([np.stack([np.cos(a), np.sin(a), np.full(len(a), z)], 1) for z, a in enumerate(angles)])
    order = rng.permutation(len(position))  # vertices may lie anywhere in the file
    faces = [face.tolist() for face in np.split(np.argsort(order), np.cumsum(sizes)[:-1])]
    mesh = load(tmp_path_factory.mktemp("fans"), "m.ply", binary_ply("<", position[order], faces, None))
    a, b, c = mesh.v_pos[mesh.t_pos_idx].double().numpy().transpose(1, 0, 2)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    owner = np.repeat(np.arange(len(sizes)), np.array(sizes) - 2)
    expected = [n / 2 * np.sin(2 * np.pi / n) for n in sizes]
    assert np.bincount(owner, area) == pytest.approx(np.array(expected), rel=1e-5)
    assert a[:, 2].tolist() == owner.tolist()


def test_too_many_faces_are_refused_before_they_are_made(tmp_path: Path) -> None:
    """One polygon, whose fan would have a triangle too many."""
    header = ascii_ply(TRIANGLE, "").replace("ascii", "binary_little_endian").replace("face 0", "face 1")
    header = header[: header.index("end_header")].replace("list uchar int", "list uint uchar") + "end_header\n"
    body = np.array(TRIANGLE, "<f4").tobytes() + struct.pack("<I", 10_000_003) + bytes(10_000_003)
    with pytest.raises(MeshError, match="10000001 faces; at most 10000000"):
        load(tmp_path, "m.ply", header.encode() + body)


@given(st.data())
@settings(max_examples=150, deadline=None)
def test_damaged_files_give_a_mesh_or_one_clear_error(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    name, sound = data.draw(
        st.sampled_from(
            [
                ("m.ply", ascii_ply(TRIANGLE, "3 0 1 2\n").encode()),
                ("m.ply", binary_ply("<", np.eye(3), [[0, 1, 2], [2, 1, 0]], [[0.0] * 6, [1.0] * 6])),
                ("m.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 3/1\n"),
                ("m.glb", glb(*triangle_document())),
            ]
        )
    )
    damaged = bytearray(sound)
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    damaged = damaged[: data.draw(st.integers(0, len(damaged)))]
    folder = tmp_path_factory.mktemp("damaged")
    try:
        mesh = load(folder, name, bytes(damaged))
    except (MeshError, ArchiveError):
        return
    assert len(mesh.t_pos_idx)
    assert int(mesh.t_pos_idx.max()) < len(mesh.v_pos)

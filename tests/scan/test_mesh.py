"""Mesh files, against trimesh and against what was written."""

from __future__ import annotations

import base64
import json
import struct
import time

import numpy as np
import pytest
import trimesh

from advtex_scan import MeshError, open_scan
from advtex_scan.mesh import read_mesh


def read(tmp_path, name, content, **others):
    for other, data in {name: content, **others}.items():
        (tmp_path / other).write_bytes(data)
    with open_scan(tmp_path) as archive:
        return read_mesh(archive, name)


def arrays(mesh):
    return np.array(mesh.positions).reshape(-1, 3), np.array(mesh.triangles).reshape(-1, 3)


@pytest.fixture(scope="module")
def sphere():
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.7)
    mesh.apply_translation([1.0, -2.0, 3.0])
    return mesh


@pytest.mark.parametrize("kind", ["ply", "ply-ascii", "obj", "glb", "gltf"])
def test_files_that_trimesh_wrote(tmp_path, sphere, kind):
    others = {}
    if kind == "ply-ascii":
        content = sphere.export(file_type="ply", encoding="ascii")
    elif kind == "gltf":
        files = sphere.export(file_type="gltf")
        content = files.pop("model.gltf")
        others = files
    else:
        content = sphere.export(file_type=kind)
    content = content.encode() if isinstance(content, str) else content
    mesh = read(tmp_path, f"mesh.{kind.partition('-')[0]}", content, **others)
    positions, triangles = arrays(mesh)
    assert mesh.facts.vertices == len(sphere.vertices)
    np.testing.assert_allclose(positions[triangles], sphere.vertices[sphere.faces], atol=1e-5)
    np.testing.assert_allclose(mesh.facts.bounds, sphere.bounds, atol=1e-5)
    assert not mesh.facts.has_uv
    assert sorted(mesh.files) == sorted(others)


@pytest.mark.parametrize("order", ["<", ">", ""])
@pytest.mark.parametrize("index", ["int", "uint", "ushort", "uchar"])
def test_ply_of_polygons(tmp_path, make, order, index):
    mesh = read(tmp_path, "mesh.ply", make.ply(faces=make.quads, order=order, index=index))
    positions, triangles = arrays(mesh)
    np.testing.assert_array_equal(positions, np.array(make.corners, np.float32))
    np.testing.assert_array_equal(triangles, make.triangles)


@pytest.mark.parametrize("order", ["<", ">"])
def test_ply_of_triangles_with_a_quad_behind_the_first_block(tmp_path, make, order):
    faces = make.triangles * 3000 + [make.quads[0]]
    _, triangles = arrays(read(tmp_path, "mesh.ply", make.ply(faces=faces, order=order)))
    expected = make.triangles * 3000 + [(0, 1, 3), (0, 3, 2)]
    np.testing.assert_array_equal(triangles, expected)


@pytest.mark.parametrize("order", ["<", ">", ""])
def test_ply_with_other_elements_and_properties(tmp_path, order):
    name = {"<": "binary_little_endian", ">": "binary_big_endian", "": "ascii"}[order]
    header = (
        f"ply\nformat {name} 1.0\nelement camera 2\nproperty list uchar float view\nproperty uchar on\n"
        "element vertex 3\nproperty uchar red\nproperty double z\nproperty float x\nproperty float y\n"
        "property float s\nproperty float t\nelement face 1\nproperty uchar flags\n"
        "property list uchar int vertex_index\nelement edge 1\nproperty int a\nend_header\n"
    ).encode()
    if order == "":
        body = b"2 0.5 0.5 1\n0 1\n255 3 1 2 0 0\n255 6 4 5 0 1\n255 9 7 9 1 1\n7 3 0 1 2\n1\n"
    else:
        body = struct.pack(f"{order}B2fB", 2, 0.5, 0.5, 1) + struct.pack(f"{order}BB", 0, 1)
        for z, x, y, s, t in [(3, 1, 2, 0, 0), (6, 4, 5, 0, 1), (9, 7, 9, 1, 1)]:
            body += struct.pack(f"{order}Bd4f", 255, z, x, y, s, t)
        body += struct.pack(f"{order}BB3ii", 7, 3, 0, 1, 2, 1)
    mesh = read(tmp_path, "mesh.ply", header + body)
    assert mesh.facts.has_uv
    np.testing.assert_array_equal(arrays(mesh)[0], [(1, 2, 3), (4, 5, 6), (7, 9, 9)])


def test_obj_dialects(tmp_path):
    text = b"""# a comment
mtllib a.mtl
v 0 0 0 1.0 0.5 0.5
v 1 0 0
v 1 1 0
v 0 1 0
vt 0 0
vn 0 0 1
f 1/1/1 2/1/1 3/1/1 4/1/1
o second
f -4//1 -3//1 -1//1
"""
    mesh = read(tmp_path, "mesh.obj", text)
    np.testing.assert_array_equal(arrays(mesh)[1], [(0, 1, 2), (0, 2, 3), (0, 1, 3)])
    assert not mesh.facts.has_uv, "some corners have none"
    assert read(tmp_path, "mesh.obj", text.replace(b"//1", b"/1")).facts.has_uv
    assert not read(tmp_path, "mesh.obj", text.replace(b"/1/1", b"//1")).facts.has_uv


def gltf(positions, indices, **changes) -> dict:
    data = np.array(positions, "<f4").tobytes() + np.array(indices, "<u2").tobytes()
    uri = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
    document = {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": len(data), "uri": uri}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": 12 * len(positions)},
            {"buffer": 0, "byteOffset": 12 * len(positions), "byteLength": 2 * len(indices)},
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": len(positions), "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": len(indices), "type": "SCALAR"},
            {"bufferView": 0, "componentType": 5126, "count": len(positions), "type": "VEC2"},
        ],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 2}, "indices": 1}]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
        "scene": 0,
    }
    return {**document, **changes}


CORNER = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]
SIDES = [0, 1, 2, 0, 2, 3]


def test_gltf_applies_node_transforms_as_trimesh_does(tmp_path):
    nodes = [
        {"children": [1, 2], "translation": [1, 2, 3], "rotation": [0.5, 0.5, -0.5, 0.5], "scale": [1, 2, 3]},
        {"mesh": 0, "matrix": [0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 1, 0, 5, 6, 7, 1]},
        {"mesh": 0},
        {"mesh": 0, "translation": [100, 0, 0]},
    ]
    content = json.dumps(gltf(CORNER, SIDES, nodes=nodes)).encode()
    mesh = read(tmp_path, "mesh.gltf", content)
    assert mesh.facts.has_uv
    assert mesh.facts.faces == 4, "the node outside the scene is not drawn"
    expected = trimesh.load_scene(tmp_path / "mesh.gltf").bounds
    np.testing.assert_allclose(mesh.facts.bounds, expected, atol=1e-5)


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({"extensionsRequired": ["KHR_draco_mesh_compression"]}, "mesh_compressed"),
        ({"accessors": [{"bufferView": 0, "componentType": 5126, "count": 10**12, "type": "VEC3"}]}, "mesh_truncated"),
        ({"accessors": [{"bufferView": 0, "componentType": 5126, "count": -1, "type": "VEC3"}]}, "bad_mesh"),
        ({"nodes": [{"mesh": 0, "children": [0]}]}, "bad_mesh"),
        ({"nodes": [{"mesh": 9}]}, "bad_mesh"),
        ({"nodes": [{"mesh": -1}]}, "bad_mesh"),
        ({"nodes": 7}, "bad_mesh"),
        ({"buffers": [{"byteLength": 4, "uri": "../../etc/passwd"}]}, "missing_file"),
        ({"buffers": [{"byteLength": 4, "uri": "data:,???"}]}, "bad_mesh"),
        ({"buffers": [{"byteLength": 4}]}, "mesh_truncated"),
        ({"meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "mode": 1}]}]}, "mesh_no_faces"),
        ({"meshes": [{"primitives": []}]}, "mesh_no_faces"),
        ({"meshes": [{"primitives": [{"attributes": {}}] * 100_001}]}, "bad_mesh"),
    ],
)
def test_gltf_that_is_refused(tmp_path, changes, code):
    with pytest.raises(MeshError) as caught:
        read(tmp_path, "mesh.gltf", json.dumps(gltf(CORNER, SIDES, **changes)).encode())
    assert [finding.code for finding in caught.value.findings] == [code]
    assert caught.value.findings[0].remedy


@pytest.mark.parametrize("suffix", ["ply", "obj", "gltf"])
@pytest.mark.parametrize(
    ("positions", "indices", "codes"),
    [
        (CORNER, [], {"mesh_no_faces"}),
        (CORNER, [0, 1, 4], {"mesh_index"}),
        ([(0, 0, float("nan")), *CORNER[1:]], SIDES, {"mesh_nan"}),
        ([(0, 0, float("inf")), *CORNER[1:]], SIDES, {"mesh_nan"}),
        (CORNER, [0, 1, 1, 2, 2, 2], {"mesh_zero_area"}),
        ([(0, 0, 0), (1, 1, 1), (2, 2, 2)], [0, 1, 2], {"mesh_zero_area"}),
    ],
)
def test_meshes_that_cannot_be_textured(tmp_path, make, suffix, positions, indices, codes):
    faces = [tuple(indices[i : i + 3]) for i in range(0, len(indices), 3)]
    if suffix == "ply":
        content = make.ply(positions, faces)
    elif suffix == "obj":
        lines = [f"v {x} {y} {z}" for x, y, z in positions] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces]
        content = "\n".join(lines).encode()
    else:
        content = json.dumps(gltf(positions, indices)).encode()
    with pytest.raises(MeshError) as caught:
        read(tmp_path, f"mesh.{suffix}", content)
    assert {finding.code for finding in caught.value.findings} == codes
    assert all(finding.where == f"mesh.{suffix}" and finding.remedy for finding in caught.value.findings)


def test_negative_and_zero_indices_are_out_of_range(tmp_path, make):
    with pytest.raises(MeshError, match="names vertex -1"):
        read(tmp_path, "mesh.ply", make.ply(faces=[(0, 1, -1)]))
    with pytest.raises(MeshError, match="names vertex -"):
        read(tmp_path, "mesh.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n")
    with pytest.raises(MeshError, match="names vertex -"):
        read(tmp_path, "mesh.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf -9 1 2\n")


@pytest.mark.parametrize("order", ["<", ">", ""])
def test_ply_counts_beyond_the_file_are_refused_before_reading(tmp_path, make, order):
    whole = make.ply(order=order)
    for old, new, code in [
        (b"vertex 8", b"vertex 9000000", "mesh_truncated"),
        (b"vertex 8", b"vertex 99999999999", "mesh_too_large"),
        (b"face 12", b"face 9000000", "mesh_truncated"),
        (b"face 12", b"face 13", "mesh_truncated"),
        (b"vertex 8", b"vertex -8", "bad_mesh"),
        (b"element face", b"element empty 999999999999\nelement face", "bad_mesh"),
    ]:
        with pytest.raises(MeshError) as caught:
            read(tmp_path, "mesh.ply", whole.replace(old, new))
        assert [finding.code for finding in caught.value.findings] == [code], new
    with pytest.raises(MeshError) as caught:
        read(tmp_path, "mesh.ply", whole[:-2])
    assert caught.value.findings[0].code == "mesh_truncated"


@pytest.mark.parametrize("name", ["mesh.ply", "mesh.obj", "mesh.glb", "mesh.gltf", "mesh.stl"])
@pytest.mark.parametrize("content", [b"", b"garbage \x00\xff" * 50, b"ply\n" * 3, b"glTF" + bytes(30), b"[" * 100_000])
def test_garbage_is_a_mesh_error(tmp_path, name, content):
    with pytest.raises(MeshError):
        read(tmp_path, name, content)


def test_a_cut_glb_says_so(tmp_path, sphere):
    whole = sphere.export(file_type="glb")
    for length in (10, 100, len(whole) - 10):
        with pytest.raises(MeshError) as caught:
            read(tmp_path, "mesh.glb", whole[:length])
        assert caught.value.findings[0].code == "mesh_truncated"


@pytest.mark.slow
def test_a_large_ply_takes_about_a_second(tmp_path):
    rng = np.random.default_rng(0)
    vertices, faces = 150_000, 300_000
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {vertices}\nproperty float x\nproperty float y\n"
    head += f"property float z\nelement face {faces}\nproperty list uchar int vertex_indices\nend_header\n"
    rows = np.empty(faces, [("n", "u1"), ("index", "<i4", 3)])
    rows["n"], rows["index"] = 3, rng.integers(0, vertices, (faces, 3))
    content = head.encode() + rng.random((vertices, 3), np.float32).tobytes() + rows.tobytes()
    start = time.process_time()
    mesh = read(tmp_path, "mesh.ply", content)
    assert time.process_time() - start < 3  # 0.4 s on a free core
    assert (mesh.facts.vertices, mesh.facts.faces) == (vertices, faces)

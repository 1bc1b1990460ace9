"""The check and the engine read the same mesh files: one grammar, with the standard library's arithmetic or numpy's."""

from __future__ import annotations

import io
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from mesh_files import GlbMaker, MeshFile, damaged, mesh_files

from advtex_engine.mesh.read import NUMPY, to_mesh
from advtex_scan.errors import Finding, MeshError
from advtex_scan.mesh import PLAIN, Arithmetic, MeshSource, MeshSurface, parse_mesh

RELAXED = settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.too_slow])


def no_files(name: str, limit: int) -> bytes:
    raise MeshError(Finding("error", "missing_file", name, "is not there"))


def parse(file: MeshFile, arithmetic: Arithmetic) -> MeshSurface:
    return parse_mesh(MeshSource(file.name, io.BytesIO(file.data), len(file.data), no_files), arithmetic)


def arrays(surface: MeshSurface) -> tuple[np.ndarray, np.ndarray]:
    return np.array(surface.positions).reshape(-1, 3), np.array(surface.triangles).reshape(-1, 3)


@RELAXED
@given(mesh_files)
def test_both_read_what_is_sound_and_find_what_was_written(file: MeshFile) -> None:
    for arithmetic in (PLAIN, NUMPY):
        surface = parse(file, arithmetic)
        positions, triangles = arrays(surface)
        assert (surface.positions.format, surface.triangles.format) == ("f", "q")
        np.testing.assert_array_equal(positions, file.positions)
        np.testing.assert_array_equal(triangles, np.array(file.triangles))
        assert surface.facts.has_uv == (file.uv is not None)
        assert (surface.facts.vertices, surface.facts.faces) == (len(positions), len(triangles))
        np.testing.assert_array_equal(surface.facts.bounds, [file.positions.min(0), file.positions.max(0)])


@RELAXED
@given(mesh_files)
def test_the_engines_mesh_is_the_checks_with_uv(file: MeshFile) -> None:
    surface = parse(file, NUMPY)
    mesh = to_mesh(surface)
    np.testing.assert_array_equal(mesh.v_pos.numpy(), file.positions)
    np.testing.assert_array_equal(mesh.t_pos_idx.numpy(), np.array(file.triangles))
    assert np.shares_memory(mesh.v_pos.numpy(), np.asarray(surface.positions))
    assert np.shares_memory(mesh.t_pos_idx.numpy(), np.asarray(surface.triangles))
    if file.uv is None:
        assert mesh.v_uv is None
        return
    assert mesh.v_uv is not None
    assert mesh.t_uv_idx is not None
    expected = file.uv if file.name == "m.glb" else file.uv * (1, -1) + (0, 1)
    np.testing.assert_array_equal(mesh.v_uv[mesh.t_uv_idx].numpy(), expected.astype(np.float32))


Outcome = tuple[tuple[Finding, ...], bytes, bytes, Any]


def outcome(file: MeshFile, arithmetic: Arithmetic) -> Outcome:
    """What is wrong with a file, or its arrays and facts."""
    try:
        surface = parse(file, arithmetic)
    except MeshError as error:
        return error.findings, b"", b"", None
    positions, triangles = arrays(surface)
    return (), (positions + 0.0).tobytes(), triangles.tobytes(), surface.facts  # -0.0 is 0.0


@settings(RELAXED, max_examples=600)
@given(damaged())
def test_of_a_damaged_file_both_say_the_same(file: MeshFile) -> None:
    assert outcome(file, NUMPY) == outcome(file, PLAIN)


def in_other_words(file: MeshFile) -> MeshFile:
    """The same file, so written that no lines are alike and all are read word by word."""
    data = file.data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if file.name == "m.obj":
        return replace(file, data=re.sub(rb"(?<!\\)\n", b"\n# \v\n", b"\n" + data))
    head, end, body = file.data.partition(b"end_header")
    if b"format ascii" not in head:
        return file
    first, rows = body.replace(b"\r\n", b"\n").split(b"\n", 1)
    return replace(file, data=head + end + first + b"\n" + rows.replace(b"\n", b" 7 x\n"))


@RELAXED
@given(mesh_files.filter(lambda file: file.name != "m.glb"))
def test_lines_that_are_alike_hold_what_they_hold_word_by_word(file: MeshFile) -> None:
    found, other = outcome(file, PLAIN), outcome(in_other_words(file), PLAIN)
    assert found == other
    assert found[0] == ()


@settings(RELAXED, max_examples=600)
@given(damaged().filter(lambda file: file.name == "m.obj"))
def test_damaged_lines_are_judged_as_they_are_word_by_word(file: MeshFile) -> None:
    """All but the line's number and the place that the message shows, which the other writing moves."""

    def verdict(file: MeshFile) -> Any:
        findings, *content = outcome(file, PLAIN)
        return [(one.code, one.message.partition(" is not understood")[0]) for one in findings], content

    found, other = verdict(file), verdict(in_other_words(file))
    assert found[1] == other[1]
    assert [code for code, _ in found[0]] == [code for code, _ in other[0]]


@pytest.mark.parametrize(
    "extension", ["KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression"]
)
def test_compressed_meshes_are_refused_with_one_sentence(extension: str) -> None:
    data = GlbMaker().glb(extensionsRequired=[extension])
    file = MeshFile("m.glb", data, np.empty(0), [])
    found = outcome(file, PLAIN)
    assert found == outcome(file, NUMPY)
    message = f"is compressed with {extension}, which is not read"
    remedy = "export it again without compression, or as PLY"
    assert found[0] == (Finding("error", "mesh_compressed", "m.glb", message, remedy),)


def test_turned_and_nested_nodes_agree_to_a_rounding_of_single_precision() -> None:
    rng = np.random.default_rng(0)
    maker = GlbMaker()
    points = rng.normal(size=(500, 3)).tolist()
    position = maker.accessor(points, 5126, "VEC3")
    maker.document["meshes"] = [{"primitives": [{"attributes": {"POSITION": position}}]}]
    nodes = [
        {"rotation": rng.normal(size=4).tolist(), "translation": [1, 2, 3], "children": [1, 2]},
        {"rotation": rng.normal(size=4).tolist(), "scale": [1.1, 0.9, -1.3], "mesh": 0},
        {"matrix": rng.normal(size=16).tolist(), "mesh": 0},
    ]
    file = MeshFile("m.glb", maker.glb(nodes=nodes, scenes=[{"nodes": [0]}]), np.empty(0), [])
    (plain, faces), (numpy, same) = arrays(parse(file, PLAIN)), arrays(parse(file, NUMPY))
    np.testing.assert_array_equal(faces, same)
    np.testing.assert_allclose(numpy, plain, rtol=2e-7, atol=1e-7)


BIG = 70_000  # faces: more than one block of a file of any kind


def big_files() -> dict[str, bytes]:
    rng = np.random.default_rng(1)
    vertices = rng.random((300, 3)).astype("<f4")
    faces = rng.integers(0, 300, (BIG, 3))
    rows = np.empty(BIG, [("n", "u1"), ("i", "<i4", 3)])
    rows["n"], rows["i"] = 3, faces
    header = (
        "ply\nformat {} 1.0\nelement vertex 300\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {BIG}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    points = "".join(f"{x!r} {y!r} {z!r}\n" for x, y, z in vertices.tolist())
    lines = "".join(f"3 {a} {b} {c}\n" for a, b, c in faces.tolist())
    obj = points.replace("\n", "\nv ").removesuffix("v ") + "".join(
        f"f {a} {b} {c}\n" for a, b, c in (faces + 1).tolist()
    )
    return {
        "binary.ply": header.format("binary_little_endian").encode() + vertices.tobytes() + rows.tobytes(),
        "ascii.ply": (header.format("ascii") + points + lines).encode(),
        "plain.obj": ("v " + obj).encode(),
        "crlf.obj": ("v " + obj).replace("\n", "\r\n").encode(),
        "mac.obj": ("v " + obj).replace("\n", "\r").encode(),
    }


@pytest.mark.parametrize("name", ["binary.ply", "ascii.ply", "plain.obj", "crlf.obj", "mac.obj"])
def test_files_of_many_blocks(name: str) -> None:
    file = MeshFile(name, big_files()[name], np.empty(0), [])
    rng = np.random.default_rng(1)
    vertices, faces = rng.random((300, 3)).astype("<f4"), rng.integers(0, 300, (BIG, 3))
    for arithmetic in (PLAIN, NUMPY):
        positions, triangles = arrays(parse(file, arithmetic))
        np.testing.assert_array_equal(positions, vertices)
        np.testing.assert_array_equal(triangles, faces)


def test_an_error_far_down_names_its_line() -> None:
    data = big_files()["plain.obj"]
    at = data.index(b"\nf ", 3 * len(data) // 4)
    line = data[: at + 1].count(b"\n") + 1
    broken = data[: at + 3] + b"x" + data[at + 3 :]
    for text in (broken, broken.replace(b"\n", b"\r\n"), b"f 1 2 \\\n3\n# \\\n\n" + broken):
        with pytest.raises(MeshError) as caught:
            parse(MeshFile("m.obj", text, np.empty(0), []), PLAIN)
        number = line + (4 if text.startswith(b"f 1 2") else 0)
        assert caught.value.findings[0].message.startswith(f"line {number} is not understood: 'f x")


@pytest.mark.parametrize("index", ["99999999999999999999", "-99999999999999999999", "1" * 5000])
def test_an_index_beyond_64_bits_is_not_understood(index: str) -> None:
    data = f"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nf 1 2 {index}\n".encode()
    for arithmetic in (PLAIN, NUMPY):
        with pytest.raises(MeshError, match=r"line 5 is not understood|a face names vertex -1"):
            parse(MeshFile("m.obj", data, np.empty(0), []), arithmetic)

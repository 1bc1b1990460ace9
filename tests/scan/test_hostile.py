"""Whatever bytes come in: findings or a ScanFormatError, never anything else, in bounded time and memory."""

from __future__ import annotations

import contextlib
import io
import json
import math
import struct
import tracemalloc
import zipfile
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from advtex_scan import ArchiveLimits, CheckReport, ScanFormatError, check_scan, open_scan
from advtex_scan.images import parse_image_header
from advtex_scan.matrices import compose, invert_rigid, matrix4, pose_problem
from advtex_scan.mesh import read_mesh

RELAXED = settings(
    max_examples=100, deadline=10_000, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)
MEMORY = 64 << 20  # bytes; the inputs here are below 100 kB


@contextlib.contextmanager
def bounded_memory():
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < MEMORY
    finally:
        tracemalloc.stop()


def check(path: Path) -> CheckReport:
    report = check_scan(path)
    json.dumps(report.to_dict(), allow_nan=False)
    report.format_text()
    return report


def edited(data: bytes, edits: list[tuple[int, int]], cut: int) -> bytes:
    """`data` with single bytes replaced, and cut short; positions wrap around."""
    changed = bytearray(data)
    for position, value in edits:
        changed[position % len(changed)] = value
    return bytes(changed[: len(changed) - cut % len(changed)])


edits = st.lists(st.tuples(st.integers(0, 1 << 20), st.integers(0, 255)), max_size=8)
cuts = st.one_of(st.just(0), st.integers(0, 1 << 16))
names = st.text(st.characters(codec="utf-8", exclude_characters="\0"), min_size=1, max_size=20) | st.sampled_from(
    ["../a", "/a", "a/../b", "a\\b", "C:/a", "a.zip", "scan.json", "color/0.jpg", "__MACOSX/x", "mesh.ply"]
)


@RELAXED
@given(st.binary(max_size=2000))
def test_garbage_as_a_zip(tmp_path, content):
    (tmp_path / "scan.zip").write_bytes(content)
    assert not check(tmp_path / "scan.zip").ok


@RELAXED
@given(edits, cuts)
def test_a_damaged_zip(maker, edits, cut):
    whole = maker.zip() if (maker.root / "whole").exists() else maker.native().zip()
    (maker.root / "whole").touch()
    path = maker.root / "damaged.zip"
    path.write_bytes(edited(whole.read_bytes(), edits, cut))
    with bounded_memory():
        check(path)


@RELAXED
@given(st.lists(st.tuples(names, st.binary(max_size=50)), max_size=6), st.sampled_from([0, 8, 12, 14]))
@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_zips_of_any_names(tmp_path, members, method):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for name, content in members:
            archive.writestr(name, content)
    path = tmp_path / "scan.zip"
    path.write_bytes(buffer.getvalue())
    with contextlib.suppress(ScanFormatError), open_scan(path, ArchiveLimits(entries=10)) as archive:
        for name in archive.names():
            assert not name.startswith("/")
            assert not {"..", ""} & set(name.split("/"))
            assert archive.read(name) in [content for _, content in members]
    check(path)


def test_directory_fields_of_any_value_never_pass_unnoticed(maker):
    """Every 2- and 4-byte field of the directory set to extremes, one at a time."""
    whole = maker.native(3).zip(method=zipfile.ZIP_STORED).read_bytes()
    path = maker.root / "s.zip"
    start = whole.index(b"PK\x01\x02")
    for at in [*range(start, start + 46, 2), *range(len(whole) - 22, len(whole), 2)]:
        for value in (b"\xff\xff\xff\xff", b"\0\0\0\0", b"\xff\xff\xff\x7f"):
            path.write_bytes(whole[:at] + value + whole[at + 4 :])
            check(path)


@RELAXED
@given(st.sampled_from(["ply", "obj", "glb", "gltf"]), st.binary(max_size=3000))
def test_garbage_as_a_mesh(tmp_path, suffix, content):
    head = {"ply": b"ply\n", "obj": b"v 0 0 0\n", "glb": b"glTF\x02\0\0\0", "gltf": b"{"}[suffix]
    for data in (content, head + content):
        (tmp_path / f"mesh.{suffix}").write_bytes(data)
        with open_scan(tmp_path) as archive, bounded_memory(), contextlib.suppress(ScanFormatError):
            read_mesh(archive, f"mesh.{suffix}")
        (tmp_path / f"mesh.{suffix}").unlink()


@RELAXED
@given(st.sampled_from(["<", ">", ""]), edits, cuts)
def test_a_damaged_ply(tmp_path, make, order, edits, cut):
    (tmp_path / "mesh.ply").write_bytes(edited(make.ply(order=order), edits, cut))
    with open_scan(tmp_path) as archive, bounded_memory(), contextlib.suppress(ScanFormatError):
        mesh = read_mesh(archive, "mesh.ply")
        assert 0 <= min(mesh.triangles) <= max(mesh.triangles) < mesh.facts.vertices
        assert all(map(math.isfinite, mesh.positions))


WORDS = """ply format ascii binary_little_endian 1.0 element vertex face 3 999999999 property list uchar int float x y z
vertex_indices end_header comment 0 1 2 -1 nan v vt f 1/1 //2"""
words = st.sampled_from(WORDS.split())


@RELAXED
@given(st.lists(st.lists(words, max_size=6), max_size=25), st.sampled_from(["ply", "obj"]))
def test_meshes_of_words(tmp_path, lines, suffix):
    text = "\n".join(" ".join(line) for line in lines)
    (tmp_path / f"mesh.{suffix}").write_text(("ply\n" if suffix == "ply" else "") + text)
    with open_scan(tmp_path) as archive, bounded_memory(), contextlib.suppress(ScanFormatError):
        read_mesh(archive, f"mesh.{suffix}")
    (tmp_path / f"mesh.{suffix}").unlink()


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | st.just("color/0.png"),
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.text(max_size=8), inner, max_size=5),
    max_leaves=20,
)


@RELAXED
@given(st.data())
def test_scan_json_with_any_value_anywhere(maker, data):
    maker.native(3)
    target = data.draw(st.sampled_from([maker.scan, maker.scan["frames"][0], maker.scan["color_intrinsics"]]))
    target[data.draw(st.sampled_from(sorted(target)))] = data.draw(json_values)
    check(maker.folder())


@RELAXED
@given(st.data())
def test_gltf_with_any_value_anywhere(tmp_path, data):
    document = {
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "translation": [0, 0, 0], "children": []}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "mode": 4}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", "byteOffset": 0},
            {"bufferView": 1, "componentType": 5121, "count": 3, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": 36, "byteOffset": 0, "byteStride": 12},
            {"buffer": 0, "byteLength": 3, "byteOffset": 36},
        ],
        "buffers": [{"byteLength": 40, "uri": "data:;base64," + "AAAA" * 13 + "AA=="}],
        "extensionsRequired": [],
    }
    here = document
    while True:
        key = data.draw(st.sampled_from(sorted(here) if isinstance(here, dict) else range(len(here))))
        if not isinstance(here[key], dict | list) or not here[key] or data.draw(st.booleans()):
            here[key] = data.draw(json_values)
            break
        here = here[key]
    (tmp_path / "mesh.gltf").write_text(json.dumps(document))
    with open_scan(tmp_path) as archive, bounded_memory(), contextlib.suppress(ScanFormatError):
        read_mesh(archive, "mesh.gltf")


@RELAXED
@given(st.binary(max_size=200), st.sampled_from([b"", b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n"]))
def test_garbage_as_an_image(content, head):
    with contextlib.suppress(ScanFormatError):
        parse_image_header(head + content, "image")


@RELAXED
@given(edits, cuts)
def test_a_damaged_sens(tmp_path, edits, cut):
    data = struct.pack("<IQ", 4, 3) + b"abc" + struct.pack("<64f", *[30.0] * 64)
    data += struct.pack("<2i4IfQ", 0, 0, 2, 2, 2, 2, 1000.0, 3)
    for _ in range(3):
        pose = (1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1)
        data += struct.pack("<16f4Q", *pose, 0, 0, 12, 8) + bytes(20)
    (tmp_path / "a.sens").write_bytes(edited(data, edits, cut))
    with bounded_memory():
        check(tmp_path)


@RELAXED
@given(st.sampled_from(["pose/1.txt", "intrinsic/intrinsic_color.txt", "scene.txt"]), st.binary(max_size=300))
def test_scannet_with_garbage_in_a_text_file(maker, make, name, content):
    maker.files = {f"color/{i}.png": make.png() for i in range(4)} | {"scene.txt": b"axisAlignment = 1"}
    maker.files |= {f"pose/{i}.txt": b"1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1" for i in range(4)}
    maker.files["intrinsic/intrinsic_color.txt"] = b"30 0 16 0 0 30 12 0 0 0 1 0 0 0 0 1"
    maker.files[name] = content
    check(maker.folder())


@RELAXED
@given(st.binary(max_size=200), st.binary(max_size=200))
def test_cam_with_garbage(maker, make, cam, intrinsics):
    maker.files = {f"color_{i}.png": make.png() for i in range(3)} | {f"color_{i}.cam": cam for i in range(3)}
    maker.files["intrinsics.txt"] = b"color 32 24 fx " + intrinsics
    check(maker.folder())


NUMBERS = ("nan", "-inf", "1e999", "-1e308", "1e-320", "-0", "0", "1", "-1", "0.5", "x", "1,0", "0x1p3", "\u0661")
entries = st.sampled_from(NUMBERS[6:10]) | st.sampled_from(NUMBERS)  # mostly plain ones, so that whole matrices come
poses = st.lists(entries, min_size=9, max_size=20) | st.lists(entries, min_size=16, max_size=16)
IDENTITY = "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"


def lines_of(words: list[str], columns: int) -> bytes:
    return "\n".join(" ".join(words[at : at + columns]) for at in range(0, len(words), columns)).encode()


@RELAXED
@given(poses, st.integers(3, 16))
def test_scannet_poses_of_any_numbers(maker, make, words, columns):
    maker.files = {f"color/{i}.png": make.png() for i in range(4)}
    maker.files |= {f"pose/{i}.txt": IDENTITY.encode() for i in range(4)} | {"pose/1.txt": lines_of(words, columns)}
    maker.files["intrinsic/intrinsic_color.txt"] = b"30 0 16 0 0 30 12 0 0 0 1 0 0 0 0 1"
    check(maker.folder())


@RELAXED
@given(poses, st.integers(3, 16), st.sampled_from(["frame-000001.pose.txt", "depth-to-color.txt"]))
def test_seven_scenes_poses_of_any_numbers(maker, make, words, columns, name):
    maker.files = {f"frame-00000{i}.color.png": make.png() for i in range(4)}
    maker.files |= {f"frame-00000{i}.pose.txt": IDENTITY.encode() for i in range(4)}
    maker.files["camera-intrinsics.txt"] = b"30 0 16\n0 30 12\n0 0 1"
    maker.files[name] = lines_of(words, columns)
    check(maker.folder())


@RELAXED
@given(poses, st.lists(entries, min_size=1, max_size=7))
def test_cam_poses_of_any_numbers(maker, make, words, second):
    maker.files = {f"color_{i}.png": make.png() for i in range(4)}
    maker.files |= {f"color_{i}.cam": b"0 0 0 1 0 0 0 1 0 0 0 1\n1 0 0 1 0.5 0.5" for i in range(4)}
    maker.files["color_1.cam"] = lines_of(words[:12], 12) + b"\n" + " ".join(second).encode()
    check(maker.folder())


floats = st.sampled_from([0.0, -0.0, 1.0, -1.0, 0.5, 3.4e38, 1e-45, math.nan, math.inf, -math.inf])


@RELAXED
@given(st.lists(floats | st.just(0.0), min_size=16, max_size=16), st.lists(floats, min_size=16, max_size=16))
def test_a_sens_with_any_floats_as_poses_and_cameras(tmp_path, pose, camera):
    data = struct.pack("<IQ", 4, 3) + b"abc" + struct.pack("<16f", *camera) + struct.pack("<48f", *[30.0] * 48)
    data += struct.pack("<2i4IfQ", 0, 0, 2, 2, 2, 2, 1000.0, 3)
    for _ in range(3):
        data += struct.pack("<16f4Q", *pose, 0, 0, 12, 8) + bytes(20)
    (tmp_path / "a.sens").write_bytes(data)
    with bounded_memory():
        check(tmp_path)


angles = st.floats(-math.pi, math.pi)


@given(angles, angles, st.tuples(*[st.floats(-100, 100)] * 3))
def test_rigid_transforms_invert(yaw, pitch, shift):
    cy, sy, cp, sp = math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch)
    turn = matrix4([cy, -sy, 0, shift[0], sy, cy, 0, shift[1], 0, 0, 1, shift[2]])
    tilt = matrix4([1, 0, 0, 0, 0, cp, -sp, 0, 0, sp, cp, 0])
    transform = compose(turn, tilt)
    assert pose_problem(transform) is None
    product = compose(transform, invert_rigid(transform))
    assert all(abs(product[i][j] - (i == j)) < 1e-9 for i in range(4) for j in range(4))

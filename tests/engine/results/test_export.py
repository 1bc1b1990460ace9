"""Exported files are valid, hold what was given, and look the same through other people's loaders."""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import trimesh
from embreex import rtcore_scene
from embreex.mesh_construction import TriangleMesh

from advtex_engine.core.scene import TO_Y_UP, Atlas, Camera, Mesh
from advtex_engine.mesh.normals import vertex_normals
from advtex_engine.render.render_view import render_layers
from advtex_engine.results.export import export_model
from advtex_engine.results.images import encode_png
from advtex_engine.runtime.files import atomic_file, write_atomically

GltfReport = Callable[[Path], dict[str, Any]]
UP = {"+x": (1, 0, 0), "-x": (-1, 0, 0), "+y": (0, 1, 0), "-y": (0, -1, 0), "+z": (0, 0, 1), "-z": (0, 0, -1)}


def globe(columns: int = 40, rows: int = 20, width: int = 320, height: int = 200) -> tuple[Atlas, torch.Tensor]:
    """A lumpy closed sphere whose positions are shared across the seam of its uv, and a texture with many colors."""
    s, t = np.meshgrid(np.linspace(0, 1, columns + 1), np.linspace(0, 1, rows + 1))
    longitude, latitude = 2 * np.pi * s, np.pi * (0.5 - t)
    radius = 1 + 0.12 * np.sin(3 * longitude) * np.cos(latitude) ** 2
    ball = np.stack([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)], -1)
    points = (radius[..., None] * ball + [3.0, -2.0, 1.0]).reshape(-1, 3)
    index = np.arange(len(points)).reshape(rows + 1, columns + 1)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    corners = np.concatenate([np.stack([a, b, c], -1)[:-1].reshape(-1, 3), np.stack([a, c, d], -1)[1:].reshape(-1, 3)])
    _, first, shared = np.unique(np.rint(points * 1e6), axis=0, return_index=True, return_inverse=True)
    mesh = Mesh(
        v_pos=torch.from_numpy(points[first].astype(np.float32)),
        t_pos_idx=torch.from_numpy(shared.reshape(-1)[corners]),
        v_uv=torch.from_numpy((0.02 + 0.96 * np.stack([s, t], -1)).reshape(-1, 2).astype(np.float32)),
        t_uv_idx=torch.from_numpy(corners),
    )
    noise = np.random.default_rng(3).random((height // 4, width // 4, 3)).astype(np.float32)
    texture = np.clip(cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC), 0, 1)
    return Atlas(mesh, width, height, "xatlas", 1), torch.from_numpy((texture * 255).astype(np.uint8))


def plane(side: int) -> tuple[Atlas, torch.Tensor]:
    """A square of side x side cells: more vertices than 16 bits count when side is 256."""
    y, x = np.mgrid[: side + 1, : side + 1] / side
    index = np.arange((side + 1) ** 2).reshape(side + 1, side + 1)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = torch.from_numpy(np.concatenate([np.stack(f, -1).reshape(-1, 3) for f in ((a, b, c), (a, c, d))]))
    uv = torch.from_numpy(np.stack([x, y], -1).reshape(-1, 2).astype(np.float32))
    v_pos = torch.cat((uv, torch.zeros(len(uv), 1)), dim=1)
    return Atlas(Mesh(v_pos, faces, uv, faces), 8, 8, "xatlas", 1), torch.full((8, 8, 3), 90, dtype=torch.uint8)


def in_pages(atlas: Atlas, texture: torch.Tensor) -> tuple[Atlas, torch.Tensor]:
    """The same surface on 2 x 2 pages, each of which has the whole texture and every fourth face."""
    mesh = atlas.mesh
    assert mesh.v_uv is not None
    assert mesh.t_uv_idx is not None
    number = torch.arange(len(mesh.t_uv_idx)) % 4
    cell = torch.stack((number % 2, number // 2), 1)[:, None]
    v_uv = ((mesh.v_uv[mesh.t_uv_idx].clamp(1e-6, 1 - 1e-6) + cell) / 2).view(-1, 2)
    paged = Mesh(mesh.v_pos, mesh.t_pos_idx, v_uv, torch.arange(len(v_uv)).view(-1, 3))
    return Atlas(paged, 2 * atlas.width, 2 * atlas.height, "xatlas", 4, 2), texture.repeat(2, 2, 1)


def camera_on_globe() -> Camera:
    """Looks along -x and a little down at the globe of `globe`."""
    eye, target = np.array([6.0, -1.2, 2.0]), np.array([3.0, -2.0, 1.0])
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, [0, 0, 1]) / np.linalg.norm(np.cross(z, [0, 0, 1]))
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([x, np.cross(z, x), z])
    matrix[:3, 3] = -matrix[:3, :3] @ eye
    K = torch.tensor([[210.0, 0, 101.3], [0, 205.0, 73.6], [0, 0, 1]], dtype=torch.float64)
    return Camera(K, torch.from_numpy(matrix), 200, 150)


def cast(loaded: trimesh.Trimesh, png: bytes, to_world: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Independent rendering of what trimesh read: Embree's rays, own sampling. Color 0..255 [H,W,3] and hits [H,W].

    to_world [3,3] takes the loaded vertices back to the scan's world. trimesh counts v from the bottom row.
    """
    vertices = (np.asarray(loaded.vertices) @ to_world.T).astype(np.float32)
    scene = rtcore_scene.EmbreeScene()
    TriangleMesh(scene, vertices[loaded.faces].astype(np.float32))
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    K, matrix = camera.K.numpy(), camera.world_to_camera.numpy()
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], -1).reshape(-1, 3)
    directions = (rays @ matrix[:3, :3]).astype(np.float32)
    origins = np.broadcast_to((-matrix[:3, :3].T @ matrix[:3, 3]).astype(np.float32), directions.shape).copy()
    found = scene.run(origins, directions, output=True)
    hit = found["primID"] >= 0
    weights = np.stack([1 - found["u"] - found["v"], found["u"], found["v"]], -1)[hit]
    uv = (weights[..., None] * np.asarray(loaded.visual.uv)[loaded.faces[found["primID"][hit]]]).sum(1)
    decoded = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert decoded is not None
    image = decoded[..., ::-1].astype(np.float64)
    height, width = image.shape[:2]
    x = np.clip(uv[:, 0] * width - 0.5, 0, width - 1)
    y = np.clip((1 - uv[:, 1]) * height - 0.5, 0, height - 1)
    x0, y0 = np.minimum(x.astype(int), width - 2), np.minimum(y.astype(int), height - 2)
    fx, fy = (x - x0)[:, None], (y - y0)[:, None]
    top = image[y0, x0] * (1 - fx) + image[y0, x0 + 1] * fx
    bottom = image[y0 + 1, x0] * (1 - fx) + image[y0 + 1, x0 + 1] * fx
    color = np.zeros((camera.height * camera.width, 3))
    color[hit] = top * (1 - fy) + bottom * fy
    return color.reshape(camera.height, camera.width, 3), hit.reshape(camera.height, camera.width)


def load_glb(path: Path) -> trimesh.Trimesh:
    """The GLB's only mesh with its node's rotation applied."""
    loaded = trimesh.load_scene(path).to_geometry()
    assert isinstance(loaded, trimesh.Trimesh)
    return loaded


def glb_chunks(path: Path) -> tuple[dict[str, Any], bytes]:
    data = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    rest, binary = struct.unpack_from("<I4s", data, 20 + size)
    assert (kind, binary, size % 4, rest % 4) == (b"JSON", b"BIN\0", 0, 0)
    assert 28 + size + rest == len(data)
    return json.loads(data[20 : 20 + size]), data[28 + size :]


def accessor(document: dict[str, Any], binary: bytes, index: int) -> np.ndarray:
    entry = document["accessors"][index]
    view = document["bufferViews"][entry["bufferView"]]
    dtype = {5123: "<u2", 5125: "<u4", 5126: "<f4"}[entry["componentType"]]
    width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}[entry["type"]]
    return np.frombuffer(binary, dtype, entry["count"] * width, view["byteOffset"]).reshape(-1, width)


def embedded_png(path: Path) -> bytes:
    return embedded_image(path, "image/png")


def embedded_image(path: Path, media_type: str) -> bytes:
    document, binary = glb_chunks(path)
    image = document["images"][document["textures"][0]["source"]]
    assert image["mimeType"] == media_type
    view = document["bufferViews"][image["bufferView"]]
    return binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]


@pytest.mark.parametrize("suffix", ["obj", "glb"])
def test_other_loaders_show_the_same_image(tmp_path: Path, suffix: str) -> None:
    atlas, texture = globe()
    export_model(tmp_path, atlas, texture, up_axis="+z", lossless=True)
    camera = camera_on_globe()
    color, coverage = render_layers(atlas, texture, camera, supersample=1)
    if suffix == "obj":
        loaded, to_world = trimesh.load_mesh(tmp_path / "model.obj"), np.eye(3)
        png = (tmp_path / "model.png").read_bytes()
    else:
        # +z became +y by a quarter turn about x: (x, y, z) -> (x, z, -y).
        loaded, to_world = load_glb(tmp_path / "model.glb"), np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
        png = embedded_png(tmp_path / "model.glb")
    theirs, hit = cast(loaded, png, to_world, camera)
    both = hit & (coverage.numpy() == 1)
    assert both.sum() > 0.2 * hit.size
    assert (hit != (coverage.numpy() == 1)).mean() < 0.001
    difference = np.abs(color.numpy() * 255 - theirs)[both]
    assert difference.mean() < 0.25
    assert np.quantile(difference, 0.999) < 3


@pytest.mark.parametrize("suffix", ["obj", "glb"])
def test_other_loaders_find_every_page(tmp_path: Path, suffix: str) -> None:
    atlas, texture = in_pages(*globe())
    export_model(tmp_path, atlas, texture, up_axis="+y", lossless=True)
    scene = trimesh.load_scene(tmp_path / f"model.{suffix}")
    parts = list(scene.geometry.values())
    assert len(parts) == 4
    assert sum(len(part.faces) for part in parts) == len(atlas.mesh.t_pos_idx)
    for part in parts:
        material = part.visual.material
        image = material.image if suffix == "obj" else material.baseColorTexture
        assert np.array_equal(np.asarray(image), texture[: atlas.height // 2, : atlas.width // 2].numpy())
        assert part.visual.uv.min() >= 0
        assert part.visual.uv.max() <= 1


def test_obj_keeps_positions_bit_for_bit_and_faces_in_order(tmp_path: Path) -> None:
    atlas, texture = globe()
    export_model(tmp_path, atlas, texture, up_axis="-y", name="thing")
    text = (tmp_path / "thing.obj").read_text()
    rows: dict[str, list[list[str]]] = {"v": [], "vt": [], "vn": [], "f": []}
    for line in text.splitlines()[2:]:
        key, *words = line.split()
        rows[key].append(words)
    mesh = atlas.mesh
    assert mesh.v_uv is not None
    assert mesh.t_uv_idx is not None
    assert np.array_equal(np.array(rows["v"], np.float32), mesh.v_pos.numpy())
    assert np.abs(np.array(rows["vt"], np.float64) - (mesh.v_uv.numpy() * [1, -1] + [0, 1])).max() < 1e-6
    corners = np.array([[word.split("/") for word in words] for words in rows["f"]], np.int64) - 1
    assert np.array_equal(corners[..., 0], mesh.t_pos_idx.numpy())
    assert np.array_equal(corners[..., 1], mesh.t_uv_idx.numpy())
    assert np.array_equal(corners[..., 2], mesh.t_pos_idx.numpy())
    assert len(rows["vn"]) == len(rows["v"])
    assert text.startswith("mtllib thing.mtl\nusemtl textured\n")
    assert "map_Kd thing.png" in (tmp_path / "thing.mtl").read_text()


@pytest.mark.parametrize("up_axis", sorted(TO_Y_UP))
def test_glb_turns_the_up_axis_to_plus_y(tmp_path: Path, up_axis: str) -> None:
    atlas, texture = globe()
    export_model(tmp_path, atlas, texture, up_axis=up_axis)
    scene = trimesh.load_scene(tmp_path / "model.glb")
    node = scene.graph.nodes_geometry[0]
    rotation = scene.graph[node][0][:3, :3]
    assert np.allclose(rotation @ UP[up_axis], [0, 1, 0], atol=1e-6)
    assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
    assert np.linalg.det(rotation) == pytest.approx(1, abs=1e-6)


def test_glb_is_compact_and_complete(tmp_path: Path) -> None:
    atlas, texture = globe()
    export_model(tmp_path, atlas, texture, up_axis="+z", lossless=True)
    document, binary = glb_chunks(tmp_path / "model.glb")
    indices, positions, normals, uv = (accessor(document, binary, i) for i in range(4))
    mesh = atlas.mesh
    assert mesh.v_uv is not None
    assert mesh.t_uv_idx is not None
    pairs = {(int(p), int(c)) for p, c in zip(mesh.t_pos_idx.flatten(), mesh.t_uv_idx.flatten(), strict=True)}
    assert len(positions) == len(normals) == len(uv) == len(pairs)
    assert indices.dtype == np.uint16
    assert np.array_equal(positions[indices[:, 0]], mesh.v_pos.numpy()[mesh.t_pos_idx.flatten().numpy()])
    assert np.array_equal(uv[indices[:, 0]], mesh.v_uv.numpy()[mesh.t_uv_idx.flatten().numpy()])
    assert np.allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
    # The globe is seen from outside: its normals point away from its centre.
    assert ((positions - np.array([3.0, -2.0, 1.0])) * normals).sum(1).min() > 0.5
    assert document["accessors"][1]["min"] == positions.min(0).tolist()
    assert embedded_png(tmp_path / "model.glb") == (tmp_path / "model.png").read_bytes()
    material = document["materials"][0]
    assert material["doubleSided"] is True
    assert material["pbrMetallicRoughness"]["metallicFactor"] == 0
    assert material["pbrMetallicRoughness"]["roughnessFactor"] == 1


def test_glb_carries_a_jpeg_with_all_of_its_chroma(tmp_path: Path) -> None:
    atlas, texture = globe()
    export_model(tmp_path, atlas, texture, up_axis="+z")
    jpeg = embedded_image(tmp_path / "model.glb", "image/jpeg")
    frame = re.search(rb"\xff[\xc0\xc2]..\x08....\x03(.{9})", jpeg, re.DOTALL)
    assert frame is not None
    assert frame[1][1::3] == b"\x11\x11\x11"  # samples of each component along both axes, beside the others'
    assert len(jpeg) < 0.7 * (tmp_path / "model.png").stat().st_size


def test_charts_do_not_bleed_into_each_other_through_the_jpeg(tmp_path: Path) -> None:
    """Strips of strong colors, each with the two texels of padding around it that charts have."""
    colors = torch.tensor([[220, 20, 20], [20, 20, 220], [20, 200, 20]], dtype=torch.uint8)
    texture = colors[torch.arange(96) // 13 % 3].expand(96, 96, 3).contiguous()
    export_model(tmp_path, replace(globe()[0], width=96, height=96), texture, up_axis="+y")
    found = cv2.imdecode(np.frombuffer(embedded_image(tmp_path / "model.glb", "image/jpeg"), np.uint8), 1)
    assert found is not None
    inside = (np.arange(96) % 13 >= 1) & (np.arange(96) % 13 < 12)  # all that bilinear samples of a chart touch
    error = np.abs(found[..., ::-1].astype(int) - texture.numpy())[:, inside]
    assert error.max() <= 12


def test_many_vertices_get_wide_indices(tmp_path: Path) -> None:
    export_model(tmp_path, *plane(256), up_axis="+y")
    document, binary = glb_chunks(tmp_path / "model.glb")
    indices = accessor(document, binary, 0)
    assert indices.dtype == np.uint32
    assert indices.max() == 257**2 - 1
    assert "rotation" not in document["nodes"][0]


@pytest.mark.parametrize("lossless", [False, True])
@pytest.mark.parametrize(("model", "up_axis"), [("globe", "+z"), ("plane", "-x"), ("pages", "+y")])
def test_khronos_validator_finds_nothing(
    tmp_path: Path, gltf_report: GltfReport, model: str, up_axis: str, lossless: bool
) -> None:
    atlas, texture = {"globe": globe, "plane": lambda: plane(256), "pages": lambda: in_pages(*globe())}[model]()
    export_model(tmp_path, atlas, texture, up_axis=up_axis, lossless=lossless)
    report = gltf_report(tmp_path / "model.glb")
    assert [issue for issue in report["issues"]["messages"] if issue["severity"] < 2] == []
    assert report["info"]["totalTriangleCount"] == len(atlas.mesh.t_pos_idx)


def test_khronos_validator_is_awake(tmp_path: Path, gltf_report: GltfReport) -> None:
    export_model(tmp_path, *globe(), up_axis="+z")
    document, _ = glb_chunks(tmp_path / "model.glb")
    data = (tmp_path / "model.glb").read_bytes()
    low = json.dumps(document["accessors"][1]["min"], separators=(",", ":")).encode()
    broken = tmp_path / "broken.glb"
    broken.write_bytes(data.replace(low, b"[" + b"9" * (len(low) - 6) + b",9,9]"))
    assert gltf_report(broken)["issues"]["numErrors"] > 0


def test_float_textures_are_clamped_and_rounded() -> None:
    texture = torch.tensor([[[-0.5, 0.0, 0.5], [1.0, 1.7, 0.2499]]])
    image = cv2.imdecode(np.frombuffer(encode_png(texture), np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    assert image[..., ::-1].tolist() == [[[0, 0, 128], [255, 255, 64]]]


def test_normals_of_a_vertex_without_faces_are_still_unit() -> None:
    v_pos = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 0, 1], [5, 5, 5]])
    normals = vertex_normals(Mesh(v_pos, torch.tensor([[0, 1, 2]])))
    assert normals.tolist() == [[0, -1, 0]] * 3 + [[0, 0, 1]]


def test_a_write_that_fails_leaves_the_old_file_alone(tmp_path: Path) -> None:
    path = tmp_path / "model.obj"
    write_atomically(path, b"old")

    def interrupted() -> None:
        with atomic_file(path) as file:
            file.write(b"half of the new")
            raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space left"):
        interrupted()
    assert path.read_bytes() == b"old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["model.obj"]


def test_files_are_as_readable_as_any_other(tmp_path: Path) -> None:
    write_atomically(tmp_path / "ours", b"")
    (tmp_path / "plain").touch()
    assert (tmp_path / "ours").stat().st_mode == (tmp_path / "plain").stat().st_mode

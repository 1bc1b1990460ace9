"""A tileset covers the model at every level, its leaves are the model texel by texel, and its numbers mean metres."""

from __future__ import annotations

import hashlib
import json
import struct
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from sheets import FROM_ABOVE, many_charts

from advtex_engine.core.errors import Stopped
from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import TO_Y_UP, Atlas, Mesh
from advtex_engine.mesh.clean import clean
from advtex_engine.mesh.models import load_model
from advtex_engine.render.render_view import render_view
from advtex_engine.results.baking import TexturedModel
from advtex_engine.results.cells import Level, distance_of_faces
from advtex_engine.results.compressed import read_glb
from advtex_engine.results.cutting import cut_out, pack_boxes
from advtex_engine.results.tiles import corners_of, tileset_axes, write_tiles

MOST = 30_000
SHEET = many_charts()
FULL = TexturedModel(replace(SHEET.atlas, mesh=clean(SHEET.atlas.mesh)), SHEET.texture)


@pytest.fixture(scope="module")
def tileset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of an unpacked tileset of three levels."""
    folder = tmp_path_factory.mktemp("tiles")
    path = write_tiles(folder, FULL.atlas, FULL.texture, up_axis="+z", most=MOST)
    with zipfile.ZipFile(path) as archive:
        archive.extractall(folder / "tileset")
    return folder / "tileset"


def tiles_of(tile: dict[str, Any], depth: int = 0) -> Iterator[tuple[int, dict[str, Any]]]:
    yield depth, tile
    for child in tile.get("children", []):
        yield from tiles_of(child, depth + 1)


def read(tileset: Path) -> dict[str, Any]:
    document: dict[str, Any] = json.loads((tileset / "tileset.json").read_text())
    return document


def arrays(path: Path) -> list[np.ndarray]:
    """Faces [T,3], positions [N,3] and normals [N,3] of a tile, as they stand in the file."""
    document, binary = read_glb(path)
    views = document["bufferViews"][:3]
    data = [binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]] for view in views]
    return [np.frombuffer(one, kind).reshape(-1, 3) for one, kind in zip(data, ("<u2", "<f4", "<f4"), strict=True)]


def in_tileset(path: Path) -> torch.Tensor:
    """Corners of a tile's faces [T,3,3] as a viewer has them: turned by the node to +y up, and from there to +z up."""
    mesh = load_model(path)[0].mesh
    x, y, z = mesh.v_pos[mesh.t_pos_idx].unbind(2)
    return torch.stack((x, -z, y), 2)


def test_children_lie_in_their_parents_and_errors_fall_to_nothing(tileset: Path) -> None:
    document = read(tileset)
    assert document["asset"] == {"version": "1.1"}
    assert document["root"]["refine"] == "REPLACE"
    assert document["geometricError"] > document["root"]["geometricError"]
    assert {depth for depth, _ in tiles_of(document["root"])} == {0, 1, 2}
    for _, tile in tiles_of(document["root"]):
        low, high = corners_of(tile)
        children = tile.get("children", [])
        assert (tile["geometricError"] == 0) == (not children), "the leaves alone are the full model"
        for child in children:
            assert child["geometricError"] < tile["geometricError"]
            assert (corners_of(child)[0] >= low - 1e-9).all()
            assert (corners_of(child)[1] <= high + 1e-9).all()


def test_every_level_covers_the_sheet_with_files_below_the_limit(tileset: Path) -> None:
    area, faces = dict[int, float](), dict[int, int]()
    for depth, tile in tiles_of(read(tileset)["root"]):
        path = tileset / tile["content"]["uri"]
        assert path.stat().st_size <= MOST
        corners = in_tileset(path)
        low, high = corners_of(tile)
        points = corners.reshape(-1, 3).numpy()
        assert (points >= low - 1e-6).all()
        assert (points <= high + 1e-6).all()
        side, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        area[depth] = area.get(depth, 0) + float(torch.linalg.cross(side, other).norm(dim=1).sum() / 2)
        faces[depth] = faces.get(depth, 0) + len(corners)
    assert faces[2] == FULL.faces
    assert faces[1] <= FULL.faces / 4
    assert faces[0] <= FULL.faces / 16
    assert [area[0], area[1]] == pytest.approx([area[2]] * 2, rel=0.05), "borders of coarse meshes are grown"


def test_leaves_are_the_model_face_by_face_and_texel_by_texel(tileset: Path) -> None:
    mesh = FULL.atlas.mesh
    wanted = {face.tobytes() for face in mesh.v_pos[mesh.t_pos_idx].numpy()}
    found = list[bytes]()
    leaves = [tile for _, tile in tiles_of(read(tileset)["root"]) if "children" not in tile]
    texels = 0
    for tile in leaves:
        path = tileset / tile["content"]["uri"]
        faces, points, _ = arrays(path)
        found += [face.tobytes() for face in points[faces]]
        texels += TexturedModel(*load_model(path)).texels
    assert len(found) == len(wanted)
    assert set(found) == wanted
    assert texels == pytest.approx(FULL.texels, rel=1e-3)


def test_neighbors_of_one_level_share_the_vertices_and_normals_of_their_border(tileset: Path) -> None:
    """A border's edge of one tile that is no border of the level's mesh is one of another tile, bit by bit."""
    normals = dict[bytes, bytes]()
    edges = dict[bytes, int]()
    for depth, tile in tiles_of(read(tileset)["root"]):
        if depth != 1:
            continue
        faces, points, normal = arrays(tileset / tile["content"]["uri"])
        for point, direction in zip(points, normal, strict=True):
            assert normals.setdefault(point.tobytes(), direction.tobytes()) == direction.tobytes()
        for face in faces:
            for side in range(3):
                ends = sorted(points[face[[side, (side + 1) % 3]]].tolist())
                key = np.array(ends, "<f4").tobytes()
                edges[key] = edges.get(key, 0) + 1
    lone = np.array([np.frombuffer(key, "<f4").reshape(2, 3) for key, count in edges.items() if count == 1])
    assert set(edges.values()) <= {1, 2}
    on_rim = (np.abs(lone[:, :, :2] - 0.5) > 0.48).any(axis=2).all(axis=1)
    assert on_rim.all(), "an edge within the sheet has a face on one side only"


def plane(height: float, spike: float = 0.0) -> TexturedModel:
    """A square of 2 x 2 cells of a metre at a height, its middle higher by a spike."""
    y, x = torch.meshgrid(torch.arange(3.0), torch.arange(3.0), indexing="ij")
    z = torch.full((9,), float(height))
    z[4] += spike
    corner = torch.tensor([0, 1, 3, 4])[:, None]
    faces = (corner + torch.tensor([[0, 1, 4, 0, 4, 3]])).view(-1, 3)
    points = torch.stack((x.flatten(), y.flatten(), z), 1)
    mesh = Mesh(points, faces, points[:, :2] / 2, faces)
    return TexturedModel(Atlas(mesh, 8, 8, "scan", 1), torch.zeros((8, 8, 3), dtype=torch.uint8))


def test_the_distance_of_a_face_is_measured_in_metres_and_in_both_directions() -> None:
    assert distance_of_faces(plane(0.03), plane(0)).tolist() == pytest.approx([0.03] * 8, abs=1e-6)
    from_spike = distance_of_faces(plane(0), plane(0, 0.2))
    assert float(from_spike.max()) == pytest.approx(0.2, abs=1e-6), "what the level lacks counts as well"


def test_a_tiles_error_is_at_least_the_side_of_its_texels() -> None:
    flat = plane(0)
    level = Level(flat, distance_of_faces(flat, flat))
    assert level.error_of(torch.arange(8)) == pytest.approx(0.25, rel=1e-3), "8 texels over 2 metres"


@pytest.mark.parametrize("up_axis", sorted(TO_Y_UP))
def test_what_is_up_in_the_scan_is_up_in_the_tileset(up_axis: str) -> None:
    axes = tileset_axes(up_axis)
    up = np.zeros(3)
    up["xyz".index(up_axis[1])] = 1 if up_axis[0] == "+" else -1
    assert (axes @ up).tolist() == [0, 0, 1]
    assert np.linalg.det(axes) == pytest.approx(1)


def test_a_scan_with_another_axis_up_is_turned_by_the_tiles_nodes(tmp_path: Path) -> None:
    write_tiles(tmp_path, FULL.atlas, FULL.texture, up_axis="-x")
    with zipfile.ZipFile(tmp_path / "model.3tz") as archive:
        archive.extractall(tmp_path)
    root = read(tmp_path)["root"]
    assert "children" not in root, "a model that is small enough is one tile"
    assert root["geometricError"] == 0
    points = in_tileset(tmp_path / root["content"]["uri"]).reshape(-1, 3).numpy()
    assert np.stack([points.min(0), points.max(0)]) == pytest.approx(corners_of(root), abs=1e-5)


def test_the_archive_tells_where_its_files_are(tmp_path: Path) -> None:
    path = write_tiles(tmp_path, FULL.atlas, FULL.texture, up_axis="+z")
    with zipfile.ZipFile(path) as archive:
        entries = archive.infolist()
        index = archive.read("@3dtilesIndex1@")
    assert entries[-1].filename == "@3dtilesIndex1@"
    assert all(entry.compress_type == zipfile.ZIP_STORED and entry.external_attr >> 16 == 0o644 for entry in entries)
    rows = [struct.unpack_from("<QQQ", index, 24 * row) for row in range(len(index) // 24)]
    assert rows == sorted(rows)
    for entry in entries[:-1]:
        first, second = struct.unpack("<QQ", hashlib.md5(entry.filename.encode()).digest())
        assert (first, second, entry.header_offset) in rows


def test_a_part_that_is_cut_out_looks_like_the_model() -> None:
    half = (FULL.atlas.mesh.v_pos[FULL.atlas.mesh.t_pos_idx].mean(1)[:, 0] < 0.5).nonzero()[:, 0]
    page = cut_out(FULL, half)
    atlas = Atlas(page.mesh, page.image.shape[1], page.image.shape[0], "scan", 0)
    assert atlas.width * atlas.height < 0.75 * FULL.texture.shape[0] * FULL.texture.shape[1]
    whole, part = (render_view(*one, FROM_ABOVE) for one in ((FULL.atlas, FULL.texture), (atlas, page.image)))
    left = slice(20, 62)
    assert float((whole - part)[:, left].abs().max()) < 1e-4


class Stopping(Monitor):
    def stop_requested(self) -> bool:
        return True


def test_a_stop_leaves_no_half_of_a_tileset(tmp_path: Path) -> None:
    with pytest.raises(Stopped, match="resume makes all of them again"):
        write_tiles(tmp_path, FULL.atlas, FULL.texture, up_axis="+z", monitor=Stopping())
    assert list(tmp_path.iterdir()) == []


def test_boxes_do_not_overlap() -> None:
    sizes = np.random.default_rng(0).integers(1, 40, (300, 2))
    place, size = pack_boxes(sizes)
    count = np.zeros(size[::-1], int)
    for (x, y), (width, height) in zip(place, sizes, strict=True):
        count[y : y + height, x : x + width] += 1
    assert count.max() == 1
    assert count.sum() == sizes.prod(1).sum() > 0.8 * size.prod()


def test_khronos_validator_finds_nothing_in_a_tile(
    tileset: Path, gltf_report: Callable[[Path], dict[str, Any]]
) -> None:
    report = gltf_report(tileset / read(tileset)["root"]["content"]["uri"])
    assert [issue for issue in report["issues"]["messages"] if issue["severity"] < 2] == []

"""Models that the engine wrote are read back; all others are refused with a remedy."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from advtex_engine.core.scene import Atlas, Camera, Mesh
from advtex_engine.mesh.models import ModelError, load_model, load_reference
from advtex_engine.render.render_view import render_layers
from advtex_engine.results.export import export_model
from advtex_engine.results.images import encode_png

CORNERS = ((0, 0.0), (1, 0.0), (1, 1.0), (0, 1.0))
TEXTURE = torch.randint(0, 256, (12, 16, 3), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)


def board() -> Atlas:
    """Two triangles whose uv have an index of their own."""
    v_pos = torch.tensor([[0.0, 0, 1], [2, 0, 1], [2, 1, 1], [0, 1, 1]])
    v_uv = torch.tensor([[0.1, 0.2], [0.9, 0.2], [0.9, 0.7], [0.1, 0.2], [0.9, 0.7], [0.1, 0.7]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    return Atlas(Mesh(v_pos, faces, v_uv, torch.arange(6).view(2, 3)), 16, 12, "scan", 1)


@pytest.fixture
def files(tmp_path: Path) -> Path:
    """A folder with model.obj, .mtl, .png and .glb; +y is up, so that the GLB's node turns nothing."""
    export_model(tmp_path, board(), TEXTURE, up_axis="+y", lossless=True)
    return tmp_path


def corners(mesh: Mesh) -> tuple[Tensor, Tensor]:
    assert mesh.v_uv is not None
    assert mesh.t_uv_idx is not None
    return mesh.v_pos[mesh.t_pos_idx], mesh.v_uv[mesh.t_uv_idx]


@pytest.mark.parametrize("name", ["model.obj", "model.glb"])
def test_an_exported_model_is_read_back(files: Path, name: str) -> None:
    atlas, texture = load_model(files / name)
    assert torch.equal(texture, TEXTURE)
    assert (atlas.width, atlas.height) == (16, 12)
    for ours, theirs in zip(corners(atlas.mesh), corners(board().mesh), strict=True):
        torch.testing.assert_close(ours, theirs, atol=1e-6, rtol=0)


def test_a_texture_is_found_behind_options_and_with_spaces_in_its_name(files: Path) -> None:
    (files / "model.png").rename(files / "my model.png")
    for line in ("map_Kd my model.png", "\tmap_Kd  my model.png "):
        (files / "model.mtl").write_text(f"newmtl a\n{line}\n")
        assert torch.equal(load_model(files / "model.obj")[1], TEXTURE)
    (files / "my model.png").rename(files / "model.png")
    (files / "model.mtl").write_text("newmtl a\nmap_Kd -s 1 1 1 model.png\n")
    assert torch.equal(load_model(files / "model.obj")[1], TEXTURE)


@pytest.mark.parametrize("name", ["model.obj", "model.glb", "mesh.ply"])
def test_a_reference_needs_no_texture(files: Path, name: str) -> None:
    (files / "mesh.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 1\n2 0 1\n2 1 1\n0 1 1\n4 0 1 2 3\n"
    )
    (files / "model.png").unlink()
    mesh = load_reference(files / name)
    assert torch.equal(mesh.v_pos[mesh.t_pos_idx], corners(board().mesh)[0])


def sheet(pages: int) -> tuple[Atlas, Tensor]:
    """A strip of quads, one for each page and on it, two texels from the page's border; the last page is left empty."""
    quads = pages**2 - 1 if pages > 1 else 1
    x = torch.arange(2.0 * quads).view(-1, 2)
    v_pos = torch.stack([torch.stack((x[:, i], torch.full((quads,), y), x[:, 0] % 3), 1) for i, y in CORNERS], 1)
    cell = torch.stack((torch.arange(quads) % pages, torch.arange(quads) // pages), 1)
    local = torch.tensor([[2.0, 2], [22, 2], [22, 14], [2, 14]]) / torch.tensor([24, 16])
    v_uv = ((cell[:, None] + local) / pages).view(-1, 2)
    faces = (4 * torch.arange(quads)[:, None] + torch.tensor([0, 1, 2, 0, 2, 3])).view(-1, 3)
    faces = faces[torch.randperm(len(faces), generator=torch.Generator().manual_seed(1))]
    size = (16 * pages, 24 * pages, 3)
    texture = torch.randint(0, 256, size, generator=torch.Generator().manual_seed(2), dtype=torch.uint8)
    return Atlas(Mesh(v_pos.view(-1, 3), faces, v_uv, faces), size[1], size[0], "xatlas", 3, pages), texture


@pytest.mark.parametrize("name", ["model.obj", "model.glb"])
@pytest.mark.parametrize("pages", [1, 2, 3])
def test_pages_are_read_back_as_one_texture(tmp_path: Path, name: str, pages: int) -> None:
    atlas, texture = sheet(pages)
    files = export_model(tmp_path, atlas, texture, up_axis="+y", lossless=True)
    count = max(1, pages**2 - 1)
    pngs = ["model.png", *(f"model_{number}.png" for number in range(2, count + 1))]
    assert sorted(file.name for file in files) == sorted(["model.obj", "model.mtl", "model.glb", *pngs])
    again, image = load_model(tmp_path / name)
    assert (again.width, again.height, again.pages) == (atlas.width, atlas.height, pages)
    for row, column in [divmod(number, pages) for number in range(count)]:
        place = (slice(16 * row, 16 * row + 16), slice(24 * column, 24 * column + 24))
        assert torch.equal(image[place], texture[place])
    assert torch.equal(sorted_faces(again), sorted_faces(atlas))


def sorted_faces(atlas: Atlas) -> Tensor:
    """[T,15] positions and uv of the faces' corners, in the order of their rows; the order of corners is kept."""
    position, uv = corners(atlas.mesh)
    rows = torch.cat((position.flatten(1), (uv * 1e5).round().flatten(1)), 1)
    return torch.unique(rows, dim=0)


@pytest.mark.parametrize("name", ["model.obj", "model.glb"])
def test_pages_look_like_the_atlas_that_they_came_from(tmp_path: Path, name: str) -> None:
    atlas, texture = sheet(2)
    export_model(tmp_path, atlas, texture, up_axis="+y", lossless=True)
    K = torch.tensor([[60.0, 0, 48], [0, 60, 16], [0, 0, 1]], dtype=torch.float64)
    world_to_camera = torch.eye(4, dtype=torch.float64)
    world_to_camera[:3, 3] = torch.tensor([-2.5, -0.5, 4])
    camera = Camera(K, world_to_camera, 96, 32)
    expected, coverage = render_layers(atlas, texture, camera, supersample=1)
    found, _ = render_layers(*load_model(tmp_path / name), camera, supersample=1)
    assert coverage.mean() > 0.1
    torch.testing.assert_close(found, expected, atol=2e-3, rtol=0)


def test_a_face_across_two_pages_is_not_exported(tmp_path: Path) -> None:
    atlas, texture = sheet(2)
    across = torch.tensor([[0, 4, 8]] * len(atlas.mesh.t_pos_idx))
    torn = replace(atlas, mesh=replace(atlas.mesh, t_uv_idx=across))
    with pytest.raises(AssertionError, match="crosses the border"):
        export_model(tmp_path, torn, texture, up_axis="+y", lossless=True)


def test_pages_of_different_sizes_are_refused(tmp_path: Path) -> None:
    export_model(tmp_path, *sheet(2), up_axis="+y", lossless=True)
    (tmp_path / "model_2.png").write_bytes(encode_png(TEXTURE))
    with pytest.raises(ModelError, match="3 textures differ in size"):
        load_model(tmp_path / "model.obj")


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("model.mtl", "map_Kd", "map_Bump", "has no texture; name one in its MTL file"),
        (
            "model.mtl",
            "newmtl",
            "newmtl other\nmap_Kd model.mtl\nnewmtl a\nmap_Kd",
            "has 2 textures, and faces without",
        ),
        ("model.obj", "mtllib", "# mtllib", "has no texture"),
        ("model.mtl", "model.png", "lost.png", r"lost\.png: cannot be read"),
        ("model.obj", "model.mtl", "lost.mtl", r"lost\.mtl: cannot be read"),
        ("model.obj", "vt 0.1", "vt -1.1", "texture repeats"),
        ("model.obj", "vt ", "# ", "a face names texture coordinate"),
        ("model.obj", "\nf ", "\n# ", "has no faces"),
    ],
)
def test_an_obj_that_cannot_be_used_is_refused(files: Path, file: str, old: str, new: str, message: str) -> None:
    edit(files / file, old, new)
    with pytest.raises(ModelError, match=message):
        load_model(files / "model.obj")


def test_an_obj_without_uv_is_refused(files: Path) -> None:
    (files / "model.obj").write_text("mtllib model.mtl\nv 0 0 1\nv 1 0 1\nv 1 1 1\nf 1 2 3\n")
    with pytest.raises(ModelError, match="unwrap the model"):
        load_model(files / "model.obj")


def test_a_texture_that_is_no_image_is_refused(files: Path) -> None:
    for content in (b"", b"no image"):
        (files / "model.png").write_bytes(content)
        with pytest.raises(ModelError, match="not an image"):
            load_model(files / "model.obj")


def rewrite_glb(path: Path, change: Any) -> None:
    """`change` gets the GLB's document and edits it."""
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    document = json.loads(data[20 : 20 + length])
    change(document)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    header = struct.pack("<III", 0x46546C67, 2, 20 + len(text) + len(rest))
    path.write_bytes(header + struct.pack("<I4s", len(text), b"JSON") + text + rest)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda document: document.pop("materials"), "has no texture"),
        (lambda document: document["images"][0].pop("bufferView"), "not stored in the GLB"),
        (lambda document: document.pop("images"), "not stored in the GLB"),
        (lambda document: document["meshes"][0]["primitives"][0]["attributes"].pop("TEXCOORD_0"), "unwrap"),
        (lambda document: document["accessors"][0].update(count=10**9), "more than its buffer holds"),
    ],
)
def test_a_glb_that_cannot_be_used_is_refused(files: Path, change: Any, message: str) -> None:
    rewrite_glb(files / "model.glb", change)
    with pytest.raises(ModelError, match=message):
        load_model(files / "model.glb")


def test_a_truncated_glb_and_other_formats_are_refused(files: Path) -> None:
    (files / "model.glb").write_bytes((files / "model.glb").read_bytes()[:-100])
    with pytest.raises(ModelError, match=r"claims \d+ bytes, but holds"):
        load_model(files / "model.glb")
    with pytest.raises(ModelError, match="only OBJ and GLB"):
        load_model(files / "model.fbx")
    with pytest.raises(ModelError, match="only PLY, OBJ and GLB"):
        load_reference(files / "model.stl")
    with pytest.raises(ModelError, match=r"absent\.obj: cannot be read"):
        load_model(files / "absent.obj")

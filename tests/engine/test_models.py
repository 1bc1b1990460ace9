"""Models that the engine wrote are read back; all others are refused with a remedy."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from advtex_engine.export import export_model
from advtex_engine.models import ModelError, load_model, load_reference
from advtex_engine.scene import Atlas, Mesh

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
    export_model(tmp_path, board(), TEXTURE, up_axis="+y")
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


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("model.mtl", "map_Kd", "map_Bump", "has 0 textures; exactly one"),
        ("model.mtl", "map_Kd", "map_Kd other.png\nmap_Kd", "has 2 textures; exactly one"),
        ("model.obj", "mtllib", "# mtllib", "has 0 textures"),
        ("model.mtl", "model.png", "lost.png", r"lost\.png: cannot be read"),
        ("model.obj", "model.mtl", "lost.mtl", r"lost\.mtl: cannot be read"),
        ("model.obj", "vt 0.1", "vt -1.1", "texture repeats"),
        ("model.obj", "vt ", "# ", "texture coordinate indices out of range|line that cannot be read"),
        ("model.obj", "\nf ", "\n# ", "the mesh has no faces"),
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
        (lambda document: document.pop("materials"), "has 0 textures"),
        (lambda document: document["images"][0].pop("bufferView"), "not stored in the GLB"),
        (lambda document: document.pop("images"), "not stored in the GLB"),
        (lambda document: document["meshes"][0]["primitives"][0]["attributes"].pop("TEXCOORD_0"), "unwrap"),
        (lambda document: document["accessors"][0].update(count=10**9), "is longer than its buffer view"),
    ],
)
def test_a_glb_that_cannot_be_used_is_refused(files: Path, change: Any, message: str) -> None:
    rewrite_glb(files / "model.glb", change)
    with pytest.raises(ModelError, match=message):
        load_model(files / "model.glb")


def test_a_truncated_glb_and_other_formats_are_refused(files: Path) -> None:
    (files / "model.glb").write_bytes((files / "model.glb").read_bytes()[:-100])
    with pytest.raises(ModelError, match="incomplete"):
        load_model(files / "model.glb")
    with pytest.raises(ModelError, match="only OBJ and GLB"):
        load_model(files / "model.fbx")
    with pytest.raises(ModelError, match="only PLY, OBJ and GLB"):
        load_reference(files / "model.stl")
    with pytest.raises(ModelError, match=r"absent\.obj: cannot be read"):
        load_model(files / "absent.obj")

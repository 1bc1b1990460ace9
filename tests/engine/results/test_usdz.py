"""The USDZ passes usd-core's own validation and, read through usd-core, looks like the GLB."""

from __future__ import annotations

import struct
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from pxr import Usd, UsdGeom, UsdShade, UsdValidation

from advtex_engine.core.scene import Atlas, Camera, Mesh
from advtex_engine.mesh.models import load_model
from advtex_engine.render.render_view import render_layers
from advtex_engine.results.export import export_model
from advtex_engine.results.usdz import MAX_SIDE


def hills(pages: int = 1, side: int = 64) -> tuple[Atlas, torch.Tensor]:
    """A wavy sheet facing +z whose rows lie on one page each, in turn; texels of many smooth colors."""
    y, x = np.mgrid[:9, :9] / 8
    index = np.arange(81).reshape(9, 9)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.concatenate([np.stack(corners, -1).reshape(-1, 3) for corners in ((a, b, c), (a, c, d))])
    page = faces.min(axis=1) // 9 % pages**2
    cell = np.stack((page % pages, page // pages), 1)[:, None]
    uv = (np.stack((x, 1 - y), -1).reshape(-1, 2)[faces] * 0.9 + 0.05 + cell) / pages
    points = np.stack((x, y, 0.1 * np.sin(6 * x)), -1).reshape(-1, 3)
    v_uv = torch.from_numpy(uv.reshape(-1, 2).astype(np.float32))
    mesh = Mesh(
        torch.from_numpy(points.astype(np.float32)), torch.from_numpy(faces), v_uv, torch.arange(len(v_uv)).view(-1, 3)
    )
    noise = np.random.default_rng(1).random((8 * pages, 8 * pages, 3)).astype(np.float32)
    texture = cv2.resize(noise, (side * pages, side * pages), interpolation=cv2.INTER_LINEAR)
    return Atlas(mesh, side * pages, side * pages, "xatlas", 1, pages), torch.from_numpy(texture)


def read_back(path: Path) -> list[tuple[Atlas, torch.Tensor]]:
    """What usd-core finds in the file, moved by its transforms: each mesh with the image that its surface shows."""
    found = []
    stage = Usd.Stage.Open(str(path))
    for prim in stage.Traverse():
        if not prim.IsA(UsdGeom.Mesh):
            continue
        mesh = UsdGeom.Mesh(prim)
        matrix = np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(Usd.TimeCode.Default()))
        points = np.array(mesh.GetPointsAttr().Get()) @ matrix[:3, :3] + matrix[3, :3]
        faces = torch.from_numpy(np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3).astype(np.int64))
        st = np.array(UsdGeom.PrimvarsAPI(prim).GetPrimvar("st").Get())
        material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
        surface, _, _ = material.ComputeSurfaceSource()
        source = surface.GetInput("diffuseColor").GetConnectedSources()[0][0].source
        name = UsdShade.Shader(source).GetInput("file").Get().path.removeprefix("./")
        with zipfile.ZipFile(path) as archive:
            image = cv2.imdecode(np.frombuffer(archive.read(name), np.uint8), cv2.IMREAD_COLOR)
        assert image is not None
        texture = torch.from_numpy(np.ascontiguousarray(image[..., ::-1]))
        v_uv = torch.from_numpy((st * [1, -1] + [0, 1]).astype(np.float32))
        loaded = Mesh(torch.from_numpy(points.astype(np.float32)), faces, v_uv, faces)
        found.append((Atlas(loaded, image.shape[1], image.shape[0], "scan", 0), texture))
    return found


def issues(path: Path) -> list[str]:
    """What all validators of usd-core say, those of packages, shading and geometry among them."""
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert {"UsdzPackageValidator", "RootPackageValidator", "ShaderSdrCompliance"} <= {
        validator.GetMetadata().name.partition(":")[2] for validator in validators
    }
    found = UsdValidation.ValidationContext(validators).Validate(Usd.Stage.Open(str(path)))
    return [f"{error.GetName()}: {error.GetMessage()}" for error in found]


@pytest.mark.parametrize("pages", [1, 2])
def test_usd_core_and_our_renderer_show_what_the_glb_shows(tmp_path: Path, pages: int) -> None:
    export_model(tmp_path, *hills(pages), up_axis="+z", usdz=True)
    K = torch.tensor([[90.0, 0, 48], [0, 90, 48], [0, 0, 1]], dtype=torch.float64)
    # From above: the sheet, which faced +z, faces +y in the files.
    matrix = torch.tensor([[1.0, 0, 0, -0.5], [0, 0, 1, 0.5], [0, -1, 0, 1.5], [0, 0, 0, 1]], dtype=torch.float64)
    camera = Camera(K, matrix, 96, 96)
    expected, coverage = render_layers(*load_model(tmp_path / "model.glb"), camera, supersample=1)
    parts = [render_layers(*part, camera, supersample=1) for part in read_back(tmp_path / "model.usdz")]
    assert len(parts) == pages**2
    color, covered = sum(part[0] for part in parts), sum(part[1] for part in parts)
    assert coverage.mean() > 0.3
    both = (coverage == 1) & (covered == 1)
    assert both.sum() > 0.98 * coverage.sum()
    assert (color - expected)[both].abs().max() < 0.02


@pytest.mark.parametrize("up_axis", ["+z", "-x", "+y"])
@pytest.mark.parametrize("lossless", [False, True])
def test_validators_find_nothing(tmp_path: Path, up_axis: str, lossless: bool) -> None:
    export_model(tmp_path, *hills(2), up_axis=up_axis, lossless=lossless, usdz=True)
    assert issues(tmp_path / "model.usdz") == []
    stage = Usd.Stage.Open(str(tmp_path / "model.usdz"))
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1
    assert stage.GetDefaultPrim().GetName() == "model"


def test_validators_are_awake(tmp_path: Path) -> None:
    export_model(tmp_path, *hills(), up_axis="+z", usdz=True)
    with zipfile.ZipFile(tmp_path / "model.usdz") as archive, zipfile.ZipFile(tmp_path / "bad.usdz", "w") as bad:
        for name in archive.namelist():
            bad.writestr(name, archive.read(name))
    assert any(words.startswith("ByteMisalignment") for words in issues(tmp_path / "bad.usdz"))


@pytest.mark.parametrize("pages", [1, 2])
def test_entries_are_stored_and_aligned_and_the_crate_comes_first(tmp_path: Path, pages: int) -> None:
    export_model(tmp_path, *hills(pages), up_axis="+z", usdz=True)
    data = (tmp_path / "model.usdz").read_bytes()
    with zipfile.ZipFile(tmp_path / "model.usdz") as archive:
        entries = archive.infolist()
    assert len(entries) == 1 + pages**2
    for number, entry in enumerate(entries):
        name_length, extra = struct.unpack_from("<HH", data, entry.header_offset + 26)
        start = entry.header_offset + 30 + name_length + extra
        assert entry.compress_type == zipfile.ZIP_STORED
        assert start % 64 == 0
        assert data[start : start + 8] == b"PXR-USDC" if number == 0 else data[start : start + 2] == b"\xff\xd8"


def test_larger_images_are_made_as_large_as_ios_shows_them(tmp_path: Path) -> None:
    atlas, _ = hills(side=MAX_SIDE + 64)
    texture = torch.full((atlas.height, atlas.width, 3), 90, dtype=torch.uint8)
    export_model(tmp_path, atlas, texture, up_axis="+z", usdz=True)
    ((read, image),) = read_back(tmp_path / "model.usdz")
    assert (read.width, read.height) == (MAX_SIDE, MAX_SIDE)
    assert (image.int() - 90).abs().max() <= 1

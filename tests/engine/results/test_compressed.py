"""The GLB with Draco has the same faces within its steps, the one with WebP the same colors; both are valid."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import DracoPy
import numpy as np
import pytest
import torch
from sheets import many_charts
from torch import Tensor

from advtex_engine.core.errors import OptionError
from advtex_engine.mesh.clean import clean
from advtex_engine.mesh.models import load_model
from advtex_engine.results.baking import TexturedModel
from advtex_engine.results.compressed import read_glb, require_draco, write_compressed
from advtex_engine.results.export import export_model


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[TexturedModel, Path]:
    out = tmp_path_factory.mktemp("compressed")
    sheet = many_charts(24)
    model = replace(sheet, atlas=replace(sheet.atlas, mesh=clean(sheet.atlas.mesh)))
    export_model(out, model.atlas, model.texture, up_axis="+z")
    files = write_compressed(out, model.atlas, model.texture, {"glb", "draco", "webp"})
    assert [path.name for path in files] == ["model_draco.glb", "model_webp.glb"]
    return model, out


def view_of(path: Path, number: int) -> bytes:
    document, binary = read_glb(path)
    view = document["bufferViews"][number]
    return binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]


def corners(mesh: Any) -> Tensor:
    """Positions and uv of each face's corners, [T,3,5]."""
    return torch.cat((mesh.v_pos[mesh.t_pos_idx], mesh.v_uv[mesh.t_uv_idx]), 2)


def test_draco_brings_back_the_same_faces_within_its_steps(made: tuple[TexturedModel, Path]) -> None:
    _, out = made
    before = corners(load_model(out / "model.glb")[0].mesh).flatten(1)
    document, _ = read_glb(out / "model_draco.glb")
    (primitive,) = document["meshes"][0]["primitives"]
    told = primitive["extensions"]["KHR_draco_mesh_compression"]
    mesh = DracoPy.decode(view_of(out / "model_draco.glb", told["bufferView"]))
    uv = mesh.get_attribute_by_unique_id(told["attributes"]["TEXCOORD_0"])["data"]
    points = mesh.get_attribute_by_unique_id(told["attributes"]["POSITION"])["data"]
    x, y, z = torch.from_numpy(points).unbind(1)
    found = torch.cat((torch.stack((x, z, -y), 1), torch.from_numpy(uv)), 1)[mesh.faces.astype(np.int64)]
    turned = torch.cat([found.roll(shift, 1).flatten(1) for shift in range(3)])  # a face may begin at any corner
    assert len(found) == len(before) == document["accessors"][primitive["indices"]]["count"] / 3
    apart = torch.cdist(before, turned, compute_mode="donot_use_mm_for_euclid_dist")
    assert float(apart.amin(1).max()) < 1e-4
    assert len(points) == document["accessors"][primitive["attributes"]["POSITION"]]["count"]
    assert (out / "model_draco.glb").stat().st_size < 0.7 * (out / "model.glb").stat().st_size


def test_webp_shows_the_same_colors(made: tuple[TexturedModel, Path]) -> None:
    model, out = made
    document, _ = read_glb(out / "model_webp.glb")
    (texture,), (image,) = document["textures"], document["images"]
    assert texture["extensions"]["EXT_texture_webp"]["source"] == 0
    assert "source" not in texture, "a viewer that knows no WebP must not take it for another image"
    data = view_of(out / "model_webp.glb", image["bufferView"])
    assert data[:4] + data[8:12] == b"RIFFWEBP"
    shown = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert np.abs(shown.astype(int) - model.texture.numpy()).mean() < 2


def test_a_lossless_run_has_lossless_webp(made: tuple[TexturedModel, Path], tmp_path: Path) -> None:
    model, _ = made
    export_model(tmp_path, model.atlas, model.texture, up_axis="+z", lossless=True)
    (path,) = write_compressed(tmp_path, model.atlas, model.texture, {"webp"}, lossless=True)
    (image,) = read_glb(path)[0]["images"]
    shown = cv2.imdecode(np.frombuffer(view_of(path, image["bufferView"]), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert np.array_equal(shown, model.texture.numpy())


@pytest.mark.parametrize("word", ["draco", "webp"])
def test_khronos_validator_finds_nothing(
    made: tuple[TexturedModel, Path], gltf_report: Callable[[Path], dict[str, Any]], word: str
) -> None:
    report = gltf_report(made[1] / f"model_{word}.glb")
    assert [issue for issue in report["issues"]["messages"] if issue["severity"] < 2] == []
    assert len(report["info"]["extensionsRequired"]) == 1


def test_without_dracos_encoder_what_to_install_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    require_draco()
    monkeypatch.setitem(sys.modules, "DracoPy", None)
    with pytest.raises(OptionError, match=r"install advtex\[draco\]"):
        require_draco()

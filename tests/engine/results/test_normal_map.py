"""Normal maps bring the fine mesh's normals back through rotated and mirrored charts, and every format carries them."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from pxr import Usd, UsdShade, UsdValidation

from advtex_engine.core.scene import Atlas, Camera, Mesh
from advtex_engine.mesh.detail import Detail
from advtex_engine.mesh.normals import vertex_normals
from advtex_engine.mesh.registration import move_mesh
from advtex_engine.mesh.tangents import TangentFrames
from advtex_engine.render.rasterize import rasterize
from advtex_engine.render.texture import sample_image
from advtex_engine.results import levels
from advtex_engine.results.export import export_model
from advtex_engine.results.levels import write_smaller
from advtex_engine.results.normal_map import bake_normals, decode_normals

SIDE, STRIPS = 384, 8
FROM_ABOVE = Camera(
    torch.tensor([[240.0, 0, 96], [0, 240, 96], [0, 0, 1]], dtype=torch.float64),
    torch.tensor([[1.0, 0, 0, -0.5], [0, -1, 0, 0.5], [0, 0, -1, 1.0], [0, 0, 0, 1]], dtype=torch.float64),
    192,
    192,
)


def sheet(cells: int, ripples: float) -> Mesh:
    """A wavy square facing +z, with ripples of that height (metres) on it."""
    y, x = np.mgrid[: cells + 1, : cells + 1] / cells
    index = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.stack((np.stack((a, b, c), -1), np.stack((a, c, d), -1)), 2).reshape(-1, 3)
    height = 0.05 * np.sin(7 * x + 3 * y) + ripples * np.sin(60 * x) * np.cos(50 * y)
    points = np.stack((x, y, height), -1).reshape(-1, 3)
    return Mesh(torch.from_numpy(points.astype(np.float32)), torch.from_numpy(faces))


def in_strips(cells: int = 32, pages: int = 1) -> Atlas:
    """The sheet without ripples in strips, each a chart of its own beside the one before, every second one mirrored."""
    mesh = sheet(cells, 0)
    faces, points = mesh.t_pos_idx.numpy(), mesh.v_pos.numpy()
    strip = np.repeat(np.arange(cells) * STRIPS // cells, 2 * cells)[:, None]
    across = points[faces, 1] * STRIPS - strip
    v = (STRIPS - 1 - strip + 0.1 + 0.8 * np.where(strip % 2, across, 1 - across)) / STRIPS
    uv = np.stack((points[faces, 0] * 0.96 + 0.02, v), -1)
    if pages > 1:
        page = np.repeat(np.arange(cells) * pages**2 // cells, 2 * cells)[:, None]
        uv = (uv + np.stack((page % pages, page // pages), -1)) / pages
    v_uv = torch.from_numpy(uv.reshape(-1, 2).astype(np.float32))
    atlas_mesh = Mesh(mesh.v_pos, mesh.t_pos_idx, v_uv, torch.arange(len(v_uv)).view(-1, 3))
    return Atlas(atlas_mesh, SIDE * pages, SIDE * pages, "xatlas", STRIPS, pages)


def shown(atlas: Atlas, normal_map: torch.Tensor | None, *, derivatives: bool = False) -> torch.Tensor:
    """Unit normals [P,3] that a viewer lights, of the pixels of FROM_ABOVE.

    derivatives: the tangent is that of each pixel's own face, as viewers make it that know no MikkTSpace.
    """
    mesh = atlas.mesh
    assert mesh.v_uv is not None and mesh.t_uv_idx is not None
    fragments = rasterize(mesh, FROM_ABOVE)
    hit = fragments.face_index.flatten() >= 0
    face, weights = fragments.face_index.flatten()[hit].long(), fragments.barycentric.view(-1, 3)[hit]
    frames = TangentFrames.of(mesh)
    frame = frames.at(face, weights)
    if derivatives:
        a, b, c = mesh.v_pos[mesh.t_pos_idx[face]].unbind(1)
        first, second, third = mesh.v_uv[mesh.t_uv_idx[face]].unbind(1)
        sides = torch.stack((b - a, c - a), 1)
        tangent = (torch.linalg.inv(torch.stack((second - first, third - first), 1)) @ sides)[:, 0]
        normal = frame[:, 2]
        tangent = F.normalize(tangent - (tangent * normal).sum(1, keepdim=True) * normal, dim=1)
        side = torch.where(frames.mirrored[face], -1.0, 1.0)[:, None]
        frame = torch.stack((tangent, side * torch.linalg.cross(normal, tangent), normal), 1)
    if normal_map is None:
        return frame[:, 2]
    uv = (mesh.v_uv[mesh.t_uv_idx[face]] * weights[..., None]).sum(1)
    height, width, _ = normal_map.shape
    own = decode_normals(sample_image(normal_map, uv * uv.new_tensor([width, height])))
    return F.normalize((own[:, None] @ frame)[:, 0], dim=1)


def degrees(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    return torch.rad2deg(torch.atan2(torch.linalg.cross(one, other).norm(dim=1), (one * other).sum(1)))


@pytest.fixture(scope="module")
def fine() -> Mesh:
    return sheet(160, 0.004)


@pytest.fixture(scope="module")
def baked(fine: Mesh) -> torch.Tensor:
    atlas = in_strips()
    return bake_normals(Detail(fine, atlas.mesh.v_pos, 0.01), atlas)


def true_normals(fine: Mesh) -> torch.Tensor:
    fragments = rasterize(fine, FROM_ABOVE)
    hit = fragments.face_index.flatten() >= 0
    corners = fine.t_pos_idx[fragments.face_index.flatten()[hit].long()]
    weights = fragments.barycentric.view(-1, 3)[hit]
    return F.normalize((vertex_normals(fine)[corners] * weights[..., None]).sum(1), dim=1)


@pytest.mark.parametrize("derivatives", [False, True])
def test_the_decimated_mesh_is_lit_as_the_fine_one_and_no_seam_shows(
    fine: Mesh, baked: torch.Tensor, derivatives: bool
) -> None:
    """Seams are an eighth of the pixels about: one that shows is in the worst percent."""
    truth, atlas = true_normals(fine), in_strips()
    without = degrees(shown(atlas, None), truth)
    found = degrees(shown(atlas, baked, derivatives=derivatives), truth)
    assert float(without.mean()) > 7
    assert float(found.mean()) < 0.6
    assert float(torch.quantile(found, 0.999)) < 3


def test_tangents_point_along_u_and_bitangents_to_the_first_row_in_mirrored_charts_too() -> None:
    atlas = in_strips()
    frames = TangentFrames.of(atlas.mesh)
    face = torch.arange(len(atlas.mesh.t_pos_idx))
    frame = frames.at(face, torch.full((len(face), 3), 1 / 3))
    assert torch.allclose(frame @ frame.mT, torch.eye(3).expand_as(frame), atol=1e-5)
    assert float(frame[:, 0, 0].min()) > 0.9  # u grows with x
    row = torch.where(frames.mirrored, -1.0, 1.0)  # y grows to the first row, and away from it where mirrored
    assert frames.mirrored.float().mean() == 0.5
    assert float((frame[:, 1, 1] * row).min()) > 0.9


def test_a_mesh_that_was_moved_takes_its_relief_along(fine: Mesh, baked: torch.Tensor) -> None:
    atlas = in_strips()
    motion = torch.tensor([[0.0, -2, 0, 5], [2, 0, 0, 1], [0, 0, 2, 0], [0, 0, 0, 1]], dtype=torch.float64)
    moved = replace(atlas.mesh, v_pos=move_mesh(atlas.mesh, motion).v_pos)
    again = bake_normals(Detail(fine, atlas.mesh.v_pos, 0.01), replace(atlas, mesh=moved))
    assert torch.equal(baked, again)


def test_what_lies_beyond_twice_the_error_is_left_alone(fine: Mesh) -> None:
    atlas = in_strips()
    low = Mesh(fine.v_pos - torch.tensor([0, 0, 0.02]), fine.t_pos_idx)
    far = bake_normals(Detail(low, atlas.mesh.v_pos, 0.002), atlas)
    assert far.view(-1, 3).unique(dim=0).shape[0] == 1
    assert far[0, 0].tolist() == [128, 128, 255]


def test_it_has_no_more_texels_than_the_fine_mesh_has_something_to_say() -> None:
    atlas = in_strips()
    sizes = [bake_normals(Detail(sheet(cells, 0.004), atlas.mesh.v_pos, 0.01), atlas).shape[0] for cells in (64, 200)]
    assert sizes == [SIDE // 2, SIDE]


def test_parts_of_the_mesh_make_the_whole(fine: Mesh, baked: torch.Tensor, monkeypatch: pytest.MonkeyPatch) -> None:
    atlas = in_strips()
    monkeypatch.setattr("advtex_engine.results.normal_map.PART_FACES", 300)
    parts = bake_normals(Detail(fine, atlas.mesh.v_pos, 0.01), atlas)
    assert float((parts.int() - baked.int()).abs().float().mean()) < 0.05


@pytest.mark.parametrize("pages", [1, 2])
def test_every_format_carries_it_and_validators_find_nothing(
    tmp_path: Path, fine: Mesh, pages: int, gltf_report: Callable[[Path], dict[str, Any]]
) -> None:
    atlas = in_strips(pages=pages)
    texture = torch.full((atlas.height, atlas.width, 3), 120, dtype=torch.uint8)
    normal_map = bake_normals(Detail(fine, atlas.mesh.v_pos, 0.01), atlas)
    files = export_model(tmp_path, atlas, texture, up_axis="+z", usdz=True, lossless=True, normal_map=normal_map)
    names = [f"model_normal{suffix}.png" for suffix in ("", "_2", "_3", "_4")[: pages**2]]
    assert [path.name for path in files if "normal" in path.name] == names
    lines = (tmp_path / "model.mtl").read_text().splitlines()
    assert [line for line in lines if line.startswith("norm ")] == [f"norm {name}" for name in names]
    picture = cv2.imread(str(tmp_path / "model_normal.png"))
    side = normal_map.shape[0] // pages
    assert picture is not None
    assert np.array_equal(picture[..., ::-1], normal_map[:side, :side].numpy())

    found = gltf_report(tmp_path / "model.glb")["issues"]["messages"]
    told = {message["code"] for message in found if message["severity"] < 2}
    assert told == {"MESH_PRIMITIVE_GENERATED_TANGENT_SPACE"}, "viewers make tangents by themselves: see export.py"
    with zipfile.ZipFile(tmp_path / "model.usdz") as archive:
        assert sum(name.startswith("normals") for name in archive.namelist()) == pages**2
    stage = Usd.Stage.Open(str(tmp_path / "model.usdz"))
    surface = UsdShade.Shader(stage.GetPrimAtPath("/model/textured/surface"))
    source = UsdShade.Shader(surface.GetInput("normal").GetConnectedSources()[0][0].source)
    assert source.GetInput("sourceColorSpace").Get() == "raw"
    assert tuple(source.GetInput("scale").Get()) == (2, 2, 2, 1)
    assert tuple(source.GetInput("bias").Get()) == (-1, -1, -1, 0)
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert not UsdValidation.ValidationContext(validators).Validate(stage)


def test_the_model_for_phones_has_one_and_levels_of_detail_none(
    tmp_path: Path, fine: Mesh, baked: torch.Tensor, monkeypatch: pytest.MonkeyPatch
) -> None:
    atlas = in_strips()
    texture = torch.full((SIDE, SIDE, 3), 120, dtype=torch.uint8)
    made = dict[str, Any]()
    monkeypatch.setattr(levels, "MOBILE_FACES", 1_500)
    monkeypatch.setattr(levels, "write_within", lambda path, model, *_: made.update(mobile=model) or path.touch())
    monkeypatch.setattr(levels, "write_glb", lambda path, *_, **options: made.update({path.name: options}))
    write_smaller(tmp_path, atlas, texture, {"mobile", "lod"}, up_axis="+z", normal_map=baked)
    mobile = made.pop("mobile")
    truth = true_normals(fine)
    assert mobile.normal_map.shape[0] < mobile.texture.shape[0] * 1.01
    found = degrees(shown(mobile.atlas, mobile.normal_map), truth)
    assert float(found.mean()) < 1.2
    assert all("normal_map" not in options for options in made.values())

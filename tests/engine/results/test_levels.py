"""Smaller models look like the full one, have the faces, texels and bytes that they are said to have, and are valid."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import Atlas, Camera, Mesh
from advtex_engine.mesh.models import load_model
from advtex_engine.render.render_view import render_view
from advtex_engine.results import levels
from advtex_engine.results.baking import TexturedModel, bake
from advtex_engine.results.levels import write_smaller

FROM_ABOVE = Camera(
    torch.tensor([[110.0, 0, 64], [0, 110, 64], [0, 0, 1]], dtype=torch.float64),
    torch.tensor([[1.0, 0, 0, -0.5], [0, -1, 0, 0.5], [0, 0, -1, 1.3], [0, 0, 0, 1]], dtype=torch.float64),
    128,
    128,
)


def many_charts(cells: int = 48, side: int = 512) -> TexturedModel:
    """A wavy sheet facing +z in strips, each a chart of its own that lies upside down beside the one before."""
    at = np.linspace(0, 1, cells + 1)
    y, x = np.meshgrid(at, at, indexing="ij")
    index = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.stack((np.stack((a, b, c), -1), np.stack((a, c, d), -1)), 2).reshape(-1, 3)
    points = np.stack((x, y, 0.05 * np.sin(7 * x + 3 * y)), -1).reshape(-1, 3)
    strips = cells // 4
    strip = np.repeat(np.arange(cells) // 4, 2 * cells)[:, None]
    place = strips - 1 - strip  # of the strip in the texture
    across = points[faces, 1] * strips - strip
    v = (place + 0.1 + 0.8 * np.where(strip % 2, across, 1 - across)) / strips
    uv = np.stack((points[faces, 0] * 0.96 + 0.02, v), -1).reshape(-1, 2)
    rows, columns = (np.mgrid[:side, :side] + 0.5) / side
    there = np.floor(rows * strips)
    within = np.clip((rows * strips - there - 0.1) / 0.8, 0, 1)
    number = strips - 1 - there
    height = (number + np.where(number % 2, within, 1 - within)) / strips
    texture = painted((columns - 0.02) / 0.96, height)
    mesh = Mesh(
        torch.from_numpy(points.astype(np.float32)),
        torch.from_numpy(faces),
        torch.from_numpy(uv.astype(np.float32)),
        torch.arange(len(uv)).view(-1, 3),
    )
    return TexturedModel(Atlas(mesh, side, side, "xatlas", strips), torch.from_numpy(texture))


def painted(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Smooth colors [...,3] uint8 of the sheet's points."""
    waves = (np.sin(9 * x + 2 * y), np.sin(8 * y - 3 * x), np.cos(11 * x * y))
    return np.stack([np.rint(127 + 100 * wave).astype(np.uint8) for wave in waves], -1)


def test_another_mesh_is_painted_with_what_lies_under_it_through_all_charts() -> None:
    source = many_charts()
    bare = Mesh(source.atlas.mesh.v_pos, source.atlas.mesh.t_pos_idx)
    baked = bake(source, bare, 1.0, 4096, Monitor())
    assert baked.error < 1e-4
    assert baked.model.texels == pytest.approx(source.texels, rel=0.05)
    before, after = (render_view(one.atlas, one.texture, FROM_ABOVE) for one in (source, baked.model))
    assert float((before - after).abs().max()) < 0.04  # a strip of another chart would be off by .5


def test_levels_have_a_quarter_of_the_faces_and_texels_each_and_look_the_same(tmp_path: Path) -> None:
    full = many_charts()
    files = write_smaller(tmp_path, full.atlas, full.texture, {"lod"}, up_axis="+y")
    assert [path.name for path in files] == ["model_lod1.glb", "model_lod2.glb"]
    seen = render_view(full.atlas, full.texture, FROM_ABOVE)
    faces, texels = full.faces, full.texels
    for path, difference in zip(files, (0.01, 0.02), strict=True):
        level = TexturedModel(*load_model(path))
        assert 0.2 * faces < level.faces <= faces / 4
        assert level.texels == pytest.approx(texels / 4, rel=0.1)
        assert float((render_view(level.atlas, level.texture, FROM_ABOVE) - seen).abs().mean()) < difference
        faces, texels = level.faces, level.texels


@pytest.mark.parametrize(("share", "most"), [(1 / 1.5, 0.008), (1 / 4, 0.02)])
def test_fewer_texels_are_as_sharp_as_they_can_be(share: float, most: float) -> None:
    """Waves of eleven texels, drawn at two pixels to one of theirs: bilinear samples are off by .012 and .048."""
    sheet = many_charts(4, 512)
    rows, columns = np.mgrid[:512, :512]
    waves = np.sin(columns * 2 * np.pi / 11) * np.sin(rows * 2 * np.pi / 11)
    texture = np.repeat(np.rint(127 + 100 * waves)[..., None], 3, 2).astype(np.uint8)
    source = TexturedModel(sheet.atlas, torch.from_numpy(texture))
    bare = Mesh(source.atlas.mesh.v_pos, source.atlas.mesh.t_pos_idx)
    K = torch.tensor([[1300.0, 0, 64], [0, 1300, 64], [0, 0, 1]], dtype=torch.float64)
    close = Camera(K, FROM_ABOVE.world_to_camera, 128, 128)
    before = render_view(source.atlas, source.texture, close)
    baked = bake(source, bare, share, 4096, Monitor()).model
    assert float((render_view(baked.atlas, baked.texture, close) - before).abs().mean()) < most


def test_the_model_for_phones_has_few_faces_and_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    full = many_charts()
    monkeypatch.setattr(levels, "MOBILE_FACES", 1500)
    write_smaller(tmp_path, full.atlas, full.texture, {"mobile"}, up_axis="+z")
    best = (tmp_path / "model_mobile.glb").stat().st_size
    assert len(load_model(tmp_path / "model_mobile.glb")[0].mesh.t_pos_idx) <= 1500
    monkeypatch.setattr(levels, "MOBILE_BYTES", best - 2000)
    write_smaller(tmp_path, full.atlas, full.texture, {"mobile"}, up_axis="+z")
    assert (tmp_path / "model_mobile.glb").stat().st_size <= best - 2000


def test_a_model_that_is_small_already_keeps_its_faces_and_texels(tmp_path: Path) -> None:
    full = many_charts()
    write_smaller(tmp_path, full.atlas, full.texture, {"mobile"}, up_axis="+y")
    atlas, texture = load_model(tmp_path / "model_mobile.glb")
    assert len(atlas.mesh.t_pos_idx) == full.faces
    assert texture.shape == full.texture.shape


def test_few_faces_stay_as_they_are_in_all_levels(tmp_path: Path) -> None:
    full = many_charts(8, 64)
    for path in write_smaller(tmp_path, full.atlas, full.texture, {"lod"}, up_axis="+y"):
        assert len(load_model(path)[0].mesh.t_pos_idx) == full.faces


def test_khronos_validator_finds_nothing(tmp_path: Path, gltf_report: Callable[[Path], dict[str, Any]]) -> None:
    full = many_charts()
    files = write_smaller(tmp_path, full.atlas, full.texture, {"mobile", "lod"}, up_axis="+z")
    for path in files:
        report = gltf_report(path)
        assert [issue for issue in report["issues"]["messages"] if issue["severity"] < 2] == []
        assert report["info"].get("extensionsUsed", []) == []


def test_nothing_is_made_that_was_not_asked_for(tmp_path: Path) -> None:
    full = many_charts(8, 64)
    assert write_smaller(tmp_path, full.atlas, full.texture, {"obj", "glb", "usdz"}, up_axis="+z") == ()
    assert list(tmp_path.iterdir()) == []

"""Smaller models look like the full one, have the faces, texels and bytes that they are said to have, and are valid."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from sheets import FROM_ABOVE, many_charts

from advtex_engine.core.errors import Problem
from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import Atlas, Camera, Mesh
from advtex_engine.mesh.models import load_model
from advtex_engine.render.render_view import render_view
from advtex_engine.results import levels
from advtex_engine.results.baking import TexturedModel, bake
from advtex_engine.results.levels import write_smaller


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


class Told(Monitor):
    def __init__(self) -> None:
        self.problems = list[Problem]()

    def warning(self, problem: Problem) -> None:
        self.problems.append(problem)


def loose_pieces(count: int, side: int) -> TexturedModel:
    """Triangles here and there that touch no other, each with its own place in the texture."""
    rng = np.random.default_rng(0)
    points = (rng.random((count, 1, 3)) * 4 + 0.01 * rng.standard_normal((count, 3, 3))).astype(np.float32)
    across = math.ceil(count**0.5)
    cell = np.stack((np.arange(count) % across, np.arange(count) // across), 1)[:, None]
    uv = ((cell + np.array([[0.2, 0.2], [0.8, 0.2], [0.2, 0.8]])) / across).astype(np.float32)
    corners = torch.arange(3 * count).view(-1, 3)
    mesh = Mesh(torch.from_numpy(points.reshape(-1, 3)), corners, torch.from_numpy(uv.reshape(-1, 2)), corners)
    return TexturedModel(Atlas(mesh, side, side, "scan", count), torch.full((side, side, 3), 99, dtype=torch.uint8))


def test_a_model_for_phones_that_misses_its_limits_is_made_and_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    full, told = loose_pieces(800, 256), Told()
    monkeypatch.setattr(levels, "MOBILE_FACES", 400)
    monkeypatch.setattr(levels, "MOBILE_BYTES", 10_000)
    write_smaller(tmp_path, full.atlas, full.texture, {"mobile"}, up_axis="+z", monitor=told)
    size = (tmp_path / "model_mobile.glb").stat().st_size
    (problem,) = told.problems
    assert (problem.code, problem.where) == ("mobile_limits_missed", "model_mobile.glb")
    assert f"it has {size / 1e6:.1f} MB, more than 0, with its image as a JPEG of quality 50" in problem.message
    assert re.search(r"it lacks [2-4]\d% of the surface", problem.message), "half of the pieces are left out"
    assert "loose pieces" in problem.remedy


def test_pieces_whose_charts_fit_in_no_image_for_phones_leave_the_model_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    full, told = loose_pieces(300, 512), Told()
    for name, value in {"MOBILE_FACES": 290, "SMALL_SIDE": 128, "MOBILE_SIDE": 128}.items():
        monkeypatch.setattr(levels, name, value)
    (path,) = write_smaller(tmp_path, full.atlas, full.texture, {"mobile"}, up_axis="+z", monitor=told)
    assert len(load_model(path)[0].mesh.t_pos_idx) == 300
    (problem,) = told.problems
    assert "it has 300 faces, more than 290" in problem.message
    assert "512 texels a side, more than 128" in problem.message


def test_a_level_whose_charts_do_not_fit_is_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    full, told = many_charts(8, 64), Told()
    monkeypatch.setattr(levels, "MOBILE_SIDE", 128)
    assert write_smaller(tmp_path, full.atlas, full.texture, {"lod"}, up_axis="+z", monitor=told) == ()
    assert [(problem.code, problem.where) for problem in told.problems] == [("level_left_out", "model_lod1.glb")]

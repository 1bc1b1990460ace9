"""Atlases of several pages: within their cap, as dense as one texture, and no sample reads another page."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from atlases import area, bumpy_sphere, camera, check_sound, texel_corners

from advtex_engine.atlas import build as atlas_module
from advtex_engine.atlas.build import SIZE_STEP, build_atlas
from advtex_engine.atlas.charting import PADDING
from advtex_engine.core.config import TextureConfig
from advtex_engine.core.errors import Stopped
from advtex_engine.core.monitor import STAGES, Monitor
from advtex_engine.ingest.read import ingest
from advtex_engine.mesh.models import load_model
from advtex_engine.pipeline import texture_scan
from advtex_engine.render.render_view import render_layers
from advtex_engine.render.texture import bilinear_footprint, decode_uv, encode_uv
from advtex_engine.synthetic.scan import synthesize


class StopsBefore(Monitor):
    def __init__(self, stage: str) -> None:
        self.stage, self.reached = stage, False

    def stage_finished(
        self, stage: str, seconds: float, peak_memory_bytes: int, peak_device_memory_bytes: int | None
    ) -> None:
        self.reached |= STAGES.index(stage) + 1 == STAGES.index(self.stage)

    def stop_requested(self) -> bool:
        return self.reached


@pytest.fixture
def small_pages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(atlas_module, "MAX_PAGE", 512)


NEAR = [camera((2.2, 0, 0), 1600, 1200, 1500.0), camera((-2.2, 0, 0), 1600, 1200, 1500.0)]


@pytest.mark.usefixtures("small_pages")
@pytest.mark.parametrize("cap", [512, 700, 1024])
def test_what_a_page_cannot_hold_gets_four(cap: int) -> None:
    mesh = bumpy_sphere(3)
    atlas = build_atlas(mesh, NEAR, TextureConfig(max_texture_size=cap), Monitor())
    check_sound(atlas, mesh)
    assert atlas.pages == (2 if cap > 512 else 1)
    assert cap - 3 * SIZE_STEP < atlas.width <= cap
    assert atlas.width // atlas.pages % SIZE_STEP == 0
    if atlas.pages == 1:
        return
    local = texel_corners(atlas) % (atlas.width // 2)
    assert local.min() >= PADDING
    assert local.max() <= atlas.width // 2 - PADDING
    used = np.bincount((texel_corners(atlas).mean(axis=1) // (atlas.width // 2) @ [1, 2]).astype(int), minlength=4)
    assert used.min() > len(mesh.t_pos_idx) / 16


def test_pages_are_as_dense_as_one_texture_would_be(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = bumpy_sphere(3)
    wanted = TextureConfig(texels_per_pixel=0.75, max_texture_size=4096)
    whole = build_atlas(mesh, NEAR, wanted, Monitor())
    monkeypatch.setattr(atlas_module, "MAX_PAGE", whole.width * 3 // 4)
    paged = build_atlas(mesh, NEAR, wanted, Monitor())
    assert (paged.pages, whole.pages) == (2, 1)
    assert area(texel_corners(paged)).sum() == pytest.approx(area(texel_corners(whole)).sum(), rel=0.01)
    assert paged.width <= whole.width * 1.3  # 22 charts cannot be shared out evenly


@pytest.mark.usefixtures("small_pages")
@pytest.mark.parametrize("scale", [1, 2])
def test_no_sample_reads_a_texel_of_another_page(scale: int) -> None:
    """Neither at the full size nor at the half one of a coarse pyramid level, with uv as coarse as views store them."""
    atlas = build_atlas(bumpy_sphere(3), NEAR, TextureConfig(max_texture_size=1024), Monitor())
    width, page = atlas.width // scale, atlas.width // scale // 2
    weights = torch.from_numpy(np.random.default_rng(0).dirichlet((0.3, 0.3, 0.3), (len(atlas.mesh.t_pos_idx), 50)))
    weights[:, :3] = torch.eye(3)
    assert atlas.mesh.v_uv is not None
    assert atlas.mesh.t_uv_idx is not None
    uv = decode_uv(encode_uv((weights @ atlas.mesh.v_uv[atlas.mesh.t_uv_idx].double()).float()))
    index, weight = bilinear_footprint(uv.view(-1, 2) * width, width, width)
    read = torch.stack((index % width // page, index // width // page), 2)
    own = torch.from_numpy(texel_corners(atlas).mean(axis=1) // (atlas.width // 2)).long().repeat_interleave(50, 0)
    assert (read == own[:, None])[weight > 0].all()


@pytest.mark.slow
def test_a_scan_is_textured_in_pages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(atlas_module, "MAX_PAGE", 256)
    synthesize(tmp_path / "scan", views=8, width=192, height=144)
    config = TextureConfig(preset="preview", steps=4, holdout=4, face_budget=2000, device="cpu", refine=False)
    with pytest.raises(Stopped):
        texture_scan(tmp_path / "scan", tmp_path, config, work=tmp_path / "work", monitor=StopsBefore("optimization"))
    result = texture_scan(tmp_path / "scan", tmp_path, config, work=tmp_path / "work", resume=True)
    assert result.report["atlas"]["pages"] == 2
    images = [path for path in result.files if path.suffix == ".png" and path.parent == tmp_path]
    pages = ["model.png", "model_2.png", "model_3.png", "model_4.png"]
    assert [path.name for path in images if "seen" not in path.name] == pages
    views = ingest(tmp_path / "scan", config, Monitor()).heldout
    for name in ("model.obj", "model.glb"):
        atlas, texture = load_model(tmp_path / name)
        assert (atlas.pages, atlas.width) == (2, result.report["atlas"]["width"])
    off, seen = list[float](), list[float]()
    atlas, texture = load_model(tmp_path / "model.obj")
    for view in views:
        color, coverage = render_layers(atlas, texture, view.camera, supersample=1)
        whole = coverage == 1
        off.append(float((color - view.color / 255)[whole].abs().mean()))
        seen.append(float(whole.float().mean()))
    assert max(off) < 0.15
    assert min(seen) > 0.1

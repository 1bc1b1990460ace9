"""Renders against closed forms, and the pictures' layout."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from advtex_engine.core.scene import Atlas, Camera, Mesh, View, evenly_spread
from advtex_engine.render.pictures import CAPTION_HEIGHT, GUTTER, contact_sheet, side_by_side
from advtex_engine.render.render_view import render_layers, render_view

WIDTH, HEIGHT = 12, 8


def screen(texture_width: int, texture_height: int, right: float = WIDTH) -> Atlas:
    """A rectangle one metre before `front_camera` that covers the image's columns 0 to `right`."""
    v_pos = torch.tensor([[0.0, 0, 1], [right / 10, 0, 1], [right / 10, HEIGHT / 10, 1], [0, HEIGHT / 10, 1]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    v_uv = torch.tensor([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    return Atlas(Mesh(v_pos, faces, v_uv, faces), texture_width, texture_height, "scan", 1)


def front_camera() -> Camera:
    """Ten pixels per metre at one metre; the image's corner looks along the world's z axis."""
    K = torch.tensor([[10.0, 0, 0], [0, 10, 0], [0, 0, 1]], dtype=torch.float64)
    return Camera(K, torch.eye(4, dtype=torch.float64), WIDTH, HEIGHT)


def texels(width: int, height: int) -> Tensor:
    return torch.randint(0, 256, (height, width, 3), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)


def view(name: str = "frame-7") -> View:
    return View(name, front_camera(), texels(WIDTH, HEIGHT))


def read(path: Path) -> np.ndarray:
    image = cv2.imread(str(path))
    assert image is not None
    return np.asarray(image[..., ::-1])


def test_a_screen_shows_its_texture_the_right_way_up() -> None:
    texture = texels(WIDTH, HEIGHT)
    picture = render_view(screen(WIDTH, HEIGHT), texture, front_camera(), supersample=1)
    assert torch.allclose(picture * 255, texture.float(), atol=0.02)


def test_supersampling_averages_the_samples() -> None:
    texture = texels(2 * WIDTH, 2 * HEIGHT)
    picture = render_view(screen(2 * WIDTH, 2 * HEIGHT), texture, front_camera(), supersample=2)
    expected = texture.float().view(HEIGHT, 2, WIDTH, 2, 3).mean(dim=(1, 3))
    assert torch.allclose(picture * 255, expected, atol=0.02)


def test_bytes_and_floats_are_the_same_texture() -> None:
    texture, atlas = texels(WIDTH, HEIGHT), screen(WIDTH, HEIGHT)
    floats = render_view(atlas, texture.double() / 255, front_camera())
    assert torch.allclose(render_view(atlas, texture, front_camera()), floats, atol=1e-6)


def test_pixels_that_are_half_covered_are_half_background() -> None:
    atlas, texture = screen(4, 4, right=5.5), torch.full((4, 4, 3), 255, dtype=torch.uint8)
    color, coverage = render_layers(atlas, texture, front_camera(), supersample=2)
    assert coverage[0].tolist() == [1] * 5 + [0.5] + [0] * 6
    assert torch.equal(color[..., 0], coverage)
    picture = render_view(atlas, texture, front_camera(), supersample=2, background=0.2)
    assert picture[3, :, 1].tolist() == pytest.approx([1] * 5 + [0.6] + [0.2] * 6)


def test_a_camera_that_looks_away_sees_the_background() -> None:
    away = Camera(front_camera().K, torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64)), WIDTH, HEIGHT)
    picture = render_view(screen(4, 4), texels(4, 4), away, background=0.25)
    assert picture.unique().tolist() == [0.25]


def test_side_by_side_holds_the_three_pictures(tmp_path: Path) -> None:
    rendered, mean = torch.full((HEIGHT, WIDTH, 3), 0.6), torch.full((HEIGHT, WIDTH, 3), 1.7)
    side_by_side(view(), rendered, mean, tmp_path / "comparison.png")
    image = read(tmp_path / "comparison.png")
    assert image.shape == (HEIGHT + CAPTION_HEIGHT, 3 * WIDTH + 2 * GUTTER, 3)
    panels = [image[CAPTION_HEIGHT:, i * (WIDTH + GUTTER) :][:, :WIDTH] for i in range(3)]
    assert np.array_equal(panels[0], view().color.numpy())
    assert (panels[1] == 153).all()
    assert (panels[2] == 255).all()


def test_contact_sheet_has_a_row_per_view(tmp_path: Path) -> None:
    views = [view("a"), view("b"), view("c")]
    rows = [[torch.full((HEIGHT, WIDTH, 3), level)] for level in (0.2, 0.4, 0.6)]
    contact_sheet(views, rows, ["render"], tmp_path / "sheet.png")
    image = read(tmp_path / "sheet.png")
    high = HEIGHT + CAPTION_HEIGHT + GUTTER
    assert image.shape == (3 * high, 2 * WIDTH + GUTTER, 3)
    for index, level in enumerate((51, 102, 153)):
        row = image[index * high + CAPTION_HEIGHT :][:HEIGHT]
        assert np.array_equal(row[:, :WIDTH], views[index].color.numpy())
        assert (row[:, WIDTH + GUTTER :] == level).all()


def test_captions_are_written(tmp_path: Path) -> None:
    wide = View("x", Camera(front_camera().K, front_camera().world_to_camera, 160, 8), texels(160, 8))
    side_by_side(wide, torch.zeros(8, 160, 3), torch.zeros(8, 160, 3), tmp_path / "wide.png")
    caption = read(tmp_path / "wide.png")[:CAPTION_HEIGHT]
    for panel in range(3):
        assert (caption[:, panel * (160 + GUTTER) :][:, :160] < 128).sum() > 100


@given(st.integers(1, 60), st.integers(1, 20))
def test_evenly_spread_views_are_distinct_ordered_and_reach_both_ends(available: int, count: int) -> None:
    views = [View(f"{index:03d}", front_camera(), texels(WIDTH, HEIGHT)) for index in range(available)]
    names = [chosen.name for chosen in evenly_spread(views, count)]
    assert len(names) == len(set(names)) == min(count, available)
    assert names == sorted(names)
    assert names[0] == views[0].name
    assert count == 1 or names[-1] == views[-1].name

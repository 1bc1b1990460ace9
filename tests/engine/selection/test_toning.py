"""Views of a texture, one with a brightness of its own, one with a stain and half of it background."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.adversarial.disagreement import disagreement
from advtex_engine.render.texture import encode_uv
from advtex_engine.render.view_maps import ViewMaps
from advtex_engine.selection.toning import tone_views

WIDTH, HEIGHT = 160, 120


def texture() -> Tensor:
    """[H,W,3] in [0.3, 0.7], as large as the views."""
    return 0.3 + 0.4 * torch.rand((HEIGHT, WIDTH, 3), generator=torch.Generator().manual_seed(0))


def straight_on(images: Tensor, depth: Tensor) -> ViewMaps:
    """Maps of views [V,H,W,3] in [0,1] whose every pixel shows the texel at its place; depth: [V,H,W]."""
    count = len(images)
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    uv = encode_uv(torch.stack((x / WIDTH, y / HEIGHT), -1)).view(1, -1, 2).repeat(count, 1, 1)
    return ViewMaps(
        color=(255 * images).round().to(torch.uint8).view(count, -1, 3),
        uv=uv,
        depth=depth.view(count, -1).to(torch.float16),
        intrinsics=torch.ones((count, 4)),
        world_to_camera=torch.eye(4, dtype=torch.float64).repeat(count, 1, 1),
        slot_map=torch.arange(HEIGHT * WIDTH, dtype=torch.int32).view(HEIGHT, WIDTH),
        slots=HEIGHT * WIDTH,
        width=WIDTH,
        height=HEIGHT,
    )


def wide(images: Tensor) -> Tensor:
    """Averages over 20 pixels, of the values of [V,H*W,3]."""
    return F.avg_pool2d(images.float().view(-1, HEIGHT, WIDTH, 3).permute(0, 3, 1, 2), 20)


@pytest.fixture
def toned() -> tuple[ViewMaps, ViewMaps]:
    """Before and after: the first view is brighter to the right by up to 15 %, the second one's left is background."""
    brighter = texture() * torch.linspace(1, 1.15, WIDTH)[None, :, None]
    half = texture() * 0.9
    half[:, : WIDTH // 2] = 1.0
    depth = torch.ones((2, HEIGHT, WIDTH))
    depth[1, :, : WIDTH // 2] = 0
    before = straight_on(torch.stack((brighter, half)), depth)
    after = replace(before, color=before.color.clone())
    tone_views(after, texture())
    return before, after


def test_wide_averages_become_those_of_the_texture(toned: tuple[ViewMaps, ViewMaps]) -> None:
    before, after = toned
    target = wide(255 * texture()[None])
    off = [(wide(maps.color[:1]) - target).abs().mean() for maps in toned]
    assert off[0] > 8
    assert off[1] < 0.15 * off[0]
    right = (wide(after.color[1:]) - target)[..., 4:].abs().mean()
    assert right < 0.15 * (wide(before.color[1:]) - target)[..., 4:].abs().mean()


def test_detail_stays_as_photographed(toned: tuple[ViewMaps, ViewMaps]) -> None:
    """Neighboring pixels differ by what they differed by."""
    steps = [maps.color[0].float().view(HEIGHT, WIDTH, 3).diff(dim=1) for maps in toned]
    assert (steps[0] - steps[1]).abs().max() <= 2
    assert steps[0].abs().mean() > 20


def test_what_is_no_foreground_does_not_count(toned: tuple[ViewMaps, ViewMaps]) -> None:
    """The white background beside it does not darken the object's edge; far from the object nothing changes."""
    before, after = (maps.color[1].float().view(HEIGHT, WIDTH, 3) for maps in toned)
    edge = float((after - before)[:, WIDTH // 2 : WIDTH // 2 + 4].mean())
    assert edge == pytest.approx(float((after - before)[:, -20:].mean()), rel=0.15)
    assert (after - before)[:, :8].abs().max() == 0


def test_a_texture_of_another_size_tones_alike(toned: tuple[ViewMaps, ViewMaps]) -> None:
    before, after = toned
    again = replace(before, color=before.color.clone())
    doubled = F.interpolate(texture().permute(2, 0, 1)[None], scale_factor=2.0, mode="nearest")[0].permute(1, 2, 0)
    tone_views(again, doubled)
    assert (again.color.float() - after.color.float()).abs().max() <= 2


def test_the_disagreement_is_the_mean_difference_over_what_each_view_shows() -> None:
    shown = texture()
    views = torch.stack((shown + 0.1, shown, shown))
    views[1, :, : WIDTH // 2] += 0.2
    depth = torch.ones((3, HEIGHT, WIDTH))
    depth[1, :, WIDTH // 2 :] = 0
    depth[2] = 0
    assert disagreement(straight_on(views, depth), shown) == pytest.approx((0.1 + 0.2) / 2, abs=2e-3)
    assert disagreement(straight_on(views, torch.zeros_like(depth)), shown) == 0.0

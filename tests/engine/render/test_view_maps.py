"""View maps, reprojection and pairs on a scene whose answer is known: two planes before a row of cameras."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from advtex_engine.core.cameras import project, unproject
from advtex_engine.core.scene import Atlas, Camera, Mesh, View
from advtex_engine.ingest.shrink import shrink
from advtex_engine.refine.points import surface_depths
from advtex_engine.render import pairs, view_maps
from advtex_engine.render.pairs import example_differences, overlaps, related_pairs
from advtex_engine.render.reproject import reproject, unproject_pixels
from advtex_engine.render.texture import decode_uv, touched_slots
from advtex_engine.render.view_maps import UNMEASURED, ViewMaps, always_read, build_view_maps, contradicted

WIDTH, HEIGHT, FOCAL = 64, 48, 60.0


def scene_mesh() -> Mesh:
    """A wall 3 x 3 m at z = 2 with uv over it, and a card 0.4 x 0.4 m at z = 1 before its middle."""
    wall = [[-1.5, -1.5, 2.0], [1.5, -1.5, 2.0], [1.5, 1.5, 2.0], [-1.5, 1.5, 2.0]]
    card = [[-0.2, -0.2, 1.0], [0.2, -0.2, 1.0], [0.2, 0.2, 1.0], [-0.2, 0.2, 1.0]]
    uv = [[0.0, 0.0], [0.7, 0.0], [0.7, 0.7], [0.0, 0.7], [0.75, 0.75], [1.0, 0.75], [1.0, 1.0], [0.75, 1.0]]
    faces = torch.tensor([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    return Mesh(torch.tensor(wall + card), faces, torch.tensor(uv), faces)


ATLAS = Atlas(scene_mesh(), 256, 256, "scan", 2)


def camera_at(x: float, turn: float = 0.0) -> Camera:
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64)
    angle = torch.tensor(turn).deg2rad().double()
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 0] = pose[2, 2] = angle.cos()
    pose[0, 2], pose[2, 0] = angle.sin(), -angle.sin()
    pose[0, 3] = x
    return Camera(K, torch.linalg.inv(pose), WIDTH, HEIGHT)


def maps_of(cameras: list[Camera], depth: torch.Tensor | None = None, mask: torch.Tensor | None = None) -> ViewMaps:
    """Views that tell by blue which they are."""
    views = [viewed(camera, depth, mask, blue=index) for index, camera in enumerate(cameras)]
    return build_view_maps(ATLAS, tuple(views), "object")


def viewed(
    camera: Camera, depth: torch.Tensor | None = None, mask: torch.Tensor | None = None, *, blue: int = 0
) -> View:
    """Its color codes its pixels: red = column, green = row."""
    color = torch.zeros(HEIGHT, WIDTH, 3, dtype=torch.uint8)
    color[..., 0] = torch.arange(WIDTH)
    color[..., 1] = torch.arange(HEIGHT)[:, None]
    color[..., 2] = blue
    return View(f"view{blue}", camera, color, depth, mask)


def test_what_a_mask_leaves_out_is_background() -> None:
    mask = torch.rand(HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0)) < 0.5
    whole, masked = (maps_of([camera_at(0.0)], mask=given).depth.view(HEIGHT, WIDTH) for given in (None, mask))
    assert torch.equal(masked, torch.where(mask, whole, 0))
    assert (masked > 0).any()


def test_a_smaller_view_uses_what_all_of_its_pixels_allow() -> None:
    mask = torch.rand(HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0)) < 0.8
    view = View("view", camera_at(0.0), torch.zeros(HEIGHT, WIDTH, 3, dtype=torch.uint8), mask=mask)
    small = shrink(view, 2)
    rows, columns = torch.arange(HEIGHT // 2)[:, None] * 2, torch.arange(WIDTH // 2) * 2
    allowed = mask[rows, columns] & mask[rows + 1, columns] & mask[rows, columns + 1] & mask[rows + 1, columns + 1]
    assert small.mask is not None
    assert torch.equal(small.mask, allowed)
    size = (WIDTH // 2, HEIGHT // 2)
    whole, masked = (
        surface_depths(scene_mesh(), (given,), size, "object")[1][0] for given in (replace(view, mask=None), view)
    )
    assert torch.equal(masked, torch.where(allowed, whole, 0))
    assert (masked > 0).any()


def test_uv_and_depth_are_those_of_the_surface_point_at_each_pixel_center() -> None:
    camera = camera_at(0.1)
    maps = maps_of([camera])
    depth = maps.depth[0].view(HEIGHT, WIDTH).float()
    wall = (depth - 2).abs() < 1e-3
    assert wall.float().mean() > 0.5
    rows, columns = wall.nonzero().unbind(1)
    points = unproject(camera, torch.stack((columns, rows), 1) + 0.5, depth[wall])
    expected = (points[:, :2] + 1.5) / 3 * 0.7
    codes = maps.uv[0].view(HEIGHT, WIDTH, 2)[wall]
    assert (decode_uv(codes) - expected).abs().max() < 1e-4


def test_device_depth_that_contradicts_the_mesh_is_background() -> None:
    measured = torch.full((HEIGHT, WIDTH), 2.0)
    measured[:10] = 1.5
    measured[10:20] = 0
    depth = maps_of([camera_at(0.0)], measured).depth[0].view(HEIGHT, WIDTH)
    assert (depth[10 + round(WIDTH * UNMEASURED) : 20, : WIDTH // 4] > 0).all()
    assert (depth[HEIGHT // 2, WIDTH // 2] == 0).all(), "the card is nearer than measured"


def test_a_reading_speaks_for_pixels_near_it_that_have_none_but_where_nothing_else_shows_the_surface(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Rows 5 to 30 have no reading; above them lies something else. Two pixels of the wall are some four texels."""
    monkeypatch.setattr(view_maps, "UNMEASURED", 25 / WIDTH)
    measured = torch.full((HEIGHT, WIDTH), 2.0)
    measured[:5] = 1.5
    measured[5:30] = 0
    corner = np.s_[:, : WIDTH // 4]
    alone = maps_of([camera_at(0.0)], measured)
    depth = alone.depth[0].view(HEIGHT, WIDTH)[corner]
    assert (depth[:5] == 0).all()
    assert (depth[5:27] > 0).all()
    assert (depth[28:30] == 0).all(), "what the pixels below them show"
    assert (depth[30:] > 0).all()
    seen = build_view_maps(ATLAS, (viewed(camera_at(0.0), measured), viewed(camera_at(0.0), measured * 0)), "object")
    depth = seen.depth[0].view(HEIGHT, WIDTH)[corner]
    assert (depth[:30] == 0).all(), "another view shows all of it"
    assert (depth[30:] > 0).all()
    assert (seen.depth[1].view(HEIGHT, WIDTH)[corner] > 0).all()
    # Every texel that a foreground pixel samples has a slot, and none else.
    for maps in (alone, seen):
        foreground = maps.depth.view(maps.count, HEIGHT, WIDTH) > 0
        codes = maps.uv.view(maps.count, HEIGHT, WIDTH, 2)
        assert torch.equal(touched_slots(codes, foreground, 256, 256)[0], maps.slot_map)


def test_no_reading_is_no_surface_where_depth_is_found_of_all_surfaces() -> None:
    """The mesh goes on for a column beyond what was measured of a wall that ends in the middle."""
    whole = scene_mesh()
    assert whole.v_uv is not None
    position, faces = whole.v_pos[:4].clone(), whole.t_pos_idx[:2]
    position[1:3, 0] = 2 / FOCAL
    atlas = Atlas(Mesh(position, faces, whole.v_uv[:4], faces), 2048, 2048, "scan", 1)
    measured = torch.full((HEIGHT, WIDTH), 2.0)
    measured[:, WIDTH // 2 :] = 0
    beyond, columns = np.s_[10:-10, WIDTH // 2], np.s_[10:-10, WIDTH // 4 : WIDTH // 2]

    def depth_of(*depths: torch.Tensor | None) -> torch.Tensor:
        views = tuple(viewed(camera_at(0.0), depth) for depth in depths)
        return build_view_maps(atlas, views, "object").depth[0].view(HEIGHT, WIDTH)

    both = depth_of(measured, None)
    assert (both[columns] > 0).all()
    assert (both[beyond] == 0).all()
    assert (depth_of(measured)[beyond] > 0).all(), "no other pixel shows it"
    measured[20:24, 20:24] = 0  # where readings fail inside of surfaces, too, a lack of them tells nothing
    failing = depth_of(measured, None)
    assert (failing[columns] > 0).all()
    assert (failing[beyond] > 0).all()


@pytest.mark.parametrize(("lacking", "expected"), [(0, True), (1, True), (3, False), (2000, False)])
def test_depth_is_always_read_if_hardly_any_pixel_inside_of_surfaces_lacks_a_reading(
    lacking: int, expected: bool
) -> None:
    """A share of 1/1000 of some 2,500; outlines, what a mask leaves out and views without depth do not count."""
    depth = maps_of([camera_at(0.0)]).depth[0].view(HEIGHT, WIDTH).float()
    inside = (depth == 2).nonzero()
    edge = (depth[:, 1:] != depth[:, :-1]).nonzero()
    depth[tuple(edge.T)] = 0
    rows, columns = inside[(inside[:, 1] < WIDTH // 4) | (inside[:, 1] >= 3 * WIDTH // 4)][:lacking].unbind(1)
    depth[rows, columns] = 0
    mask = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    mask[HEIGHT // 2 :, :5] = False
    depth[~mask] = 0
    views = [viewed(camera_at(0.0)), viewed(camera_at(0.0), depth, mask)]
    assert always_read(scene_mesh(), views, 0.03) == expected
    assert not always_read(scene_mesh(), views[:1], 0.03), "nothing was measured"


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.02, 0.5, 1.0]))
def test_what_is_contradicted_is_what_its_plain_twin_says(seed: int, unmeasured: float) -> None:
    generator = torch.Generator().manual_seed(seed)
    measured, rendered = (1 + torch.rand(23, 110, generator=generator) * scale for scale in (0.104, 0.1))
    measured[torch.rand(measured.shape, generator=generator) < unmeasured] = 0
    differs = (measured > 0) & ((measured - rendered).abs() >= 0.1)
    expected = differs.clone()
    for row, column in (measured == 0).nonzero().tolist():
        window = differs[max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3]
        expected[row, column] = window.any()
    found, doubtful = contradicted(measured, rendered, 0.1)
    assert torch.equal(found, differs)
    assert torch.equal(doubtful, expected & ~differs)


def pixel_points(maps: ViewMaps, view: int) -> tuple[torch.Tensor, torch.Tensor]:
    columns, rows = torch.arange(WIDTH).repeat(HEIGHT), torch.arange(HEIGHT).repeat_interleave(WIDTH)
    xy = torch.stack((columns, rows), 1) + 0.5
    return xy, unproject_pixels(xy, maps.depth[view].float(), maps.intrinsics[view])


def test_reprojection_finds_the_pixel_that_shows_the_same_point_and_knows_what_is_hidden() -> None:
    cameras = [camera_at(0.0), camera_at(0.25, 4.0)]
    maps = maps_of(cameras)
    xy, points = pixel_points(maps, 0)
    relative = (cameras[1].world_to_camera @ torch.linalg.inv(cameras[0].world_to_camera))[:3].float()
    color, visible = reproject(points, relative, maps, torch.tensor(1), 0.03)
    world = unproject(cameras[0], xy, maps.depth[0].double())
    expected, depth_there = project(cameras[1], world)
    # The colors code column and row of pixel centres, so a bilinear sample is the position itself, less half a pixel.
    assert (color[visible, :2] - (expected[visible] - 0.5)).abs().max() < 0.05
    assert (color[visible, 2] - 1).abs().max() < 1e-4
    inside = ((expected > 1) & (expected < torch.tensor([WIDTH - 1, HEIGHT - 1]))).all(1)
    rendered = maps.depth[1].view(HEIGHT, WIDTH).float()
    column, row = expected[:, 0].long().clamp(0, WIDTH - 1), expected[:, 1].long().clamp(0, HEIGHT - 1)
    hidden = inside & (depth_there - rendered[row, column] > 0.5) & (maps.depth[0] > 0)
    assert hidden.sum() > 20
    near_card_edge = (rendered[row, column] < 1.5) & (depth_there > 1.5)
    assert visible[hidden].float().mean() < 0.35, "only the rim of the card may pass, by its nearest neighbor"
    assert not visible[~inside & ((expected < 0) | (expected > torch.tensor([WIDTH, HEIGHT]))).any(1)].any()
    assert visible[inside & ~near_card_edge & (maps.depth[0] > 0)].float().mean() > 0.9


def test_reprojection_keeps_the_finest_detail() -> None:
    """Stripes of five pixels, looked at between pixels: bilinear colors would lose a fifth of their contrast."""
    cameras = [camera_at(0.0), camera_at(0.5 / FOCAL * 2)]
    maps = maps_of(cameras)
    stripes = 128 + 100 * torch.sin(torch.arange(WIDTH) * (2 * torch.pi / 5))
    maps.color[1] = stripes.round().to(torch.uint8).expand(HEIGHT, -1).reshape(-1, 1)
    xy, points = pixel_points(maps, 0)
    relative = (cameras[1].world_to_camera @ torch.linalg.inv(cameras[0].world_to_camera))[:3].float()
    color, visible = reproject(points, relative, maps, torch.tensor(1), 0.03)
    inner = ((xy > 3) & (xy < torch.tensor([WIDTH - 3, HEIGHT - 3]))).all(1)
    wall = visible & inner & (maps.depth[0] > 1.9) & ((xy[:, 0] - WIDTH / 2).abs() > 20)
    assert wall.sum() > 400
    expected = 128 + 100 * torch.sin((xy[:, 0] - 1) * (2 * torch.pi / 5))
    assert (color[wall, 0] - expected[wall]).abs().max() < 4


def test_reprojection_mixes_in_no_background_and_nothing_from_beyond_the_image() -> None:
    cameras = [camera_at(0.0), camera_at(0.5 / FOCAL * 2)]
    mask = torch.rand(HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0)) < 0.9
    maps = maps_of(cameras, mask=mask)
    maps.color[1] = torch.where(mask, 100, 255).to(torch.uint8).view(-1, 1)
    _, points = pixel_points(maps, 0)
    relative = (cameras[1].world_to_camera @ torch.linalg.inv(cameras[0].world_to_camera))[:3].float()
    color, visible = reproject(points, relative, maps, torch.tensor(1), 0.03)
    assert visible.sum() > 1000
    torch.testing.assert_close(color[visible], torch.full_like(color[visible], 100.0), atol=2.0, rtol=0)


def test_a_view_sees_all_of_itself() -> None:
    maps = maps_of([camera_at(0.0)])
    _, points = pixel_points(maps, 0)
    foreground = maps.depth[0] > 0
    color, visible = reproject(points[foreground], torch.eye(4)[:3], maps, torch.tensor(0), 0.03)
    assert visible.float().mean() > 0.95
    torch.testing.assert_close(color[visible], maps.color[0][foreground][visible].float(), atol=0.02, rtol=0)


def test_pairs_obey_angle_and_overlap_and_hold_the_view_itself_once() -> None:
    cameras = [camera_at(0.0), camera_at(0.05, 5.0), camera_at(0.0, 14.0), camera_at(1.4), camera_at(0.0, 180.0)]
    maps = maps_of(cameras)
    share = overlaps(maps, "object", 15.0, range(5))
    assert share[0, 1] > 0.8
    assert share[1, 2] > 0.3
    assert share[0, 4] == 0
    pairs = related_pairs(maps, "object", 15.0, 0.3)
    rows = [pairs.auxiliary[i, : pairs.count[i]].tolist() for i in range(5)]
    assert all(row.count(index) == 1 for index, row in enumerate(rows[:4]))
    assert 1 in rows[0]
    assert 4 not in rows[0]
    assert int(pairs.count[4]) == 0, "it looks away from the mesh"
    assert pairs.sources.tolist() == [0, 1, 2, 3]
    relative = cameras[1].world_to_camera @ torch.linalg.inv(cameras[0].world_to_camera)
    torch.testing.assert_close(pairs.relative[0, rows[0].index(1)], relative[:3].float())


def test_overlaps_are_the_same_where_views_come_from_the_host_and_each_is_copied_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    maps = maps_of([camera_at(0.1 * index, 3.0 * index) for index in range(5)] + [camera_at(0.0, 180.0)])
    share = overlaps(maps, "object", 15.0, range(6))
    copied = list[int]()

    class Copied(torch.Tensor):
        def to(self, *given: Any) -> torch.Tensor:
            if self.dim() == 2:
                copied.append(len(self))
            return self.as_subclass(torch.Tensor).to(*given)

    other = torch.device("cpu:0")  # not equal to the tensors' device
    monkeypatch.setattr(ViewMaps, "device", property(lambda _: other))
    monkeypatch.setattr(pairs, "TOGETHER", 4)
    elsewhere = replace(maps, depth=maps.depth.as_subclass(Copied))
    assert overlaps(elsewhere, "object", 15.0, range(6)).equal(share)
    assert copied == [4, 2]


def painted(maps: ViewMaps, levels: list[int]) -> ViewMaps:
    """Each view in one gray of its own, but for its left half, which is 4 levels darker."""
    color = torch.tensor(levels, dtype=torch.uint8)[:, None, None].repeat(1, maps.height * maps.width, 3)
    color.view(len(levels), maps.height, maps.width, 3)[:, :, : maps.width // 2] -= 4
    return replace(maps, color=color)


def test_examples_differ_as_their_colors_do_wherever_the_views_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """Against the whole warped images, which are sampled at every pixel and not at every eighth."""
    maps = painted(maps_of([camera_at(0.03 * index, index) for index in range(4)]), [40, 90, 50, 200])
    related = torch.ones((4, 4), dtype=torch.bool).fill_diagonal_(False)
    related[2, 3] = False
    found = example_differences(maps, "object", related)
    assert torch.equal(found.isinf(), ~related)
    for source, auxiliary in related.nonzero().tolist():
        _, points = pixel_points(maps, source)
        relative = maps.world_to_camera[auxiliary] @ torch.linalg.inv(maps.world_to_camera[source])
        color, visible = reproject(points, relative[:3].float(), maps, torch.tensor(auxiliary), 0.03)
        visible &= maps.depth[source] > 0
        expected = (color - maps.color[source])[visible].abs().mean()
        assert float(found[source, auxiliary]) == pytest.approx(float(expected), abs=0.6)

    monkeypatch.setattr(ViewMaps, "device", property(lambda _: torch.device("cpu:0")))
    monkeypatch.setattr(pairs, "TOGETHER", 3)
    assert torch.equal(example_differences(maps, "object", related), found)


def test_of_related_views_those_stay_that_show_what_the_source_shows() -> None:
    maps = painted(maps_of([camera_at(0.03 * index, index) for index in range(4)]), [40, 90, 50, 200])
    every = related_pairs(maps, "object", 15.0, 0.3)
    assert every.count.tolist() == [4, 4, 4, 4]
    half = related_pairs(maps, "object", 15.0, 0.3, 0.5)
    assert half.count.tolist() == [3, 3, 3, 3], "the view itself, and two of three"
    rows = [half.auxiliary[index, :3].tolist() for index in range(4)]
    assert rows == [[0, 1, 2], [1, 0, 2], [2, 0, 1], [3, 1, 2]]
    fewest = related_pairs(maps, "object", 15.0, 0.3, 0.1)
    assert [fewest.auxiliary[index, :2].tolist() for index in range(4)] == [[0, 2], [1, 2], [2, 0], [3, 1]]


def test_a_view_without_near_neighbors_gets_the_one_that_overlaps_most() -> None:
    pairs = related_pairs(maps_of([camera_at(0.0), camera_at(-0.5, 20.0)]), "object", 15.0, 0.3)
    assert pairs.auxiliary[0, : pairs.count[0]].tolist() == [0, 1]


def test_views_of_different_sizes_are_refused() -> None:
    small = Camera(camera_at(0.0).K, torch.eye(4, dtype=torch.float64), 32, 24)
    views = (
        View("a", camera_at(0.0), torch.zeros(HEIGHT, WIDTH, 3, dtype=torch.uint8)),
        View("b", small, torch.zeros(24, 32, 3, dtype=torch.uint8)),
    )
    with pytest.raises(AssertionError):
        build_view_maps(Atlas(scene_mesh(), 256, 256, "scan", 2), views, "object")

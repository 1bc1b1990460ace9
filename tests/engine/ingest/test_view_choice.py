"""The choice of views: frames along a wall whose picture is known, some of them spoiled."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from advtex_engine.core.scene import Camera, Mesh
from advtex_engine.ingest.thumbnails import THUMBNAIL_WIDTH, thumbnail_of, visibility_of
from advtex_engine.ingest.view_choice import GOOD_VIEW, Candidate, ViewChoice, _Chosen, _row_quantiles, choose_views

WIDTH, HEIGHT, FOCAL = 160, 120, 120.0
LENGTH, TALL = 6.0, 1.2  # metres of wall
PER_METRE = 150  # pixels of its picture
DISTANCE = 1.0


def wall() -> Mesh:
    """x in [0, LENGTH], y in [0, TALL], z = 0, in squares of 0.2 m."""
    x, y = np.meshgrid(np.linspace(0, LENGTH, 31), np.linspace(0, TALL, 7))
    positions = np.stack((x, y, np.zeros_like(x)), 2).reshape(-1, 3)
    corner = (np.arange(6)[:, None] * 31 + np.arange(30)).ravel()
    quads = np.stack((corner, corner + 1, corner + 32, corner + 31), 1)
    faces = np.concatenate((quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]))
    return Mesh(torch.from_numpy(positions).float(), torch.from_numpy(faces))


def paper() -> np.ndarray:
    """The wall's picture: noise of some pixels' grain, [rows,columns,3] uint8."""
    noise = np.random.default_rng(1).integers(40, 200, (int(TALL * 50), int(LENGTH * 50), 3)).astype(np.uint8)
    return np.asarray(cv2.resize(noise, None, fx=3, fy=3, interpolation=cv2.INTER_CUBIC), np.uint8)


def camera(x: float, y: float = TALL / 2, distance: float = DISTANCE) -> Camera:
    """Looks along +z at the point (x, y) of the wall."""
    world_to_camera = torch.eye(4, dtype=torch.float64)
    world_to_camera[:3, 3] = torch.tensor([-x, -y, distance])
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64)
    return Camera(K, world_to_camera, WIDTH, HEIGHT)


def photograph(of: Camera) -> np.ndarray:
    """What the camera sees of the wall, [H,W,3] uint8; gray beside it."""
    x, y, z = (-of.world_to_camera[0, 3], -of.world_to_camera[1, 3], of.world_to_camera[2, 3])
    scale = FOCAL / float(z) / PER_METRE
    shift = (WIDTH / 2 - float(x) * PER_METRE * scale, HEIGHT / 2 - float(y) * PER_METRE * scale)
    M = np.array([[scale, 0, shift[0]], [0, scale, shift[1]]])
    return np.asarray(cv2.warpAffine(paper(), M, (WIDTH, HEIGHT), flags=cv2.INTER_AREA, borderValue=(99, 99, 99)))


def blurred(image: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.blur(image, (9, 1)))


def exposed(image: np.ndarray, stops: float) -> np.ndarray:
    return np.asarray(np.clip(image / 255 * 2 ** (stops / 2.2), 0, 1) * 255, np.uint8)


def candidate(of: Camera, image: np.ndarray | None = None, name: str = "") -> Candidate:
    at = f"{float(-of.world_to_camera[0, 3]):05.2f}"
    return Candidate(name or at, of, thumbnail_of(photograph(of) if image is None else image))


def walk(count: int = 41) -> list[Candidate]:
    """Along the wall from end to end."""
    return [candidate(camera(x), name=f"{i:03d}") for i, x in enumerate(np.linspace(0.5, LENGTH - 0.5, count))]


def kept_names(choice: ViewChoice) -> list[str]:
    return [entry["name"] for entry in choice.report["kept"]]


def test_a_look_tells_brightness_and_detail() -> None:
    flat = thumbnail_of(np.full((60, 90, 3), 128, np.uint8))
    np.testing.assert_allclose(flat.brightness, 2.2 * np.log2(128 / 255), atol=1e-5)
    image = photograph(camera(2))
    sharp, soft = thumbnail_of(image), thumbnail_of(blurred(image))
    assert (sharp.detail - flat.detail.max() > 5).all()
    assert np.median(sharp.detail - soft.detail) > 1.5
    assert sharp.detail.shape == sharp.brightness.shape == (THUMBNAIL_WIDTH * HEIGHT // WIDTH, THUMBNAIL_WIDTH)
    large = np.kron(image, np.ones((10, 10, 1), np.uint8))
    assert np.median(np.abs(thumbnail_of(large).brightness - sharp.brightness)) < 0.2
    assert thumbnail_of(image[:7, :5]).detail.shape == (7, 5)


def test_sights_are_of_the_side_that_is_seen() -> None:
    """From the front and from behind no cell is the same; nearer and from the front a cell fills more pixels."""
    front, near, turned = camera(3), camera(3, distance=0.6), camera(3)
    behind = torch.diag(torch.tensor([-1.0, 1, -1, 1], dtype=torch.float64))
    behind[:3, 3] = torch.tensor([3.0, -TALL / 2, DISTANCE])
    cameras = [front, near, replace(turned, world_to_camera=behind)]
    visibility = visibility_of(wall(), cameras, [thumbnail_of(photograph(front))] * 3)
    seen = visibility.shown > 0
    assert seen.any(1).all()
    assert not (seen[0] & seen[2]).any()
    both = seen[0] & seen[1]
    assert np.median(visibility.shown[1, both] / visibility.shown[0, both]) == pytest.approx((1 / 0.6) ** 2, rel=0.2)
    assert np.isnan(visibility.detail[~seen]).all()
    assert not np.isnan(visibility.detail[seen]).any()


def test_all_good_frames_are_kept_where_the_budget_allows() -> None:
    choice = choose_views(wall(), walk(), 100)
    assert choice.kept == tuple(range(41))
    assert choice.report["left_out"] == {}
    assert choice.report["surface_seen"]["1"] == 1


def test_spoiled_frames_are_left_out() -> None:
    frames = walk()
    spoiled = {"blurred": [5, 14, 30], "exposure": [9, 20]}
    for index in spoiled["blurred"]:
        frames[index] = candidate(frames[index].camera, blurred(photograph(frames[index].camera)), f"{index:03d}")
    for index, stops in zip(spoiled["exposure"], (-1.5, 1.3), strict=True):
        image = exposed(photograph(frames[index].camera), stops)
        frames[index] = candidate(frames[index].camera, image, f"{index:03d}")
    away = camera(3)
    turned = torch.diag(torch.tensor([-1.0, 1, -1, 1], dtype=torch.float64)) @ away.world_to_camera
    frames.append(candidate(replace(away, world_to_camera=turned), name="999"))
    choice = choose_views(wall(), frames, 100)
    expected = {reason: [f"{index:03d}" for index in indices] for reason, indices in spoiled.items()}
    assert choice.report["left_out"] == expected | {"blind": ["999"]}
    assert len(choice.kept) == 36


def test_the_app_says_what_is_blurred() -> None:
    frames = [replace(one, sharpness=80.0 + index) for index, one in enumerate(walk())]
    frames[7] = replace(frames[7], sharpness=20.0)
    frames[8] = replace(frames[8], sharpness=None)
    assert choose_views(wall(), frames, 100).report["left_out"] == {"blurred": ["007"]}


@pytest.mark.parametrize("budget", [6, 9, 14])
def test_few_views_still_cover_the_wall(budget: int) -> None:
    """Each frame shows 1.33 m of 6 m; six side by side reach from end to end but for what is cut at the ends."""
    frames = walk()
    choice = choose_views(wall(), frames, budget)
    assert len(choice.kept) == budget
    assert choice.kept == tuple(sorted(choice.kept))
    assert choice.report["surface_seen"]["1"] > (0.8 if budget == 6 else 0.95)
    evenly = visibility_of(wall(), [one.camera for one in frames], [one.thumbnail for one in frames]).shown > 0
    best_evenly = evenly[np.linspace(0, 40, budget).round().astype(int)].any(0).mean()
    assert choice.report["surface_seen"]["1"] >= best_evenly - 0.06
    assert json.loads(json.dumps(choice.report, allow_nan=False)) == choice.report
    assert len(choice.kept) + sum(map(len, choice.report["left_out"].values())) == len(frames)
    assert choose_views(wall(), frames, budget) == choice


def test_views_get_partners() -> None:
    """Nearly all frames crowd at one end; a pair at the other end must stay a pair."""
    frames = [candidate(camera(x), name=f"{x:.2f}") for x in np.linspace(0.6, 1.6, 30)]
    frames += [candidate(camera(x), name=f"{x:.2f}") for x in (5.0, 5.1)]
    choice = choose_views(wall(), frames, 10)
    assert kept_names(choice)[-2:] == ["5.00", "5.10"]


def test_a_partner_is_named_as_one() -> None:
    """Five frames side by side overlap by less than the pairs need; the sixth is a partner of one of them."""
    reasons = [entry["reason"] for entry in choose_views(wall(), walk(60), 6).report["kept"]]
    assert sorted(reasons) == ["coverage"] * 5 + ["partner"]


def test_a_blurred_frame_returns_as_the_only_one_that_shows_a_part() -> None:
    near = [candidate(camera(x), name=f"{x:.2f}") for x in np.linspace(0.6, 4.0, 30)]
    soft = camera(4.6)
    frames = [*near, candidate(soft, blurred(blurred(photograph(soft))), "soft")]
    choice = choose_views(wall(), frames, 40)
    assert choice.report["kept"][-1]["name"] == "soft"
    assert choice.report["kept"][-1]["reason"] == "only_sight"
    assert choice.report["left_out"] == {}


def test_nothing_to_choose_from() -> None:
    choice = choose_views(wall(), [], 5)
    assert (choice.kept, choice.report["frames"], choice.report["kept"]) == ((), 0, [])


shares = arrays(np.float32, (7, 5), elements=st.floats(0, GOOD_VIEW, width=32))


@given(shares, st.integers(1, 4))
def test_greedy_cover_reaches_its_bound(table: np.ndarray, budget: int) -> None:
    """Against all subsets: at least 1 - 1/e of the best."""
    chosen = _Chosen(table, np.ones(7, bool), np.full(7, "", object))
    chosen.cover(budget, "coverage")
    assert len(chosen.gains) <= budget
    reached = float(np.sum(1 - np.prod(1 - table[list(chosen.gains)], axis=0)))
    assert reached == pytest.approx(sum(chosen.gains.values()), abs=1e-4)
    best = max(
        float(np.sum(1 - np.prod(1 - table[list(subset)], axis=0)))
        for subset in itertools.combinations(range(7), budget)
    )
    assert reached >= (1 - np.exp(-1)) * best - 1e-4


@given(arrays(np.float32, (3, 6), elements=st.floats(-9, 9, width=16) | st.just(np.nan)), st.floats(0, 1))
def test_quantiles_leave_out_what_is_not_there(table: np.ndarray, share: float) -> None:
    for row, found in zip(table, _row_quantiles(table, share), strict=True):
        values = row[~np.isnan(row)]
        assert np.isnan(found) == (len(values) == 0)
        if len(values):
            assert found == pytest.approx(np.quantile(values.astype(float), share, method="midpoint"), abs=1e-5)

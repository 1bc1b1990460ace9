"""Metrics against closed forms and plain twins."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from advtex_engine.metrics import image_metrics as metrics
from advtex_engine.metrics.image_metrics import (
    METRICS,
    eroded,
    gradient_ratio,
    nearest_patch_loss,
    psnr,
    score_views,
    sharpness_ratio,
    sliced_wasserstein,
    ssim,
)
from advtex_engine.metrics.photograph import Photograph


def noise(height: int = 40, width: int = 48, seed: int = 0) -> Tensor:
    return torch.rand(height, width, 3, generator=torch.Generator().manual_seed(seed))


def blurred(image: Tensor) -> Tensor:
    planes = image.permute(2, 0, 1)[None]
    return torch.nn.functional.avg_pool2d(planes, 5, 1, 2, count_include_pad=False)[0].permute(1, 2, 0)


def everywhere(image: Tensor) -> Tensor:
    return torch.ones(image.shape[:2], dtype=torch.bool)


def whole(image: Tensor) -> Photograph:
    return Photograph(image, everywhere(image))


def half(image: Tensor) -> Tensor:
    mask = everywhere(image)
    mask[:, image.shape[1] // 2 :] = False
    return mask


@pytest.mark.parametrize("name", sorted(METRICS))
def test_equal_images_score_perfectly(name: str) -> None:
    image = noise()
    perfect = {"psnr": metrics.MAX_PSNR, "sliced_wasserstein": 0.0}.get(name, 1.0)
    assert METRICS[name](image, whole(image)) == pytest.approx(perfect, abs=1e-5)


@pytest.mark.parametrize("name", sorted(METRICS))
def test_nothing_outside_the_mask_counts(name: str) -> None:
    image, truth, mask = noise(seed=1), noise(seed=2), half(noise())
    metric, photograph = METRICS[name], Photograph(truth, mask)
    score = metric(image, photograph)
    assert metric(torch.where(mask[..., None], image, 9.0), photograph) == pytest.approx(score, rel=1e-4)
    other = Photograph(torch.where(mask[..., None], truth, -3.0), mask)
    assert metric(image, other) == pytest.approx(score, rel=1e-4)
    assert metric(image, whole(truth)) != score


@given(st.floats(0.001, 0.9), st.integers(1, 30), st.integers(1, 30))
@settings(max_examples=25, deadline=None)
def test_psnr_of_a_constant_error(error: float, height: int, width: int) -> None:
    truth = torch.full((height, width, 3), 0.05)
    score = psnr(truth + error, whole(truth))
    assert score == pytest.approx(-20 * math.log10(error), abs=1e-3)


def test_ssim_is_its_definition_with_masked_weights() -> None:
    image, truth = noise(24, 26, 1), blurred(noise(24, 26, 2))
    mask = torch.rand(24, 26, generator=torch.Generator().manual_seed(5)) > 0.3
    x, y = ((picture.numpy() @ np.array([0.299, 0.587, 0.114])) for picture in (image, truth))
    rows, columns = np.mgrid[:24, :26]
    likeness = []
    for i, j in np.argwhere(mask.numpy()):
        near = (abs(rows - i) <= 5) & (abs(columns - j) <= 5) & mask.numpy()
        w = np.exp(-((rows - i) ** 2 + (columns - j) ** 2) / (2 * 1.5**2))[near]
        w /= w.sum()
        mx, my = (w * x[near]).sum(), (w * y[near]).sum()
        vx, vy = (w * (x[near] - mx) ** 2).sum(), (w * (y[near] - my) ** 2).sum()
        cov = (w * (x[near] - mx) * (y[near] - my)).sum()
        likeness.append((2 * mx * my + 1e-4) * (2 * cov + 9e-4) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4)))
    assert ssim(image, Photograph(truth, mask)) == pytest.approx(float(np.mean(likeness)), abs=1e-5)


def test_ssim_of_a_negative_is_negative() -> None:
    image = noise()
    assert ssim(image, whole(1 - image)) < -0.5


@pytest.mark.parametrize(("slope", "other"), [(0.01, 0.02), (0.02, 0.005), (0.01, 0.01)])
def test_gradient_ratio_of_ramps_is_that_of_their_slopes(slope: float, other: float) -> None:
    ramp = torch.arange(40.0)[None, :, None].expand(30, 40, 3)
    assert gradient_ratio(slope * ramp, whole(other * ramp)) == pytest.approx(slope / other, rel=1e-3)
    down = ramp.transpose(0, 1)
    assert gradient_ratio(slope * down, whole(other * down)) == pytest.approx(slope / other, rel=1e-3)


def test_sharpness_ratio_sees_curvature_only() -> None:
    x = torch.arange(40.0)[None, :, None].expand(30, 40, 3)
    bowl = x.square() / 1600
    assert sharpness_ratio(bowl, whole(bowl / 4)) == pytest.approx(4, rel=1e-2)
    assert sharpness_ratio(x / 40, whole(bowl)) < 0.01


@pytest.mark.parametrize("ratio", [gradient_ratio, sharpness_ratio])
def test_blur_lowers_the_ratios_and_flat_pairs_have_one(ratio: Callable[..., float]) -> None:
    image, flat = noise(), torch.full((30, 30, 3), 0.4)
    assert ratio(blurred(image), whole(image)) < 0.4
    assert ratio(image, whole(blurred(image))) > 2.5
    assert ratio(flat, whole(flat + 0.1)) == pytest.approx(1, abs=0.05)


def brute_nearest(image: Tensor, truth: Tensor) -> float:
    def patches(picture: Tensor) -> np.ndarray:
        values = picture.numpy().astype(np.float64) * 255
        rows, columns = values.shape[0] - 6, values.shape[1] - 6
        return np.array([values[i : i + 7, j : j + 7].ravel() for i in range(rows) for j in range(columns)])

    theirs = patches(truth)
    nearest = [np.sqrt(((theirs - patch) ** 2).sum(1).min()) for patch in patches(image)]
    return float(np.mean(nearest)) / math.sqrt(147)


def test_nearest_patch_loss_is_its_definition(monkeypatch: pytest.MonkeyPatch) -> None:
    image, truth = noise(15, 17, 1), noise(18, 14, 2)
    expected = brute_nearest(image, truth)
    assert nearest_patch_loss(image, truth) == pytest.approx(expected, rel=1e-4)
    monkeypatch.setattr(metrics, "CHUNK_BYTES", 4 * 100)
    monkeypatch.setattr(metrics, "PATCH_BLOCK", 25)
    assert nearest_patch_loss(image, truth) == pytest.approx(expected, rel=1e-4)


def test_nearest_patch_loss_forgives_shifts_and_not_blur() -> None:
    truth = noise(30, 34)
    assert nearest_patch_loss(truth[4:24, 7:30], truth) < 0.1
    assert nearest_patch_loss(blurred(truth), truth) > 20
    flat = torch.full((12, 12, 3), 0.2)
    assert nearest_patch_loss(flat + 0.1, flat) == pytest.approx(25.5, rel=1e-4)


def test_nearest_patches_are_sought_within_the_mask() -> None:
    image, truth = noise(40, 48, 1), noise(40, 48, 2)
    mask = half(image)
    assert nearest_patch_loss(image, truth, mask) == pytest.approx(nearest_patch_loss(image[:, :24], truth[:, :24]))
    assert nearest_patch_loss(image, truth, everywhere(image)) == pytest.approx(nearest_patch_loss(image, truth))
    assert math.isnan(nearest_patch_loss(image, truth, ~everywhere(image)))


def test_a_few_queries_estimate_the_nearest_patch_loss() -> None:
    image, truth = noise(60, 64, 1), blurred(noise(60, 64, 2))
    whole = nearest_patch_loss(image, truth)
    estimates = [nearest_patch_loss(image, truth, queries=300, seed=seed) for seed in (0, 0, 1)]
    assert estimates[0] == estimates[1] != estimates[2]
    assert estimates == pytest.approx([whole] * 3, rel=0.02)
    assert nearest_patch_loss(image, truth, queries=10**6) == pytest.approx(whole)


def test_sliced_wasserstein_of_constant_images() -> None:
    flat = torch.full((20, 20, 3), 0.3)
    # Along a unit vector d the shift is 25.5 times the sum of d, whose mean magnitude is sqrt(2 / pi).
    assert sliced_wasserstein(flat + 0.1, whole(flat)) == pytest.approx(25.5 * math.sqrt(2 / math.pi), rel=0.15)


def test_sliced_wasserstein_forgives_shifts_and_not_blur() -> None:
    truth = noise(64, 64)
    shift, blur = (sliced_wasserstein(one, whole(truth)) for one in (truth.roll((9, 14), (0, 1)), blurred(truth)))
    assert shift < 0.1 * blur


def test_sliced_wasserstein_is_its_definition() -> None:
    image, truth = noise(20, 22, 1), blurred(noise(20, 22, 2))
    directions = np.random.default_rng(0).standard_normal((4000, 147))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)

    def patches(picture: Tensor) -> np.ndarray:
        planes = picture.permute(2, 0, 1).numpy().astype(np.float64) * 255
        return np.array([planes[:, i : i + 7, j : j + 7].ravel() for i in range(14) for j in range(16)])

    ordered = [np.sort(directions @ patches(picture).T, axis=1) for picture in (image, truth)]
    expected = float(np.abs(ordered[0] - ordered[1]).mean())
    assert sliced_wasserstein(image, whole(truth)) == pytest.approx(expected, rel=0.1)


def test_sliced_wasserstein_of_some_patches_estimates_that_of_all(monkeypatch: pytest.MonkeyPatch) -> None:
    image, truth = blurred(noise(80, 90, 1)), noise(80, 90, 2)
    every = sliced_wasserstein(image, whole(truth))
    monkeypatch.setattr(metrics, "MAX_PATCHES", 2000)
    assert sliced_wasserstein(image, whole(truth)) == pytest.approx(every, rel=0.03)
    assert sliced_wasserstein(truth, whole(truth)) == 0


def test_sliced_wasserstein_without_a_whole_patch_is_nan() -> None:
    image = noise()
    assert math.isnan(sliced_wasserstein(image, Photograph(image, ~everywhere(image))))


@given(st.integers(1, 12), st.integers(1, 12), st.integers(0, 3), st.integers(0, 2**31))
@settings(max_examples=40, deadline=None)
def test_eroded_is_its_definition(height: int, width: int, radius: int, seed: int) -> None:
    mask = torch.rand(height, width, generator=torch.Generator().manual_seed(seed)) > 0.15
    padded = np.pad(mask.numpy(), radius)
    for i in range(height):
        for j in range(width):
            assert eroded(mask, radius)[i, j] == padded[i : i + 2 * radius + 1, j : j + 2 * radius + 1].all()


def test_score_views_averages_the_views_that_show_something() -> None:
    first, second, truth = noise(seed=1), noise(seed=2), noise(seed=3)
    full, nothing = everywhere(first), ~everywhere(first)
    scores = score_views([first, second, first], [truth] * 3, [full, full, nothing])
    assert scores["views"] == 2
    for name, metric in METRICS.items():
        expected = (metric(first, Photograph(truth, full)) + metric(second, Photograph(truth, full))) / 2
        assert scores[name] == pytest.approx(expected, rel=1e-5)
    assert score_views([first], [truth], [nothing]) == {}


def test_score_views_takes_bytes() -> None:
    image = (noise() * 255).round().to(torch.uint8)
    assert score_views([image], [image.float() / 255], [everywhere(image)])["psnr"] == metrics.MAX_PSNR


def test_score_views_needs_as_many_photos_as_renders() -> None:
    image = noise()
    with pytest.raises(ValueError, match="shorter"):
        score_views([image, image], [image], [everywhere(image)])

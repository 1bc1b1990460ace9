"""What is found of a photograph once, for all images that are compared with it."""

from __future__ import annotations

import pytest
import torch
from lpips_weights import random_lpips
from torch import Tensor

from advtex_engine.metrics import image_metrics, lpips, sharpness
from advtex_engine.metrics.evaluate import VIEW_METRICS, Metric
from advtex_engine.metrics.photograph import Photograph
from advtex_engine.metrics.sharpness import flat_energy

LPIPS = random_lpips()
ALL: dict[str, Metric] = {
    **VIEW_METRICS,
    "lpips": LPIPS.masked,
    "lpips_full": LPIPS.on_black,
    "flat_energy": lambda image, truth: flat_energy(image, truth, truth.mask),
}


def picture(seed: int) -> Tensor:
    """Noise beside a wall."""
    image = torch.rand(96, 112, 3, generator=torch.Generator().manual_seed(seed))
    image[:, 50:] = 0.5 + 0.01 * (image[:, 50:] - 0.5)
    return image


def photograph() -> Photograph:
    mask = torch.ones(96, 112, dtype=torch.bool)
    mask[:20] = False
    return Photograph(picture(0), mask)


@pytest.mark.parametrize("name", sorted(ALL))
def test_images_score_one_after_the_other_as_each_alone(name: str) -> None:
    metric, shared = ALL[name], photograph()
    images = [picture(1), 0.5 * picture(2), picture(1)]
    scores = [metric(image, shared) for image in images]
    assert scores == [metric(image, photograph()) for image in images]
    assert scores[0] != scores[1]


@pytest.mark.parametrize(
    ("name", "module", "costly"),
    [
        ("ssim", image_metrics, "luminance"),
        ("gradient_ratio", image_metrics, "gradient_magnitude"),
        ("sharpness_ratio", image_metrics, "_filtered"),
        ("sliced_wasserstein", image_metrics, "_patches"),
        ("band_error", sharpness, "luminance"),
        ("s3_ratio", sharpness, "s3_map"),
        ("flat_energy", sharpness, "gradient_magnitude"),
        ("lpips", lpips.FeatureStack, "forward"),
        ("lpips_full", lpips.FeatureStack, "forward"),
    ],
)
def test_a_photographs_part_is_found_once(
    name: str, module: object, costly: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls, function = list[object](), getattr(module, costly)

    def counted(*arguments: object) -> object:
        calls.append(arguments)
        return function(*arguments)

    monkeypatch.setattr(module, costly, counted)
    shared, counts = photograph(), list[int]()
    for seed in (1, 2, 3):
        ALL[name](picture(seed), shared)
        counts.append(len(calls))
    first, second, third = counts
    assert third - second == second - first < first


def test_images_of_other_shapes_and_masks_of_numbers_are_refused() -> None:
    image = picture(0)
    with pytest.raises(AssertionError):
        Photograph(image, torch.ones(96, 112))
    with pytest.raises(AssertionError):
        Photograph(image, torch.ones(96, 111, dtype=torch.bool))

"""Spectral measures against plain twins in NumPy and OpenCV, and what they must and must not see."""

from __future__ import annotations

import math
from collections.abc import Callable

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from advtex_engine.metrics.photograph import Photograph
from advtex_engine.metrics.sharpness import FLAT_PIXELS, band_error, flat_energy, flat_pixels, s3_map, s3_ratio

Measure = Callable[[Tensor, Photograph], float]
GRAY = np.array([0.299, 0.587, 0.114])


def noise(height: int = 96, width: int = 112, seed: int = 0) -> Tensor:
    return torch.rand(height, width, 3, generator=torch.Generator().manual_seed(seed))


def natural(height: int = 96, width: int = 112, seed: int = 0) -> Tensor:
    """Noise whose amplitude falls with the frequency, as in photographs."""
    fy, fx = torch.fft.fftfreq(height)[:, None, None], torch.fft.fftfreq(width)[None, :, None]
    spectrum = torch.fft.fft2(noise(height, width, seed) - 0.5, dim=(0, 1)) / torch.hypot(fy, fx).clamp(min=0.01)
    image = torch.fft.ifft2(spectrum, dim=(0, 1)).real
    return (0.5 + 0.15 * (image - image.mean()) / image.std()).clamp(0, 1)


def blurred(image: Tensor, sigma: float = 1.5) -> Tensor:
    return torch.from_numpy(cv2.GaussianBlur(image.numpy(), (0, 0), sigma))


def everywhere(image: Tensor) -> Tensor:
    return torch.ones(image.shape[:2], dtype=torch.bool)


def whole(image: Tensor) -> Photograph:
    return Photograph(image, everywhere(image))


def blob(height: int, width: int) -> Tensor:
    ys, xs = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    return ((ys / height - 0.55) ** 2 + (xs / width - 0.45) ** 2) < 0.16


# Bands ---------------------------------------------------------------------------------------------------------------


def band_twin(image: Tensor, truth: Tensor, mask: Tensor) -> float:
    ours, theirs = (np.float32(picture.numpy() @ GRAY) for picture in (image, truth))
    weight = mask.numpy().astype(np.float32)
    errors = []
    for tile in (32, 16, 8):
        details = [plane - cv2.GaussianBlur(plane, (0, 0), 1.2) for plane in (ours, theirs)]
        found = []
        for row in range(0, weight.shape[0] - tile + 1, tile):
            for column in range(0, weight.shape[1] - tile + 1, tile):
                window = (slice(row, row + tile), slice(column, column + tile))
                share = weight[window].mean()
                if share > 0.8:
                    a, b = (float((detail[window] ** 2 * weight[window]).mean() / share) + 1e-5 for detail in details)
                    found.append(0.5 * abs(math.log(a / b)))
        errors.append(np.mean(found))
        ours, theirs, weight = cv2.pyrDown(ours), cv2.pyrDown(theirs), cv2.pyrDown(weight)
    return float(np.mean(errors))


@pytest.mark.parametrize(("height", "width"), [(96, 112), (97, 131)])
def test_band_error_is_its_definition(height: int, width: int) -> None:
    image, truth = blurred(natural(height, width, 1)), natural(height, width, 2)
    for mask in (everywhere(truth), blob(height, width)):
        assert band_error(image, Photograph(truth, mask)) == pytest.approx(band_twin(image, truth, mask), rel=1e-3)


def test_band_error_forgives_shifts_and_sees_blur_and_noise() -> None:
    truth = natural(192, 224)
    shift = band_error(truth.roll((2, 3), (0, 1)), whole(truth))
    assert band_error(truth, whole(truth)) == 0
    assert band_error(blurred(truth), whole(truth)) > 3 * shift
    assert band_error(truth + 0.3 * (noise(192, 224, 5) - 0.5), whole(truth)) > 3 * shift


@given(st.floats(0.3, 3.0))
@settings(max_examples=10, deadline=None)
def test_band_error_of_a_change_of_contrast_is_its_logarithm(contrast: float) -> None:
    truth = noise(64, 64)
    image = 0.5 + contrast * (truth - 0.5)
    assert band_error(image, whole(truth)) == pytest.approx(abs(math.log(contrast)), rel=0.05, abs=1e-3)


# S3 ------------------------------------------------------------------------------------------------------------------


def s3_twin(image: Tensor, row: int, column: int) -> float:
    """S3 of the 32x32 block that starts at a pixel."""
    gray = image.numpy().astype(np.float64) @ GRAY * 255
    block = gray[row : row + 32, column : column + 32]
    if block.max() - block.min() <= 5 or block.mean() <= 2:
        return 0.0
    magnitude = np.abs(np.fft.fft2(block * np.outer(np.hanning(32), np.hanning(32))))
    rings: dict[int, list[float]] = {}
    for i in range(32):
        for j in range(32):
            radius = round(math.hypot(min(i, 32 - i), min(j, 32 - j)))
            rings.setdefault(radius, []).append(magnitude[i, j])
    radii = range(1, 17)
    slope = -np.polyfit(np.log(radii), [math.log(np.mean(rings[radius])) for radius in radii], 1)[0]
    spectral = 1 - 1 / (1 + math.exp(-3 * (slope - 2)))
    largest = 0.0
    for i in range(row + 12, row + 20):
        for j in range(column + 12, column + 20):
            a, b, c, d = gray[i, j], gray[i, j + 1], gray[i + 1, j], gray[i + 1, j + 1]
            largest = max(largest, sum(map(abs, (a - b, a - c, a - d, b - c, b - d, c - d))) / (4 * 255))
    return math.sqrt(spectral * min(largest, 1.0))


def test_s3_is_its_definition() -> None:
    image = natural(70, 85)
    image[:40, 30:] = blurred(image)[:40, 30:]
    image[30:, 45:] = 0.4
    values = s3_map(image)
    assert values.shape == (5, 7)
    expected = [[s3_twin(image, 8 * i, 8 * j) for j in range(7)] for i in range(5)]
    torch.testing.assert_close(values, torch.tensor(expected), rtol=1e-3, atol=1e-4)
    assert float(values[4, 6]) == 0, "a block without contrast has no sharpness"


def test_s3_ratio_falls_with_blur_and_counts_blocks_in_the_mask_only() -> None:
    truth = natural()
    ratios = [s3_ratio(blurred(truth, sigma), whole(truth)) for sigma in (0.6, 1.0, 2.0)]
    assert 1 > ratios[0] > ratios[1] > ratios[2]
    assert s3_ratio(truth, whole(truth)) == 1
    left = everywhere(truth)
    left[:, 60:] = False
    half = truth.clone()
    half[:, 64:] = 0
    assert s3_ratio(half, Photograph(truth, left)) == 1
    assert math.isnan(s3_ratio(truth, Photograph(truth, ~everywhere(truth))))


# Flat surfaces -------------------------------------------------------------------------------------------------------


def wall(sensor: float = 1.5, seed: int = 0) -> Tensor:
    """A shaded wall with a poster, and sensor noise of that many gray levels."""
    ramp = torch.linspace(0.5, 0.7, 160)[None, :, None].expand(120, 160, 3).clone()
    ramp[20:60, 20:70] = (noise(10, 10, 9) * 0.8).repeat_interleave(4, 0).repeat_interleave(5, 1)
    generator = torch.Generator().manual_seed(seed)
    return ramp + torch.randn(ramp.shape, generator=generator) * sensor / 255


def test_flat_pixels_are_the_wall_away_from_its_poster() -> None:
    photo = wall()
    flat = flat_pixels(photo, everywhere(photo))
    assert bool(flat[90:110, 20:140].all())
    assert not bool(flat[20:60, 20:70].any())
    assert not bool(flat[:8].any()), "windows reach over the border"
    mask = everywhere(photo)
    mask[100:] = False
    assert not bool(flat_pixels(photo, mask)[92:].any())


def test_flat_energy_takes_the_photographs_noise_for_the_reference() -> None:
    photo, other = wall(1.5, 1), wall(1.5, 2)
    truth = whole(photo)
    assert flat_energy(photo, truth, truth.mask) == 1
    assert flat_energy(other, truth, truth.mask) == pytest.approx(1, abs=0.03)
    assert flat_energy(wall(0.0), truth, truth.mask) < 0.1
    assert flat_energy(wall(3.0, 2), truth, truth.mask) == pytest.approx(2, rel=0.05)


def test_flat_energy_sees_ringing_and_seams_on_the_wall_only() -> None:
    photo = wall()
    truth = whole(photo)
    rings = 0.01 * torch.cos(torch.arange(160.0) * 2 * math.pi / 5)[None, :, None]
    assert flat_energy(photo + rings, truth, truth.mask) > 1.5
    seam = photo.clone()
    seam[:, 110:] += 0.05
    assert flat_energy(seam, truth, truth.mask) > 1.2
    poster = photo.clone()
    poster[24:56, 25:65] += 0.3 * noise(32, 40, 3)
    assert flat_energy(poster, truth, truth.mask) == pytest.approx(1, abs=0.01)
    exposed = photo * 1.02 + 0.05
    assert flat_energy(exposed, truth, truth.mask) == pytest.approx(1.02, abs=0.01)


@pytest.mark.parametrize("level", [0.0, 1.0])
def test_flat_energy_leaves_out_what_the_photograph_clips(level: float) -> None:
    photo = wall()
    photo[:, 80:] = level
    truth = whole(photo)
    image = photo + 0.02 * (noise(120, 160) - 0.5) * (torch.arange(160) >= 90)[None, :, None]
    assert flat_energy(image, truth, truth.mask) == pytest.approx(1, abs=0.01)


def test_flat_energy_says_nothing_without_flat_pixels() -> None:
    busy = whole(noise())
    assert math.isnan(flat_energy(busy.color, busy, busy.mask))
    photo = wall()
    mask = ~everywhere(photo)
    mask[70:106, 20:50] = True
    assert 0 < int(flat_pixels(photo, mask).sum()) < FLAT_PIXELS
    assert math.isnan(flat_energy(photo, Photograph(photo, mask), mask))


@pytest.mark.parametrize("measure", [band_error, s3_ratio, lambda image, truth: flat_energy(image, truth, truth.mask)])
def test_bytes_of_other_shapes_are_refused(measure: Measure) -> None:
    image = natural()
    with pytest.raises(AssertionError):
        measure(image[:-1], whole(image))

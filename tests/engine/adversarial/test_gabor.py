"""The Gabor term against a plain twin, its gradient against finite differences, and what it forgives."""

from __future__ import annotations

import math
from functools import partial

import cv2
import numpy as np
import pytest
import torch
import torch.nn.functional as F

from advtex_engine.adversarial.gabor import (
    FAINT,
    LUMA,
    OCTAVES,
    ORIENTATIONS,
    SIZE,
    SPACING,
    TINY,
    WAVELENGTH,
    WINDOW,
    gabor_filters,
    gabor_loss,
    window_reach,
)
from advtex_engine.render.motion import smeared

FILTERS = gabor_filters(torch.device("cpu"))


def blur(image: np.ndarray, sigma: float) -> np.ndarray:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma))


def moved_by(image: np.ndarray, right: int, down: int = 0) -> np.ndarray:
    return np.roll(image, (down, right), (0, 1))


def texture(seed: int, height: int = 60, width: int = 72) -> np.ndarray:
    """[h,w] in [0,1]: edges and grain of several sizes."""
    random = np.random.default_rng(seed)
    layers = [blur(random.standard_normal((height, width)), size) * size for size in (0.7, 1.5, 4.0)]
    image = 0.5 + 0.12 * sum(layers) + 0.2 * np.sign(blur(random.standard_normal((height, width)), 6.0))
    return np.clip(image, 0, 1)


def shown(gray: np.ndarray) -> torch.Tensor:
    """[1,3,h,w] in [-1,1]."""
    return (torch.from_numpy(gray).float() * 2 - 1).expand(1, 3, *gray.shape).contiguous()


def loss_of(render: torch.Tensor, photograph: torch.Tensor, filters: torch.Tensor = FILTERS) -> torch.Tensor:
    return gabor_loss(render, photograph, torch.ones_like(render[:, :1]), filters)


def distance(a: np.ndarray, b: np.ndarray) -> float:
    return float(loss_of(shown(a), shown(b)))


def twin_shares(gray: np.ndarray) -> list[np.ndarray]:
    """Window by window, with filters drawn anew from their formula."""
    octaves = []
    for _ in range(OCTAVES):
        energies = []
        for number in range(ORIENTATIONS):
            angle = number * math.pi / ORIENTATIONS
            energy = np.full((gray.shape[0] - SIZE + 1, gray.shape[1] - SIZE + 1), TINY)
            for phase in (0.0, math.pi / 2):
                kernel = np.empty((SIZE, SIZE))
                envelope = np.empty((SIZE, SIZE))
                for row in range(SIZE):
                    for column in range(SIZE):
                        x, y = column - SIZE // 2, row - SIZE // 2
                        u, v = x * math.cos(angle) + y * math.sin(angle), y * math.cos(angle) - x * math.sin(angle)
                        envelope[row, column] = math.exp(-(u * u + v * v / 2) / (WAVELENGTH**2 / 2))
                        kernel[row, column] = envelope[row, column] * math.cos(2 * math.pi * u / WAVELENGTH + phase)
                kernel -= envelope * kernel.sum() / envelope.sum()
                response = cv2.filter2D(gray, cv2.CV_64F, kernel / np.sqrt((kernel**2).sum()))
                inside = SIZE // 2
                energy += response[inside:-inside, inside:-inside] ** 2
            energies.append(np.sqrt(energy))
        rows, columns = (1 + (side - (WINDOW - SPACING + 1)) // WINDOW for side in energies[0].shape)
        places = slice(0, WINDOW, SPACING)
        greatest = np.array(
            [
                [[e[WINDOW * r :, WINDOW * c :][places, places].max() for c in range(columns)] for r in range(rows)]
                for e in energies
            ]
        )
        octaves.append(greatest / np.sqrt((greatest**2).sum(0) + FAINT**2))
        height, width = (side // 2 * 2 for side in gray.shape)
        gray = gray[:height, :width].reshape(height // 2, 2, width // 2, 2).mean((1, 3))
    return octaves


def test_it_is_the_formulas() -> None:
    random = np.random.default_rng(0)
    a, b = (np.stack([texture(seed), *random.random((2, 60, 72))]) for seed in (1, 2))
    grays = [np.tensordot(LUMA, image, 1) for image in (a, b)]
    expected = sum(((x - y) ** 2).sum(0).mean() for x, y in zip(*map(twin_shares, grays), strict=True))
    images = [torch.from_numpy(image)[None].float() * 2 - 1 for image in (a, b)]
    assert float(loss_of(images[0], images[1])) == pytest.approx(expected, rel=1e-4)


def test_its_gradient_is_that_of_differences() -> None:
    a, b = (shown(texture(seed, 26, 30)).double() for seed in (3, 4))
    at = a.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(loss_of(at, b, FILTERS.double()), at)
    generator = torch.Generator().manual_seed(0)
    for _ in range(5):
        towards = torch.randn(a.shape, generator=generator, dtype=torch.float64)
        step = 1e-6
        ahead, behind = (loss_of(a + sign * step * towards, b, FILTERS.double()) for sign in (1, -1))
        assert float((gradient * towards).sum()) == pytest.approx(float((ahead - behind) / (2 * step)), rel=1e-4)


def test_alike_is_nothing_and_pulls_nowhere() -> None:
    image = shown(texture(5)).requires_grad_()
    loss = loss_of(image, image.detach())
    assert float(loss.detach()) == 0
    (gradient,) = torch.autograd.grad(loss, image)
    assert float(gradient.abs().max()) == 0
    flat = torch.zeros(1, 3, 40, 40, requires_grad=True)
    (gradient,) = torch.autograd.grad(loss_of(flat, image[..., :40, :40].detach()), flat)
    assert bool(gradient.isfinite().all()), "a flat render has no energy, whose root has no slope"


@pytest.mark.parametrize("seed", range(4))
def test_it_forgives_a_shift_and_not_a_blur(seed: int) -> None:
    """A pixel to the right and down costs L1 about twice what a blur of a pixel costs, and these about as much."""
    sharp = texture(seed)
    moved = moved_by(sharp, 1, 1)
    blurred = blur(sharp, 1.0)
    by_l1 = np.abs(sharp - moved).mean() / np.abs(sharp - blurred).mean()
    assert by_l1 > 1.5
    assert distance(moved, sharp) / distance(blurred, sharp) < 0.6 * by_l1


@pytest.mark.parametrize("seed", range(4))
def test_of_views_that_disagree_the_nearest_texture_is_sharp(seed: int) -> None:
    """Between two views a pixel apart: either of them is nearer to both than their mean is, in these energies alone."""
    sharp = texture(seed)
    moved = moved_by(sharp, 1)
    mean = (sharp + moved) / 2
    assert distance(sharp, moved) < distance(mean, sharp) + distance(mean, moved)
    assert np.abs(sharp - moved).mean() == pytest.approx(np.abs(mean - sharp).mean() + np.abs(mean - moved).mean())


def test_exposure_costs_little() -> None:
    sharp = texture(7)
    assert distance(np.clip(0.9 * sharp + 0.03, 0, 1), sharp) < 0.1 * distance(blur(sharp, 1.0), sharp)


def test_images_smaller_than_a_window_have_no_energy() -> None:
    small = torch.zeros(1, 3, window_reach() - 1, 40, requires_grad=True)
    assert float(loss_of(small, small.detach())) == 0
    least = torch.rand(1, 3, window_reach(), window_reach())
    assert float(loss_of(least, 1 - least.roll(2, -1))) > 0


def test_the_background_shows_the_photograph() -> None:
    render, photograph = shown(texture(1)), shown(texture(2))
    foreground = torch.ones(1, 1, *render.shape[-2:])
    foreground[..., :30] = 0
    at = render.clone().requires_grad_()
    loss = gabor_loss(at, photograph, foreground, FILTERS)
    same = torch.cat((photograph[..., :30], render[..., 30:]), 3)
    assert float(loss.detach()) == pytest.approx(float(loss_of(same, photograph)), rel=1e-6)
    (gradient,) = torch.autograd.grad(loss, at)
    assert bool((gradient[..., :30] == 0).all()) and float(gradient[..., 30:].abs().max()) > 0


def test_a_texture_of_views_that_disagree_is_sharper_for_it() -> None:
    """An image optimized against its two shifted views, by L1 and by this: the edges' strength."""
    sharp = texture(9)
    views = [shown(moved_by(sharp, by)) for by in (-1, 1)]
    strengths = []
    for weight in (0.0, 1.0):
        image = ((views[0] + views[1]) / 2).requires_grad_()
        adam = torch.optim.Adam([image], lr=0.01)
        for step in range(60):
            view = views[step % 2]
            loss = F.l1_loss(image, view) + weight * loss_of(image, view)
            adam.zero_grad()
            loss.backward()
            adam.step()
        strengths.append(float(image.detach()[:, :1].diff(dim=-1).abs().mean()))
    assert strengths[1] > 1.1 * strengths[0]


def test_before_a_photograph_that_moved_a_sharp_render_is_the_best() -> None:
    sharp = texture(0)
    motion = ((0, -1, 0.3), (0, 0, 0.4), (0, 1, 0.3))
    photograph = shown(smeared(torch.from_numpy(sharp)[None].float(), motion)[0].numpy())
    foreground = torch.ones_like(photograph[:, :1])
    foreground[..., :20] = 0
    losses = [
        [float(gabor_loss(render, photograph, foreground, FILTERS, moved)) for render in (shown(sharp), photograph)]
        for moved in (partial(smeared, taps=motion), None)
    ]
    assert losses[0][0] < 0.1 * losses[0][1]
    assert losses[1][0] > 10 * losses[1][1]

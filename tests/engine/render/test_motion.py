"""Motion blur that was put onto a photograph is found and put onto a render, against plain twins."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.render.filtering import blurred
from advtex_engine.render.motion import (
    LEAST_KNOWN,
    PIXELS,
    Taps,
    _energies_after,
    _steps,
    _taps,
    found_motion,
    motion_kernel,
    motions,
    smeared,
)

HEIGHT, WIDTH = 90, 120
KNOWN = torch.ones((HEIGHT, WIDTH), dtype=torch.bool)
MOVED = [1, 4, 20, 33, 44, 58, 71]  # one or two of each length, in several directions


def picture(seed: int = 0, right: int = 0, down: int = 0) -> Tensor:
    """[h,w] in [0,1]: edges and detail of several sizes; what lies so many pixels further."""
    size = (3, HEIGHT + 10, WIDTH + 10)
    random = torch.randn(size, generator=torch.Generator().manual_seed(seed))
    layers = [size * blurred(part[None], size)[0] for part, size in zip(random, (0.7, 1.5, 4.0), strict=True)]
    whole = (0.5 + 0.12 * sum(layers, torch.zeros(size[1:])) + 0.2 * layers[2].sign()).clamp(0, 1)
    return whole[5 + down :, 5 + right :][:HEIGHT, :WIDTH].clone()


def photographed(taps: Taps, seed: int = 1) -> Tensor:
    """What `picture` shows from two pixels beside, smeared, with some grain."""
    grain = torch.randn((HEIGHT, WIDTH), generator=torch.Generator().manual_seed(seed))
    return smeared(picture(right=-2, down=1)[None], taps)[0] + 0.002 * grain


@pytest.mark.parametrize("pixels", PIXELS)
def test_a_motion_is_found(pixels: float) -> None:
    """To the candidate; of a pixel or two on a grid of pixels directions are alike, and a line aslant is hardly one."""
    for number, (length, angle) in enumerate(motions()):
        if length != pixels:
            continue
        found = found_motion(picture(), photographed(_taps(number)), KNOWN)
        length, direction = motions()[[_taps(other) for other in range(len(motions()))].index(found)]
        assert length == pixels
        turned = abs((direction - angle + np.pi / 2) % np.pi - np.pi / 2)
        assert turned < (0.01 if pixels > 4 else 0.53 if pixels > 2 else np.pi)


def test_a_photograph_that_is_sharper_or_only_elsewhere_has_not_moved() -> None:
    sharp = picture()
    assert found_motion(sharp, photographed(()), KNOWN) == ()
    assert found_motion(smeared(sharp[None], _taps(30))[0], sharp, KNOWN) == ()
    assert found_motion(blurred(sharp[None], 1.0)[0], sharp, KNOWN) == ()


def test_what_is_not_known_has_no_say() -> None:
    sharp = picture()
    photograph = photographed(_taps(33))
    known = KNOWN.clone()
    known[:, 70:] = False
    known[20:26, 30:36] = False
    found = found_motion(sharp, photograph, known)
    other = torch.where(known, photograph, torch.rand(KNOWN.shape, generator=torch.Generator().manual_seed(3)))
    assert found_motion(torch.where(known, sharp, 0.0), other, known) == found != ()
    few = torch.zeros_like(KNOWN)
    few[10:20, 10 : 10 + LEAST_KNOWN // 10] = True  # its border has no steps
    assert found_motion(sharp, photograph, few) == ()


@pytest.mark.parametrize("number", [0, *MOVED])
def test_energies_are_those_of_the_smeared_picture(number: int) -> None:
    """Found from correlations, but for what lies beyond the border."""
    sharp = picture()
    taps = _taps(number)
    inside = F.pad(torch.ones((HEIGHT - 2, WIDTH - 2), dtype=torch.bool), (1, 1, 1, 1))
    right, down = _steps(smeared(sharp[None], taps)[0], inside)
    wanted = torch.stack([(right * right).sum(), (right * down).sum(), (down * down).sum()])
    found = _energies_after(*_steps(sharp, inside), inside)[:, number]
    scale = float(wanted[0] + wanted[2])
    torch.testing.assert_close(found / scale, wanted / scale, atol=0.0 if number == 0 else 0.03, rtol=1e-4)


@pytest.mark.parametrize("number", MOVED)
def test_a_smeared_picture_is_the_convolution(number: int) -> None:
    planes = torch.stack([picture(seed) for seed in range(3)])
    kernel = motion_kernel(*motions()[number]).numpy()
    twin = [cv2.filter2D(plane.numpy(), -1, kernel, borderType=cv2.BORDER_REPLICATE) for plane in planes]
    found = smeared(planes, _taps(number))
    torch.testing.assert_close(found, torch.from_numpy(np.stack(twin)), atol=6e-3, rtol=0)
    torch.testing.assert_close(found.mean(), planes.mean(), atol=2e-3, rtol=0)


@pytest.mark.parametrize("number", MOVED)
def test_its_gradient_is_the_transpose(number: int) -> None:
    planes = torch.rand((2, 12, 17), dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert torch.autograd.gradcheck(lambda values: smeared(values, _taps(number)), (planes.requires_grad_(True),))


def test_without_a_motion_a_picture_stays_as_it_is() -> None:
    planes = picture()[None]
    assert smeared(planes, ()) is planes
    assert _taps(0) == ()

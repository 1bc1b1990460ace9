"""The measure of probes: blur, ghosts and noise cost much, what a texture cannot mend costs little."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.adversarial.unlikeness import FLAT, REACH, STRIDE, WINDOWS, structure_unlikeness


def photograph(height: int = 64, width: int = 72) -> Tensor:
    """[1,3,height,width]: detail of all sizes, as photographs have, with a border of 8 pixels to be cut off."""
    generator = torch.Generator().manual_seed(0)
    image = torch.zeros((1, 3, height + 16, width + 16))
    for size in (2, 4, 8, 16, 32):
        noise = torch.rand((1, 3, height // size + 9, width // size + 9), generator=generator)
        grown = F.interpolate(noise, scale_factor=float(size), mode="bicubic", align_corners=False)
        image += grown[..., : height + 16, : width + 16] * size**0.5
    return (image - image.min()) / (image.max() - image.min())


def cut(image: Tensor, down: int = 0, right: int = 0) -> Tensor:
    return image[..., 8 + down : image.shape[2] - 8 + down, 8 + right : image.shape[3] - 8 + right]


def blurred(image: Tensor) -> Tensor:
    """By a standard deviation of 1.15 pixels."""
    for _ in range(2):
        image = F.avg_pool2d(image, 3, 1, 1, count_include_pad=False)
    return image


IMAGE = photograph()
NOISE = torch.randn(IMAGE.shape, generator=torch.Generator().manual_seed(1))


def unlike(render: Tensor) -> float:
    return float(structure_unlikeness(render, cut(IMAGE)).mean())


def test_an_image_is_like_itself() -> None:
    assert unlike(cut(IMAGE)) == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize(
    "spoiled",
    [cut(blurred(IMAGE)), (cut(IMAGE) + cut(IMAGE, 3, 2)) / 2, cut(IMAGE + 0.03 * NOISE)],
    ids=["blur", "ghost", "noise"],
)
def test_what_a_game_must_not_bring_costs_ten_times_a_shift_of_a_pixel_and_a_tone(spoiled: Tensor) -> None:
    assert float((spoiled - cut(IMAGE)).abs().mean()) < 0.05, "and the colors hardly change"
    for harmless in (cut(IMAGE, 1, 0), cut(IMAGE, -1, 1), cut(IMAGE) + 0.08, 0.95 * cut(IMAGE)):
        assert unlike(spoiled) > 10 * unlike(harmless)


def test_colors_would_say_the_opposite() -> None:
    moved, blur = ((each - cut(IMAGE)).abs().mean() for each in (cut(IMAGE, 1, 1), cut(blurred(IMAGE))))
    assert moved > blur
    assert unlike(cut(IMAGE, 1, 1)) < 0.1 * unlike(cut(blurred(IMAGE)))


def test_more_of_it_is_worse() -> None:
    assert unlike(cut(blurred(blurred(IMAGE)))) > 1.5 * unlike(cut(blurred(IMAGE)))
    assert unlike(cut(IMAGE + 0.06 * NOISE)) > 1.5 * unlike(cut(IMAGE + 0.03 * NOISE))
    assert unlike(cut(IMAGE, 5, 0)) > 10 * unlike(cut(IMAGE, 2, 0)), "a shift of more than two pixels counts"


def test_a_window_is_as_by_hand() -> None:
    """In the middle, window by window and shift by shift."""
    render, photo = cut(blurred(IMAGE)), cut(IMAGE)
    row, column = 32, 36
    expected = 0.0
    a, b = render.mean(1)[0].double(), photo.mean(1)[0].double()
    for size in WINDOWS:
        beyond = (size - STRIDE) // 2
        rows, columns = (slice(first - beyond, first - beyond + size) for first in (row, column))
        window, found = b[rows, columns], []
        for down in range(-REACH, REACH + 1):
            for right in range(-REACH, REACH + 1):
                other = a.roll((-down, -right), (0, 1))[rows, columns]
                together = ((other - other.mean()) * (window - window.mean())).mean()
                spread = other.var(correction=0) + window.var(correction=0)
                found.append(float((2 * together + FLAT) / (spread + FLAT)))
        expected += (1 - max(found)) / len(WINDOWS)
        a, b = (F.avg_pool2d(each[None], 3, 1, 1, count_include_pad=False)[0] for each in (a, b))
    shown = structure_unlikeness(render, photo)[0, row : row + STRIDE, column : column + STRIDE]
    assert torch.allclose(shown, torch.full_like(shown, expected), atol=1e-4)
    assert expected > 0.01


def test_any_size_and_any_number_at_once() -> None:
    image = IMAGE[..., :37, :50]
    both = structure_unlikeness(torch.cat((image, blurred(image))), torch.cat((image, image)))
    assert both.shape == (2, 37, 50)
    assert torch.equal(both[1:], structure_unlikeness(blurred(image), image))

"""Offsets of blocks by phase correlation, and the image moved by them."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F

from advtex_engine.adversarial.alignment import BLOCK, DETAIL, block_offsets, box_mean, search_bound, shift

BOUND = 5


def textured(height: int, width: int, seed: int = 0) -> torch.Tensor:
    """Smooth noise [1,3,height,width] in [-1,1] with detail of a few pixels."""
    noise = torch.rand(1, 3, height + 8, width + 8, generator=torch.Generator().manual_seed(seed))
    return F.avg_pool2d(noise, 3, 1)[..., 3:-3, 3:-3] * 6 - 3


def moved(image: torch.Tensor, x: int, y: int) -> torch.Tensor:
    """The image's content x pixels to the right and y down."""
    return image.roll((y, x), (-2, -1))


def ones(image: torch.Tensor) -> torch.Tensor:
    return torch.ones_like(image[:1, :1])


@pytest.mark.parametrize(("x", "y"), [(0, 0), (3, -2), (-4, 4), (1, 0)])
def test_the_offset_of_a_moved_image_is_found_and_undone(x: int, y: int) -> None:
    image = textured(160, 224)
    example = moved(image, x, y)
    offsets = block_offsets(image, example, ones(image), BOUND)
    assert offsets.shape == (1, 4, 6, 2)
    assert torch.equal(offsets, torch.tensor([float(x), float(y)]).expand_as(offsets))
    inner = (..., slice(8, -8), slice(8, -8))
    torch.testing.assert_close(shift(example, offsets)[inner], image[inner], atol=1e-4, rtol=0)


def test_each_example_and_each_block_has_its_own_offset() -> None:
    image = textured(128, 256)
    halves = torch.cat((moved(image, 2, 0)[..., :128], moved(image, -3, 1)[..., 128:]), -1)
    offsets = block_offsets(image, torch.cat((image, halves)), ones(image), BOUND)
    assert bool((offsets[0] == 0).all())
    assert torch.equal(offsets[1, :, 0], torch.tensor([2.0, 0.0]).expand(3, 2))
    assert torch.equal(offsets[1, :, -1], torch.tensor([-3.0, 1.0]).expand(3, 2))


def test_what_is_not_clearly_better_keeps_its_place() -> None:
    image = textured(128, 128)
    examples = torch.cat((torch.zeros_like(image), moved(image, BOUND + 4, 0), textured(128, 128, seed=1)))
    assert bool((block_offsets(image, examples, ones(image), BOUND) == 0).all())
    assert bool((block_offsets(image, moved(image, 2, 0), torch.zeros_like(ones(image)), BOUND) == 0).all())


def test_exposure_does_not_move_anything() -> None:
    image = textured(128, 128)
    assert bool((block_offsets(image, image * 0.7 + 0.2, ones(image), BOUND) == 0).all())


def test_shift_is_bilinear_sampling_with_its_gradient() -> None:
    image = textured(BLOCK, BLOCK).requires_grad_(True)
    offsets = torch.zeros(1, 1, 1, 2)
    offsets[..., 0] = 0.25
    result = shift(image, offsets)
    twin = torch.cat((image[..., 1:], image[..., -1:]), -1) * 0.25 + image * 0.75
    torch.testing.assert_close(result, twin, atol=1e-5, rtol=0)
    (gradient,) = torch.autograd.grad(result[..., 30, 30].sum(), image)
    assert float(gradient[0, 0, 30, 30]) == pytest.approx(0.75, abs=1e-5)
    assert float(gradient[0, 0, 30, 31]) == pytest.approx(0.25, abs=1e-5)


def test_the_bound_follows_the_views_width() -> None:
    assert [search_bound(width) for width in (160, 320, 640, 1296)] == [2, 2, 5, 10]


@pytest.mark.parametrize("dim", [2, 3])
def test_thebox_mean_is_average_pooling_to_the_last_bit(dim: int) -> None:
    images = torch.rand(3, 1, 40, 50, generator=torch.Generator().manual_seed(0))
    along, padding = ((DETAIL, 1), (DETAIL // 2, 0)) if dim == 2 else ((1, DETAIL), (0, DETAIL // 2))
    assert torch.equal(box_mean(images, dim), F.avg_pool2d(images, along, 1, padding))

"""What the discriminator is shown: both examples moved onto the source image, as condition and residual.

Images are [1,C,h,w] in [-1,1], masks [1,1,h,w] float 0/1, offsets those of `alignment.block_offsets`.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from advtex_engine.adversarial.alignment import move, moved_positions

WHOLLY_VISIBLE = 0.99  # a moved pixel that mixes in what is not visible does not count


@dataclass(frozen=True)
class Examples:
    """fake_input, real_input: [1,channels,h,w], the discriminator's inputs: condition, residual, and zeros if any.

    fake, real: [1,3,h,w] as moved. visible: [1,1,h,w], where both still show what the auxiliary view sees.
    """

    fake_input: Tensor
    real_input: Tensor
    fake: Tensor
    real: Tensor
    visible: Tensor


@dataclass(frozen=True)
class InputForm:
    """The form of the discriminator's input. channels: 6, or 8 where kernels want a multiple of 8, the last two zero.

    conditioned: whether the source image is shown; if not, its three channels are zero and the residual is the example
    itself.
    """

    channels: int = 6
    dtype: torch.dtype = torch.float32
    conditioned: bool = True


def assemble(
    condition: Tensor, real: Tensor, fake: Tensor, visible: Tensor, offsets: Tensor | None, form: InputForm
) -> Examples:
    """Both examples, moved by offsets [2,gh,gw,2] (the real one's first) if any; pixels that B does not see are nil.

    Differentiable in `fake` only.
    """
    if offsets is not None:
        positions = moved_positions(offsets, condition.shape[-2:])
        # The mask goes with the real example through one gather.
        with_mask = move(torch.cat((real, visible), 1), positions[:1])
        seen = torch.minimum(with_mask[:, 3:], move(visible, positions[1:])) > WHOLLY_VISIBLE
        real, fake, visible = with_mask[:, :3], move(fake, positions[1:]), visible * seen
    shown = condition if form.conditioned else torch.zeros_like(condition)
    return Examples(_judged(shown, fake, visible, form), _judged(shown, real, visible, form), fake, real, visible)


def _judged(condition: Tensor, example: Tensor, visible: Tensor, form: InputForm) -> Tensor:
    parts = [condition, (example - condition) * visible]
    if form.channels > 6:
        parts.append(condition.new_zeros(()).expand(1, form.channels - 6, *condition.shape[-2:]))
    return torch.cat(parts, 1).to(form.dtype, memory_format=torch.channels_last)

"""The parts of a step that have a fast form for a GPU, behind one set of signatures; chosen once, at the start.

The plain ones are torch and run everywhere. The fused ones are Triton's and need CUDA, the package `triton` and a C
compiler, with which Triton builds its launchers. On a CPU torch.compile makes steps longer, by 2 to 50 %
(`tests/benchmarks/compiled.py`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from advtex_engine.adversarial.alignment import example_offsets
from advtex_engine.adversarial.examples import Examples, InputForm, assemble
from advtex_engine.adversarial.gabor import gabor_loss
from advtex_engine.adversarial.losses import Verdict, judge, l1_loss, mean_difference
from advtex_engine.adversarial.pair_sampler import DrawnPair, PairSampler
from advtex_engine.render.texture import sample_texels


@dataclass(frozen=True)
class Operations:
    """name: "torch" or "triton". reason: why not the other one; None for the better one.

    draw: `PairSampler.draw`. sample_texels: `texture.sample_texels`. offsets: `alignment.example_offsets`. assemble:
    `examples.assemble`. judge, l1_loss, mean_difference: those of `losses`. gabor_loss: `gabor.gabor_loss`.
    average(mean, state, weight): mean += weight * (state - mean), weight 0-dim on the device.
    """

    name: str
    reason: str | None
    draw: Callable[[PairSampler], DrawnPair]
    sample_texels: Callable[[Tensor, Tensor, Tensor], Tensor]
    offsets: Callable[[Tensor, Tensor, Tensor, Tensor, int], Tensor]
    assemble: Callable[[Tensor, Tensor, Tensor, Tensor, Tensor | None, InputForm], Examples]
    judge: Callable[[Tensor, Tensor, Tensor, Tensor], Verdict]
    l1_loss: Callable[[Tensor, Tensor, Tensor], Tensor]
    mean_difference: Callable[[Tensor, Tensor], Tensor]
    gabor_loss: Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]
    average: Callable[[Tensor, Tensor, Tensor], object]


def plain_operations(reason: str | None = None) -> Operations:
    return Operations(
        "torch",
        reason,
        draw=PairSampler.draw,
        sample_texels=sample_texels,
        offsets=example_offsets,
        assemble=assemble,
        judge=judge,
        l1_loss=l1_loss,
        mean_difference=mean_difference,
        gabor_loss=gabor_loss,
        average=torch.Tensor.lerp_,
    )

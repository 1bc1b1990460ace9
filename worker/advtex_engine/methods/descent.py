"""A texture that minimizes a loss without an opponent: Adam over the texels, what `gabor`, `l1` and `vgg` share."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor
from torch.optim.adam import adam

from advtex_engine.core.errors import Diverged, Stopped
from advtex_engine.methods.inputs import LossPoint, MethodInput
from advtex_engine.methods.mean import dense_texture
from advtex_engine.render.streaming import PairViews
from advtex_engine.render.view_maps import ViewMaps, foregrounds
from advtex_engine.runtime.checkpoint import CHECKPOINT, Checkpoints, restore_generator
from advtex_engine.runtime.threads import fit_threads

LR = 1e-3
"""Learning rate of the first step, in colors of [0, 1], from the mean. It falls to zero in a straight line, so that the
last steps settle and do not shake."""
HISTORY_POINTS = 200  # loss means kept for the report and shown as progress

Gradient = Callable[[Tensor, int], tuple[Tensor, Tensor]]
"""(compact texture [slots,3], step) -> 0-dim loss, and its gradient [slots,3], which holds until the next call."""


def gradient_of(loss: Callable[[Tensor, int], Tensor]) -> Gradient:
    """The same as a function of the step, of a loss that is differentiable in the texture."""

    def gradient(values: Tensor, step: int) -> tuple[Tensor, Tensor]:
        values = values.requires_grad_(True)
        value = loss(values, step)
        (slope,) = torch.autograd.grad(value, [values])
        return value.detach(), slope

    return gradient


def descend(
    given: MethodInput,
    name: str,
    gradient: Gradient,
    steps: int,
    generator: torch.Generator,
    views: PairViews | None = None,
    rate: float | None = None,
    checkpoint: str = CHECKPOINT,
) -> tuple[Tensor, list[LossPoint]]:
    """Goes down `gradient` from given.start, or else the mean -> dense texture [H,W,3] in [0,1], history of the loss.

    name: of the loss in the history. generator: all that `gradient` draws from; its state goes into the checkpoint, so
    a run that is stopped and resumed gives the same texture. views: what it draws its views from, if it draws pairs.
    rate: Adam's at the first step, None: LR. checkpoint: the name of its file; one of another name is of what comes
    before the method, and is not shown on the way. Raises Stopped, after a checkpoint, when the monitor asks.
    """
    maps, rate = given.maps[1], LR if rate is None else rate
    start = given.means[1] if given.start is None else given.start
    values = start[maps.slot_map >= 0].clone()
    moments = (torch.zeros_like(values), torch.zeros_like(values))
    taken = torch.zeros((), device=values.device)
    total = torch.zeros((), device=values.device)
    first, losses = 0, list[LossPoint]()
    checkpoints = Checkpoints(given.work, given.config.checkpoint_seconds, steps, checkpoint)
    shown = checkpoint == CHECKPOINT
    saved = checkpoints.load("step", "losses", "quality", "values", "total", "moments", "generator", "views")
    if saved is not None:
        first, losses = saved["step"], saved["losses"]
        given.live.quality = saved["quality"]
        values.data.copy_(saved["values"])
        total.copy_(saved["total"])
        for moment, kept in zip(moments, saved["moments"], strict=True):
            moment.copy_(kept)
        taken.fill_(first)
        restore_generator(generator, saved["generator"], first)
        if views is not None:
            views.load_state_dict(saved["views"])
    every = max(1, steps // HISTORY_POINTS)
    for step in range(first, steps):
        fit_threads()
        value, slope = gradient(values.detach(), step)
        # Not torch.optim.Adam: it imports torch's compiler when it is made, which takes a second.
        adam(
            [values],
            [slope],
            [moments[0]],
            [moments[1]],
            [],
            [taken],
            fused=True,
            amsgrad=False,
            beta1=0.9,
            beta2=0.999,
            lr=rate * (1 - step / steps),
            weight_decay=0.0,
            eps=1e-8,
            maximize=False,
        )
        if views is not None:
            views.advance(1)
        total += value
        done = step + 1
        if done % every == 0 or done == steps:
            losses.append({"step": done, name: float(total) / (done - (losses[-1]["step"] if losses else 0))})
            if not math.isfinite(losses[-1][name]):
                raise Diverged(f"the loss was no longer finite at step {done} of {steps}; choose another method")
            given.monitor.progress(done, steps, {name: losses[-1][name]})
            total.zero_()
        if shown and (done == steps or given.live.due()):
            given.live.show(done, maps, values, given.means[1], losses)
        stop = given.monitor.stop_requested() and done < steps
        if stop or checkpoints.due():
            state = {"step": done, "losses": losses, "quality": given.live.quality, "values": values}
            state |= {"total": total, "moments": list(moments), "generator": generator.get_state()}
            checkpoints.save({**state, "views": views.state_dict() if views is not None else {}})
        if stop:
            raise Stopped(f"stopped after step {done} of {steps}; resume goes on from there")
    return dense_texture(maps, values).clamp(0, 1), losses


def drawn_views(maps: ViewMaps, count: int | None, passes: float, generator: torch.Generator) -> list[int]:
    """So many views, all that see the mesh in a new random order per pass; count: None for so many passes."""
    seen: list[int] = foregrounds(maps).nonzero().flatten().tolist()
    count = count or math.ceil(passes * len(seen))
    orders = [torch.randperm(len(seen), generator=generator).tolist() for _ in range(-(-count // len(seen)))]
    return [seen[index] for order in orders for index in order][:count]

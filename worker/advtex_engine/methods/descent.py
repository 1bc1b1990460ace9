"""A texture that minimizes a loss without an opponent: Adam over the texels, what `l1` and `vgg` share."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from advtex_engine.core.errors import Diverged, Stopped
from advtex_engine.methods.inputs import LossPoint, MethodInput
from advtex_engine.methods.mean import dense_texture
from advtex_engine.render.streaming import PairViews
from advtex_engine.runtime.checkpoint import Checkpoints, restore_generator

LR = 1e-3
"""Learning rate of the first step, in colors of [0, 1]; it falls to zero in a straight line, so that the last steps
settle and do not shake."""
HISTORY_POINTS = 200  # loss means kept for the report and shown as progress

Loss = Callable[[Tensor, int], Tensor]
"""(compact texture [slots,3], step) -> 0-dim loss, differentiable in the texture."""


def descend(
    given: MethodInput,
    name: str,
    loss: Loss,
    steps: int,
    generator: torch.Generator,
    views: PairViews | None = None,
) -> tuple[Tensor, list[LossPoint]]:
    """Minimizes `loss` from the mean texture -> dense texture [H,W,3] float32 in [0,1] and the history of the loss.

    name: of the loss in the history. generator: all that `loss` draws from; its state goes into the checkpoint, so a
    run that is stopped and resumed gives the same texture. views: what `loss` draws its views from, if it draws pairs.
    Raises Stopped, after a checkpoint, when the monitor asks.
    """
    maps = given.maps[1]
    values = given.means[1][maps.slot_map >= 0].clone().requires_grad_(True)
    adam = torch.optim.Adam([values], lr=LR, fused=True)
    total = torch.zeros((), device=values.device)
    first, losses = 0, list[LossPoint]()
    checkpoints = Checkpoints(given.work, given.config.checkpoint_seconds, steps)
    saved = checkpoints.load("step", "losses", "quality", "values", "total", "adam", "generator", "views")
    if saved is not None:
        first, losses = saved["step"], saved["losses"]
        given.live.quality = saved["quality"]
        values.data.copy_(saved["values"])
        total.copy_(saved["total"])
        adam.load_state_dict(saved["adam"])
        restore_generator(generator, saved["generator"], first)
        if views is not None:
            views.load_state_dict(saved["views"])
    every = max(1, steps // HISTORY_POINTS)
    for step in range(first, steps):
        adam.param_groups[0]["lr"] = LR * (1 - step / steps)
        value = loss(values, step)
        (values.grad,) = torch.autograd.grad(value, [values])
        adam.step()
        if views is not None:
            views.advance(1)
        total += value.detach()
        done = step + 1
        if done % every == 0 or done == steps:
            losses.append({"step": done, name: float(total) / (done - (losses[-1]["step"] if losses else 0))})
            if not math.isfinite(losses[-1][name]):
                raise Diverged(f"the loss was no longer finite at step {done} of {steps}; choose another method")
            given.monitor.progress(done, steps, {name: losses[-1][name]})
            total.zero_()
        if done == steps or given.live.due():
            given.live.show(done, maps, values, given.means[1], losses)
        stop = given.monitor.stop_requested() and done < steps
        if stop or checkpoints.due():
            state = {"step": done, "losses": losses, "quality": given.live.quality, "values": values.detach()}
            state |= {"total": total, "adam": adam.state_dict(), "generator": generator.get_state()}
            checkpoints.save({**state, "views": views.state_dict() if views is not None else {}})
        if stop:
            raise Stopped(f"stopped after step {done} of {steps}; resume goes on from there")
    return dense_texture(maps, values.detach()).clamp(0, 1), losses

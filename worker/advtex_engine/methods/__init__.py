"""Texturing methods behind one signature: `Method`, from the view maps to a dense texture."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from advtex_engine.methods.adversarial import adversarial, adversarial_no_auxiliary, adversarial_no_condition
from advtex_engine.methods.inputs import LossPoint, MethodInput
from advtex_engine.methods.mean import mean

Method = Callable[[MethodInput], tuple[Tensor, list[LossPoint]]]

METHODS: dict[str, Method] = {
    "adversarial": adversarial,
    "adversarial_no_auxiliary": adversarial_no_auxiliary,
    "adversarial_no_condition": adversarial_no_condition,
    "mean": mean,
}

__all__ = ["METHODS", "LossPoint", "Method", "MethodInput"]

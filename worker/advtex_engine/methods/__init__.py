"""Texturing methods behind one signature: `Method`, from the view maps to a dense texture."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from advtex_engine.methods.adversarial import adversarial, adversarial_no_auxiliary, adversarial_no_condition
from advtex_engine.methods.best_view import best_view
from advtex_engine.methods.colormap import colormap
from advtex_engine.methods.inputs import LossPoint, MethodInput
from advtex_engine.methods.l1 import l1
from advtex_engine.methods.mean import mean
from advtex_engine.methods.sharpest import sharpest
from advtex_engine.methods.vgg import load_vgg, vgg
from advtex_engine.methods.view_selection import view_selection

Method = Callable[[MethodInput], tuple[Tensor, list[LossPoint]]]

METHODS: dict[str, Method] = {
    "adversarial": adversarial,
    "adversarial_no_auxiliary": adversarial_no_auxiliary,
    "adversarial_no_condition": adversarial_no_condition,
    "best_view": best_view,
    "colormap": colormap,
    "l1": l1,
    "mean": mean,
    "sharpest": sharpest,
    "vgg": vgg,
    "view_selection": view_selection,
}

__all__ = ["METHODS", "LossPoint", "Method", "MethodInput", "require"]


def require(method: str) -> None:
    """Raises what the method would fail with for lack of weights, before a run has cost anything."""
    if method == "vgg":
        load_vgg()

"""View selection: one photograph per face, and then nearer to what all of them show; the same without the latter."""

from __future__ import annotations

from torch import Tensor

from advtex_engine.methods.gabor import descended
from advtex_engine.methods.inputs import LossPoint, MethodInput
from advtex_engine.methods.selected import select_views, with_detail


def view_selection(given: MethodInput) -> tuple[Tensor, list[LossPoint]]:
    """As `descended`, from given.start, in given.config.steps."""
    return descended(given, given.config.steps)


def view_selection_no_descent(given: MethodInput) -> tuple[Tensor, list[LossPoint]]:
    """The texture of `select_views` with its detail; no iterations, so no losses."""
    selection = select_views(given)
    given.facts["known"] = selection.known
    return with_detail(selection.texture, selection.painted, given.maps[1]), []

"""Texturing methods behind one signature, `TextureFunction`: from the view maps to a dense texture.

Each is told of by its record in `advtex_options.methods`, which names its function here or in another package.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

from torch import Tensor

from advtex_engine.core.errors import EngineError
from advtex_engine.methods.inputs import LossPoint, MethodInput
from advtex_options.methods import known_methods

TextureFunction = Callable[[MethodInput], tuple[Tensor, list[LossPoint]]]

__all__ = ["LossPoint", "MethodInput", "TextureFunction", "require", "texture_function"]


def texture_function(method: str) -> TextureFunction:
    """The function of a method that is known. Raises EngineError if its package does not hold it."""
    function: TextureFunction = _imported(method, known_methods()[method].function)
    return function


def require(method: str) -> None:
    """Raises what the method would fail with for lack of its function or weights, before a run has cost anything."""
    texture_function(method)
    if weights := known_methods()[method].weights:
        _imported(method, weights)()


def _imported(method: str, place: str) -> Any:
    module, _, function = place.partition(":")
    try:
        return getattr(importlib.import_module(module), function)
    except Exception as error:  # whatever a package of others does
        told = f"{type(error).__name__}: {error}"
        remedy = "update or reinstall the package that brings it, or choose another method"
        raise EngineError(f"the method {method} cannot be used: {place} is not there ({told}); {remedy}") from error

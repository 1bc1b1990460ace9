"""Texturing methods: a record of each, which says all that is asked about it elsewhere, and the registry that finds it.

A record is known wherever this package is, also without the engine: the method's own code is named and not imported.
Those that come with advtex are in `BUILT_IN`; a package brings others by entry points of the group `advtex.methods`.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from types import MappingProxyType

GROUP = "advtex.methods"

_NAME = re.compile(r"[a-z][a-z0-9_]{0,39}")
_FUNCTION = re.compile(r"\w+(\.\w+)*:\w+")

log = logging.getLogger("advtex.methods")


@dataclass(frozen=True)
class StepMemory:
    """What a step holds on its device beside the views.

    textures: of three float32 per texel that views sample; one with Adam's gradient and two moments is four. network,
    rest: bytes per pixel that the step sees, of a network's activations and of all else. crop: pixels a side of what it
    sees of a view at most; None: all of it.
    """

    textures: int = 2
    network: int = 0
    rest: int = 0
    crop: int | None = None


@dataclass(frozen=True)
class Method:
    """A way to make the texture.

    name: lower-case letters, digits and `_`, 40 at most. help: a phrase for users.
    function: "module:function", from the engine's `MethodInput` to a dense texture and its losses; imported by a run.
    draws_pairs: its steps draw pairs of views, and can do with a part of the views on the device at a time.
    plays_game: its steps train a discriminator by the preset, which decides its start, the views' tones and its memory.
    starts_selected: it begins with selected photographs' texture, whose tones the views are given.
    makes_detail: of photographs that are blurred it begins with a texture that lacks the finest detail.
    refines_cameras: cameras and exposures are refined first, whatever was asked for.
    weights: "module:function" that raises, before a run has cost anything, if weights lack; empty: it needs none.
    memory: of a step that plays no game.

    Raises ValueError for what is none of this.
    """

    name: str
    help: str
    function: str
    draws_pairs: bool = False
    plays_game: bool = False
    starts_selected: bool = False
    makes_detail: bool = False
    refines_cameras: bool = False
    weights: str = ""
    memory: StepMemory = StepMemory()

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.name):
            raise ValueError(f"{self.name!r} is no name of a method; use lower-case letters, digits and _, 40 at most")
        for function in filter(None, (self.function, self.weights)):
            if not _FUNCTION.fullmatch(function):
                raise ValueError(f"{function!r} is no function; give it as module:function")
        if self.plays_game and not self.draws_pairs:
            raise ValueError(f"{self.name} plays a game without pairs of views; set draws_pairs")


BUILT_IN = (
    Method(
        "adversarial",
        "the texture is optimized against a patch discriminator",
        "advtex_engine.methods.adversarial:adversarial",
        draws_pairs=True,
        plays_game=True,
    ),
    Method(
        "adversarial_no_auxiliary",
        "the same without auxiliary views: what they are worth",
        "advtex_engine.methods.adversarial:adversarial_no_auxiliary",
        draws_pairs=True,
        plays_game=True,
    ),
    Method(
        "adversarial_no_condition",
        "the same without showing the discriminator the source view",
        "advtex_engine.methods.adversarial:adversarial_no_condition",
        draws_pairs=True,
        plays_game=True,
    ),
    Method(
        "best_view",
        "each face from the view that shows it largest",
        "advtex_engine.methods.best_view:best_view",
    ),
    Method(
        "colormap",
        "refined cameras and smoothly corrected photographs, then the mean",
        "advtex_engine.methods.colormap:colormap",
        refines_cameras=True,
    ),
    Method(
        "l1",
        "least absolute difference to all views",
        "advtex_engine.methods.l1:l1",
        # Spread over four texels per pixel, with their indices and weights.
        memory=StepMemory(textures=5, rest=200),
    ),
    Method(
        "mean",
        "the mean of all views",
        "advtex_engine.methods.mean:mean",
    ),
    Method(
        "sharpest",
        "each face from the sharpest view that sees it",
        "advtex_engine.methods.sharpest:sharpest",
    ),
    Method(
        "vgg",
        "least difference in the features of VGG16, whose weights the worker must have",
        "advtex_engine.methods.vgg:vgg",
        draws_pairs=True,
        weights="advtex_engine.methods.vgg:load_vgg",
        # Of both examples.
        memory=StepMemory(textures=4, network=10_000, crop=128),
    ),
    Method(
        "view_selection",
        "one photograph per face, then nearer to every photograph's fine structure; in a minute and a quarter",
        "advtex_engine.methods.view_selection:view_selection",
        starts_selected=True,
        makes_detail=True,
        # Two gradients; shared detail at the end takes more a pixel than the two views of a step.
        memory=StepMemory(textures=5, rest=1200),
    ),
    Method(
        "view_selection_no_descent",
        "the same without the latter: what it is worth; in about a minute",
        "advtex_engine.methods.view_selection:view_selection_no_descent",
    ),
)

EARLIER_NAMES: Mapping[str, str] = MappingProxyType({"gabor": "view_selection"})
"""Of methods, which jobs that were accepted under them go on to have; they are taken, and not offered."""


@cache
def known_methods() -> Mapping[str, Method]:
    """Every method that is known here by its name, those of other packages last.

    They are looked for at the first call, not when this is imported: their packages import this module. One that cannot
    be used is left out, and a line of the log says why.
    """
    known = {method.name: method for method in BUILT_IN}
    for point in sorted(entry_points(group=GROUP), key=lambda point: (_package(point), point.name)):
        try:
            method = point.load()
            if not isinstance(method, Method):
                raise TypeError(f"{point.value} is a {type(method).__name__} and no advtex_options.methods.Method")
            if method.name in known or method.name in EARLIER_NAMES:
                raise ValueError(f"the name {method.name} is taken")
        except Exception as error:  # whatever a package of others does
            log.warning(
                "the method %s of the package %s is left out: %s: %s; mend, update or uninstall the package",
                *(point.name, _package(point), type(error).__name__, error),
            )
        else:
            known[method.name] = method
    return MappingProxyType(known)


def _package(point: EntryPoint) -> str:
    return point.dist.name if point.dist is not None else point.module


def chosen_method(method: str | None, preset: str) -> str:
    """The method's name, also where none is asked for: presets but `auto` are recipes of the adversarial method."""
    if not method:
        return "view_selection" if preset == "auto" else "adversarial"
    return EARLIER_NAMES.get(method, method)


class _Help(Mapping[str, str]):
    """The help of `known_methods`, which are looked for when it is read. Has earlier names, and does not list them."""

    def __contains__(self, name: object) -> bool:
        return name in known_methods() or name in EARLIER_NAMES

    def __getitem__(self, name: str) -> str:
        return known_methods()[name].help

    def __iter__(self) -> Iterator[str]:
        return iter(known_methods())

    def __len__(self) -> int:
        return len(known_methods())


METHOD_HELP: Mapping[str, str] = _Help()

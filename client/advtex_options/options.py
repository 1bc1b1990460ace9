"""Every option of a run: its type and default, its bounds, and what users are told about it.

An option is a field of `Options`, which the engine's configuration inherits and the API's `JobOptions` is made of. A
new one is a field here and the line of the engine that reads it; flags, the page's field, the manifest's column and
the API follow. `size` alone differs by place: one word for people, a pair for the engine, `width` and `height` in the
API.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from functools import cache
from types import MappingProxyType
from typing import Any, TypeVar, get_type_hints

from advtex_options.box import FORM, parse_box
from advtex_options.methods import METHOD_HELP
from advtex_options.outputs import OUTPUTS
from advtex_options.words import PRESET_HELP, Preset
from advtex_scan.layouts import LAYOUT_NAMES

UNSEEN_HELP = MappingProxyType(
    {
        "guess": "it has the tone of its surroundings",
        "gray": "it is gray",
        "remove": "its faces are left out of the model",
    }
)
FACE_BUDGET = 100_000
MAX_VIEWS = 240

T = TypeVar("T")


@dataclass(frozen=True)
class Described:
    """What is told about an option, in the API, on the page and on the command line.

    help: a phrase. label: the page's name for it. low, high: bounds, both included, of what is a number; `unit` says
    of what. choices: the words that it may be, with their help where they have one; `others` says how there come to be
    more. unset: what happens without it.
    form: of a text, what it looks like; `parse` reads it, and raises ValueError, in a sentence, for what it is not.
    more, `several` that more than one may be given, with commas between. unset: what happens without it.
    offers: values among which the page lets choose, with what it calls them; `offered` is chosen there to begin with.
    """

    help: str
    label: str
    unset: str
    low: float | None = None
    high: float | None = None
    unit: str = ""
    choices: Mapping[str, str] | None = None
    others: str = ""
    several: bool = False
    offers: tuple[tuple[str, str], ...] = ()
    offered: str = ""
    form: str = ""
    parse: Callable[[object], object] | None = None

    @property
    def bounds(self) -> str:
        """The bounds in words, for example "2 to 2000 frames"; empty where there are none."""
        return "" if self.low is None else f"{self.low} to {self.high} {self.unit}".rstrip()


def option(default: T, help: str, label: str, *, unset: str = "", **more: Any) -> T:  # noqa: A002 (typer's own name)
    """A field of `Options`. unset: what happens without it, where that is not the default itself."""
    about = Described(help, label, unset or str(default), **more)
    return field(default=default, metadata={"described": about})


@dataclass(frozen=True)
class Options:
    """What a user may set. Everything has a default that suits most scans."""

    preset: str = option(
        Preset.auto.value, "what is best and fast, or a recipe of the adversarial method", "Preset", choices=PRESET_HELP
    )
    method: str | None = option(
        None,
        "how the texture is made",
        "Method",
        unset="view_selection, or adversarial where one of its presets is asked for",
        choices=METHOD_HELP,
        others="install the package that brings it",
    )
    steps: int | None = option(None, "steps of the optimization", "Steps", unset="the method's", low=1, high=1_000_000)
    face_budget: int | None = option(
        None,
        "simplify a larger mesh to this many faces",
        "Faces at most",
        unset=str(FACE_BUDGET),
        low=100,
        high=2_000_000,
        unit="faces",
    )
    max_views: int | None = option(
        None,
        "choose this many frames of a longer scan, the best ones",
        "Views at most",
        unset=str(MAX_VIEWS),
        low=2,
        high=2000,
        unit="frames",
    )
    max_texture_size: int = option(
        4096,
        "cap on the texture's side, texels; it is only as large as the photographs are sharp",
        "Largest texture",
        low=256,
        high=16384,
        unit="texels",
        offers=tuple((str(side), f"{side} × {side}") for side in (2048, 4096, 8192, 16384)),
        offered="4096",
    )
    holdout: int | None = option(
        None,
        "leave every Nth frame out (position % N == N // 2 in sorted order) and score the result on these",
        "Scores",
        unset="every frame is used",
        low=2,
        high=1000,
        offers=(
            ("", "use every frame"),
            ("8", "hold out every 8th frame"),
            ("16", "hold out every 16th frame"),
        ),
        offered="8",
    )
    seed: int = option(0, "seed of the random numbers", "Seed", low=0, high=2**31 - 1)
    layout: str | None = option(
        None,
        "read the files as this layout",
        "Layout",
        unset="the one that fits best",
        choices=MappingProxyType(dict.fromkeys(LAYOUT_NAMES, "")),
    )
    lossless: bool | None = option(
        None,
        "images inside of models as PNG: exact, and four times as large",
        "Lossless images",
        unset="no, they are JPEG in all but the OBJ",
    )
    unseen: str | None = option(
        None,
        "what becomes of the surface that no photograph shows, nor one beside it",
        "Never seen",
        unset="guess",
        choices=UNSEEN_HELP,
    )
    close_holes: float | None = option(
        None,
        "close holes of the mesh whose border is no longer than this; what closes them counts as unseen",
        "Close holes",
        unset="holes stay open",
        low=0.001,
        high=1000,
        unit="metres",
    )
    box: str | None = option(
        None,
        "keep only what lies in this box: its center and size in metres of the scan's world, and its turn about the "
        "up axis in degrees, counter-clockwise from above",
        "Box",
        unset="the whole scan is kept",
        form=FORM,
        parse=parse_box,
    )
    outputs: str | None = option(
        None,
        "which files are made beside OBJ, GLB, report and previews, with commas between",
        "Files",
        unset="usdz, mobile and lod, and tiles of scenes beyond one image",
        choices=MappingProxyType({word: output.purpose for word, output in OUTPUTS.items()}),
        several=True,
        offers=(
            ("", "the usual, for phones and AR too"),
            ("glb", "OBJ and GLB only"),
            ("usdz,mobile,lod,tiles", "the usual, and 3D Tiles"),
        ),
    )


SIZE = Described(
    "working size of the views, pixels; half of it takes about a quarter of the time",
    "Working size",
    unset="the scan's own",
    low=64,
    high=4096,
    unit="pixels a side",
    offers=(("", "as in the scan"), *((size, size) for size in ("320x240", "640x480", "960x720", "1280x960"))),
)


@cache
def described() -> Mapping[str, Described]:
    """Every option by its name, `size` among them, in the order in which they are shown."""
    found = {one.name: one.metadata["described"] for one in fields(Options)}
    first = {name: found.pop(name) for name in ("preset", "method")}
    return MappingProxyType({**first, "size": SIZE, **found})


@cache
def kind_of(name: str) -> type[int | float | str]:
    """What a single value of the option is: bool, int, float or str."""
    hint = get_type_hints(Options).get(name, str if name == "size" else int)
    return next(kind for kind in (bool, int, float, str) if hint in (kind, kind | None))


def refusal(name: str, value: object) -> str | None:
    """Why a value cannot be used, naming the option, what it takes and the remedy; None where it can.

    name: of an option, or `width` or `height`. value: of `size`, the pair of both.
    """
    sides = ("size", "width", "height")
    about = SIZE if name in sides else described()[name]
    unset = f", or leave it out ({about.unset})" + (f", or {about.others}" if about.others else "")
    shown = "x".join(map(str, value)) if isinstance(value, tuple) else repr(value)[:60]
    if about.choices is not None:
        words = value.split(",") if isinstance(value, str) and about.several else [value]
        known = all(isinstance(word, str) and word in about.choices for word in words)
        return None if known else f"{name} {shown} is unknown; choose one of {', '.join(about.choices)}{unset}"
    if about.parse is not None:
        try:
            about.parse(value)
        except ValueError as error:
            return f"{error}{unset}"
        return None
    kind = int if name in sides else kind_of(name)
    if kind is bool and not isinstance(value, bool):
        return f"{name} {shown} is neither true nor false; give one of them{unset}"
    if about.low is None or about.high is None:
        return None
    for number in value if isinstance(value, tuple) else (value,):
        if isinstance(number, bool) or not isinstance(number, kind if kind is int else int | float):
            return f"{name} {shown} is no {'whole ' if kind is int else ''}number; give {about.bounds}{unset}"
        if not about.low <= number <= about.high:
            return f"{name} {shown} is out of bounds; give {about.bounds}{unset}"
    return None


def parse_size(text: str) -> tuple[int, int]:
    """ "320x240" -> (320, 240); ValueError, in a sentence, for what is no size."""
    match = re.fullmatch(r"(\d{1,6})[x×](\d{1,6})", text.strip().lower(), re.ASCII)
    if match is None:
        raise ValueError(f"size {text!r} is no size; give it as WIDTHxHEIGHT in pixels, for example 320x240")
    return int(match[1]), int(match[2])

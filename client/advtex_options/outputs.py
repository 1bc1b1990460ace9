"""The files of a result: which of them a user may choose, and what each is for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from types import MappingProxyType


@dataclass(frozen=True)
class Output:
    """Files that are made together. patterns: of their names. purpose: of the files, in a phrase.

    made: "always", whatever is asked for; "usually", unless others are asked for; "large", as usually, of scenes beyond
    one image; or "asked", if they are asked for.
    """

    patterns: tuple[str, ...]
    purpose: str
    made: str = "always"


OUTPUTS: Mapping[str, Output] = MappingProxyType(
    {
        "obj": Output(
            ("model.obj", "model.mtl", "model*.png"), "for modeling programs: exact, images and any normal map as PNG"
        ),
        "glb": Output(("model.glb",), "for viewers and game engines: all faces and texels in one file"),
        "usdz": Output(("model.usdz",), "for AR on iOS", "usually"),
        "mobile": Output(
            ("model_mobile.glb",), "for phones and web pages: at most 50,000 faces, one image, 5 MB", "usually"
        ),
        "lod": Output(
            ("model_lod?.glb",), "for scenes of many models: a quarter, a sixteenth of the detail", "usually"
        ),
        "tiles": Output(
            ("model.3tz",), "for viewers of 3D Tiles: a zip of a tileset of GLB tiles under 3 MB each", "large"
        ),
        "draco": Output(
            ("model_draco.glb",), "for viewers with a decoder of Draco: an eighth of the bytes of the faces", "asked"
        ),
        "webp": Output(("model_webp.glb",), "for viewers that take WebP: fewer bytes of the images", "asked"),
    }
)
"""By the word for them, which is also the `kind` of the files in the API."""

REST: Mapping[str, Output] = MappingProxyType(
    {
        "seen": Output(("model_seen*.png",), "where the texture was seen, and where it is a guess"),
        "report": Output(("report.json",), "what was done, and how well"),
        "page": Output(("index.html",), "all of the result in a browser, from disk"),
        "previews": Output(("previews/*",), "pictures"),
    }
)
"""Of the same form; nobody chooses them."""


def wanted(outputs: str | None, *, large: bool = False) -> frozenset[str]:
    """The words of what is to be made. outputs: the option of that name. large: the scene is beyond one image."""
    usual = {"always", "usually", "large"} if large else {"always", "usually"}
    made = {"always"} if outputs else usual
    return frozenset(outputs.split(",") if outputs else ()) | {
        word for word, one in OUTPUTS.items() if one.made in made
    }


def kind_and_purpose(name: str) -> tuple[str, str]:
    """Of a result's file; empty for one that is not known here."""
    for word, output in {**REST, **OUTPUTS}.items():
        if any(fnmatchcase(name, pattern) for pattern in output.patterns):
            return word, output.purpose
    return "", ""

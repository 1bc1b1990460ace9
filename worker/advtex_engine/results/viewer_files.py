"""What `index.html` shows the model in 3D with: the scripts of `advtex_viewer` and its files, in `previews/viewer/`.

scripts.js       the scripts and their style, as text
model.js         model.glb or model_mobile.glb, whichever is smaller
photographs.js   photographs.json and .mjpeg

A browser refuses a page from disk to read files, or to load modules; it does run classic scripts. So each of these is
one, which gives the page its contents: `given[name] = text`, of what is not text as base64. They are loaded when
somebody asks for the model in 3D.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from pathlib import Path

import advtex_viewer
from advtex_engine.runtime.files import write_atomically

FOLDER = "previews/viewer"
MODELS = ("model.glb", "model_mobile.glb")
PHOTOGRAPHS = ("previews/photographs.json", "previews/photographs.mjpeg")


def write_viewer(out: Path) -> tuple[Path, ...]:
    """Writes them below `out`, where the model and the previews are; -> their paths."""
    model = min((path for name in MODELS if (path := out / name).exists()), key=lambda path: path.stat().st_size)
    folder = out / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    return (
        _write(folder / "scripts.js", scripts()),
        _write(folder / "model.js", {"model.glb": _base64(model)}),
        _write(folder / "photographs.js", {name: _base64(out / name) for name in PHOTOGRAPHS}),
    )


def scripts() -> dict[str, str]:
    """The viewer's scripts and its style by the names that they have for each other."""
    found = (path for path in sorted(advtex_viewer.FOLDER.rglob("*")) if path.suffix in (".js", ".css"))
    return {path.relative_to(advtex_viewer.FOLDER).as_posix(): path.read_text(encoding="utf-8") for path in found}


def _base64(path: Path) -> str:
    return base64.b64encode(path.read_bytes()).decode()


def _write(path: Path, given: Mapping[str, str]) -> Path:
    lines = (f"given[{json.dumps(name)}] = {json.dumps(text)};\n" for name, text in given.items())
    write_atomically(path, "".join(lines).encode())
    return path

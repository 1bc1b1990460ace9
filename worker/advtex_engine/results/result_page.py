"""`index.html` beside a result: one page that shows it from disk, without a server and without network.

A browser refuses pages from disk to read other files, so all data lie in the page itself; pictures are linked.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from string import Template
from typing import Any

from advtex_engine.results.viewer_files import write_viewer
from advtex_engine.runtime.files import json_text, write_atomically

TEMPLATE = Path(__file__).with_name("result_page.html")
LEFT_OUT = ("losses", "game")  # of the report: the curves have them


def write_page(out: Path, report: Mapping[str, Any], files: Sequence[Path]) -> tuple[Path, ...]:
    """Writes index.html, and what it shows the model in 3D with, beside what `export_model` and `write_gallery` left.

    files: the result's; those at its root are linked. -> the paths, that of the page last.
    """
    game = report.get("game") or {}
    previews, viewer = out / "previews", write_viewer(out)
    data = {
        "manifest": json.loads((previews / "manifest.json").read_bytes()),
        "curves": json.loads((previews / "curves.json").read_bytes()),
        "report": {name: part for name, part in report.items() if name not in LEFT_OUT},
        "game": game.get("points", []),
        "probes": (game.get("probes") or {}).get("told", ""),
        "files": [file.name for file in files if file.parent == out],
        "viewer": {file.name: file.stat().st_size for file in viewer},
    }
    page = Template(TEMPLATE.read_text(encoding="utf-8")).substitute(data=embedded(data))
    path = out / "index.html"
    write_atomically(path, page.encode())
    return *viewer, path


def embedded(data: object) -> str:
    """JSON that may stand in a script element, whatever names a scan brings: no character opens or ends a tag."""
    return json_text(data).replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")

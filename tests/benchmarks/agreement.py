"""Where the descent of `view_selection` helps and where it harms: how unlike its start is to other photographs.

    python tests/benchmarks/agreement.py [--turns 0.3 0.6 1.2 2.5 5] [--levels 2.75 4.5] [--scans SCAN …] [--refine]

One synthetic object with cameras that are turned by so many degrees (the study's e_a), and with errors of the geometry;
and scans of one's own, scored against every 8th frame, which is left out. Cameras stay as they
came, but for rows of --refine. It leaves the start as it is above `UNLIKE`; here it never does, so that the table
says what it would have done. Writes agreement.json and agreement.md below --results; goes on with missing cells.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from harness import (
    Results,
    Stopwatch,
    common_arguments,
    completed,
    load_truth,
    markdown_table,
    needed_lpips,
    parsed_size,
    prepare,
    score_model,
    score_texture,
    started,
    write_report,
)
from study import GEOMETRY_BASE, GROWTH, OBJECT_SIZE

from advtex_engine.core.config import TextureConfig
from advtex_engine.methods import gabor
from advtex_engine.metrics.lpips import Lpips
from advtex_engine.runtime.devices import choose_device
from advtex_engine.synthetic.scan import synthesize


def arguments_of(line: list[str] | None = None) -> argparse.Namespace:
    parser = common_arguments("agreement", __doc__)
    parser.add_argument("--turns", nargs="*", type=float, default=[0.3, 0.6, 1.2, 2.5, 5.0], help="degrees")
    parser.add_argument("--levels", nargs="*", type=float, default=[2.75, 4.5], help="n of the geometry's error")
    parser.add_argument("--scans", nargs="*", type=Path, default=[], help="folders or zip files")
    parser.add_argument("--seed", type=int, default=0, help="of the object")
    parsed: argparse.Namespace = parser.parse_args(line)
    return parsed


def cells(arguments: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """The settings of every cell."""
    shared = {name: getattr(arguments, name) for name in ("size", "refine")}
    made = shared | {name: getattr(arguments, name) for name in ("views", "faces", "seed")}
    for turn in arguments.turns:
        yield {"scan": "cameras", "error": turn, **made}
    for level in arguments.levels:
        yield {"scan": "geometry", "error": level, **made}
    for scan in arguments.scans:
        yield {"scan": scan.stem, "error": 0.0, **shared}


def fill(arguments: argparse.Namespace, results: Results, lpips: Lpips) -> None:
    """Runs every cell that is not in the results yet."""
    scans = {scan.stem: scan for scan in arguments.scans}
    for cell in cells(arguments):
        if results.find(cell) is None:
            with tempfile.TemporaryDirectory(prefix="advtex-agreement-") as folder:
                watch = Stopwatch()
                scores = _scores(arguments, cell, scans.get(cell["scan"]), Path(folder), lpips)
                results.add(cell, scores, watch.seconds)


def _scores(
    arguments: argparse.Namespace, cell: dict[str, Any], scan: Path | None, folder: Path, lpips: Lpips
) -> dict[str, float]:
    """Unlikeness of the start, and LPIPS of it and of the end."""
    device = choose_device(arguments.device)
    config = TextureConfig(
        preset=arguments.preset,
        method="view_selection",
        size=parsed_size(arguments.size),
        holdout=None if scan is None else 8,
        refine=arguments.refine,
        device=arguments.device,
        **({"face_budget": arguments.faces} if scan is None else {}),
    )
    truth = None
    if scan is None:
        scan = folder / "scan"
        _make(scan, cell)
        truth = load_truth(scan)
    given = started(prepare(scan, config, folder / "work", device))
    unlike = gabor.start_unlikeness(given)
    assert given.start is not None
    ends, limit = [given.start], gabor.UNLIKE
    gabor.UNLIKE = math.inf
    try:
        ends.append(gabor.descended(given, given.config.steps)[0])
    finally:
        gabor.UNLIKE = limit
    found = list[float]()
    for texture in (completed(given, end) for end in ends):
        if truth is not None:
            found.append(score_texture(given.atlas, texture, truth, lpips)["lpips"])
        else:
            found.append(score_model(given, texture, scan, folder / "model", None, arguments.lpips_weights)["lpips"])
    return {"unlike": unlike, "start": found[0], "end": found[1]}


def _make(folder: Path, cell: dict[str, Any]) -> None:
    width, height = parsed_size(cell["size"])
    of_cameras = cell["scan"] == "cameras"
    synthesize(
        folder,
        views=cell["views"],
        width=width,
        height=height,
        seed=cell["seed"],
        camera_error=0.0,
        camera_turn=math.radians(cell["error"]) if of_cameras else 0.0,
        geometry_error=0.0 if of_cameras else OBJECT_SIZE * GEOMETRY_BASE * GROWTH ** cell["error"],
    )


def report(arguments: argparse.Namespace, results: Results) -> None:
    """agreement.md: all cells of the file, the likest first."""
    rows = [
        [
            settings["scan"],
            {"cameras": f"{settings['error']:g} degrees", "geometry": f"n = {settings['error']:g}"}.get(
                settings["scan"], ""
            ),
            "refined" if settings["refine"] else "as they came",
            *(scores[name] for name in ("unlike", "start", "end")),
            scores["end"] / scores["start"],
        ]
        for settings, scores in sorted(
            ((cell["settings"], cell["scores"]) for cell in results.cells), key=lambda pair: float(pair[1]["unlike"])
        )
    ]
    head = ["scan", "error", "cameras", "unlike", "LPIPS of the start", "of the end", "ratio"]
    write_report(
        arguments.results / "agreement.md",
        "How unlike the start is to other photographs, and what the descent makes of it",
        results.cells,
        markdown_table(head, rows),
    )


def main(line: list[str] | None = None) -> None:
    arguments = arguments_of(line)
    lpips = needed_lpips(arguments.lpips_weights)
    results = Results(arguments.results / "agreement.json")
    fill(arguments, results, lpips)
    report(arguments, results)


if __name__ == "__main__":
    main()

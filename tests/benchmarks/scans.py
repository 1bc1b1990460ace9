"""Every method on scans of one's own: trained without every Nth frame, scored against those frames.

    python tests/benchmarks/scans.py SCAN [SCAN …] [--methods mean view_selection adversarial] [--reference MESH]

The stages before the methods are run once per scan, so that all methods have the same views, cameras and atlas; only
`colormap` is nothing without refined cameras when `--no-refine` says that the others go without. Writes scans.json (one
cell per scan and method), scans.md, and per cell the model and a contact sheet below --results/SCAN. Stopped and run
again, it goes on with the cells that are missing.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

from harness import (
    RESULTS,
    SCAN_SCORES,
    Results,
    Stopwatch,
    geometric_means,
    markdown_table,
    needed_lpips,
    parsed_size,
    prepare,
    run_method,
    score_model,
    shown_mean,
    write_report,
)

from advtex_engine.core.config import TextureConfig
from advtex_engine.methods import MethodInput, require
from advtex_engine.pipeline import choose_device
from advtex_options.methods import known_methods


def arguments_of(line: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scans", nargs="+", type=Path, help="folders or zip files")
    methods = known_methods()
    usual = [name for name, method in methods.items() if not method.weights]
    parser.add_argument("--methods", nargs="+", default=usual, choices=methods)
    parser.add_argument("--holdout", type=int, default=8)
    parser.add_argument("--size", default="640x480", help="WIDTHxHEIGHT of the views")
    parser.add_argument("--preset", default="standard")
    parser.add_argument("--steps", type=int, help="of the methods that take steps; default: the preset's")
    parser.add_argument("--no-refine", action="store_true", help="leave the cameras as they came")
    parser.add_argument("--reference", type=Path, help="mesh that decides which pixels count; default: the scan's")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--lpips-weights", type=Path, help="folder; default: $ADVTEX_LPIPS_WEIGHTS, else the cache")
    parser.add_argument("--results", type=Path, default=RESULTS / "scans", help="folder of the results")
    parsed: argparse.Namespace = parser.parse_args(line)
    return parsed


def settings_of(arguments: argparse.Namespace, scan: Path, method: str) -> dict[str, Any]:
    """What a cell is found by."""
    shared = {name: getattr(arguments, name) for name in ("holdout", "size", "preset", "steps")}
    return {"scan": scan.stem, "method": method, **shared, "refined": not arguments.no_refine or method == "colormap"}


def fill(arguments: argparse.Namespace, results: Results) -> None:
    """Runs every cell that is not in the results yet, those with unrefined cameras first."""
    device = choose_device(arguments.device)
    for method in arguments.methods:
        require(method)
    for scan in arguments.scans:
        wanted = [settings_of(arguments, scan, method) for method in arguments.methods]
        missing = [cell for cell in wanted if results.find(cell) is None]
        with tempfile.TemporaryDirectory(prefix="advtex-scans-") as work:
            for refined in (False, True):
                cells = [cell for cell in missing if cell["refined"] == refined]
                if cells:
                    config = _config(arguments, refined)
                    given = prepare(scan, config, Path(work), device)
                    for cell in cells:
                        _run(arguments, scan, given, cell, results)


def _config(arguments: argparse.Namespace, refine: bool) -> TextureConfig:
    return TextureConfig(
        preset=arguments.preset,
        size=parsed_size(arguments.size),
        holdout=arguments.holdout,
        steps=arguments.steps,
        refine=refine,
        device=arguments.device,
    )


def _run(arguments: argparse.Namespace, scan: Path, given: MethodInput, cell: dict[str, Any], results: Results) -> None:
    """One method, its model written and scored."""
    folder = arguments.results / scan.stem / cell["method"]
    folder.mkdir(parents=True, exist_ok=True)
    watch = Stopwatch()
    texture = run_method(given, cell["method"])
    seconds = watch.seconds
    scores = score_model(given, texture, scan, folder, arguments.reference, arguments.lpips_weights)
    results.add(cell, scores, seconds)


def report(arguments: argparse.Namespace, results: Results) -> None:
    """scans.md: a table per scan, the best LPIPS first, and the geometric means over all scans."""
    body, wanted = "", list[dict[str, Any]]()
    for scan in arguments.scans:
        found = [results.find(settings_of(arguments, scan, method)) for method in arguments.methods]
        cells = sorted((cell for cell in found if cell is not None), key=lambda cell: float(cell["scores"]["lpips"]))
        rows = [
            [
                cell["settings"]["method"],
                *(shown_mean([cell], name) for name in SCAN_SCORES),
                cell["seconds"],
            ]
            for cell in cells
        ]
        body += f"\n## {scan.stem}\n\n{markdown_table(['method', *SCAN_SCORES.values(), 'seconds'], rows)}"
        wanted += cells
    lines = {
        method: [results.find(settings_of(arguments, scan, method)) for scan in arguments.scans]
        for method in arguments.methods
    }
    body += geometric_means("method", lines)
    write_report(arguments.results / "scans.md", "Methods on scans", wanted, body)


def main(line: list[str] | None = None) -> None:
    arguments = arguments_of(line)
    needed_lpips(arguments.lpips_weights)
    results = Results(arguments.results / "scans.json")
    fill(arguments, results)
    report(arguments, results)


if __name__ == "__main__":
    main()

"""The paper's synthetic 3D study: every method under growing errors of the cameras, and of the geometry.

    python tests/benchmarks/study.py [--levels 1 2.75 4.5] [--methods mean l1 adversarial]

Textured objects with known truth are photographed from a hemisphere; then either the cameras or the geometry are
disturbed (paper's supplement): e_t = 0.01 * 1.5^n and e_a = 5 degrees, or e_g = 0.02 * 1.5^n smoothed by three
Laplacian steps. Lengths are in units of the object's size. The texture is scored from undisturbed cameras against the
true object. Camera refinement, a stage of its own before any method, is off unless asked for (`colormap` is nothing
without).

Writes study.json (one cell per object, error and method), study.md and study.png below --results. Stopped and run
again, it goes on with the cells that are missing.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from harness import (
    SCORES,
    Panel,
    Results,
    Stopwatch,
    Truth,
    common_arguments,
    configuration,
    load_truth,
    markdown_table,
    mean_of,
    needed_lpips,
    parsed_size,
    plot_grid,
    prepare,
    run_method,
    score_texture,
    write_report,
)

from advtex_engine.core.config import resolve_preset
from advtex_engine.methods import MethodInput, require
from advtex_engine.metrics.lpips import Lpips, WeightsError
from advtex_engine.runtime.devices import choose_device
from advtex_engine.synthetic.scan import synthesize
from advtex_options.methods import known_methods

OBJECT_SIZE = 0.3
"""Metres, of the synthetic object: the unit of the paper's errors."""
CAMERA_BASE, GEOMETRY_BASE, GROWTH = 0.01, 0.02, 1.5
PLOTTED = ("lpips", "nearest_patch", "s3_difference", "gradient_difference")
SCANS = {
    "default": "Scans with errors of cameras and geometry, as `advtex-engine synthesize` makes them",
    "geometry": "The study's scans with errors of the geometry, n = 2.75",
}
"""Synthetic scans that other benchmarks take."""
MIDDLE_LEVEL = 2.75


def arguments_of(line: list[str] | None = None) -> argparse.Namespace:
    parser = common_arguments("study", __doc__)
    parser.add_argument("--models", type=int, default=3, help="objects, with other prints each")
    parser.add_argument("--errors", nargs="+", default=["cameras", "geometry"], choices=["cameras", "geometry"])
    parser.add_argument("--levels", nargs="+", type=float, default=[1.0, 2.75, 4.5], help="n of the error's size")
    parser.add_argument("--turn", type=float, default=5.0, help="e_a in degrees")
    parser.add_argument("--methods", nargs="+", default=list(known_methods()), choices=known_methods())
    parsed: argparse.Namespace = parser.parse_args(line)
    return parsed


def cells(arguments: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """The settings of every cell, scan by scan and for each scan with the given cameras first."""
    methods = sorted(
        arguments.methods, key=lambda method: (arguments.refine or known_methods()[method].refines_cameras, method)
    )
    for model in range(arguments.models):
        for errors in arguments.errors:
            for level in arguments.levels:
                for method in methods:
                    yield {
                        "errors": errors,
                        "level": level,
                        "model": model,
                        "method": method,
                        "turn": arguments.turn if errors == "cameras" else 0.0,
                        "refined": arguments.refine or method == "colormap",
                        **{name: getattr(arguments, name) for name in ("views", "size", "steps", "preset", "faces")},
                    }


def make_scan(folder: Path, cell: dict[str, Any]) -> None:
    """The scan of a cell, with one kind of error."""
    width, height = parsed_size(cell["size"])
    of_cameras = cell["errors"] == "cameras"
    base = CAMERA_BASE if of_cameras else GEOMETRY_BASE
    error = OBJECT_SIZE * base * GROWTH ** cell["level"]
    synthesize(
        folder,
        views=cell["views"],
        width=width,
        height=height,
        seed=cell["model"],
        camera_error=error if of_cameras else 0.0,
        camera_turn=math.radians(cell["turn"]),
        geometry_error=0.0 if of_cameras else error,
    )


def make_named_scan(folder: Path, scan: str, *, views: int, size: str, seed: int) -> None:
    """One of SCANS."""
    if scan == "geometry":
        make_scan(
            folder, {"errors": scan, "level": MIDDLE_LEVEL, "model": seed, "turn": 0.0, "size": size, "views": views}
        )
        return
    width, height = parsed_size(size)
    synthesize(folder, views=views, width=width, height=height, seed=seed)


class _Scans:
    """The newest scan and what was made from it: cells that share it come one after the other."""

    def __init__(self, folder: Path, device: torch.device) -> None:
        self.folder, self.device = folder, device
        self.scan: tuple[object, ...] = ()
        self.refined: bool | None = None

    def given(self, cell: dict[str, Any], arguments: argparse.Namespace) -> tuple[MethodInput, Truth]:
        scan = tuple(cell[name] for name in ("errors", "level", "model"))
        if scan != self.scan:
            make_scan(self.folder / "scan", cell)
            self.truth = load_truth(self.folder / "scan")
            self.scan, self.refined = scan, None
        config = configuration(arguments, cell["method"])
        if self.refined != cell["refined"]:
            self.prepared = prepare(self.folder / "scan", config, self.folder / "work", self.device)
            self.refined = cell["refined"]
        preset = resolve_preset(config)
        return dataclasses.replace(self.prepared, config=config, preset=preset), self.truth


def fill(arguments: argparse.Namespace, results: Results, lpips: Lpips) -> None:
    """Runs every cell that is not in the results yet."""
    device = choose_device(arguments.device)
    usable = {method: _reason(method) for method in arguments.methods}
    for method, reason in usable.items():
        if reason:
            print(f"{method} is left out: {reason}", flush=True)
    with tempfile.TemporaryDirectory(prefix="advtex-study-") as folder:
        scans = _Scans(Path(folder), device)
        for cell in cells(arguments):
            if usable[cell["method"]] or results.find(cell) is not None:
                continue
            given, truth = scans.given(cell, arguments)
            watch = Stopwatch()
            texture = run_method(given, cell["method"])
            seconds = watch.seconds
            results.add(cell, score_texture(given.atlas, texture, truth, lpips), seconds)


def _reason(method: str) -> str:
    """Why a method cannot be run; empty when it can."""
    try:
        require(method)
    except WeightsError as error:
        return str(error)
    return ""


def report(arguments: argparse.Namespace, results: Results) -> None:
    """study.md: a table per kind of error and level; study.png: curves over the level."""
    wanted = [found for cell in cells(arguments) if (found := results.find(cell)) is not None]
    body, panels = "", []
    for errors in arguments.errors:
        for level in arguments.levels:
            rows = []
            for method in arguments.methods:
                here = _chosen(wanted, errors, level, method)
                if here:
                    rows.append([method, *(mean_of(here, name) for name in SCORES), len(here)])
            rows.sort(key=lambda row: row[1])
            head = ["method", *SCORES.values(), "objects"]
            body += f"\n## Errors of the {errors}, n = {level:g}\n\n{markdown_table(head, rows)}"
        curves = {name: _curves(arguments, wanted, errors, name) for name in PLOTTED}
        panels.append([Panel(f"{SCORES[name]}, {errors}", "n", curves[name]) for name in PLOTTED])
    unit = "Lower is better, but for the gradient ratio, which is best at 1. Means over the objects.\n"
    write_report(arguments.results / "study.md", "Methods under errors of cameras and geometry", wanted, unit + body)
    plot_grid(arguments.results / "study.png", panels)


def _chosen(wanted: list[dict[str, Any]], errors: str, level: float, method: str) -> list[dict[str, Any]]:
    key = {"errors": errors, "level": level, "method": method}
    return [cell for cell in wanted if key.items() <= cell["settings"].items()]


def _curves(
    arguments: argparse.Namespace, wanted: list[dict[str, Any]], errors: str, name: str
) -> dict[str, tuple[list[float], list[float]]]:
    curves = {}
    for method in arguments.methods:
        points = {level: _chosen(wanted, errors, level, method) for level in sorted(arguments.levels)}
        known = {level: mean_of(found, name) for level, found in points.items() if found}
        curves[method] = (list(known), list(known.values()))
    return curves


def main(line: list[str] | None = None) -> None:
    arguments = arguments_of(line)
    results = Results(arguments.results / "study.json")
    fill(arguments, results, needed_lpips(arguments.lpips_weights))
    report(arguments, results)


if __name__ == "__main__":
    main()

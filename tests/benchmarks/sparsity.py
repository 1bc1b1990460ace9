"""What sparse views cost: the same scan with every 1st, 2nd, 5th, 10th and 20th view.

    python tests/benchmarks/sparsity.py [--every 1 2 5 10 20] [--methods l1 view_selection adversarial]

`adversarial_virtual` adds the virtual cameras that the paper's supplement D proposes for sparse views: each auxiliary
camera is moved at random, by up to PERTURBATION of the view's width in its image.

Writes sparsity.json, sparsity.md and sparsity.png below --results; goes on with missing cells when run again. In the
table, `share` is the LPIPS over that of the same method with all views.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from harness import (
    SCORES,
    Panel,
    Results,
    Stopwatch,
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

from advtex_engine.config import METHODS
from advtex_engine.perceptual import Lpips
from advtex_engine.pipeline import choose_device, resolve_preset
from advtex_engine.synthesize import synthesize

VIRTUAL, PERTURBATION = "adversarial_virtual", 0.01
SHOWN = ("l1", "view_selection", "adversarial", VIRTUAL)


def arguments_of(line: list[str] | None = None) -> argparse.Namespace:
    parser = common_arguments("sparsity", __doc__)
    parser.add_argument("--every", nargs="+", type=int, default=[1, 2, 5, 10, 20])
    parser.add_argument("--seed", type=int, default=0, help="of the scan")
    parser.add_argument("--methods", nargs="+", default=SHOWN, choices=[*METHODS, VIRTUAL])
    parsed: argparse.Namespace = parser.parse_args(line)
    return parsed


def cells(arguments: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """The settings of every cell, those that share a selection of views one after the other."""
    for every in arguments.every:
        for method in arguments.methods:
            shared = ("views", "size", "steps", "preset", "faces", "refine", "seed")
            yield {"every": every, "method": method, **{name: getattr(arguments, name) for name in shared}}


def fill(arguments: argparse.Namespace, results: Results, lpips: Lpips) -> None:
    """Runs every cell that is not in the results yet."""
    missing = [cell for cell in cells(arguments) if results.find(cell) is None]
    if not missing:
        return
    device = choose_device(arguments.device)
    width, height = parsed_size(arguments.size)
    with tempfile.TemporaryDirectory(prefix="advtex-sparsity-") as folder:
        scan = Path(folder) / "scan"
        synthesize(scan, views=arguments.views, width=width, height=height, seed=arguments.seed)
        truth = load_truth(scan)
        every = 0
        for cell in missing:
            virtual = cell["method"] == VIRTUAL
            config = configuration(arguments, "adversarial" if virtual else cell["method"])
            if cell["every"] != every:
                every = cell["every"]
                prepared = prepare(scan, config, Path(folder) / "work", device, every)
            preset = dataclasses.replace(resolve_preset(config, device), perturbation=PERTURBATION if virtual else 0.0)
            given = dataclasses.replace(prepared, config=config, preset=preset)
            watch = Stopwatch()
            texture = run_method(given, config.method)
            seconds = watch.seconds
            scores = score_texture(given.atlas, texture, truth, lpips)
            results.add(cell, scores | {"used_views": float(given.maps[1].count)}, seconds)


def report(arguments: argparse.Namespace, results: Results) -> None:
    """sparsity.md and sparsity.png: scores over the number of views."""
    found = [cell for wanted in cells(arguments) if (cell := results.find(wanted)) is not None]
    rows, curves = [], dict[str, dict[str, tuple[list[float], list[float]]]]()
    for method in arguments.methods:
        mine = [cell for cell in found if cell["settings"]["method"] == method]
        all_views = [cell["scores"]["lpips"] for cell in mine if cell["settings"]["every"] == 1]
        for cell in mine:
            share = cell["scores"]["lpips"] / all_views[0] if all_views else "-"
            rows.append([method, int(cell["scores"]["used_views"]), *(mean_of([cell], name) for name in SCORES), share])
        for name in SCORES:
            views = [cell["scores"]["used_views"] for cell in mine]
            curves.setdefault(name, {})[method] = (views, [cell["scores"][name] for cell in mine])
    table = markdown_table(["method", "views", *SCORES.values(), "share"], rows)
    write_report(arguments.results / "sparsity.md", "Sparse views", found, table)
    panels = [Panel(SCORES[name], "views", curves[name]) for name in ("lpips", "s3_difference", "gradient_ratio")]
    plot_grid(arguments.results / "sparsity.png", [panels])


def main(line: list[str] | None = None) -> None:
    arguments = arguments_of(line)
    results = Results(arguments.results / "sparsity.json")
    fill(arguments, results, needed_lpips(arguments.lpips_weights))
    report(arguments, results)


if __name__ == "__main__":
    main()

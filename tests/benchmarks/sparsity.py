"""What sparse views cost: the same scan with every 1st, 2nd, 5th, 10th and 20th view.

    python tests/benchmarks/sparsity.py [--every 1 2 5 10 20] [--methods l1 view_selection_no_descent adversarial]

Of two scans: `default`, as `advtex-engine synthesize` makes it, and `geometry`, the study's with errors of the geometry
at its middle level. `adversarial_virtual` adds the virtual cameras that the paper's supplement D proposes for sparse
views: each auxiliary camera is moved at random, by up to PERTURBATION of the view's width in its image.

Writes sparsity.json, sparsity.md, sparsity.png and, for the views of each scan whose cells were all run at once, a
picture below --results; goes on with missing cells when run again. In the table, `share` is the LPIPS over that of the
same method with all views.
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
    draw,
    load_truth,
    markdown_table,
    mean_of,
    needed_lpips,
    picture,
    plot_grid,
    prepare,
    run_method,
    score_texture,
    write_report,
)
from study import SCANS, make_named_scan
from torch import Tensor

from advtex_engine.core.config import resolve_preset
from advtex_engine.metrics.lpips import Lpips
from advtex_engine.runtime.devices import choose_device
from advtex_options.methods import known_methods

VIRTUAL, PERTURBATION = "adversarial_virtual", 0.01
SHOWN = ("l1", "view_selection_no_descent", "adversarial", VIRTUAL)


def arguments_of(line: list[str] | None = None) -> argparse.Namespace:
    parser = common_arguments("sparsity", __doc__)
    parser.add_argument("--every", nargs="+", type=int, default=[1, 2, 5, 10, 20])
    parser.add_argument("--scans", nargs="+", default=list(SCANS), choices=SCANS)
    parser.add_argument("--seed", type=int, default=0, help="of the scans")
    parser.add_argument("--methods", nargs="+", default=SHOWN, choices=[*known_methods(), VIRTUAL])
    parsed: argparse.Namespace = parser.parse_args(line)
    return parsed


def cells(arguments: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """The settings of every cell, those that share a selection of views one after the other."""
    shared = ("views", "size", "steps", "preset", "faces", "refine", "seed")
    for scan in arguments.scans:
        for every in arguments.every:
            for method in arguments.methods:
                cell = {"scan": scan, "every": every, "method": method}
                yield cell | {name: getattr(arguments, name) for name in shared}


def fill(arguments: argparse.Namespace, results: Results, lpips: Lpips) -> None:
    """Runs every cell that is not in the results yet."""
    device = choose_device(arguments.device)
    arguments.results.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="advtex-sparsity-") as folder:
        scan = Path(folder) / "scan"
        made, used = "", (0, "")
        for cell in cells(arguments):
            if results.find(cell) is not None:
                continue
            if cell["scan"] != made:
                made = cell["scan"]
                make_named_scan(scan, made, views=cell["views"], size=cell["size"], seed=cell["seed"])
                truth = load_truth(scan)
            virtual = cell["method"] == VIRTUAL
            config = configuration(arguments, "adversarial" if virtual else cell["method"])
            if (cell["every"], made) != used:
                used, shown = (cell["every"], made), dict[str, Tensor]()
                prepared = prepare(scan, config, Path(folder) / "work", device, cell["every"])
            preset = dataclasses.replace(resolve_preset(config), perturbation=PERTURBATION if virtual else 0.0)
            given = dataclasses.replace(prepared, config=config, preset=preset)
            watch = Stopwatch()
            texture = run_method(given, config.method)
            seconds = watch.seconds
            scores = score_texture(given.atlas, texture, truth, lpips)
            shown[cell["method"]] = picture(given.atlas, texture, truth)
            if set(arguments.methods) <= shown.keys():
                draw(arguments.results / f"{made}_{given.maps[1].count}_views.png", scan, truth, shown)
            results.add(cell, scores | {"used_views": float(given.maps[1].count)}, seconds)


def report(arguments: argparse.Namespace, results: Results) -> None:
    """sparsity.md and sparsity.png: scores over the number of views, for each scan."""
    wanted = [found for cell in cells(arguments) if (found := results.find(cell)) is not None]
    body, panels = "", []
    for scan in arguments.scans:
        rows, curves = [], dict[str, dict[str, tuple[list[float], list[float]]]]()
        for method in arguments.methods:
            key = {"scan": scan, "method": method}
            mine = [cell for cell in wanted if key.items() <= cell["settings"].items()]
            all_views = [cell["scores"]["lpips"] for cell in mine if cell["settings"]["every"] == 1]
            for cell in mine:
                scores = [mean_of([cell], name) for name in SCORES]
                share = cell["scores"]["lpips"] / all_views[0] if all_views else "-"
                rows.append([method, int(cell["scores"]["used_views"]), *scores, share])
            for name in SCORES:
                views = [cell["scores"]["used_views"] for cell in mine]
                curves.setdefault(name, {})[method] = (views, [cell["scores"][name] for cell in mine])
        table = markdown_table(["method", "views", *SCORES.values(), "share"], rows)
        body += f"\n## {SCANS[scan]}\n\n{table}"
        shown = ("lpips", "s3_difference", "gradient_ratio")
        panels.append([Panel(f"{SCORES[name]}, {scan}", "views", curves[name]) for name in shown])
    write_report(arguments.results / "sparsity.md", "Sparse views", wanted, body)
    plot_grid(arguments.results / "sparsity.png", panels)


def main(line: list[str] | None = None) -> None:
    arguments = arguments_of(line)
    results = Results(arguments.results / "sparsity.json")
    fill(arguments, results, needed_lpips(arguments.lpips_weights))
    report(arguments, results)


if __name__ == "__main__":
    main()

"""What each part is worth: the whole, and the whole with one part switched off, on synthetic scans with known truth.

    python tests/benchmarks/parts.py [--models 2] [--steps 1000]

Scans have the errors that real ones have (`advtex_engine.synthesize`). Writes parts.json (one cell per object and
variant), parts.md, and per object a picture: a photograph from a held-out place beside the mean, view selection and the
whole. Stopped and run again, it goes on with the cells that are missing.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
from pathlib import Path
from typing import Any

import torch
from harness import (
    SCORES,
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
    prepare,
    run_method,
    score_texture,
    write_report,
)
from torch import Tensor

from advtex_engine.methods import MethodInput
from advtex_engine.perceptual import Lpips
from advtex_engine.pipeline import choose_device, resolve_preset
from advtex_engine.previews import BACKGROUND, contact_sheet, render_view
from advtex_engine.scene import View
from advtex_engine.synthesize import synthesize


@dataclasses.dataclass(frozen=True)
class Variant:
    """A method, whether cameras and exposures are refined, and what differs from its preset."""

    method: str = "adversarial"
    refine: bool = True
    changes: dict[str, Any] = dataclasses.field(default_factory=dict)


VARIANTS = {
    "mean": Variant("mean"),
    "view selection": Variant("view_selection"),
    "the whole": Variant(),
    "without refined cameras": Variant(refine=False),
    "from the mean, not from view selection": Variant(changes={"start": "mean"}),
    "without alignment in the loop": Variant(changes={"alignment": False}),
    "without feature matching": Variant(changes={"feature_weight": 0.0}),
}
SHOWN = ("mean", "view selection", "the whole")
SHOWN_VIEW = 1  # of the held-out ones


def arguments_of(line: list[str] | None = None) -> argparse.Namespace:
    parser = common_arguments("parts", __doc__)
    parser.add_argument("--models", type=int, default=2, help="objects, with other prints each")
    parsed: argparse.Namespace = parser.parse_args(line)
    return parsed


def settings_of(arguments: argparse.Namespace, model: int, variant: str) -> dict[str, Any]:
    """What a cell is found by."""
    shared = {name: getattr(arguments, name) for name in ("views", "size", "steps", "preset", "faces")}
    return {"model": model, "variant": variant, **shared}


def fill(arguments: argparse.Namespace, results: Results, lpips: Lpips) -> None:
    """Runs every cell that is not in the results yet; the picture is drawn when all that it shows was run."""
    device = choose_device(arguments.device)
    width, height = parsed_size(arguments.size)
    for model in range(arguments.models):
        missing = [name for name in VARIANTS if results.find(settings_of(arguments, model, name)) is None]
        if not missing:
            continue
        with tempfile.TemporaryDirectory(prefix="advtex-parts-") as folder:
            scan, work = Path(folder) / "scan", Path(folder) / "work"
            synthesize(scan, views=arguments.views, width=width, height=height, seed=model)
            truth = load_truth(scan)
            inputs: dict[bool, MethodInput] = {}
            shown: dict[str, Tensor] = {}
            for name in missing:
                variant = VARIANTS[name]
                config = dataclasses.replace(configuration(arguments, variant.method), refine=variant.refine)
                if variant.refine not in inputs:
                    inputs[variant.refine] = prepare(scan, config, work, device)
                preset = dataclasses.replace(resolve_preset(config, device), **variant.changes)
                given = dataclasses.replace(inputs[variant.refine], config=config, preset=preset)
                watch = Stopwatch()
                texture = run_method(given, variant.method)
                seconds = watch.seconds
                shown[name] = render_view(given.atlas, texture, truth.cameras[SHOWN_VIEW])
                scores = score_texture(given.atlas, texture, truth, lpips)
                results.add(settings_of(arguments, model, name), scores, seconds)
            if set(SHOWN) <= shown.keys():
                draw(arguments.results / f"object_{model}.png", truth, [shown[name] for name in SHOWN])


def draw(path: Path, truth: Truth, pictures: list[Tensor]) -> None:
    """A photograph from a held-out place beside what the shown variants give there."""
    camera, image = (
        truth.cameras[SHOWN_VIEW],
        truth.images[SHOWN_VIEW] + BACKGROUND * ~truth.covers[SHOWN_VIEW][..., None],
    )
    photograph = View("held out", camera, (image.clamp(0, 1) * 255).round().to(torch.uint8))
    contact_sheet([photograph], [pictures], SHOWN, path)


def report(arguments: argparse.Namespace, results: Results) -> None:
    """parts.md: means over the objects."""
    rows, found = [], list[dict[str, Any]]()
    for name in VARIANTS:
        here = [results.find(settings_of(arguments, model, name)) for model in range(arguments.models)]
        cells = [cell for cell in here if cell is not None]
        found += cells
        rows.append(
            [name, *(mean_of(cells, score) for score in SCORES), sum(cell["seconds"] for cell in cells) / len(cells)]
        )
    table = markdown_table(["variant", *SCORES.values(), "seconds"], rows)
    write_report(arguments.results / "parts.md", "What each part is worth", found, table)


def main(line: list[str] | None = None) -> None:
    arguments = arguments_of(line)
    results = Results(arguments.results / "parts.json")
    fill(arguments, results, needed_lpips(arguments.lpips_weights))
    report(arguments, results)


if __name__ == "__main__":
    main()

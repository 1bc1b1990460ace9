"""What each part is worth: the whole, and the whole with one part switched off.

    python tests/benchmarks/parts.py [SCAN …] [--models 2] [--steps 1000] [--variants NAME …]

On synthetic scans with known truth, `default` with the errors that real ones have (`advtex_engine.synthetic.scan`) and
`geometry` with larger ones of the mesh alone, and on scans of one's own against every 8th frame, held out. Writes
parts.json (one cell per scan and variant), parts.md, and per synthetic scan a picture: a photograph from a held-out
place beside the mean, selection alone and the whole; per real scan and variant the model and a contact sheet. Stopped
and run again, it goes on with the missing cells.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from harness import (
    SCAN_SCORES,
    SCORES,
    Results,
    Stopwatch,
    common_arguments,
    configuration,
    draw,
    geometric_means,
    load_truth,
    markdown_table,
    needed_lpips,
    parsed_size,
    picture,
    prepare,
    run_method,
    score_model,
    score_texture,
    shown_mean,
    steps_of,
    write_report,
)
from study import SCANS, make_named_scan
from torch import Tensor

from advtex_engine.core.config import TextureConfig, resolve_preset
from advtex_engine.methods import MethodInput
from advtex_engine.metrics.lpips import Lpips
from advtex_engine.runtime.devices import choose_device
from advtex_options.options import FACE_BUDGET


@dataclasses.dataclass(frozen=True)
class Variant:
    """A method, whether cameras are refined, and what differs from its preset and from the engine's code.

    prepared: in the code while the scan is prepared. code: in that of the method.
    """

    method: str = "adversarial"
    refine: bool = True
    changes: dict[str, Any] = dataclasses.field(default_factory=dict)
    prepared: dict[str, Any] = dataclasses.field(default_factory=dict)
    code: dict[str, Any] = dataclasses.field(default_factory=dict)


def _one_exposure(samples: Tensor, *_: object) -> tuple[Tensor, Tensor]:
    """Gain and offset [V,3] that change nothing."""
    ones = samples.new_ones((len(samples), 3))
    return ones, torch.zeros_like(ones)


def _pinhole(*_: object) -> tuple[None, dict[str, Any]]:
    """No distortion, and a report of it."""
    return None, {"corrected": False}


SELECTION, REFINE = "advtex_engine.selection", "advtex_engine.refine"
VARIANTS = {
    "mean": Variant("mean"),
    "no descent": Variant("view_selection_no_descent"),
    "no descent, with whole faces": Variant(
        "view_selection_no_descent", code={"advtex_engine.methods.selected.LONGEST_SIDE": 1e6}
    ),
    "no descent, without regional blur": Variant("view_selection_no_descent", code={f"{SELECTION}.detail.WEIGHT": 0.0}),
    "no descent, without agreement": Variant(
        "view_selection_no_descent", code={f"{SELECTION}.candidates.AGREEMENT_WEIGHT": 0.0}
    ),
    "no descent, without shared tones": Variant("view_selection_no_descent", code={f"{SELECTION}.tones.SCALE": 1e-6}),
    "no descent, without back-projection": Variant(
        "view_selection_no_descent", code={"advtex_engine.methods.selected.back_project": lambda color, *_: color}
    ),
    "no descent, without shared detail": Variant(
        "view_selection_no_descent", code={"advtex_engine.methods.selected.share_detail": lambda texture, *_: texture}
    ),
    "no descent, without exposures": Variant(
        "view_selection_no_descent", prepared={f"{REFINE}.run.fit_exposure": _one_exposure}
    ),
    "no descent, without a lens": Variant(
        "view_selection_no_descent", prepared={f"{REFINE}.run.refine_distortion": _pinhole}
    ),
    "no descent, without refined geometry": Variant("view_selection_no_descent", prepared={f"{REFINE}.run.ROUNDS": 0}),
    "no descent, without refinement": Variant("view_selection_no_descent", refine=False),
    "no descent, what is not measured is seen": Variant(
        "view_selection_no_descent",
        prepared={"advtex_engine.render.view_maps.UNMEASURED": 0.0, "advtex_engine.render.view_maps.ALWAYS_READ": 0.0},
    ),
    "view selection": Variant("view_selection"),
    "view selection, without motion": Variant(
        "view_selection", code={"advtex_engine.methods.gabor.start_motions": lambda *_, **__: {}}
    ),
    "the whole": Variant(),
    "without refined cameras": Variant(refine=False),
    "without refined cameras and without alignment": Variant(refine=False, changes={"alignment": False}),
    "from the mean, not from view selection": Variant(changes={"start": "mean"}),
    "without alignment in the loop": Variant(changes={"alignment": False}),
    "without feature matching": Variant(changes={"feature_weight": 0.0}),
}
SHOWN = ("mean", "no descent", "the whole")
HOLDOUT = 8  # of scans of one's own


def arguments_of(line: list[str] | None = None) -> argparse.Namespace:
    parser = common_arguments("parts", __doc__)
    parser.add_argument("scans", nargs="*", type=Path, help="folders or zip files")
    parser.add_argument("--scan-faces", type=int, default=FACE_BUDGET, help="of scans, most faces of their meshes")
    parser.add_argument("--synthetic", nargs="*", default=list(SCANS), choices=SCANS)
    parser.add_argument("--models", type=int, default=2, help="objects, with other prints each")
    parser.add_argument("--variants", nargs="+", default=list(VARIANTS), choices=VARIANTS, metavar="NAME")
    parsed: argparse.Namespace = parser.parse_args(line)
    return parsed


def settings_of(arguments: argparse.Namespace, synthetic: str, model: int, variant: str) -> dict[str, Any]:
    """What a cell of a synthetic scan is found by."""
    shared = {name: getattr(arguments, name) for name in ("views", "size", "steps", "preset", "faces")}
    return {"synthetic": synthetic, "model": model, "variant": variant, **shared}


def scan_settings_of(arguments: argparse.Namespace, scan: Path, variant: str) -> dict[str, Any]:
    """What a cell of a real scan is found by."""
    shared = {name: getattr(arguments, name) for name in ("size", "steps", "preset", "scan_faces")}
    return {"scan": scan.stem, "variant": variant, **shared}


def fill(arguments: argparse.Namespace, results: Results, lpips: Lpips) -> None:
    """Runs every cell that is not in the results yet; the picture is drawn when all that it shows was run."""
    device = choose_device(arguments.device)
    config = configuration(arguments, "adversarial")
    for synthetic, model in itertools.product(arguments.synthetic, range(arguments.models)):
        settings = {name: settings_of(arguments, synthetic, model, name) for name in arguments.variants}
        missing = [name for name in arguments.variants if results.find(settings[name]) is None]
        if not missing:
            continue
        with tempfile.TemporaryDirectory(prefix="advtex-parts-") as folder:
            scan, work = Path(folder) / "scan", Path(folder) / "work"
            make_named_scan(scan, synthetic, views=arguments.views, size=arguments.size, seed=model)
            truth = load_truth(scan)
            shown: dict[str, Tensor] = {}
            for name, given, texture, times in textures(missing, scan, config, work, device):
                shown[name] = picture(given.atlas, texture, truth)
                scores = score_texture(given.atlas, texture, truth, lpips)
                results.add(settings[name], {**scores, "prepared": times[0]}, times[1])
            if set(SHOWN) <= shown.keys():
                path = arguments.results / f"{synthetic}_{model}.png"
                draw(path, scan, truth, {name: shown[name] for name in SHOWN})


def fill_scans(arguments: argparse.Namespace, results: Results) -> None:
    """The same on real scans, whose frames are scored against the model that was written."""
    device = choose_device(arguments.device)
    for scan in arguments.scans:
        missing = [name for name in arguments.variants if results.find(scan_settings_of(arguments, scan, name)) is None]
        config = TextureConfig(
            preset=arguments.preset,
            size=parsed_size(arguments.size),
            holdout=HOLDOUT,
            steps=arguments.steps,
            face_budget=arguments.scan_faces,
            device=arguments.device,
        )
        with tempfile.TemporaryDirectory(prefix="advtex-parts-") as folder:
            for name, given, texture, times in textures(missing, scan, config, Path(folder), device):
                kept = arguments.results / scan.stem / name.replace(" ", "_")
                scores = score_model(given, texture, scan, kept, None, arguments.lpips_weights)
                results.add(scan_settings_of(arguments, scan, name), {**scores, "prepared": times[0]}, times[1])


def textures(
    variants: list[str], scan: Path, config: TextureConfig, work: Path, device: torch.device
) -> Iterator[tuple[str, MethodInput, Tensor, tuple[float, float]]]:
    """Per variant what its method was given, the texture [H,W,3], and the seconds of the preparation and the method.

    What several variants share is prepared once.
    """
    inputs: dict[object, tuple[MethodInput, float]] = {}
    for name in variants:
        variant = VARIANTS[name]
        steps = steps_of(variant.method, config.steps)
        changed = dataclasses.replace(config, method=variant.method, refine=variant.refine, steps=steps)
        shared = (variant.refine, *variant.prepared.items())
        if shared not in inputs:
            watch = Stopwatch()
            with patched(variant.prepared):
                inputs[shared] = prepare(scan, changed, work, device), watch.seconds
        given, before = inputs[shared]
        preset = dataclasses.replace(resolve_preset(changed), **variant.changes)
        given = dataclasses.replace(given, config=changed, preset=preset)
        watch = Stopwatch()
        with patched(variant.code):
            texture = run_method(given, variant.method)
        yield name, given, texture, (before, watch.seconds)


@contextmanager
def patched(code: Mapping[str, Any]) -> Iterator[None]:
    """Other values at places of the engine's code, for as long as the block lasts."""
    with ExitStack() as stack:
        for place, value in code.items():
            stack.enter_context(patch(place, value))
        yield


def report(arguments: argparse.Namespace, results: Results) -> None:
    """parts.md: means over the synthetic objects, then a table per scan, and the geometric means over all scans."""
    tables = {}
    for synthetic in arguments.synthetic:
        models = range(arguments.models)
        lines = [
            [results.find(settings_of(arguments, synthetic, model, name)) for model in models] for name in VARIANTS
        ]
        tables[SCANS[synthetic]] = (SCORES, lines)
    for scan in arguments.scans:
        lines = [[results.find(scan_settings_of(arguments, scan, name))] for name in VARIANTS]
        tables[scan.stem] = (SCAN_SCORES, lines)
    body, found = "", list[dict[str, Any]]()
    for title, (scores, lines) in tables.items():
        rows = []
        for name, line in zip(VARIANTS, lines, strict=True):
            if cells := [cell for cell in line if cell is not None]:
                seconds = sum(cell["seconds"] for cell in cells) / len(cells)
                rows.append([name, *(shown_mean(cells, score) for score in (*scores, "prepared")), seconds])
                found += cells
        head = ["variant", *scores.values(), "seconds before", "seconds"]
        body += f"\n## {title}\n\n{markdown_table(head, rows)}"
    over_scans = {
        name: [results.find(scan_settings_of(arguments, scan, name)) for scan in arguments.scans] for name in VARIANTS
    }
    body += geometric_means("variant", over_scans)
    write_report(arguments.results / "parts.md", "What each part is worth", found, body)


def main(line: list[str] | None = None) -> None:
    arguments = arguments_of(line)
    results = Results(arguments.results / "parts.json")
    fill(arguments, results, needed_lpips(arguments.lpips_weights))
    fill_scans(arguments, results)
    report(arguments, results)


if __name__ == "__main__":
    main()

"""The preset `paper` beside what the paper compares its method with, cameras as they came.

    python tests/benchmarks/paper.py [SCAN …] [--errors cameras geometry] [--levels 1 2.75 4.5] [--rows l1 adversarial]

On the study's synthetic scans (`study.py`: 256x192, 60 views) against the true object, and on scans of one's own at
320x240 against every 8th frame, held out. Nothing is refined but the cameras of `colormap`, which is nothing without.
Beside every row stand its LPIPS over that of `l1`, as in the paper's table of real scans, and its share of speckled
texels over that of `view_selection_no_descent`. `--rows suspects` changes the printed recipe, which speckles in 3D, one
suspect at a time, and takes the preset's choices back one at a time; --steps 6000 tells them apart. `--rows standard
full` are the other presets as they are, refinement included.

Writes paper.json (one cell per scan and row), paper.md, and a render of each, from a place that is held out, below
--results. Stopped and run again, it goes on with the cells that are missing.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import torch
from harness import (
    RESULTS,
    Results,
    Stopwatch,
    geometric_means,
    load_truth,
    markdown_table,
    needed_lpips,
    on_cpu,
    parsed_size,
    prepare,
    run_method,
    score_model,
    score_texture,
    shown_mean,
    shown_view,
    write_report,
)
from study import make_scan
from torch import Tensor

from advtex_engine.adversarial.examples import Examples, assemble
from advtex_engine.adversarial.operations import Operations, plain_operations
from advtex_engine.core.config import PRESETS, TextureConfig, resolve_preset
from advtex_engine.core.monitor import Monitor
from advtex_engine.methods import MethodInput
from advtex_engine.metrics.evaluate import heldout_scene
from advtex_engine.metrics.lpips import Lpips
from advtex_engine.metrics.speckle import speckle_share
from advtex_engine.render.pictures import to_bytes
from advtex_engine.render.render_view import render_view
from advtex_engine.runtime.devices import choose_device

SIZE, VIEWS, FACES, TURN = "256x192", 60, 20_000, 5.0
"""Of the study's scans; the turn in degrees is the paper's e_a."""
SCAN_SIZE, SCAN_FACES, HOLDOUT = "320x240", 80_000, 8
"""Of scans of one's own."""
PRINTED = {"Object": 0.175 / 0.197, "ScanNet": 0.395 / 0.470, "CAD": 0.176 / 0.199}
"""The paper's LPIPS over that of its L1 (table 2)."""
TABLE = {
    "lpips": "LPIPS",
    "of_l1": "of l1's",
    "lpips_corrected": "corrected LPIPS",
    "displacement_pixels": "displacement, pixels",
    "gradient_ratio": "gradient ratio",
    "band_error": "band error",
    "flat_energy": "energy where flat",
    "s3_difference": "S3 difference",
    "nearest_patch": "nearest patch",
    "nearest_patch_reverse": "nearest patch, truth to texture",
    "speckle": "speckled texels",
    "of_selection": "of selection's",
}
CLAIMS = {"of_l1": (0.0, 0.89), "gradient_ratio": (0.9, 1.1), "flat_energy": (0.8, 1.2), "of_selection": (0.0, 1.2)}
"""Within which the preset is to end, from MIDDLE on; OWN_OF_L1: on scans of one's own."""
MIDDLE, OWN_OF_L1 = 2.75, 0.95
PHOTOGRAPH = "photograph"
PICTURES = 4
"""Side by side on the page."""


@dataclasses.dataclass(frozen=True)
class Row:
    """A method of a preset, and what differs from the preset, from the options and from the engine's code."""

    method: str = "adversarial"
    named: str = "paper"
    preset: dict[str, Any] = dataclasses.field(default_factory=dict)
    options: dict[str, Any] = dataclasses.field(default_factory=dict)
    code: dict[str, Any] = dataclasses.field(default_factory=dict)


METHOD_ROWS = {
    name: Row(name)
    for name in (
        "mean",
        "l1",
        "sharpest",
        "colormap",
        "view_selection_no_descent",
        "adversarial",
        "adversarial_no_auxiliary",
        "adversarial_no_condition",
    )
}
OTHER_PRESETS = {name: Row(named=name) for name in ("standard", "full")}

FROM_MEAN: dict[str, Any] = {
    "start": "mean",
    "toned": False,
    "lr_texture": 1e-3,
    "lr_unit": "color",
    "l1_target": "auxiliary",
    "lr_follows": 0.0,
    "nearest_share": 1.0,
}
"""As printed, but for the start: black takes thousands of steps to get away from, and hides all else in short runs."""


def _fake_without_holes(condition: Tensor, real: Tensor, fake: Tensor, *rest: Any) -> Examples:
    """The render is shown to the discriminator also where the auxiliary view sees nothing."""
    visible, offsets, form = rest
    whole = assemble(condition, real, fake, torch.ones_like(visible), offsets, form)
    return dataclasses.replace(assemble(condition, real, fake, *rest), fake_input=whole.fake_input)


def _fakes_without_holes(device: torch.device) -> Operations:
    return dataclasses.replace(plain_operations(), assemble=_fake_without_holes)


ADVERSARIAL = "advtex_engine.adversarial"
SUSPECTS = {
    "as printed": Row(preset={**FROM_MEAN, "start": "zero"}),
    "from the mean": Row(preset=FROM_MEAN),
    "from the mean, averaged": Row(preset={**FROM_MEAN, "averaging": 2_000}),
    "from the mean, toned": Row(preset={**FROM_MEAN, "toned": True}),
    "from the mean, half the rate": Row(preset={**FROM_MEAN, "lr_texture": 5e-4}),
    "from the mean, a tenth of the rate": Row(preset={**FROM_MEAN, "lr_texture": 1e-4}),
    "from the mean, L1 to the source": Row(preset={**FROM_MEAN, "l1_target": "source"}),
    "from the mean, fewer texels": Row(preset=FROM_MEAN, options={"texels_per_pixel": 0.8}),
    "from the mean, wider pairs": Row(preset={**FROM_MEAN, "max_pair_angle": 30.0}),
    "from the mean, closer pairs": Row(preset={**FROM_MEAN, "min_pair_overlap": 0.7}),
    "from the mean, nearest half": Row(preset={**FROM_MEAN, "nearest_share": 0.5}),
    "from the mean, small crops": Row(preset={**FROM_MEAN, "max_crop": (96, 96)}),
    "from the mean, in float32": Row(
        preset=FROM_MEAN, code={f"{ADVERSARIAL}.optimizer.native_bfloat16": lambda _: False}
    ),
    "from the mean, a tenth of theta_z": Row(
        preset=FROM_MEAN, code={f"{ADVERSARIAL}.pair_sampler.DEPTH_TOLERANCE": {"object": 0.003, "scene": 0.01}}
    ),
    "from the mean, fake without holes": Row(
        preset=FROM_MEAN, code={f"{ADVERSARIAL}.optimizer.choose_operations": _fakes_without_holes}
    ),
    "a rate of 6e-4": Row(preset={"lr_texture": 6e-4}),
    "a rate of 3e-4": Row(preset={"lr_texture": 3e-4}),
    "an even rate": Row(preset={"lr_follows": 0.0}),
    "views as photographed": Row(preset={"toned": False}),
    "all pairs": Row(preset={"nearest_share": 1.0}),
    "L1 to the auxiliary": Row(preset={"l1_target": "auxiliary"}),
    "from zero": Row(preset={"start": "zero"}),
}
"""One at a time from the printed recipe on, and taken back from the preset's."""
ROWS = {**METHOD_ROWS, **OTHER_PRESETS, **SUSPECTS}


def arguments_of(line: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scans", nargs="*", type=Path, help="folders or zip files")
    parser.add_argument("--errors", nargs="*", default=["cameras", "geometry"], choices=["cameras", "geometry"])
    parser.add_argument("--levels", nargs="+", type=float, default=[1.0, 2.75, 4.5], help="n of the error's size")
    parser.add_argument("--rows", nargs="+", default=list(METHOD_ROWS), choices=[*ROWS, "suspects"])
    parser.add_argument("--steps", type=int, default=PRESETS["paper"].steps, help="of the preset `paper`")
    parser.add_argument("--scan-size", default=SCAN_SIZE, help="WIDTHxHEIGHT of the views of one's own scans")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--lpips-weights", type=Path, help="folder; default: $ADVTEX_LPIPS_WEIGHTS, else the cache")
    parser.add_argument("--results", type=Path, default=RESULTS / "paper", help="folder of the results")
    parsed: argparse.Namespace = parser.parse_args(line)
    if "suspects" in parsed.rows:
        parsed.rows = [name for name in parsed.rows if name != "suspects"] + list(SUSPECTS)
    return parsed


def cells(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """The settings of every cell, scan by scan, each scan's refined cameras last."""
    rows = sorted(arguments.rows, key=lambda name: ROWS[name].method == "colormap" or ROWS[name].named != "paper")
    study = [
        {"scan": f"{errors} {level:g}", "size": SIZE, "errors": errors, "level": level}
        for errors in arguments.errors
        for level in arguments.levels
    ]
    own = [{"scan": scan.stem, "size": arguments.scan_size} for scan in arguments.scans]
    return [{**scan, "row": name, "steps": _steps(arguments, name)} for scan in (*study, *own) for name in rows]


def _steps(arguments: argparse.Namespace, name: str) -> int:
    named = ROWS[name].named
    return int(arguments.steps) if named == "paper" else PRESETS[named].steps


def _config(arguments: argparse.Namespace, cell: dict[str, Any]) -> TextureConfig:
    row, synthetic = ROWS[cell["row"]], "errors" in cell
    steps = {"steps": cell["steps"]} if row.method.startswith("adversarial") else {}
    return TextureConfig(
        preset=row.named,
        method=row.method,
        size=parsed_size(cell["size"]),
        holdout=None if synthetic else HOLDOUT,
        face_budget=FACES if synthetic else SCAN_FACES,
        device=arguments.device,
        **steps,
        **row.options,
    )


def fill(arguments: argparse.Namespace, results: Results, lpips: Lpips) -> None:
    """Runs every cell that is not in the results yet."""
    device = choose_device(arguments.device)
    paths = {scan.stem: scan for scan in arguments.scans}
    missing = [cell for cell in cells(arguments) if results.find(cell) is None]
    for name in dict.fromkeys(cell["scan"] for cell in missing):
        with tempfile.TemporaryDirectory(prefix="advtex-paper-") as folder:
            scan = paths.get(name, Path(folder) / "scan")
            inputs: dict[object, MethodInput] = {}
            for cell in (cell for cell in missing if cell["scan"] == name):
                if "errors" in cell and not scan.exists():
                    turn = TURN if cell["errors"] == "cameras" else 0.0
                    make_scan(scan, {**cell, "views": VIEWS, "model": 0, "turn": turn})
                _run(arguments, scan, cell, inputs, Path(folder) / "work", results, lpips, device)


def _run(
    arguments: argparse.Namespace,
    scan: Path,
    cell: dict[str, Any],
    inputs: dict[object, MethodInput],
    work: Path,
    results: Results,
    lpips: Lpips,
    device: torch.device,
) -> None:
    """One row of one scan. inputs: what was made of the scan so far, by what it depends on."""
    row, config = ROWS[cell["row"]], _config(arguments, cell)
    key = (config.refines, *row.options.values())
    if key not in inputs:
        inputs.clear()
        inputs[key] = prepare(scan, config, work, device)
    preset = dataclasses.replace(resolve_preset(config), **row.preset)
    given = dataclasses.replace(inputs[key], config=config, preset=preset)
    watch = Stopwatch()
    with ExitStack() as stack:
        for name, changed in row.code.items():
            stack.enter_context(patch(name, changed))
        texture = run_method(given, row.method)
    seconds = watch.seconds
    if "errors" in cell:
        truth = load_truth(scan)
        scores = score_texture(given.atlas, texture, truth, lpips)
        view = shown_view(scan, truth)
    else:
        scores = score_model(given, texture, scan, work.parent / "model", None, arguments.lpips_weights)
        views = heldout_scene(scan, config, Monitor()).views
        view = views[len(views) // 2]
    pictures = {PHOTOGRAPH: view.color / 255, cell["row"]: render_view(on_cpu(given.atlas), texture, view.camera)}
    for name, image in pictures.items():
        path = arguments.results / _picture(cell, name)
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), to_bytes(image)[..., ::-1])
    speckle = speckle_share(texture, given.maps[1].slot_map >= 0)
    gpu = torch.cuda.get_device_name(device) if device.type == "cuda" else None
    results.add(cell, scores if speckle is None else {**scores, "speckle": speckle}, seconds, gpu)


def report(arguments: argparse.Namespace, results: Results) -> None:
    """paper.md: a table per scan of everything that was run, the least LPIPS first; geometric means over own scans."""
    body = "The paper's own LPIPS over that of its L1 (table 2): "
    body += ", ".join(f"{name} {share:.2f}" for name, share in PRINTED.items()) + ".\n"
    body += _claims(results)
    keys = dict.fromkeys((cell["settings"]["scan"], cell["settings"]["size"]) for cell in results.cells)
    for scan, size in keys:
        here = [cell for cell in results.cells if (cell["settings"]["scan"], cell["settings"]["size"]) == (scan, size)]
        here.sort(key=lambda cell: float(cell["scores"]["lpips"]))
        rows = [_line(cell, here) for cell in here]
        body += f"\n## {scan}, {size}\n\n{markdown_table(['row', 'steps', *TABLE.values(), 'seconds'], rows)}"
        body += _pictures({"scan": scan, "size": size}, [cell["settings"]["row"] for cell in here])
    own = [cell for cell in cells(arguments) if "errors" not in cell]
    lines = {name: [results.find(cell) for cell in own if cell["row"] == name] for name in arguments.rows}
    body += geometric_means("row", lines)
    write_report(arguments.results / "paper.md", "The paper's method beside its peers", results.cells, body)


def _claims(results: Results) -> str:
    """What the preset was to show on each scan that it was run to its end on; what it missed is bold."""
    rows = []
    for cell in results.cells:
        settings = cell["settings"]
        if settings["row"] != "adversarial" or settings["steps"] != PRESETS["paper"].steps:
            continue
        place = (settings["scan"], settings["size"])
        here = [other for other in results.cells if (other["settings"]["scan"], other["settings"]["size"]) == place]
        scores = _with_ratios(cell, here)
        asked = CLAIMS if settings.get("level", MIDDLE) >= MIDDLE else {}
        shown = []
        for name in CLAIMS:
            least, most = asked.get(name, (0.0, float("inf")))
            most = OWN_OF_L1 if name == "of_l1" and "errors" not in settings else most
            score = scores.get(name)
            within = score is None or least <= score <= most
            shown.append("-" if score is None else f"{score:.3f}" if within else f"**{score:.3f}**")
        rows.append([settings["scan"], *shown])
    if not rows:
        return ""
    bars = ", ".join(f"{TABLE[name]} {least:g} to {most:g}" for name, (least, most) in CLAIMS.items())
    told = f"\nThe preset's last step; **bold**: outside of what it was to show ({bars}; of l1's {OWN_OF_L1} on scans"
    told += f" of one's own; nothing was asked of errors below {MIDDLE}). Of selection's: speckled texels.\n\n"
    return told + markdown_table(["scan", *(TABLE[name] for name in CLAIMS)], sorted(rows))


def _picture(cell: dict[str, Any], name: str) -> Path:
    """Of a row of the cell's scan, or of its photograph."""
    words = [cell["scan"], cell["size"], name]
    return Path("pictures", "_".join(words).replace(" ", "_").replace(",", "") + ".jpg")


def _pictures(cell: dict[str, Any], rows: list[str]) -> str:
    """The photograph and what the rows show of the same place, PICTURES in a line."""
    names = [PHOTOGRAPH, *rows]
    lines = [names[first : first + PICTURES] for first in range(0, len(names), PICTURES)]
    return "".join(
        "\n" + markdown_table(line, [[f"![{name}]({_picture(cell, name)})" for name in line]]) for line in lines
    )


def _with_ratios(cell: dict[str, Any], here: list[dict[str, Any]]) -> dict[str, float]:
    """A cell's scores and its ratios to those rows of the same scan that were run."""
    scores = dict(cell["scores"])
    for name, score, row in (("of_l1", "lpips", "l1"), ("of_selection", "speckle", "view_selection_no_descent")):
        known = [other["scores"].get(score) for other in here if other["settings"]["row"] == row]
        if known and known[0] and score in scores:
            scores[name] = scores[score] / known[0]
    return scores


def _line(cell: dict[str, Any], here: list[dict[str, Any]]) -> list[object]:
    """A row of the table; ratios to rows that were not run are dashes."""
    settings, scores = cell["settings"], _with_ratios(cell, here)
    stepped = ROWS[settings["row"]].method.startswith("adversarial")
    shown = (shown_mean([{"scores": scores}], name) for name in TABLE)
    seconds = f"{cell['seconds']}, on a GPU" if "gpu" in cell else cell["seconds"]
    return [settings["row"], settings["steps"] if stepped else "-", *shown, seconds]


def main(line: list[str] | None = None) -> None:
    arguments = arguments_of(line)
    results = Results(arguments.results / "paper.json")
    fill(arguments, results, needed_lpips(arguments.lpips_weights))
    report(arguments, results)


if __name__ == "__main__":
    main()

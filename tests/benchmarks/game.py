"""The game along its run: what the discriminator knows, and how far the texture is from what it has not seen.

    python tests/benchmarks/game.py [SCAN …] [--preset paper] [--errors cameras geometry] [--levels 2.75]
        [--scan-size 320x240] [--steps 50000] [--points 10] [--change start=selection lr_texture=1e-4 …]

A preset, changed as asked, on the scans of `paper.py`, refined where a run would refine them: a table per run, a line
per point of it. Told apart are shares of the real and of the fake patches, since the reading before; margin, spread and
the gradients' norms are those of `adversarial/game.py`. Where the losses stand still, the discriminator tells half of
the patches apart, or it is always ahead (`skipped` is the share of steps in which it is), the columns beside them say
whether the texture is the better for it. The schedule is that of all the steps.

Writes game.json (a cell per reading, READINGS of them per point), game.md and game.png below --results. A run that is
stopped begins anew.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from harness import (
    RESULTS,
    Results,
    Stopwatch,
    Truth,
    completed,
    load_truth,
    markdown_table,
    needed_lpips,
    parsed_size,
    prepare,
    score_model,
    score_texture,
    shown_mean,
    started,
    write_report,
)
from matplotlib.figure import Figure
from paper import FACES, HOLDOUT, SCAN_FACES, SCAN_SIZE, SIZE, TURN, VIEWS
from study import make_scan
from torch import Tensor

from advtex_engine.adversarial.discriminator import PatchDiscriminator
from advtex_engine.adversarial.game import CHANCE
from advtex_engine.adversarial.optimizer import AdversarialOptimizer
from advtex_engine.core.config import PRESETS, Preset, TextureConfig, resolve_preset
from advtex_engine.methods import MethodInput
from advtex_engine.methods.adversarial import fitted, pairs_of
from advtex_engine.methods.mean import dense_texture
from advtex_engine.metrics.lpips import Lpips
from advtex_engine.metrics.speckle import speckle_share
from advtex_engine.runtime.devices import choose_device

READINGS = 5
TABLE = {
    "accuracy": "told apart",
    "accuracy_real": "real told",
    "accuracy_fake": "fake told",
    "margin": "margin",
    "spread": "spread",
    "gradient_adversarial": "gradient, adversarial",
    "gradient_l1": "gradient, L1",
    "gradient_features": "gradient, features",
    "gradient_gabor": "gradient, Gabor energies",
    "discriminator": "discriminator's loss",
    "adversarial": "texture's loss",
    "l1": "L1",
    "skipped": "skipped",
    "lpips": "LPIPS",
    "lpips_corrected": "corrected LPIPS",
    "displacement_pixels": "displacement, pixels",
    "gradient_ratio": "gradient ratio",
    "flat_energy": "energy where flat",
    "speckle": "speckled texels",
    "ms": "ms per step",
}
PANELS = {
    "share told apart": ("accuracy", "accuracy_real", "accuracy_fake"),
    "logits": ("margin", "spread"),
    "norm of the texture's gradient": ("gradient_adversarial", "gradient_l1", "gradient_features", "gradient_gabor"),
    "LPIPS of held-out views": ("lpips", "lpips_corrected"),
    "displacement, pixels": ("displacement_pixels",),
    "energy where flat, gradient ratio": ("flat_energy", "gradient_ratio"),
}


def arguments_of(line: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scans", nargs="*", type=Path, help="folders or zip files")
    parser.add_argument("--errors", nargs="*", default=[], choices=["cameras", "geometry"])
    parser.add_argument("--levels", nargs="+", type=float, default=[2.75], help="n of the error's size")
    parser.add_argument("--scan-size", default=SCAN_SIZE, help="WIDTHxHEIGHT of the views of one's own scans")
    parser.add_argument("--preset", default="paper", choices=[name for name in PRESETS if name != "preview"])
    parser.add_argument("--steps", type=int, help="the preset's if not given")
    parser.add_argument("--points", type=int, default=10, help="at which the texture is scored")
    parser.add_argument("--change", nargs="*", default=[], metavar="NAME=VALUE", help="numbers of the preset")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--lpips-weights", type=Path, help="folder; default: $ADVTEX_LPIPS_WEIGHTS, else the cache")
    parser.add_argument("--results", type=Path, default=RESULTS / "game", help="folder of the results")
    parsed: argparse.Namespace = parser.parse_args(line)
    return parsed


def changes(pairs: list[str]) -> dict[str, Any]:
    """NAME=VALUE as the preset's fields; what is no number, true or false is a word."""
    found = {}
    for name, _, text in (pair.partition("=") for pair in pairs):
        if name not in Preset.__dataclass_fields__:
            raise SystemExit(
                f"--change {name}: the preset has no such number; it has {', '.join(vars(PRESETS['paper']))}"
            )
        try:
            found[name] = json.loads(text)
        except json.JSONDecodeError:
            found[name] = text
    return found


def play(
    given: MethodInput,
    points: int,
    score: Callable[[Tensor], dict[str, float]],
    results: Results,
    settings: dict[str, Any],
) -> None:
    """One run from the start; a cell per reading, with the texture's scores at each point."""
    given = started(given)
    maps, preset, start = given.maps[1], given.preset, given.start
    assert start is not None
    optimizer = AdversarialOptimizer(
        maps,
        pairs_of(given, maps),
        start[maps.slot_map >= 0],
        fitted(preset, maps, start),
        kind=given.scene.kind,
        steps=preset.steps,
        generator=torch.Generator(maps.device).manual_seed(given.config.seed),
        discriminator=PatchDiscriminator(torch.Generator().manual_seed(given.config.seed)).to(maps.device),
    )
    ends = {preset.steps * point // points for point in range(points + 1)}
    readings = {preset.steps * reading // (points * READINGS) for reading in range(points * READINGS + 1)}
    for end in sorted(ends | readings):
        watch, before, found = Stopwatch(), optimizer.index, dict[str, float]()
        while optimizer.index < end:
            optimizer.step()
        if end > before:
            found = optimizer.drain_losses()
            found["ms"] = 1000 * watch.seconds / (end - before)
            found |= optimizer.gradient_norms()
        seconds = watch.seconds
        if end in ends:
            texture = completed(given, dense_texture(maps, optimizer.result).clamp(0, 1))
            found |= score(texture)
            found["speckle"] = speckle_share(texture, maps.slot_map.cpu() >= 0) or 0.0
        results.add({**settings, "step": end}, found, seconds)


def run(arguments: argparse.Namespace, results: Results, lpips: Lpips) -> None:
    """One run per scan."""
    made = [(f"{errors} {level:g}", errors, level) for errors in arguments.errors for level in arguments.levels]
    for name, errors, level in made:
        with tempfile.TemporaryDirectory(prefix="advtex-game-") as folder:
            scan = Path(folder) / "scan"
            cell = {"size": SIZE, "errors": errors, "level": level, "views": VIEWS, "model": 0}
            make_scan(scan, {**cell, "turn": TURN if errors == "cameras" else 0.0})
            given, truth = _input(arguments, scan, SIZE, None, FACES, Path(folder)), load_truth(scan)
            score = partial(_against_truth, given, truth, lpips)
            play(given, arguments.points, score, results, _settings(arguments, name, SIZE))
    for scan in arguments.scans:
        with tempfile.TemporaryDirectory(prefix="advtex-game-") as folder:
            given = _input(arguments, scan, arguments.scan_size, HOLDOUT, SCAN_FACES, Path(folder))
            score = partial(_against_photographs, given, scan, Path(folder) / "model", arguments.lpips_weights)
            play(given, arguments.points, score, results, _settings(arguments, scan.stem, arguments.scan_size))


def _settings(arguments: argparse.Namespace, scan: str, size: str) -> dict[str, Any]:
    steps = arguments.steps or PRESETS[arguments.preset].steps
    changed = " ".join(arguments.change)
    return {"scan": scan, "size": size, "preset": arguments.preset, "steps": steps, "changes": changed}


def _input(
    arguments: argparse.Namespace, scan: Path, size: str, holdout: int | None, faces: int, folder: Path
) -> MethodInput:
    device = choose_device(arguments.device)
    config = TextureConfig(
        preset=arguments.preset,
        steps=arguments.steps,
        size=parsed_size(size),
        holdout=holdout,
        face_budget=faces,
        device=arguments.device,
    )
    given = prepare(scan, config, folder / "work", device)
    preset = dataclasses.replace(resolve_preset(config), **changes(arguments.change))
    return dataclasses.replace(given, preset=preset)


def _against_truth(given: MethodInput, truth: Truth, lpips: Lpips, texture: Tensor) -> dict[str, float]:
    return score_texture(given.atlas, texture, truth, lpips)


def _against_photographs(
    given: MethodInput, scan: Path, folder: Path, weights: Path | None, texture: Tensor
) -> dict[str, float]:
    return score_model(given, texture, scan, folder, None, weights)


def report(arguments: argparse.Namespace, results: Results) -> None:
    """game.md: a table per run, its points in order; game.png: a row of curves per run."""
    runs = dict[str, list[dict[str, Any]]]()
    for cell in results.cells:
        scan, size, preset, steps, changed, _ = cell["settings"].values()
        title = f"{scan}, {size}, {preset}, {steps} steps" + (f", {changed}" if changed else "")
        runs.setdefault(title, []).append(cell)
    body = ""
    for title, cells in runs.items():
        scored = [cell for cell in cells if "speckle" in cell["scores"]]
        lines = [[cell["settings"]["step"], *(shown_mean([cell], name) for name in TABLE)] for cell in scored]
        body += f"\n## {title}\n\n{markdown_table(['step', *TABLE.values()], lines)}"
    write_report(arguments.results / "game.md", "The game along its run", results.cells, body)
    draw_curves(arguments.results / "game.png", runs)


def draw_curves(path: Path, runs: Mapping[str, Sequence[Mapping[str, Any]]]) -> None:
    """A PNG with the PANELS of each run, in two rows."""
    columns = len(PANELS) // 2
    figure = Figure(figsize=(4 * columns, 5 * len(runs)), layout="constrained")
    for part, (title, cells) in zip(np.ravel(figure.subfigures(len(runs), 1)), runs.items(), strict=True):
        part.suptitle(title, fontsize=9)
        places = np.ravel(part.subplots(2, columns))
        for place, (name, scores) in zip(places, PANELS.items(), strict=True):
            for score in scores:
                known = [cell for cell in cells if score in cell["scores"]]
                steps = [cell["settings"]["step"] for cell in known]
                values = [cell["scores"][score] for cell in known]
                place.plot(steps, values, marker="o", markersize=2, linewidth=1, label=TABLE[score])
            place.set_title(name, fontsize=8)
            place.tick_params(labelsize=7)
            place.legend(fontsize=6)
        places[0].set_ylim(0, 1)
        places[0].axhspan(*CHANCE, color="0.9")
        places[1].set_yscale("symlog", linthresh=0.01)
        places[2].set_yscale("symlog", linthresh=0.001)
    figure.savefig(path, dpi=100)


def main(line: list[str] | None = None) -> None:
    arguments = arguments_of(line)
    results = Results(arguments.results / "game.json")
    run(arguments, results, needed_lpips(arguments.lpips_weights))
    report(arguments, results)


if __name__ == "__main__":
    main()

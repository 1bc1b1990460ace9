"""The game along its run: both players' losses, and how far the texture is from what it has not seen.

    python tests/benchmarks/game.py [SCAN …] [--errors cameras geometry] [--levels 2.75] [--scan-size 320x240]
        [--steps 50000] [--points 10] [--change start=selection lr_texture=1e-4 …]

The preset `paper`, changed as asked, on the scans of `paper.py`: a table per run, a line per point of it. Where the
losses stand still, or one player is always ahead (`skipped` is the share of steps in which the discriminator is), the
lines beside them say whether the texture is the better for it. The schedule is that of all the steps.

Writes game.json (one cell per point) and game.md below --results. A run that is stopped begins anew.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
from harness import (
    RESULTS,
    Results,
    Stopwatch,
    Truth,
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
from paper import FACES, HOLDOUT, SCAN_FACES, SCAN_SIZE, SIZE, TURN, VIEWS
from study import make_scan
from torch import Tensor

from advtex_engine.adversarial.discriminator import PatchDiscriminator
from advtex_engine.adversarial.optimizer import AdversarialOptimizer
from advtex_engine.core.config import PRESETS, Preset, TextureConfig, resolve_preset
from advtex_engine.methods import MethodInput
from advtex_engine.methods.adversarial import pairs_of, rated
from advtex_engine.methods.mean import dense_texture
from advtex_engine.metrics.lpips import Lpips
from advtex_engine.metrics.speckle import speckle_share
from advtex_engine.render.texture import fill_holes
from advtex_engine.runtime.devices import choose_device

TABLE = {
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


def arguments_of(line: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scans", nargs="*", type=Path, help="folders or zip files")
    parser.add_argument("--errors", nargs="*", default=[], choices=["cameras", "geometry"])
    parser.add_argument("--levels", nargs="+", type=float, default=[2.75], help="n of the error's size")
    parser.add_argument("--scan-size", default=SCAN_SIZE, help="WIDTHxHEIGHT of the views of one's own scans")
    parser.add_argument("--steps", type=int, default=PRESETS["paper"].steps)
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
    """One run from the start; a cell per point."""
    given = started(given)
    maps, preset, start = given.maps[1], given.preset, given.start
    assert start is not None
    optimizer = AdversarialOptimizer(
        maps,
        pairs_of(given, maps),
        start[maps.slot_map >= 0],
        rated(preset, maps, start),
        kind=given.scene.kind,
        steps=preset.steps,
        generator=torch.Generator(maps.device).manual_seed(given.config.seed),
        discriminator=PatchDiscriminator(torch.Generator().manual_seed(given.config.seed)).to(maps.device),
    )
    for point in range(points + 1):
        end, watch, before = preset.steps * point // points, Stopwatch(), optimizer.index
        while optimizer.index < end:
            optimizer.step()
        losses = optimizer.drain_losses()
        seconds = watch.seconds
        texture = fill_holes(dense_texture(maps, optimizer.result).clamp(0, 1), maps.slot_map >= 0).cpu()
        found = {**losses, **score(texture), "speckle": speckle_share(texture, maps.slot_map.cpu() >= 0) or 0.0}
        if end > before:
            found["ms"] = 1000 * seconds / (end - before)
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
    return {"scan": scan, "size": size, "steps": arguments.steps, "changes": " ".join(arguments.change)}


def _input(
    arguments: argparse.Namespace, scan: Path, size: str, holdout: int | None, faces: int, folder: Path
) -> MethodInput:
    device = choose_device(arguments.device)
    config = TextureConfig(
        preset="paper",
        steps=arguments.steps,
        size=parsed_size(size),
        holdout=holdout,
        face_budget=faces,
        device=arguments.device,
    )
    given = prepare(scan, config, folder / "work", device)
    preset = dataclasses.replace(resolve_preset(config, device.type), **changes(arguments.change))
    return dataclasses.replace(given, preset=preset)


def _against_truth(given: MethodInput, truth: Truth, lpips: Lpips, texture: Tensor) -> dict[str, float]:
    return score_texture(given.atlas, texture, truth, lpips)


def _against_photographs(
    given: MethodInput, scan: Path, folder: Path, weights: Path | None, texture: Tensor
) -> dict[str, float]:
    return score_model(given, texture, scan, folder, None, weights)


def report(arguments: argparse.Namespace, results: Results) -> None:
    """game.md: a table per run, its points in order."""
    body = ""
    runs = dict.fromkeys(tuple(v for k, v in cell["settings"].items() if k != "step") for cell in results.cells)
    for scan, size, steps, changed in runs:
        wanted = {"scan": scan, "size": size, "steps": steps, "changes": changed}
        here = [cell for cell in results.cells if wanted.items() <= cell["settings"].items()]
        lines = [[cell["settings"]["step"], *(shown_mean([cell], name) for name in TABLE)] for cell in here]
        title = f"{scan}, {size}, {steps} steps" + (f", {changed}" if changed else "")
        body += f"\n## {title}\n\n{markdown_table(['step', *TABLE.values()], lines)}"
    write_report(arguments.results / "game.md", "The game along its run", results.cells, body)


def main(line: list[str] | None = None) -> None:
    arguments = arguments_of(line)
    results = Results(arguments.results / "game.json")
    run(arguments, results, needed_lpips(arguments.lpips_weights))
    report(arguments, results)


if __name__ == "__main__":
    main()

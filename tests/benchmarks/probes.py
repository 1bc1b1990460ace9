"""Whether views that are left out of the game know what views say that it never sees.

    python tests/benchmarks/probes.py [SCAN …] [--synthetic geometry] [--scan-size 192x144] [--turn 60] [--steps 1500]

The preset's game, probed as a run is (`adversarial/probes.py`) but never ended: after each turn the accumulated gain by
each measure stands beside the LPIPS of views that are held out of everything. A table per scan, and one of what would
be kept: by rank (Spearman's rho of gain and fall of LPIPS over the states of a run), the state of the most gain within
the preset's patience, what its LPIPS is, and what that of the best state would have been.

Writes probes.json (a cell per state) and probes.md below --results. A run that is stopped begins anew.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from game import changes
from harness import (
    RESULTS,
    Results,
    Stopwatch,
    completed,
    load_truth,
    markdown_table,
    needed_lpips,
    parsed_size,
    prepare,
    started,
    write_report,
)
from study import SCANS, make_named_scan
from torch import Tensor

from advtex_engine.adversarial.discriminator import PatchDiscriminator
from advtex_engine.adversarial.optimizer import AdversarialOptimizer
from advtex_engine.adversarial.probes import LeftOutCells, Probes
from advtex_engine.adversarial.unlikeness import Unlikeness, structure_unlikeness
from advtex_engine.core.config import PRESETS, Preset, TextureConfig, resolve_preset
from advtex_engine.methods import MethodInput
from advtex_engine.methods.adversarial import fitted, pairs_of
from advtex_engine.methods.gabor import start_motions
from advtex_engine.methods.mean import dense_texture
from advtex_engine.metrics.evaluate import score_views
from advtex_engine.metrics.lpips import Lpips
from advtex_engine.metrics.photograph import Photograph
from advtex_engine.render.render_view import render_layers
from advtex_engine.render.streaming import ResidentViews
from advtex_engine.runtime.devices import choose_device
from advtex_engine.synthetic.scan import SUPERSAMPLE

MEASURES = ("LPIPS", "structure")
HOLDOUT = 8
Score = Callable[[Tensor], float]
"""A texture [H,W,3] in [0,1] -> LPIPS of what the run never sees."""


def arguments_of(line: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scans", nargs="*", type=Path, help="folders or zip files")
    parser.add_argument("--synthetic", nargs="*", default=[], choices=list(SCANS))
    parser.add_argument("--views", type=int, default=60, help="of synthetic scans")
    parser.add_argument("--faces", type=int, default=20_000)
    parser.add_argument("--scan-size", default="192x144", help="WIDTHxHEIGHT of the views")
    parser.add_argument("--preset", default="standard", choices=["standard", "full"])
    parser.add_argument("--steps", type=int, help="the preset's if not given")
    parser.add_argument("--turn", type=int, help="steps; the preset's if not given")
    parser.add_argument("--change", nargs="*", default=[], metavar="NAME=VALUE", help="numbers of the preset")
    parser.add_argument("--no-refine", action="store_true", help="cameras as they are")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--lpips-weights", type=Path, help="folder; default: $ADVTEX_LPIPS_WEIGHTS, else the cache")
    parser.add_argument("--results", type=Path, default=RESULTS / "probes", help="folder of the results")
    parsed: argparse.Namespace = parser.parse_args(line)
    return parsed


def play(given: MethodInput, lpips: Lpips, score: Score, results: Results, settings: dict[str, Any]) -> None:
    """One run from the start; a cell per state between two turns."""
    given = started(given)
    maps, preset, start, painted = given.maps[1], given.preset, given.start, given.painted
    assert start is not None
    assert painted is not None
    pairs = pairs_of(given, maps)
    views = ResidentViews(maps, pairs)
    sources = pairs.sources.tolist()
    optimizer = AdversarialOptimizer(
        maps,
        pairs,
        start[maps.slot_map >= 0],
        fitted(preset, maps, start),
        kind=given.scene.kind,
        steps=preset.steps,
        generator=torch.Generator(maps.device).manual_seed(given.config.seed),
        discriminator=PatchDiscriminator(torch.Generator().manual_seed(given.config.seed)).to(maps.device),
    )

    def leave_out(left_out: Tensor) -> None:
        optimizer.sampler.source_count.fill_(views.leave_out(left_out))

    measures: dict[str, Unlikeness] = {"LPIPS": lpips.to(maps.device).maps, "structure": structure_unlikeness}
    motions = start_motions(start, maps, areas=optimizer.preset.areas)
    judges = {
        name: Probes(
            LeftOutCells(maps, painted, measure, areas=optimizer.preset.areas, motions=motions),
            sources,
            leave_out,  # twice the same
            judged_by=name,
            start=start,
            first=preset.pretraining,
            end=preset.steps,
            turn=preset.turn,
            patience=preset.steps,
        )
        for name, measure in measures.items()
    }
    looks = dict.fromkeys(judges, 0.0)
    watch, in_steps = Stopwatch(), 0.0
    step = 0
    while step < preset.steps:
        began = time.monotonic()
        until = judges["LPIPS"].next
        while step < until:
            optimizer.step()
            step += 1
        in_steps += time.monotonic() - began
        for name, probes in judges.items():
            began = time.monotonic()
            probes.reached(step, optimizer.result)
            looks[name] += time.monotonic() - began
        texture = completed(given, dense_texture(maps, optimizer.result).clamp(0, 1))
        found = {f"gain_{name}": probes.turns.gain for name, probes in judges.items()}
        found |= {f"looks_{name}": seconds * step / in_steps for name, seconds in looks.items()}
        results.add({**settings, "step": step}, {"lpips": score(texture), **found}, watch.seconds)


def run(arguments: argparse.Namespace, results: Results, lpips: Lpips) -> None:
    """One run per scan."""
    for name in arguments.synthetic:
        with tempfile.TemporaryDirectory(prefix="advtex-probes-") as folder:
            scan = Path(folder) / "scan"
            make_named_scan(scan, name, views=arguments.views, size=arguments.scan_size, seed=arguments.seed)
            given = _input(arguments, scan, None, Path(folder))
            play(given, lpips, _against_truth(given, scan, lpips), results, _settings(arguments, name, given.preset))
    for scan in arguments.scans:
        with tempfile.TemporaryDirectory(prefix="advtex-probes-") as folder:
            given = _input(arguments, scan, HOLDOUT, Path(folder))
            score = _against_photographs(given, lpips)
            play(given, lpips, score, results, _settings(arguments, scan.stem, given.preset))


def _settings(arguments: argparse.Namespace, scan: str, preset: Preset) -> dict[str, Any]:
    given = {"preset": arguments.preset, "steps": preset.steps, "turn": preset.turn, "seed": arguments.seed}
    changed = " ".join(arguments.change)
    return {"scan": scan, "size": arguments.scan_size, "refined": not arguments.no_refine, "changes": changed, **given}


def _input(arguments: argparse.Namespace, scan: Path, holdout: int | None, folder: Path) -> MethodInput:
    device = choose_device(arguments.device)
    config = TextureConfig(
        preset=arguments.preset,
        steps=arguments.steps,
        size=parsed_size(arguments.scan_size),
        holdout=holdout,
        face_budget=arguments.faces,
        device=arguments.device,
        refine=not arguments.no_refine,
        seed=arguments.seed,
    )
    given = prepare(scan, config, folder / "work", device)
    preset = resolve_preset(config)
    preset = dataclasses.replace(preset, turn=arguments.turn or preset.turn, **changes(arguments.change))
    return dataclasses.replace(given, preset=preset)


def _against_truth(given: MethodInput, scan: Path, lpips: Lpips) -> Score:
    truth = load_truth(scan)

    def score(texture: Tensor) -> float:
        found = []
        for camera, image, cover in zip(truth.cameras, truth.images, truth.covers, strict=True):
            render, seen = render_layers(given.atlas, texture, camera, supersample=SUPERSAMPLE)
            found.append(lpips.masked(render, Photograph(image, cover & (seen == 1))))
        return sum(found) / len(found)

    return score


def _against_photographs(given: MethodInput, lpips: Lpips) -> Score:
    views = given.scene.heldout
    return lambda texture: float(score_views(given.atlas, {"": texture}, views, lpips)[""]["lpips"])


def ranks(values: Sequence[float]) -> list[float]:
    """From 1 on; equal values share the mean of theirs."""
    ordered = sorted(values)
    return [ordered.index(value) + (ordered.count(value) + 1) / 2 for value in values]


def rank_correlation(a: Sequence[float], b: Sequence[float]) -> float:
    """Spearman's rho; NaN where one of them is constant."""
    pair = torch.tensor([ranks(a), ranks(b)], dtype=torch.float64)
    return float(torch.corrcoef(pair)[0, 1])


def kept_state(gains: Sequence[float], patience: int) -> tuple[int, int]:
    """Which of the states, the start first, is kept, and at which the game ends."""
    best = 0
    for state, gain in enumerate(gains):
        if gain > gains[best]:
            best = state
        if state - best >= patience:
            return best, state
    return best, len(gains) - 1


def patience_of(settings: dict[str, Any]) -> int:
    """Turns of the run's length that have as many steps as the preset's patience."""
    preset = PRESETS[settings["preset"]]
    return max(1, round(preset.patience * preset.turn * settings["steps"] / preset.steps / settings["turn"]))


def report(arguments: argparse.Namespace, results: Results) -> None:
    """probes.md: what is kept by each measure, and a table of states per run."""
    runs = dict[str, list[dict[str, Any]]]()
    for cell in results.cells:
        settings = cell["settings"]
        cameras = "" if settings["refined"] else ", cameras as they are"
        changed = f", {settings['changes']}" if settings["changes"] else ""
        title = f"{settings['scan']}, {settings['size']}, {settings['preset']}, {settings['steps']} steps in turns of"
        runs.setdefault(f"{title} {settings['turn']}, seed {settings['seed']}{cameras}{changed}", []).append(cell)
    kept, body = [], ""
    for title, cells in runs.items():
        patience = patience_of(cells[0]["settings"])
        truth = [cell["scores"]["lpips"] for cell in cells]
        best = min(truth)
        for name in MEASURES:
            gains = [cell["scores"][f"gain_{name}"] for cell in cells]
            state, end = kept_state(gains, patience)
            steps = [cells[index]["settings"]["step"] for index in (state, end, truth.index(best))]
            looks = cells[end]["scores"][f"looks_{name}"]
            rho = rank_correlation(gains, [-value for value in truth])
            kept.append([title, name, rho, *steps, truth[0], truth[state], best, truth[-1], f"{looks:.0f}"])
        head = ["step", "LPIPS held out", *(f"gain, {name}" for name in MEASURES)]
        lines = [
            [cell["settings"]["step"], f"{cell['scores']['lpips']:.4f}"]
            + [f"{cell['scores'][f'gain_{name}']:+.4f}" for name in MEASURES]
            for cell in cells
        ]
        body += f"\n## {title}\n\n{markdown_table(head, lines)}"
    head = [
        "run",
        "judged by",
        "rho",
        "kept",
        "ended",
        "best",
        "LPIPS of the start",
        "of what is kept",
        "of the best",
        "of the last",
        "looks, in steps",
    ]
    table = markdown_table(head, [[f"{cell:.4f}" if isinstance(cell, float) else cell for cell in row] for row in kept])
    told = (
        "The patience is as many turns as have the preset's steps of it. Kept, ended and best are steps; the start is"
        " that at the end of the pretraining.\n\n"
    )
    write_report(arguments.results / "probes.md", "Views left out by turns", results.cells, f"{told}{table}{body}")


def main(line: list[str] | None = None) -> None:
    arguments = arguments_of(line)
    results = Results(arguments.results / "probes.json")
    run(arguments, results, needed_lpips(arguments.lpips_weights))
    report(arguments, results)


if __name__ == "__main__":
    main()

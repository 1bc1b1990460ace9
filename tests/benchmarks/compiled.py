"""What torch.compile does for a step: its parts compiled, one at a time, side by side with the plain step in one run.

    python tests/benchmarks/compiled.py [--device auto] [--sizes 320x240 640x480] [--presets paper standard]

Writes compiled.md below --results. The forms take turns, ROUNDS times STEPS each. `first` is the first step of each
form, with compilation. Every step updates both players. A form that cannot be compiled says why.
"""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import torch
from harness import RESULTS, markdown_table

from advtex_engine.adversarial.optimizer import AdversarialOptimizer
from advtex_engine.bench.run import full_optimizer
from advtex_engine.bench.scene import made_scene
from advtex_engine.core.config import PRESETS
from advtex_engine.render.pairs import Pairs, related_pairs
from advtex_engine.render.view_maps import ViewMaps, build_view_maps
from advtex_engine.runtime.devices import choose_device, wait_for
from advtex_engine.runtime.files import write_atomically

FACES, VIEWS = 20_000, 16
ROUNDS, STEPS = 8, 5
HEADER = ["size", "preset", "compiled", "first, s", "step, ms", "least", "times the plain one"]


def _nothing(_: AdversarialOptimizer) -> None:
    """The plain step."""


def _draw(optimizer: AdversarialOptimizer) -> None:
    draw = torch.compile(optimizer.operations.draw)
    optimizer.operations = dataclasses.replace(optimizer.operations, draw=draw)


def _examine(optimizer: AdversarialOptimizer) -> None:
    optimizer.discriminator.examine = torch.compile(optimizer.discriminator.examine)  # type: ignore[method-assign]


def _play(optimizer: AdversarialOptimizer) -> None:
    optimizer.play = torch.compile(optimizer.play)  # type: ignore[method-assign]


FORMS: dict[str, Callable[[AdversarialOptimizer], None]] = {
    "nothing": _nothing,
    "draw and reproject": _draw,
    "the discriminator": _examine,
    "render, losses and the discriminator": _play,
}


def compare(maps: ViewMaps, pairs: Pairs, preset: str) -> list[list[object]]:
    """A row per form, without size and preset."""
    optimizers, firsts, failed = dict[str, AdversarialOptimizer](), dict[str, float](), list[list[object]]()
    for name, form in FORMS.items():
        torch.compiler.reset()
        optimizer = full_optimizer(maps, pairs, PRESETS[preset])
        form(optimizer)
        try:
            firsts[name] = _seconds(optimizer)
            _seconds(optimizer)
        except Exception as error:
            failed.append([name, f"failed: {str(error).splitlines()[0][:100]}", "-", "-", "-"])
        else:
            optimizers[name] = optimizer
    times: dict[str, list[float]] = {name: [] for name in optimizers}
    for _ in range(ROUNDS):
        for name, optimizer in optimizers.items():
            times[name] += [_seconds(optimizer) for _ in range(STEPS)]
    medians = {name: sorted(taken)[len(taken) // 2] for name, taken in times.items()}
    rows: list[list[object]] = [
        [
            name,
            f"{firsts[name]:.1f}",
            f"{1e3 * medians[name]:.1f}",
            f"{1e3 * min(times[name]):.1f}",
            f"{medians[name] / medians['nothing']:.2f}",
        ]
        for name in optimizers
    ]
    return rows + failed


def _seconds(optimizer: AdversarialOptimizer) -> float:
    wait_for(optimizer.device)
    started = time.perf_counter()
    optimizer.step()
    wait_for(optimizer.device)
    return time.perf_counter() - started


def main(line: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--sizes", nargs="+", default=["320x240", "640x480"])
    parser.add_argument("--presets", nargs="+", default=["paper", "standard"])
    parser.add_argument("--results", type=Path, default=RESULTS / "compiled")
    arguments = parser.parse_args(line)
    os.environ["TORCHINDUCTOR_CACHE_DIR"] = tempfile.mkdtemp()  # else `first` tells what an earlier run left
    device, load = choose_device(arguments.device), os.getloadavg()[0]
    rows = list[list[object]]()
    for size in arguments.sizes:
        width, height = map(int, size.split("x"))
        scene, atlas = made_scene(FACES, VIEWS, width, height)
        mesh = dataclasses.replace(atlas.mesh, **{name: part.to(device) for name, part in vars(atlas.mesh).items()})
        maps = build_view_maps(dataclasses.replace(atlas, mesh=mesh), scene.views, scene.kind)
        pairs = related_pairs(maps, scene.kind, PRESETS["paper"].max_pair_angle, PRESETS["paper"].min_pair_overlap)
        for preset in arguments.presets:
            rows += [[size, preset, *row] for row in compare(maps, pairs, preset)]
            print(markdown_table(HEADER, rows[-len(FORMS) :]), flush=True)
    name = "CPU" if device.type == "cpu" else torch.cuda.get_device_name(device)
    day, threads = datetime.datetime.now(datetime.UTC), torch.get_num_threads()
    told = f"{day:%Y-%m-%d}, {name}, {threads} threads, load {load:.1f} at the beginning, torch {torch.__version__}"
    sizes, presets = " ".join(arguments.sizes), " ".join(arguments.presets)
    command = f"python tests/benchmarks/compiled.py --sizes {sizes} --presets {presets}"
    text = f"# torch.compile\n\n{told}, by\n\n    {command}\n\n" + markdown_table(HEADER, rows)
    arguments.results.mkdir(parents=True, exist_ok=True)
    write_atomically(arguments.results / "compiled.md", text.encode())


if __name__ == "__main__":
    main()

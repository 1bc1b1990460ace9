"""Runs `advtex-engine bench` for sizes and presets and keeps a row for each in results/bench/.

    python tests/benchmarks/bench.py [--device auto] [--sizes 320x240 640x480] [--presets paper full standard]

Writes bench.json, one cell per run with all that the bench said, and bench.md: a table of steps, and for the newest run
of each device and size its parts and stages beside their floors. Each row says the date, the device, the load of the
machine when it began and the command. Runs add to what is there. Devices that were asked for and never measured keep
an empty row.
"""

from __future__ import annotations

import argparse
import datetime
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from harness import RESULTS, markdown_table

from advtex_engine.runtime.files import write_atomically

WANTED = ("NVIDIA H200",)
"""Devices that figures are promised for: without one at hand, their rows stay empty."""
HEADER = ["date", "device", "load", "views", "preset", "step, ms", "least", "floor", "ratio", "steps/s", "GFLOP/s"]

Cell = dict[str, Any]


def run(device: str, size: str, preset: str, views: int, faces: int) -> Cell:
    """One run of the bench in a process of its own, as anyone would start it."""
    width, height = size.split("x")
    options = ["--device", device, "--width", width, "--height", height, "--preset", preset]
    options += ["--views", str(views), "--faces", str(faces), "--json"]
    command = [sys.executable, "-m", "advtex_engine", "bench", *options]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    day = datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M UTC")
    return {"date": day, "command": " ".join(["advtex-engine", "bench", *options]), "result": json.loads(done.stdout)}


def add(path: Path, cell: Cell) -> list[Cell]:
    """All cells of the file with this one, which is kept at once."""
    cells: list[Cell] = json.loads(path.read_text())["cells"] if path.exists() else []
    cells.append(cell)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, json.dumps({"cells": cells}, indent=1).encode() + b"\n")
    return cells


def device_of(result: Cell) -> str:
    """As the tables name it."""
    threads = result["threads"]
    named = f"CPU, {threads} thread{'s' * (threads != 1)}" if result["device"] == "cpu" else result["device"]
    return f"{named}, {result['precision']}"


def page(cells: Sequence[Cell]) -> str:
    """bench.md."""
    rows = []
    for cell in cells:
        result = cell["result"]
        figures = [result["step_ms"], result["step_ms_least"], result["floor_ms"], result["ratio"]]
        shape = f"{result['width']}x{result['height']}, {result['views']}"
        rates = [f"{result['steps_per_second']:.4g}", f"{result['gflops_per_second']:.4g}"]
        told = [cell["date"], device_of(result), f"{result['load']:.1f}", shape, result["preset"]]
        rows.append([*told, *(f"{figure:.4g}" for figure in figures), *rates])
    measured = {cell["result"]["device"] for cell in cells}
    missing = [name for name in WANTED if name not in measured]
    rows += [["-", name, *["not measured"] * (len(HEADER) - 2)] for name in missing]
    introduction = INTRODUCTION + (NOT_AT_HAND.format(" and no ".join(missing)) if missing else "")
    text = "# Steps and stages on devices\n\n" + introduction + "\n" + markdown_table(HEADER, rows)
    newest = {(device_of(cell["result"]), cell["result"]["width"], cell["result"]["preset"]): cell for cell in cells}
    for cell in newest.values():
        text += details(cell)
    return text


INTRODUCTION = """\
Floors: bytes over the speed of a large copy plus operations over that of a large matrix product, both measured in the
same run (`advtex_engine/bench/counts.py` says what is counted). Load: of the whole machine, in the minute before the
run; where it is near the number of cores or above, other work took its share, and the figures say little but the
ratios within one run. On a CPU nothing is uploaded. On a GPU parts are timed by events while the step waits in the
device's queue, so that they are kernels and not launches.
"""


NOT_AT_HAND = """
**No idle {} was at hand: these rows are empty.** What runs on one is tested without it: kernels through
Triton's interpreter and compiled for sm_80 and sm_90, capture and streams by their order alone.
"""


def details(cell: Cell) -> str:
    """Parts and stages of one run."""
    result = cell["result"]
    rows: list[list[object]] = []
    for kind in ("parts", "stages"):
        for name, row in result[kind].items():
            figures = ["left out"] if "skipped" in row else [f"{row['ms']:.4g}"]
            figures += [f"{row[key]:.4g}" if key in row else "-" for key in ("gflop", "mb", "floor_ms", "ratio")]
            rows.append([name, *figures])
    title = f"{device_of(result)}, {result['width']}x{result['height']}, preset {result['preset']}"
    limits = f"{result['product_gflops_per_second']} GFLOP/s, {result['copy_gb_per_second']} GB/s"
    scene = (
        f"{result['views']} views, {result['faces']:,} faces, texture {result['texture']}², {result['texels']:,} texels"
    )
    made = f"{cell['date']}, load {result['load']}; {limits}; {scene}\n\n    {cell['command']}\n\n"
    text = f"\n## {title}\n\n{made}" + markdown_table(["", "ms", "GFLOP", "MB", "floor, ms", "ratio"], rows)
    profile = result.get("profile")  # runs before it was taken have none
    if profile is None:
        return text
    share = profile["busy_ms"] / result["step_ms"]
    said = f"\nOperations of a step, by torch's profiler ({profile['busy_ms']} ms, {share:.2f} of the step above):\n\n"
    operations = [
        [f"`{row['name']}`", *(f"{row[key]:.4g}" for key in ("ms", "calls", "share"))] for row in profile["operations"]
    ]
    return text + said + markdown_table(["", "ms", "calls", "share"], operations)


def main(line: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--sizes", nargs="+", default=["320x240", "640x480"])
    parser.add_argument("--presets", nargs="+", default=["paper", "full", "standard"])
    parser.add_argument("--views", type=int, default=16)
    parser.add_argument("--faces", type=int, default=80_000)
    parser.add_argument("--results", type=Path, default=RESULTS / "bench")
    arguments = parser.parse_args(line)
    for size in arguments.sizes:
        for preset in arguments.presets:
            cell = run(arguments.device, size, preset, arguments.views, arguments.faces)
            cells = add(arguments.results / "bench.json", cell)
            write_atomically(arguments.results / "bench.md", page(cells).encode())
            result = cell["result"]
            print(f"{size} {preset}: {result['step_ms']:.1f} ms, {result['ratio']:.1f} times the floor", flush=True)


if __name__ == "__main__":
    main()

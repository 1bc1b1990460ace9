"""What each error of real scans costs by itself, and all of them together.

    python tests/benchmarks/real_errors.py [--scenes room object] [--errors all blur ...] [--methods view_selection l1]

Scans as `advtex-engine synthesize --real` makes them, with one error at a time; errors of depth are seen by the mesh
that is fused, so they come with it. LPIPS against the truth from the true poses, with the tone put right as well, and
from the poses that the tracker would have found for the same views, which drift as the mesh does; where the mesh has
holes, nothing is scored. Cameras are refined if asked for. Several --seeds, each another room, path and tracker: by
what a refinement just takes or leaves, one of them alone is off by a tenth.

Writes real_errors.json (one cell per scene, error, method and seed) and real_errors.md below --results, and per scene
and method a picture of the truth beside the textures of the first seed. Stopped and run again, it goes on with the
cells that are missing.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import tempfile
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from harness import (
    Results,
    Stopwatch,
    Truth,
    common_arguments,
    configuration,
    load_truth,
    markdown_table,
    mean_of,
    moved,
    needed_lpips,
    parsed_size,
    prepare,
    run_method,
    write_report,
)
from torch import Tensor

from advtex_engine.core.scene import Atlas
from advtex_engine.metrics.budget import corrected_tone
from advtex_engine.metrics.evaluate import Comparison, mean_scores, score
from advtex_engine.metrics.image_metrics import METRICS
from advtex_engine.metrics.lpips import Lpips
from advtex_engine.metrics.photograph import Photograph
from advtex_engine.render.render_view import render_layers, render_view
from advtex_engine.runtime.devices import choose_device
from advtex_engine.synthetic.camera import Errors
from advtex_engine.synthetic.files import TRUTH, write_png
from advtex_engine.synthetic.real import synthesize_real
from advtex_engine.synthetic.scan import SUPERSAMPLE

NONE = Errors.none()
ALONE = [field.name for field in dataclasses.fields(Errors) if field.name != "depth"]
ROWS: dict[str, Errors] = {
    "none": NONE,
    "all": Errors(),
    **{name: dataclasses.replace(NONE, **{name: True}) for name in ALONE},
    "fused, depth": dataclasses.replace(NONE, fused=True, depth=True),
    "fused, drift": dataclasses.replace(NONE, fused=True, drift=True),
}
SCORES = {
    "lpips": "LPIPS",
    "lpips_toned": "tone corrected",
    "lpips_tracked": "tracker's poses",
    "gradient_ratio": "gradient ratio",
    "coverage": "coverage",
}
SHOWN_VIEW = 4


def arguments_of(line: list[str] | None = None) -> argparse.Namespace:
    parser = common_arguments("real_errors", __doc__)
    parser.add_argument("--scenes", nargs="+", default=["room"], choices=["room", "object"])
    parser.add_argument("--sensor", default="structured", choices=["structured", "lidar"])
    parser.add_argument("--errors", nargs="+", default=list(ROWS), choices=ROWS)
    parser.add_argument("--methods", nargs="+", default=["view_selection_no_descent", "view_selection"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parsed: argparse.Namespace = parser.parse_args(line)
    return parsed


def settings_of(arguments: argparse.Namespace, scene: str, errors: str, method: str, seed: int) -> dict[str, Any]:
    """What a cell is found by."""
    shared = {name: getattr(arguments, name) for name in ("sensor", "views", "size", "preset", "faces", "refine")}
    return {"scene": scene, "errors": errors, "method": method, "scan_seed": seed, **shared}


def tracked(scan: Path, truth: Truth) -> Truth:
    """The same pictures of the truth, for renders from where the tracker would have placed the cameras."""
    frames = json.loads((scan / "truth" / "scan.json").read_text())["frames"]
    matrices = [torch.from_numpy(np.linalg.inv(np.array(frame["camera_to_world"]))) for frame in frames]
    cameras = [
        dataclasses.replace(camera, world_to_camera=matrix)
        for camera, matrix in zip(truth.cameras, matrices, strict=True)
    ]
    return dataclasses.replace(truth, cameras=cameras)


def fill(arguments: argparse.Namespace, results: Results, lpips: Lpips) -> None:
    """Runs every cell that is not in the results yet."""
    width, height = parsed_size(arguments.size)
    for scene, errors, seed in product(arguments.scenes, arguments.errors, arguments.seeds):
        settings = {method: settings_of(arguments, scene, errors, method, seed) for method in arguments.methods}
        if all(results.find(cell) for cell in settings.values()):
            continue
        with tempfile.TemporaryDirectory(prefix="advtex-real-errors-") as folder:
            scan = Path(folder) / "scan"
            synthesize_real(
                scan,
                scene=scene,
                sensor=arguments.sensor,
                views=arguments.views,
                width=width,
                height=height,
                seed=seed,
                errors=ROWS[errors],
            )
            for method, cell in settings.items():
                if results.find(cell) is None:
                    shown = seed == arguments.seeds[0]
                    picture = arguments.results / f"{scene}_{method}_{errors.replace(', ', '_')}.png" if shown else None
                    _cell(arguments, results, lpips, scan, cell, picture)


def _cell(
    arguments: argparse.Namespace,
    results: Results,
    lpips: Lpips,
    scan: Path,
    cell: dict[str, Any],
    picture: Path | None,
) -> None:
    device = choose_device(arguments.device)
    watch = Stopwatch()
    given = prepare(scan, configuration(arguments, cell["method"]), scan.parent / "work", device)
    texture = run_method(given, cell["method"])
    seconds = watch.seconds
    truth = load_truth(scan)
    seen = tracked(scan, truth)
    scores = _scores(given.atlas, texture, truth, lpips)
    scores["lpips_tracked"] = _scores(given.atlas, texture, seen, lpips)["lpips"]
    told = json.loads((scan / TRUTH).read_text())["frames"]
    scores["blur_pixels"] = float(np.median([frame["blur_pixels"] for frame in told]))
    results.add(cell, scores, seconds)
    if picture is None:
        return
    picture.parent.mkdir(parents=True, exist_ok=True)
    render = render_view(given.atlas, texture, seen.cameras[SHOWN_VIEW])
    shown = torch.cat((truth.images[SHOWN_VIEW], render), 1)
    write_png(picture, (255 * shown).round().to(torch.uint8).numpy())


def _scores(atlas: Atlas, texture: Tensor, truth: Truth, lpips: Lpips) -> dict[str, float]:
    """Means over the held-out views, of pixels where both the model and the true scene are; and how many these are."""
    atlas = dataclasses.replace(atlas, mesh=moved(atlas.mesh, torch.device("cpu")))
    rows, shares, toned = [], [], []
    for camera, image, cover in zip(truth.cameras, truth.images, truth.covers, strict=True):
        render, seen = render_layers(atlas, texture, camera, supersample=SUPERSAMPLE)
        mask = cover & (seen == 1)
        shown = torch.where(mask[..., None], render, image)
        rows.append(score(Comparison("", image, shown, mask, mask), lpips, METRICS))
        shares.append(float(mask.sum() / cover.sum()))
        toned.append(lpips.masked(corrected_tone(shown, image, mask), Photograph(image, mask)))
    means = mean_scores([{"view": "", **row} for row in rows])
    mean = {"coverage": sum(shares) / len(shares), "lpips_toned": sum(toned) / len(toned)}
    return {**mean, **{name: means[name] for name in ("lpips", "gradient_ratio")}}


def report(arguments: argparse.Namespace, results: Results) -> None:
    """real_errors.md: a table per scene and method, with a row for each error, the mean of its seeds."""
    body, cells = "", list[dict[str, Any]]()
    for scene in arguments.scenes:
        for method in arguments.methods:
            rows = []
            for errors in ROWS:
                settings = [settings_of(arguments, scene, errors, method, seed) for seed in arguments.seeds]
                found = [cell for cell in map(results.find, settings) if cell is not None]
                if found:
                    cells += found
                    rows.append([errors, *(mean_of(found, name) for name in SCORES)])
            body += f"\n## {scene}, {method}\n\n{markdown_table(['errors', *SCORES.values()], rows)}"
    write_report(arguments.results / "real_errors.md", "What each error of real scans costs", cells, body)


def main(line: list[str] | None = None) -> None:
    arguments = arguments_of(line)
    results = Results(arguments.results / "real_errors.json")
    fill(arguments, results, needed_lpips(arguments.lpips_weights))
    report(arguments, results)


if __name__ == "__main__":
    main()

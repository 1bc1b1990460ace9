"""What the benchmarks share: scans with known truth through the engine's stages, scores, results that survive a stop.

A benchmark fills a `Results` file cell by cell. Run again with the same arguments it goes on where it was stopped; run
with others, it adds to the file.
"""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import fcntl
import json
import math
import os
import shlex
import statistics
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from advtex_engine.atlas.build import build_atlas, for_photographs
from advtex_engine.core.config import TextureConfig, resolve_preset
from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import Atlas, Camera, DepthFrame, Mesh, View
from advtex_engine.coverage import complete_texture
from advtex_engine.ingest.read import ingest
from advtex_engine.mesh.clean import clean, decimate
from advtex_engine.mesh.models import load_model
from advtex_engine.methods import MethodInput, texture_function
from advtex_engine.methods.adversarial import starting_texture
from advtex_engine.methods.gabor import descended
from advtex_engine.methods.mean import mean_texture
from advtex_engine.methods.selected import selected_start
from advtex_engine.metrics.evaluate import PATCH_METRICS, VIEW_METRICS, Comparison, evaluate, score
from advtex_engine.metrics.lpips import Lpips, WeightsError, load_lpips
from advtex_engine.previews.live import Live
from advtex_engine.refine.run import apply_refinement, refine_scene
from advtex_engine.render.pictures import contact_sheet
from advtex_engine.render.render_view import render_layers, render_view
from advtex_engine.render.view_maps import build_view_maps
from advtex_engine.results.export import export_model
from advtex_engine.runtime.checkpoint import WorkFolder
from advtex_engine.runtime.files import write_atomically
from advtex_engine.selection.toning import tone_views
from advtex_engine.synthetic.scan import SUPERSAMPLE, TRUTH
from advtex_options.methods import known_methods

RESULTS = Path(__file__).parent / "results"
SHOWN_VIEW = 4  # of the held-out ones
OWN_STEPS = ("l1", "view_selection")
"""Methods that take as many steps here as in everybody's runs: until they have settled, passes over all views."""
SCORES = {
    "lpips": "LPIPS",
    "nearest_patch": "nearest patch",
    "nearest_patch_reverse": "nearest patch, truth to texture",
    "s3_difference": "S3 difference",
    "gradient_difference": "gradient difference",
    "gradient_ratio": "gradient ratio",
}
COMPARED_SCORES = {
    "lpips": "LPIPS",
    "lpips_corrected": "corrected LPIPS",
    "displacement_cost": "of it displacement",
    "displacement_pixels": "displacement, pixels",
    "gradient_ratio": "gradient ratio",
    "flat_energy": "energy where flat",
}
"""Of real scans, and of all of them together; corrected: with pose and tone of the held-out views put right."""
SCAN_SCORES = {
    **COMPARED_SCORES,
    "motion_cost": "of it motion of the photographs",
    "lpips_full": "full image",
    "band_error": "band error",
    "s3_ratio": "S3 ratio",
    "nearest_patch": "nearest patch",
    "nearest_patch_reverse": "nearest patch, photo to texture",
    "psnr": "PSNR",
    "coverage": "coverage",
}
"""Of real scans, where there are photographs instead of the truth."""


@dataclasses.dataclass(frozen=True)
class Truth:
    """The true object from the held-out cameras of a synthesized scan: images [H,W,3] in [0,1], where it is [H,W]."""

    cameras: list[Camera]
    images: list[Tensor]
    covers: list[Tensor]


def load_truth(scan: Path) -> Truth:
    """scan: folder that `synthesize` wrote."""
    told = json.loads((scan / TRUTH).read_text())
    K = torch.tensor(told["intrinsics_matrix"], dtype=torch.float64)
    atlas, texture = load_model(scan / "truth" / "object.obj")
    cameras = [
        Camera(K, torch.from_numpy(np.linalg.inv(np.array(view["camera_to_world"]))), told["width"], told["height"])
        for view in told["heldout"]
    ]
    layers = [render_layers(atlas, texture, camera, supersample=SUPERSAMPLE) for camera in cameras]
    return Truth(cameras, [color for color, _ in layers], [cover == 1 for _, cover in layers])


def prepare(scan: Path, config: TextureConfig, work: Path, device: torch.device, every: int = 1) -> MethodInput:
    """A scan as methods take it: every `every`-th view, refined where the configuration says so."""
    monitor = Monitor()
    scene = ingest(scan, config, monitor)
    views = scene.views[::every]
    frames = [DepthFrame(view.camera, view.depth) for view in views if view.depth is not None]
    scene = dataclasses.replace(
        scene, views=views, mesh=decimate(clean(scene.mesh), config.face_budget, monitor, frames)
    )
    if config.refines:
        scene = apply_refinement(scene, refine_scene(scene, device, config.seed))
    suited = for_photographs(config, scene.views)
    atlas = build_atlas(scene.mesh, [view.camera for view in scene.views], suited, monitor)
    atlas = dataclasses.replace(atlas, mesh=moved(atlas.mesh, device))
    maps = build_view_maps(atlas, scene.views, scene.kind)
    preset = resolve_preset(config)
    folder = WorkFolder(work, "", monitor)
    live = Live(scene, atlas, monitor)
    return MethodInput(scene, atlas, {1: maps}, {1: mean_texture(maps)}, preset, config, monitor, folder, live)


def moved(mesh: Mesh, device: torch.device) -> Mesh:
    """A mesh with texture coordinates on another device."""
    assert mesh.v_uv is not None
    assert mesh.t_uv_idx is not None
    return Mesh(*(part.to(device) for part in (mesh.v_pos, mesh.t_pos_idx, mesh.v_uv, mesh.t_uv_idx)))


def on_cpu(atlas: Atlas) -> Atlas:
    """Where textures are that `run_method` made, and the held-out views."""
    return dataclasses.replace(atlas, mesh=moved(atlas.mesh, torch.device("cpu")))


def run_method(given: MethodInput, method: str) -> Tensor:
    """The method's texture [H,W,3] on the CPU, from the start: what an earlier method left behind is cleared."""
    given.work.clear()
    given = dataclasses.replace(given, facts={})
    record = known_methods()[method]
    if record.starts_selected:
        preset = dataclasses.replace(given.preset, start="selection", toned=True)
        given = started(dataclasses.replace(given, preset=preset), makes_detail=record.makes_detail)
    elif record.plays_game:
        descends = given.preset.start == "selection" and given.preset.passes > 0
        given = started(given, makes_detail=descends)
        if descends:
            start, _ = descended(given, passes=given.preset.passes, checkpoint="descent")
            given = dataclasses.replace(given, start=start)
    given = dataclasses.replace(given, config=dataclasses.replace(given.config, method=method))
    texture, _ = texture_function(method)(given)
    return completed(given, texture)


def completed(given: MethodInput, texture: Tensor) -> Tensor:
    """The texture [H,W,3], on the CPU, with a guess from the surface where no photograph shows it, as a run ends."""
    touched = given.maps[1].slot_map >= 0
    return complete_texture(given.atlas, texture, touched & given.facts.get("known", touched)).texture.cpu()


def started(given: MethodInput, *, makes_detail: bool = False) -> MethodInput:
    """With the start [H,W,3] in [0,1] that the preset has, and views in its tones if the preset wants that.

    makes_detail: whether a descent follows.
    """
    start, painted = starting_texture(given), None
    if given.preset.start == "selection":
        start, painted = selected_start(given, makes_detail=makes_detail)
    maps = {scale: dataclasses.replace(level, color=level.color.clone()) for scale, level in given.maps.items()}
    if given.preset.toned:
        for level in maps.values():
            tone_views(level, start)
    return dataclasses.replace(given, start=start, painted=painted, maps=maps)


def needed_lpips(folder: Path | None) -> Lpips:
    """LPIPS; ends the program without its weights, since a table without LPIPS says little."""
    try:
        return load_lpips(folder)
    except WeightsError as error:
        raise SystemExit(str(error)) from error


def score_texture(atlas: Atlas, texture: Tensor, truth: Truth, lpips: Lpips) -> dict[str, float]:
    """Means over the held-out views, of pixels where both the model and the true object are; NaN where none has it."""
    atlas = on_cpu(atlas)
    rows = []
    for camera, image, cover in zip(truth.cameras, truth.images, truth.covers, strict=True):
        render, seen = render_layers(atlas, texture, camera, supersample=SUPERSAMPLE)
        mask = cover & (seen == 1)
        shown = torch.where(mask[..., None], render, image)
        row = score(Comparison("", image, shown, mask, mask), lpips, {**VIEW_METRICS, **PATCH_METRICS})
        for name in ("s3", "gradient"):
            ratio = row[f"{name}_ratio"]
            row[f"{name}_difference"] = None if ratio is None else abs(1 - ratio)
        rows.append(row)
    known = {name: [value for row in rows if (value := row[name]) is not None] for name in SCORES}
    return {name: sum(values) / len(values) if values else math.nan for name, values in known.items()}


def score_model(
    given: MethodInput, texture: Tensor, scan: Path, folder: Path, reference: Path | None, weights: Path | None
) -> dict[str, float]:
    """Means over the scan's held-out frames of the model with this texture; it is left in `folder`, with a sheet."""
    folder.mkdir(parents=True, exist_ok=True)
    export_model(folder, on_cpu(given.atlas), texture, up_axis=given.scene.up_axis)
    found = evaluate(
        folder / "model.obj",
        scan,
        size=given.config.size,
        holdout=given.config.holdout,
        reference=reference,
        weights=weights,
        sheet=folder / "sheet.png",
        budget=True,
    )
    scores = {name: value for name in SCAN_SCORES if (value := found.mean[name]) is not None}
    return scores | {"heldout_views": float(found.mean["views"])}


class Results:
    """Cells of a benchmark in a JSON file: each its settings, its scores and how it was made.

    Several processes may fill one file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.cells = self._read()

    def _read(self) -> list[dict[str, Any]]:
        cells: list[dict[str, Any]] = json.loads(self.path.read_text())["cells"] if self.path.exists() else []
        return cells

    def find(self, settings: Mapping[str, Any]) -> dict[str, Any] | None:
        """The cell with exactly these settings."""
        return next((cell for cell in self.cells if cell["settings"] == settings), None)

    def add(
        self, settings: Mapping[str, Any], scores: Mapping[str, float], seconds: float, gpu: str | None = None
    ) -> None:
        """Keeps a cell, in place of one with the same settings, and writes the file, so that a stop loses no more than
        the cell in the making.

        gpu: the name of the one that it was run on.
        """
        day = datetime.datetime.now(datetime.UTC).date().isoformat()
        made = {"date": day, "command": command(), "seconds": round(seconds, 1)} | ({"gpu": gpu} if gpu else {})
        self.path.parent.mkdir(parents=True, exist_ok=True)
        folder = os.open(self.path.parent, os.O_RDONLY)
        try:
            fcntl.flock(folder, fcntl.LOCK_EX)
            others = [cell for cell in self._read() if cell["settings"] != settings]
            self.cells = [*others, {"settings": dict(settings), "scores": dict(scores), **made}]
            write_atomically(self.path, json.dumps({"cells": self.cells}, indent=1).encode() + b"\n")
        finally:
            os.close(folder)
        shown = ", ".join(f"{name} {value:.4g}" for name, value in scores.items())
        print(f"{' '.join(str(value) for value in settings.values())}: {shown}; {seconds:.0f} s", flush=True)


def command() -> str:
    """The command line as one would type it at the top of the repository."""
    script = Path(sys.argv[0])
    shown = Path("tests/benchmarks") / script.name if script.suffix == ".py" else script
    return shlex.join(["python", str(shown), *sys.argv[1:]])


def mean_of(cells: Sequence[Mapping[str, Any]], name: str) -> float:
    """Mean of a score over cells."""
    return sum(float(cell["scores"][name]) for cell in cells) / len(cells)


def shown_mean(cells: Sequence[Mapping[str, Any]], name: str) -> float | str:
    """The same for a table: a dash where a cell lacks the score."""
    return mean_of(cells, name) if all(name in cell["scores"] for cell in cells) else "-"


def geometric_means(
    label: str,
    lines: Mapping[str, Sequence[Mapping[str, Any] | None]],
    scores: Mapping[str, str] = COMPARED_SCORES,
) -> str:
    """A section with scores over scans; empty for one scan. lines: per row its cell of each scan.

    Rows that lack a scan are left out: what is easy would be compared with what is not.
    """
    whole = {name: [cell for cell in cells if cell is not None] for name, cells in lines.items() if all(cells)}
    count = max(map(len, whole.values()), default=0)
    if count < 2:
        return ""
    rows = [[name, *(geometric_mean(cells, score) for score in scores)] for name, cells in whole.items()]
    return f"\n## Geometric mean over {count} scans\n\n{markdown_table([label, *scores.values()], rows)}"


def geometric_mean(cells: Sequence[Mapping[str, Any]], name: str) -> float | str:
    """Of a score over cells, for a table: a dash where a cell lacks it or has none above 0."""
    values = [cell["scores"].get(name, 0.0) for cell in cells]
    return statistics.geometric_mean(values) if min(values) > 0 else "-"


def picture(atlas: Atlas, texture: Tensor, truth: Truth) -> Tensor:
    """The texture [H,W,3] from the held-out place that is shown, [h,w,3] in [0,1]."""
    return render_view(on_cpu(atlas), texture, truth.cameras[SHOWN_VIEW])


def draw(path: Path, scan: Path, truth: Truth, pictures: Mapping[str, Tensor]) -> None:
    """The photograph from the held-out place that is shown, beside the named `picture`s from there."""
    contact_sheet([shown_view(scan, truth)], [list(pictures.values())], tuple(pictures), path)


def shown_view(scan: Path, truth: Truth) -> View:
    """The photograph from the held-out place that is shown."""
    file = sorted((scan / "truth" / "heldout").iterdir())[SHOWN_VIEW]
    return View("held out", truth.cameras[SHOWN_VIEW], torch.from_numpy(cv2.imread(str(file))[..., ::-1].copy()))


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Numbers with three digits behind the point."""
    lines = [head, ["---"] * len(head), *rows]
    return "".join(
        "| " + " | ".join(f"{cell:.3f}" if isinstance(cell, float) else str(cell) for cell in line) + " |\n"
        for line in lines
    )


def write_report(path: Path, title: str, cells: Sequence[Mapping[str, Any]], body: str) -> None:
    """A page of results that says with which commands and when it was made."""
    days = sorted({cell["date"] for cell in cells})
    commands = "".join(f"    {line}\n" for line in dict.fromkeys(cell["command"] for cell in cells))
    hours = sum(cell["seconds"] for cell in cells) / 3600
    span = days[0] if len(days) == 1 else f"{days[0]} to {days[-1]}"
    made = f"{span}, {len(cells)} cells in {hours:.2f} hours, by\n\n{commands}"
    write_atomically(path, f"# {title}\n\n{made}\n{body}".encode())


@dataclasses.dataclass(frozen=True)
class Panel:
    """A plot: its title, the label of the x axis, and per curve its x and y values."""

    title: str
    label: str
    curves: Mapping[str, tuple[Sequence[float], Sequence[float]]]


def plot_grid(path: Path, panels: Sequence[Sequence[Panel]]) -> None:
    """A PNG with rows of panels, all of the same curves."""
    rows, columns = len(panels), len(panels[0])
    figure = Figure(figsize=(4 * columns, 3.2 * rows), layout="tight")
    for row, line in zip(figure.subplots(rows, columns, squeeze=False), panels, strict=True):
        for place, panel in zip(row, line, strict=True):
            for name, (x, y) in panel.curves.items():
                place.plot(x, y, marker="o", markersize=3, label=name)
            place.set_title(panel.title, fontsize=9)
            place.set_xlabel(panel.label, fontsize=8)
            place.tick_params(labelsize=7)
    figure.axes[0].legend(fontsize=6)
    figure.savefig(path, dpi=110)


class Stopwatch:
    """Seconds since it was made."""

    def __init__(self) -> None:
        self.started = time.monotonic()

    @property
    def seconds(self) -> float:
        return time.monotonic() - self.started


def common_arguments(name: str, description: str | None) -> argparse.ArgumentParser:
    """The options of every benchmark on synthesized scans."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, default=60)
    parser.add_argument("--size", default="320x240", help="WIDTHxHEIGHT of the views")
    parser.add_argument(
        "--steps", type=int, default=1000, help=f"of methods that take steps, but {' and '.join(OWN_STEPS)}"
    )
    parser.add_argument("--preset", default="standard")
    parser.add_argument("--faces", type=int, default=20_000)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--refine", action="store_true", help="refine the cameras for every method")
    parser.add_argument("--lpips-weights", type=Path, help="folder; default: $ADVTEX_LPIPS_WEIGHTS, else the cache")
    parser.add_argument("--results", type=Path, default=RESULTS / name, help="folder of the results")
    return parser


def configuration(arguments: argparse.Namespace, method: str) -> TextureConfig:
    """The common options as the engine takes them."""
    return TextureConfig(
        preset=arguments.preset,
        method=method,
        steps=steps_of(method, arguments.steps),
        face_budget=arguments.faces,
        refine=arguments.refine,
        device=arguments.device,
    )


def steps_of(method: str, asked: int | None) -> int | None:
    """asked; None, as many as the method itself takes, for those of OWN_STEPS."""
    return None if method in OWN_STEPS else asked


def parsed_size(text: str) -> tuple[int, int]:
    """ "320x240" -> (320, 240)."""
    width, height = text.split("x")
    return int(width), int(height)

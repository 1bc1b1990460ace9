"""What people carry away: each file of a result, its size, what it costs, and how it looks from held-out places.

    python tests/benchmarks/models.py [SCAN …] [--runs FOLDER] [--judge PROGRAM]

Every scan, and the default synthetic one, is textured once with all words of the option `outputs`; a run that --runs
holds already is taken as it is. The files are read back by programs that others wrote (`models_read.py`) and rendered
at the held-out frames: against the photographs, the same pixels for all files of a scan, and against the OBJ with its
PNG. Writes models.json, models.md, and per scan a picture of the files from one held-out place.

--judge: a program that takes --mesh, --views (a folder with views.json: image, depth in mm, K with pixel centers at
whole numbers, camera-to-world pose), --ref-mesh and --json, and writes {"mean": {"lpips": …}} there.
"""

from __future__ import annotations

import argparse
import datetime
import json
import resource
import subprocess
import tempfile
import threading
import time
import unittest.mock
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh
from harness import RESULTS, Stopwatch, command, markdown_table, needed_lpips, parsed_size, write_report
from models_read import Unread, read_model
from numpy.typing import NDArray
from torch import Tensor

from advtex_engine.core.config import TextureConfig
from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import Scene
from advtex_engine.ingest.read import ingest
from advtex_engine.mesh.models import load_model
from advtex_engine.metrics.evaluate import VIEW_METRICS, compare, mean_scores, score
from advtex_engine.metrics.lpips import Lpips
from advtex_engine.metrics.photograph import Photograph
from advtex_engine.pipeline import texture_scan
from advtex_engine.render.pictures import encode_jpeg, to_bytes
from advtex_engine.render.render_view import render_layers, render_view
from advtex_engine.results.baking import TexturedModel
from advtex_engine.results.export import export_model
from advtex_engine.runtime.files import write_atomically
from advtex_engine.synthetic.scan import synthesize
from advtex_options.outputs import OUTPUTS, kind_and_purpose

HEAD = ("file", "bytes", "faces", "texels a side", "LPIPS", "PSNR", "LPIPS to the OBJ", "LPIPS by the judge", "CPU s")
POLL = 0.005  # seconds
LOSSLESS = "lossless/model.glb"
PANEL, COLUMNS, CAPTION, QUALITY = 224, 4, 18, 72  # of the picture: pixels, panels in a row, pixels, JPEG


@dataclass(frozen=True)
class Run:
    """What a run left in `folder`. told: its report; seconds: of the CPU, by the name of the file that they made."""

    folder: Path
    told: dict[str, Any]
    seconds: dict[str, float]

    @property
    def files(self) -> list[tuple[Path, ...]]:
        """The lines of the table: what is read as one model, the file that is opened first."""
        names = [path.name for path in sorted(self.folder.iterdir()) if kind_and_purpose(path.name)[0] in OUTPUTS]
        obj = sorted(name for name in names if kind_and_purpose(name)[0] == "obj")
        obj.sort(key=lambda name: not name.endswith(".obj"))
        alone = sorted(set(names) - set(obj), key=list(self.seconds).index)
        lines = [obj, *([name] for name in alone), [LOSSLESS]]
        return [tuple(self.folder / name for name in line) for line in lines]


class ExportClock(Monitor):
    """Notes how much time of the CPU has passed in the stage `export` when a file of the result appears."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.seconds, self._ended = folder, dict[str, float](), threading.Event()
        self._thread = threading.Thread(target=self._watch)

    def stage_started(self, stage: str) -> None:
        print(stage, flush=True)
        if stage == "export":
            self._last = _cpu_seconds()
            self._thread.start()

    def stage_finished(self, stage: str, *_: Any) -> None:
        if stage == "export":
            self._ended.set()
            self._thread.join()

    def _watch(self) -> None:
        while True:
            ended = self._ended.wait(POLL)
            for path in sorted(self.folder.iterdir()):
                if path.name not in self.seconds and kind_and_purpose(path.name)[0]:
                    now = _cpu_seconds()
                    self.seconds[path.name], self._last = round(now - self._last, 2), now
            if ended:
                return


def _cpu_seconds() -> float:
    """Of this process and its children that have ended."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def arguments_of(line: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scans", nargs="*", type=Path, help="folders or zip files")
    parser.add_argument("--synthetic", action=argparse.BooleanOptionalAction, default=True, help="the default one too")
    parser.add_argument("--method", default="view_selection")
    parser.add_argument("--size", default="640x480", help="WIDTHxHEIGHT of the views; the synthetic scan keeps its own")
    parser.add_argument("--holdout", type=int, default=8)
    parser.add_argument("--runs", type=Path, help="folder in which runs are kept; default: none is")
    parser.add_argument("--judge", type=Path, help="a program that scores a model file")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--lpips-weights", type=Path, help="folder; default: $ADVTEX_LPIPS_WEIGHTS, else the cache")
    parser.add_argument("--results", type=Path, default=RESULTS / "models", help="folder of the results")
    parsed: argparse.Namespace = parser.parse_args(line)
    return parsed


def textured(scan: Path, config: TextureConfig, folder: Path) -> Run:
    """The run in the folder, which is made unless it was."""
    costs = folder / "seconds.json"
    if not costs.exists():
        clock = ExportClock(folder)
        # A run scores its held-out views beside the export; here that is done later, with others.
        with unittest.mock.patch("advtex_engine.pipeline.heldout_scores", return_value=None):
            texture_scan(scan, folder, config, work=folder / "work", monitor=clock)
        seconds = clock.seconds | {LOSSLESS: lossless(folder)}
        write_atomically(costs, json.dumps(seconds, indent=1).encode())
    told = json.loads((folder / "report.json").read_text())
    return Run(folder, told, json.loads(costs.read_text()))


def lossless(folder: Path) -> float:
    """Writes the GLB of a run as the option of that name has it; -> seconds of the CPU."""
    up_axis = json.loads((folder / "report.json").read_text())["scan"]["up_axis"]
    atlas, texture = load_model(folder / "model.obj")
    target = folder / Path(LOSSLESS).parent
    target.mkdir(exist_ok=True)
    clock = ExportClock(target)
    clock.stage_started("export")
    export_model(target, atlas, texture, up_axis=up_axis, lossless=True)
    clock.stage_finished("export")
    return clock.seconds[Path(LOSSLESS).name]


@dataclass(frozen=True)
class Judge:
    """Another program's LPIPS of model files at a scan's held-out frames, which are written to `folder` for it."""

    program: Path
    folder: Path

    def prepare(self, scene: Scene) -> None:
        self.folder.mkdir()
        views = []
        for view in scene.heldout:
            K, pose = view.camera.K.numpy().copy(), view.camera.world_to_camera.inverse()
            K[:2, 2] -= 0.5
            told = {"image": f"{view.name}.png", "pose": pose.tolist(), "K": K.tolist()}
            cv2.imwrite(str(self.folder / told["image"]), np.ascontiguousarray(view.color.numpy()[..., ::-1]))
            if view.depth is not None:
                told["depth"] = f"{view.name}.depth.png"
                cv2.imwrite(str(self.folder / told["depth"]), (view.depth.numpy() * 1000).round().astype(np.uint16))
            views.append(told)
        (self.folder / "views.json").write_text(json.dumps({"views": views}))
        mesh = scene.mesh
        trimesh.Trimesh(mesh.v_pos.numpy(), mesh.t_pos_idx.numpy(), process=False).export(self.folder / "reference.ply")

    def lpips(self, model: Path) -> float | str:
        """A dash for files that it does not read."""
        scores = self.folder / "scores.json"
        scores.unlink(missing_ok=True)
        if model.suffix == ".glb":
            model = in_scans_world(model, self.folder / "model.glb")
        options = ["--mesh", model, "--views", self.folder, "--ref-mesh", self.folder / "reference.ply"]
        line = [str(word) for word in (self.program, *options, "--json", scores)]
        if model.suffix not in (".obj", ".glb") or subprocess.run(line, capture_output=True).returncode:
            return "-"
        found: float = json.loads(scores.read_text())["mean"]["lpips"]
        return found


def in_scans_world(glb: Path, copy: Path) -> Path:
    """A copy of a GLB without its node's turn to +Y up, which another program would have to guess."""
    data = glb.read_bytes()
    length = int.from_bytes(data[12:16], "little")
    document = json.loads(data[20 : 20 + length])
    for node in document["nodes"]:
        node.pop("rotation", None)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    size = len(data) - length + len(text)
    head = data[:8] + size.to_bytes(4, "little") + len(text).to_bytes(4, "little") + data[16:20]
    copy.write_bytes(head + text + data[20 + length :])
    return copy


def table(run: Run, scene: Scene, lpips: Lpips, judge: Judge | None, sheet: Path) -> list[list[object]]:
    """A line per file, and their picture from the middle one of the held-out places."""
    rows, panels, exact = list[list[object]](), dict[str, Tensor](), list[tuple[Tensor, Tensor]]()
    shown = scene.heldout[len(scene.heldout) // 2]
    panels["photograph"] = shown.color.float() / 255
    for paths in run.files:
        name = str(paths[0].relative_to(run.folder))
        size = sum(path.stat().st_size for path in paths)
        seconds = sum(run.seconds.get(str(path.relative_to(run.folder)), 0.0) for path in paths)
        judged = "-" if judge is None else judge.lpips(paths[0])
        try:
            atlas, texture = read_model(paths[0], scene.up_axis)
        except Unread as reason:
            rows.append([f"`{name}` ({reason})", size, *["-"] * 5, judged, seconds])
            continue
        compared = [compare(atlas, texture, view, scene.mesh) for view in scene.heldout]
        scores = mean_scores([score(one, lpips, VIEW_METRICS) for one in compared if one is not None])
        layers = [render_layers(atlas, texture, view.camera) for view in scene.heldout]
        exact = exact or layers
        pairs = [(one, Photograph(other, there == 1)) for (one, _), (other, there) in zip(layers, exact, strict=True)]
        apart = [lpips.masked(*pair) for pair in pairs if bool(pair[1].mask.any())]
        model = TexturedModel(atlas, texture)
        sides = f"{atlas.width}" if atlas.width == atlas.height else f"{atlas.width} x {atlas.height}"
        looks: list[object] = [scores["lpips"], scores["psnr"], sum(apart) / len(apart)]
        rows.append([f"`{name}`", size, model.faces, sides, *looks, judged, seconds])
        panels[name] = render_view(atlas, texture, shown.camera)
        print(*rows[-1], flush=True)
    write_atomically(sheet, encode_jpeg(_panels(panels), QUALITY))
    return rows


def _panels(pictures: dict[str, Tensor]) -> NDArray[np.uint8]:
    """Pictures [H,W,3] of one size, made smaller, under their names, in rows of COLUMNS."""
    cells = []
    for name, picture in pictures.items():
        height, width, _ = picture.shape
        size = (PANEL, round(PANEL * height / width))
        image = np.pad(
            cv2.resize(to_bytes(picture), size, interpolation=cv2.INTER_AREA), ((CAPTION, 0), (0, 0), (0, 0))
        )
        cells.append(cv2.putText(image, name, (4, 13), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (255, 255, 255), 1, cv2.LINE_AA))
    cells += [np.zeros_like(cells[0])] * (-len(cells) % COLUMNS)
    rows = [np.concatenate(cells[start : start + COLUMNS], 1) for start in range(0, len(cells), COLUMNS)]
    return np.concatenate(rows)


def heading(run: Run) -> str:
    stages = {record["stage"]: record["seconds"] for record in run.told["stages"]}
    options, scan, total = run.told["options"], run.told["scan"], sum(stages.values())
    made = sum(run.seconds[key] for key in run.seconds if key != LOSSLESS)
    return (
        f"{scan['views']} views of {scan['width']} x {scan['height']}, method {options['method']}, "
        f"{len(scan['heldout'])} held out. The run took {total:.0f} s, of it the stage that writes all files "
        f"{stages['export']:.1f} s ({stages['export'] / total:.1%}), {made:.1f} s of the CPU."
    )


def section(cell: dict[str, Any]) -> str:
    name, lines = cell["scan"], markdown_table(HEAD, [list(row.values()) for row in cell["rows"]])
    return f"\n## {name}\n\n{cell['head']}\n\n{lines}\n![from one held-out place]({name}.jpg)\n"


def main(line: list[str] | None = None) -> None:
    arguments = arguments_of(line)
    lpips = needed_lpips(arguments.lpips_weights)
    arguments.results.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="advtex-models-") as scratch:
        scans = {scan.stem: scan for scan in arguments.scans}
        if arguments.synthetic:
            scans["synthetic"] = Path(scratch) / "synthetic"
            synthesize(scans["synthetic"])
        for name, scan in scans.items():
            keep(arguments.results, cell_of(arguments, name, scan, Path(scratch), lpips))


def cell_of(arguments: argparse.Namespace, name: str, scan: Path, scratch: Path, lpips: Lpips) -> dict[str, Any]:
    watch = Stopwatch()
    config = TextureConfig(
        method=arguments.method,
        size=None if name == "synthetic" else parsed_size(arguments.size),
        holdout=arguments.holdout,
        outputs=",".join(OUTPUTS),
        device=arguments.device,
    )
    run = textured(scan, config, (arguments.runs or scratch / "runs") / name)
    scene = ingest(scan, config, Monitor())
    judge = Judge(arguments.judge, scratch / f"{name}_views") if arguments.judge else None
    if judge:
        judge.prepare(scene)
    rows = table(run, scene, lpips, judge, arguments.results / f"{name}.jpg")
    day = datetime.datetime.now(datetime.UTC).date().isoformat()
    told = {"date": day, "command": command(), "seconds": round(watch.seconds, 1)}
    return {"scan": name, "head": heading(run), "rows": [dict(zip(HEAD, row, strict=True)) for row in rows], **told}


def keep(results: Path, cell: dict[str, Any]) -> None:
    """The scan's cell in models.json in place of an older one, and models.md written anew."""
    path = results / "models.json"
    cells = json.loads(path.read_text())["cells"] if path.exists() else []
    cells = [one for one in cells if one["scan"] != cell["scan"]] + [cell]
    write_atomically(path, json.dumps({"cells": cells}, indent=1).encode() + b"\n")
    body = "".join(section(one) for one in cells)
    write_report(results / "models.md", "Files of a result", cells, body)


if __name__ == "__main__":
    main()

"""What the discriminator is shown as real, against the source itself: where the game leads if it ends in a draw.

    python tests/benchmarks/examples.py [SCAN …] [--errors cameras geometry] [--level 2.75] [--pairs 40]

An auxiliary image that is warped into the source view has the errors of two cameras and of the mesh, another exposure
and its own noise. A texture that cannot be told from it is as far from the photographs as it is. So the LPIPS of these
examples says what the adversarial loss asks for: where the texture of least L1 distance is nearer, a discriminator that
knows all leads away from the photographs. Measured over pixels that the auxiliary view sees, with cameras as they came,
on the study's scans (`study.py`) and on scans of one's own; `l1` and `view_selection_no_descent` at the same pixels
stand beside them. "Toned" examples have the source's mean color. Pairs are also parted by whether the preset `paper`
keeps them, and into halves by overlap.

Writes examples.json (one cell per scan) and examples.md below --results; goes on with missing scans when started again.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from harness import (
    RESULTS,
    Results,
    Stopwatch,
    markdown_table,
    needed_lpips,
    parsed_size,
    prepare,
    run_method,
    write_report,
)
from paper import FACES, HOLDOUT, SCAN_FACES, SCAN_SIZE, SIZE, TURN, VIEWS
from study import make_scan
from torch import Tensor

from advtex_engine.core.config import PAPER, TextureConfig
from advtex_engine.methods import MethodInput
from advtex_engine.metrics.evaluate import Comparison, score
from advtex_engine.metrics.image_metrics import gradient_ratio
from advtex_engine.metrics.lpips import Lpips
from advtex_engine.pipeline import choose_device
from advtex_engine.render.pairs import overlaps, related_pairs
from advtex_engine.render.reproject import reproject, unproject_pixels
from advtex_engine.render.texture import bilinear_footprint, decode_uv, sample_texels
from advtex_engine.render.view_maps import DEPTH_TOLERANCE, ViewMaps

TEXTURES = ("l1", "view_selection_no_descent")
KEPT = {"kept": True, "left out": False}
PARTS = ("kept", "left out", "less overlap", "more overlap")
LEAST_PIXELS = 3_000
"""Pairs of which the auxiliary view sees less are left out."""


def arguments_of(line: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scans", nargs="*", type=Path, help="folders or zip files")
    parser.add_argument("--errors", nargs="*", default=["cameras", "geometry"], choices=["cameras", "geometry"])
    parser.add_argument("--level", type=float, default=2.75, help="n of the error's size")
    parser.add_argument("--scan-size", default=SCAN_SIZE, help="WIDTHxHEIGHT of the views of one's own scans")
    parser.add_argument("--pairs", type=int, default=40, help="drawn at random, the view itself left out")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--lpips-weights", type=Path, help="folder; default: $ADVTEX_LPIPS_WEIGHTS, else the cache")
    parser.add_argument("--results", type=Path, default=RESULTS / "examples", help="folder of the results")
    parsed: argparse.Namespace = parser.parse_args(line)
    return parsed


def drawn_pairs(given: MethodInput, count: int) -> Iterator[tuple[int, int, float, bool]]:
    """Source, auxiliary view, the share of the source that it sees, and whether the preset `paper` keeps the pair."""
    maps, kind = given.maps[1], given.scene.kind
    every, kept = (
        related_pairs(maps, kind, PAPER.max_pair_angle, PAPER.min_pair_overlap, nearest)
        for nearest in (1.0, PAPER.nearest_share)
    )
    share = overlaps(maps, kind, 180.0, range(maps.count))
    rows = [row[:number].tolist() for row, number in zip(kept.auxiliary, kept.count, strict=True)]
    others = [(source, k) for source in range(maps.count) for k in range(1, int(every.count[source]))]
    order = torch.randperm(len(others), generator=torch.Generator().manual_seed(0)).tolist()
    for source, k in (others[index] for index in order[:count]):
        auxiliary = int(every.auxiliary[source, k])
        yield source, auxiliary, float(share[source, auxiliary]), auxiliary in rows[source]


def example(maps: ViewMaps, kind: str, source: int, auxiliary: int) -> tuple[Tensor, Tensor]:
    """The auxiliary image warped into the source view [H,W,3] in [0,1], and where it shows something [H,W] bool."""
    x, y = torch.arange(maps.width) + 0.5, torch.arange(maps.height) + 0.5
    xy = torch.stack((x.repeat(maps.height), y.repeat_interleave(maps.width)), 1).to(maps.device)
    depth = maps.depth[source].to(torch.float32)
    points = unproject_pixels(xy, depth, maps.intrinsics[source])
    relative = maps.world_to_camera[auxiliary] @ torch.linalg.inv(maps.world_to_camera[source])
    which = torch.tensor(auxiliary, device=maps.device)
    color, visible = reproject(points, relative[:3].to(torch.float32), maps, which, DEPTH_TOLERANCE[kind])
    shape = (maps.height, maps.width)
    return (color / 255).view(*shape, 3), (visible & (depth > 0)).view(shape)


def rendered(maps: ViewMaps, texture: Tensor, view: int) -> Tensor:
    """A dense texture seen by a view as the optimization samples it, [H,W,3]."""
    height, width = texture.shape[:2]
    size = torch.tensor([width, height], dtype=torch.float32, device=maps.device)
    texels, weights = bilinear_footprint(decode_uv(maps.uv[view]) * size, width, height)
    return sample_texels(texture.view(-1, 3), texels, weights).view(maps.height, maps.width, 3)


def measured(given: MethodInput, textures: dict[str, Tensor], count: int, lpips: Lpips) -> dict[str, float]:
    """Means over the pairs: LPIPS and gradient ratio of examples and textures against the sources."""
    maps, rows = given.maps[1], list[dict[str, float]]()
    for source, auxiliary, share, kept in drawn_pairs(given, count):
        real, seen = example(maps, given.scene.kind, source, auxiliary)
        if int(seen.sum()) < LEAST_PIXELS:
            continue
        photo = maps.color[source].view_as(real) / 255
        toned = (real * (photo[seen].mean(0) / real[seen].mean(0).clamp(min=1e-3))).clamp(0, 1)
        shown = {"real": real, "toned": toned} | {name: rendered(maps, one, source) for name, one in textures.items()}
        row = {"overlap": share, "kept": float(kept)}
        for name, image in shown.items():
            whole = torch.where(seen[..., None], image, photo).cpu()
            comparison = Comparison("", photo.cpu(), whole, seen.cpu(), seen.cpu())
            found = score(comparison, lpips, {"gradient_ratio": gradient_ratio})
            row |= {f"{name} {key}": float(found[key] or 0.0) for key in ("lpips", "gradient_ratio")}
        rows.append(row)
    rows.sort(key=lambda row: row["overlap"])
    means = {key: sum(row[key] for row in rows) / len(rows) for key in rows[0]}
    half = len(rows) // 2
    parts = {"less overlap": rows[:half], "more overlap": rows[half:]}
    parts |= {name: [row for row in rows if bool(row["kept"]) == wanted] for name, wanted in KEPT.items()}
    for name, part in parts.items():
        real, of_l1 = (sum(row[key] for row in part) for key in ("real lpips", "l1 lpips"))
        means |= {name: real / of_l1} if part else {}
    return means | {"pairs": float(len(rows))}


def fill(arguments: argparse.Namespace, results: Results, lpips: Lpips) -> None:
    """Measures every scan that is not in the results yet."""
    device = choose_device(arguments.device)
    study = [{"scan": f"{errors} {arguments.level:g}", "size": SIZE, "errors": errors} for errors in arguments.errors]
    own = {scan.stem: scan for scan in arguments.scans}
    for settings in (*study, *({"scan": name, "size": arguments.scan_size} for name in own)):
        settings = {**settings, "pairs": arguments.pairs}
        if results.find(settings) is not None:
            continue
        watch = Stopwatch()
        with tempfile.TemporaryDirectory(prefix="advtex-examples-") as folder:
            scan, config = own.get(settings["scan"]), TextureConfig(preset="paper", face_budget=FACES)
            if scan is None:
                scan = Path(folder) / "scan"
                turn = TURN if settings["errors"] == "cameras" else 0.0
                more = {"level": arguments.level, "views": VIEWS, "model": 0, "turn": turn}
                make_scan(scan, {**settings, **more})
            else:
                size = parsed_size(settings["size"])
                config = TextureConfig(preset="paper", size=size, holdout=HOLDOUT, face_budget=SCAN_FACES)
            given = prepare(scan, config, Path(folder) / "work", device)
            textures = {name: run_method(_of(given, name), name).to(device) for name in TEXTURES}
            results.add(settings, measured(given, textures, arguments.pairs, lpips), watch.seconds)


def _of(given: MethodInput, method: str) -> MethodInput:
    return dataclasses.replace(given, config=dataclasses.replace(given.config, method=method))


def report(arguments: argparse.Namespace, results: Results) -> None:
    """examples.md: a row per scan."""
    rows: list[list[Any]] = []
    for cell in results.cells:
        scores = cell["scores"]
        shown: list[object] = [scores[f"{name} lpips"] for name in ("real", "toned", *TEXTURES)]
        shown += [scores[f"{name} gradient_ratio"] for name in ("real", "l1")]
        shown += [scores["real lpips"] / scores["l1 lpips"], *(scores.get(part, "-") for part in PARTS)]
        rows.append([cell["settings"]["scan"], cell["settings"]["size"], *shown])
    head = ["scan", "size", "real", "real, toned", *TEXTURES, "gradients of real", "gradients of l1"]
    head += ["real over l1", *PARTS]
    note = (
        "LPIPS against the source photographs, which `l1` and `view_selection_no_descent` were made of, too. The last"
    )
    note += " five columns are ratios of the real examples' to that of `l1` at the same pixels.\n\n"
    write_report(arguments.results / "examples.md", "Real examples", results.cells, note + markdown_table(head, rows))


def main(line: list[str] | None = None) -> None:
    arguments = arguments_of(line)
    results = Results(arguments.results / "examples.json")
    fill(arguments, results, needed_lpips(arguments.lpips_weights))
    report(arguments, results)


if __name__ == "__main__":
    main()

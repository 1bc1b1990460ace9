"""The paper's 2D case (section 4.1): how near the patches of the optimized texture come to those of the truth.

    python tests/benchmarks/planar.py [--size 128] [--shift 8] [--steps 2000] [--picture photo.png]

Every view is a cut of one picture, shifted by up to `shift` pixels. Compared with the truth are the L1 optimum
(per-pixel median) and the texture with auxiliary views and, as the negative control, without: nearest patches both ways
and the sliced Wasserstein distance of 7x7 patches, also as a share of the L1 optimum's. Scores are taken along the way,
at a quarter, half, three quarters and the end. Arithmetic is in float32, the paper's, on every processor.

Writes planar.json, planar.md and planar.png below --results; goes on with missing runs when started again. The paper's
size is --size 512 --shift 16, and a GPU's work.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from harness import RESULTS, Results, Stopwatch, markdown_table, write_report
from torch import Tensor

from advtex_engine.adversarial.discriminator import PatchDiscriminator
from advtex_engine.adversarial.examples import InputForm
from advtex_engine.adversarial.optimizer import AdversarialOptimizer
from advtex_engine.core.config import PRINTED
from advtex_engine.metrics.image_metrics import nearest_patch_loss, sliced_wasserstein
from advtex_engine.metrics.photograph import Photograph
from advtex_engine.pipeline import choose_device
from advtex_engine.synthetic.planar import planar_maps, planar_pairs, shifted_views
from advtex_engine.synthetic.print import tin_side

SIZE, SHIFT, VIEWS = 128, 8, 60
QUERIES = 4000
"""Patches whose nearest ones are sought, of up to a quarter of a million."""
PRINTED_NEAREST = 1.53, 7.33
"""The paper's, section 4.1."""
SCORES = {
    "nearest_patch": "nearest patch",
    "nearest_patch_reverse": "nearest patch, truth to texture",
    "sliced_wasserstein": "sliced Wasserstein",
}


def drawn_picture(side: int = SIZE + 2 * SHIFT) -> Tensor:
    """A piece of print drawn by code, [side,side,3] uint8: lettering, ornament and grain."""
    rng = np.random.default_rng(0)
    width, height, density = 300, 140, 1.1  # millimetres, pixels per millimetre
    density *= max(1.0, side / (height * density))
    return torch.from_numpy(tin_side(width, height, density, rng)[:side, :side].copy())


def cut(path: Path, side: int) -> Tensor:
    """The middle of a photograph [side,side,3] uint8, at half its size if it is large enough."""
    image = cv2.imread(str(path))
    if image is None:
        raise SystemExit(f"{path} is no picture that can be read")
    if min(image.shape[:2]) >= 2 * side:
        image = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    if min(image.shape[:2]) < side:
        raise SystemExit(f"{path} has fewer than {side} pixels on a side; choose a larger picture or a smaller --size")
    top, left = (image.shape[0] - side) // 2, (image.shape[1] - side) // 2
    return torch.from_numpy(image[top : top + side, left : left + side, ::-1].copy())


def optimize(
    color: Tensor, steps: int, *, auxiliary: bool, seed: int = 0, device: torch.device | None = None
) -> Iterator[tuple[int, Tensor]]:
    """The texture of views [V,S,S,3] uint8 after each quarter of the steps, [S,S,3] in [0,1]; it starts at the mean."""
    device = device or torch.device("cpu")
    maps = planar_maps(color.to(device), color.shape[2], color.shape[1])
    texture = color.float().mean(0) / 255
    optimizer = AdversarialOptimizer(
        maps,
        planar_pairs(len(color), device, auxiliary=auxiliary),
        texture.to(device)[maps.slot_map >= 0],
        PRINTED,
        kind="scene",
        steps=steps,
        generator=torch.Generator(device).manual_seed(seed),
        discriminator=PatchDiscriminator(torch.Generator().manual_seed(seed)).to(device),
    )
    optimizer.bfloat16, optimizer.form = False, InputForm()
    marks = {max(1, steps * quarter // 4) for quarter in (1, 2, 3, 4)}
    known = (maps.slot_map >= 0).cpu()
    for step in range(1, steps + 1):
        optimizer.step()
        if step in marks:
            texture[known] = optimizer.values.detach().cpu()
            yield step, texture.clamp(0, 1)


def views_of(picture: Tensor, size: int, shift: int) -> tuple[Tensor, Tensor, Tensor]:
    """Views [V,size,size,3] uint8 of a picture [size+2*shift,...], the truth and the L1 optimum [size,size,3]."""
    color = shifted_views(picture, size, shift, VIEWS, 0)
    truth = picture[shift : shift + size, shift : shift + size].float() / 255
    return color, truth, color.float().median(0).values / 255


def ratio(size: int, shift: int, steps: int, *, auxiliary: bool, seed: int = 0) -> float:
    """Sliced Wasserstein distance of the texture's patches to the drawn truth's, over that of the L1 optimum's."""
    color, truth, l1_optimum = views_of(drawn_picture(size + 2 * shift), size, shift)
    *_, (_, texture) = optimize(color, steps, auxiliary=auxiliary, seed=seed)
    whole = _whole(truth)
    return sliced_wasserstein(texture, whole) / sliced_wasserstein(l1_optimum, whole)


def _whole(truth: Tensor) -> Photograph:
    return Photograph(truth, torch.ones(truth.shape[:2], dtype=torch.bool))


def scores_of(texture: Tensor, truth: Tensor) -> dict[str, float]:
    return {
        "nearest_patch": nearest_patch_loss(texture, truth, queries=QUERIES),
        "nearest_patch_reverse": nearest_patch_loss(truth, texture, queries=QUERIES),
        "sliced_wasserstein": sliced_wasserstein(texture, _whole(truth)),
    }


def arguments_of(line: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=SIZE, help="pixels on a side of the texture and of the views")
    parser.add_argument("--shift", type=int, default=SHIFT, help="pixels")
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--picture", type=Path, help="a photograph; default: print drawn by code")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--results", type=Path, default=RESULTS / "planar", help="folder of the results")
    parsed: argparse.Namespace = parser.parse_args(line)
    return parsed


def fill(arguments: argparse.Namespace, results: Results) -> None:
    """Both runs, each a cell per quarter of its steps, and the L1 optimum."""
    side = arguments.size + 2 * arguments.shift
    picture = cut(arguments.picture, side) if arguments.picture else drawn_picture(side)
    color, truth, l1_optimum = views_of(picture, arguments.size, arguments.shift)
    settings = {
        "size": arguments.size,
        "shift": arguments.shift,
        "picture": arguments.picture.name if arguments.picture else "drawn",
    }
    if results.find({"texture": "L1 optimum", **settings}) is None:
        results.add({"texture": "L1 optimum", **settings}, scores_of(l1_optimum, truth), 0.0)
    shown = [truth, l1_optimum]
    for auxiliary in (True, False):
        name = "with auxiliary views" if auxiliary else "without auxiliary views"
        settings["steps"] = arguments.steps
        if results.find({"texture": name, **settings, "step": arguments.steps}) is not None:
            continue
        watch = Stopwatch()
        runs = optimize(color, arguments.steps, auxiliary=auxiliary, device=choose_device(arguments.device))
        for step, texture in runs:
            cell = {"texture": name, **settings, "step": step}
            if results.find(cell) is None:
                results.add(cell, scores_of(texture, truth), watch.seconds)
            watch = Stopwatch()
        shown.append(texture)
    if len(shown) == 4:
        row = torch.cat(shown, 1).mul(255).round().byte().numpy()
        cv2.imwrite(str(arguments.results / "planar.png"), row[..., ::-1])


def report(arguments: argparse.Namespace, results: Results) -> None:
    """planar.md: everything that was ever run, by size."""
    rows: list[list[Any]] = []
    for cell in results.cells:
        told, scores = cell["settings"], cell["scores"]
        key = {name: told[name] for name in ("size", "shift", "picture")}
        optimum = results.find({"texture": "L1 optimum", **key})
        assert optimum is not None
        share = scores["sliced_wasserstein"] / optimum["scores"]["sliced_wasserstein"]
        steps = f"{told['step']} of {told['steps']}" if "step" in told else "-"
        place = f"{told['size']}², ±{told['shift']}"
        rows.append([told["picture"], place, told["texture"], steps, *(scores[name] for name in SCORES), share])
    head = ["picture", "size", "texture", "steps", *SCORES.values(), "share of the L1 optimum's"]
    note = "planar.png: truth, L1 optimum, with and without auxiliary views, of the newest run of both. "
    note += "The paper's nearest patch, of its own picture at 512²: {} with auxiliary views, {} the L1 optimum.\n\n"
    note = note.format(*PRINTED_NEAREST)
    write_report(arguments.results / "planar.md", "The 2D case", results.cells, note + markdown_table(head, rows))


def main(line: list[str] | None = None) -> None:
    arguments = arguments_of(line)
    results = Results(arguments.results / "planar.json")
    fill(arguments, results)
    report(arguments, results)


if __name__ == "__main__":
    main()

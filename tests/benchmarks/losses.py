"""By what a texture is best compared with its photographs, where cameras and mesh are off by a pixel: each loss alone.

    python tests/benchmarks/losses.py SCAN … [--losses l1 gabor …] [--scan-size 320x240] [--steps 200]

From the start of the preset `standard` the texture takes the same steps each time, its render against the photograph of
the same view, by nothing but one loss; Adam's rate is the preset's and falls as there. The last state is scored on
views that are held out. "gabor" is the term of `adversarial/gabor.py`, the lines below it change one of its constants;
"no maximum" compares energies where they are. Features are those of a PatchGAN that has learned nothing, and of VGG16
up to relu3_3. "lpips" is LPIPS of AlexNet itself, which scores, too: what a texture gains that is tuned to its ruler.
So each is scored by another ruler as well, LPIPS of VGG16, where that has weights.

Writes losses.json (a cell per scan and loss) and losses.md below --results; goes on with missing cells when run again.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from harness import (
    COMPARED_SCORES,
    RESULTS,
    Results,
    completed,
    geometric_means,
    markdown_table,
    on_cpu,
    parsed_size,
    prepare,
    score_model,
    shown_mean,
    started,
    write_report,
)
from paper import HOLDOUT, SCAN_FACES, SCAN_SIZE
from torch import Tensor

from advtex_engine.adversarial import gabor
from advtex_engine.adversarial.discriminator import PatchDiscriminator
from advtex_engine.adversarial.optimizer import crop_size
from advtex_engine.adversarial.pair_sampler import DrawnPair, PairSampler
from advtex_engine.core.config import TextureConfig
from advtex_engine.methods import MethodInput
from advtex_engine.methods.mean import dense_texture
from advtex_engine.methods.vgg import load_vgg
from advtex_engine.metrics.evaluate import compare, heldout_scene, view_budget
from advtex_engine.metrics.lpips import Lpips, WeightsError, load_lpips, unlike
from advtex_engine.render.pairs import own_pairs
from advtex_engine.render.texture import sample_texels
from advtex_engine.runtime.devices import choose_device

Loss = Callable[[Tensor, Tensor, Tensor], Tensor]
"""Render, photograph, both [1,3,h,w] in [-1,1], and foreground [1,1,h,w]; the render is the photograph elsewhere."""

VARIANTS: dict[str, dict[str, Any]] = {
    "gabor": {},
    "no maximum": {"WINDOW": 1},
    "windows of 8": {"WINDOW": 8},
    "faint 0.05": {"FAINT": 0.05},
    "faint 0.1": {"FAINT": 0.1},
    "faint 0.4": {"FAINT": 0.4},
    "faint 1": {"FAINT": 1.0},
    "4 orientations": {"ORIENTATIONS": 4},
    "8 orientations": {"ORIENTATIONS": 8},
    "1 octave": {"OCTAVES": 1},
    "2 octaves": {"OCTAVES": 2},
    "4 octaves": {"OCTAVES": 4},
    "wavelength 4": {"WAVELENGTH": 4.0, "SIZE": 9},
}
OTHERS = ("start", "l1", "ssim", "untrained discriminator", "vgg16", "lpips")
NAMES = (*OTHERS, *VARIANTS)
COLUMNS = {
    "lpips": "LPIPS",
    "lpips_corrected": "corrected LPIPS",
    "lpips_vgg16": "corrected LPIPS of VGG16",
    "gradient_ratio": "gradient ratio",
    "flat_energy": "energy where flat",
    "psnr": "PSNR",
    "ms": "ms per step",
}


def arguments_of(line: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scans", nargs="+", type=Path, help="folders or zip files")
    parser.add_argument("--losses", nargs="+", default=NAMES, choices=NAMES, metavar="NAME")
    parser.add_argument("--scan-size", default=SCAN_SIZE, help="WIDTHxHEIGHT of the views")
    parser.add_argument("--faces", type=int, default=SCAN_FACES)
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--no-refine", action="store_true", help="cameras as they are")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--lpips-weights", type=Path, help="folder; default: $ADVTEX_LPIPS_WEIGHTS, else the cache")
    parser.add_argument("--results", type=Path, default=RESULTS / "losses", help="folder of the results")
    parsed: argparse.Namespace = parser.parse_args(line)
    return parsed


@contextmanager
def constants(changed: Mapping[str, Any]) -> Iterator[None]:
    """The Gabor term's, for as long as the block lasts."""
    before = {name: getattr(gabor, name) for name in changed}
    try:
        for name, value in changed.items():
            setattr(gabor, name, value)
        yield
    finally:
        for name, value in before.items():
            setattr(gabor, name, value)


def loss_named(name: str, device: torch.device, weights: Path | None = None) -> Loss:
    """One of NAMES but "start"; for those of VARIANTS inside `constants`. weights: folder of LPIPS's."""
    if name in VARIANTS:
        return partial(gabor.gabor_loss, filters=gabor.gabor_filters(device))
    if name == "l1":
        return lambda render, photograph, _: (render - photograph).abs().mean()
    if name == "ssim":
        return lambda render, photograph, _: 1 - ssim((render + 1) / 2, (photograph + 1) / 2).mean()
    if name == "vgg16":
        network = load_vgg().to(device)
        return lambda render, photograph, _: _distance(network((render + 1) / 2), network((photograph + 1) / 2))
    if name == "lpips":
        return partial(lpips_loss, load_lpips(weights).to(device))
    discriminator = PatchDiscriminator(torch.Generator().manual_seed(0)).to(device)

    def responses(image: Tensor, photograph: Tensor) -> list[Tensor]:
        return discriminator.examine(torch.cat((photograph, image - photograph), 1))[1]

    return lambda render, photograph, _: _distance(responses(render, photograph), responses(photograph, photograph))


def ssim(a: Tensor, b: Tensor) -> Tensor:
    """Structural similarity (Wang et al. 2004) of images [1,3,h,w] in [0,1], a channel each, in windows of 7 pixels."""
    mean_a, mean_b = (F.avg_pool2d(image, 7, 1) for image in (a, b))
    variance_a, variance_b, together = (
        F.avg_pool2d(x * y, 7, 1) - mean_x * mean_y
        for x, y, mean_x, mean_y in ((a, a, mean_a, mean_a), (b, b, mean_b, mean_b), (a, b, mean_a, mean_b))
    )
    luminance = (2 * mean_a * mean_b + 0.01**2) / (mean_a.square() + mean_b.square() + 0.01**2)
    return luminance * (2 * together + 0.03**2) / (variance_a + variance_b + 0.03**2)


def lpips_loss(lpips: Lpips, render: Tensor, photograph: Tensor, _: Tensor) -> Tensor:
    """What `Lpips.__call__` says of two images [1,3,h,w] in [-1,1], with a gradient for the render."""
    ours, theirs = (lpips.stack((image + 1) / 2) for image in (render, photograph))
    layers = [unlike(*features).mean() for features in zip(ours, theirs, lpips.heads, strict=True)]
    return torch.stack(layers).sum()


def _distance(first: list[Tensor], second: list[Tensor]) -> Tensor:
    return torch.stack([(a - b.detach()).abs().mean() for a, b in zip(first, second, strict=True)]).sum()


def descended(given: MethodInput, loss: Loss, steps: int) -> tuple[Tensor, float]:
    """The compact texture after the steps, and their mean milliseconds; given: as of `started`."""
    maps, preset, start = given.maps[1], given.preset, given.start
    assert start is not None
    values = start[maps.slot_map >= 0].clone().requires_grad_()
    adam = torch.optim.Adam([values], lr=preset.lr_texture, betas=(preset.beta1, 0.999))
    generator = torch.Generator(maps.device).manual_seed(given.config.seed)
    crop = crop_size(maps.width, maps.height, preset.max_crop)
    sampler = PairSampler(maps, own_pairs(maps), given.scene.kind, crop, generator)
    began = time.perf_counter()
    for step in range(steps):
        adam.param_groups[0]["lr"] = preset.lr_texture * (1 - (1 - preset.lr_end) * step / steps)
        pair: DrawnPair = sampler.draw()
        render = sampler.image(sample_texels(values, pair.slots, pair.weights)) * 2 - 1
        render = torch.where(pair.foreground > 0, render, pair.condition)
        adam.zero_grad()
        loss(render, pair.condition, pair.foreground).backward()  # type: ignore[no-untyped-call]
        adam.step()
    return values.detach(), 1000 * (time.perf_counter() - began) / max(steps, 1)


def by_vgg16(given: MethodInput, texture: Tensor, scan: Path, weights: Path | None) -> dict[str, float]:
    """`lpips_vgg16`: mean over held-out frames, with their pose and tone put right; empty without weights."""
    try:
        lpips = load_lpips(weights, "vgg16")
    except WeightsError:
        return {}
    scene, atlas = heldout_scene(scan, given.config, given.monitor), on_cpu(given.atlas)
    found = []
    for view in scene.views:
        comparison = compare(atlas, texture, view, scene.mesh)
        if comparison is not None:
            budget = view_budget(atlas, texture, view, comparison, scene.mesh, scene.kind, lpips)
            found.append(budget["lpips_corrected"] or 0.0)
    return {"lpips_vgg16": sum(found) / len(found)}


def run(arguments: argparse.Namespace, results: Results) -> None:
    for scan in arguments.scans:
        settings = {"size": arguments.scan_size, "steps": arguments.steps, "refined": not arguments.no_refine}
        common = {"scan": scan.stem, **settings}
        missing = [name for name in arguments.losses if not results.find({**common, "loss": name})]
        if not missing:
            continue
        with tempfile.TemporaryDirectory(prefix="advtex-losses-") as folder:
            device = choose_device(arguments.device)
            config = TextureConfig(
                preset="standard",
                size=parsed_size(arguments.scan_size),
                holdout=HOLDOUT,
                face_budget=arguments.faces,
                refine=not arguments.no_refine,
                device=arguments.device,
            )
            given = started(prepare(scan, config, Path(folder) / "work", device))
            maps = given.maps[1]
            for name in missing:
                began = time.perf_counter()
                with constants(VARIANTS.get(name, {})):
                    steps = 0 if name == "start" else arguments.steps
                    loss = loss_named("l1" if name == "start" else name, device, arguments.lpips_weights)
                    values, ms = descended(given, loss, steps)
                texture = completed(given, dense_texture(maps, values).clamp(0, 1))
                scores = score_model(given, texture, scan, Path(folder) / "model", None, arguments.lpips_weights)
                scores |= by_vgg16(given, texture, scan, arguments.lpips_weights)
                results.add({**common, "loss": name}, {**scores, "ms": ms}, time.perf_counter() - began)


def report(arguments: argparse.Namespace, results: Results) -> None:
    """losses.md: a table per scan, and the geometric means over all of them."""
    scans = dict[str, dict[str, dict[str, Any]]]()
    for cell in results.cells:
        scan, size, steps, refined, loss = cell["settings"].values()
        cameras = "" if refined else ", cameras as they are"
        scans.setdefault(f"{scan}, {size}, {steps} steps{cameras}", {})[loss] = cell
    body = ""
    for title, cells in scans.items():
        rows = [[name, *(shown_mean([cells[name]], column) for column in COLUMNS)] for name in NAMES if name in cells]
        body += f"\n## {title}\n\n{markdown_table(['loss', *COLUMNS.values()], rows)}"
    common = [name for name in NAMES if all(name in cells for cells in scans.values())]
    lines = {name: [cells[name] for cells in scans.values()] for name in common}
    scores = COMPARED_SCORES | {"lpips_vgg16": COLUMNS["lpips_vgg16"]}
    body += geometric_means("loss", lines, scores)
    write_report(arguments.results / "losses.md", "By what a texture is compared", results.cells, body)


def main(line: list[str] | None = None) -> None:
    arguments = arguments_of(line)
    results = Results(arguments.results / "losses.json")
    run(arguments, results)
    report(arguments, results)


if __name__ == "__main__":
    main()

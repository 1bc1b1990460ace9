"""What the discriminator's options are worth: the condition, the auxiliary views, the size of its patches.

    python tests/benchmarks/discriminator.py [--seeds 1]

One synthesized scan, as `advtex-engine synthesize` makes it; the texture takes the same number of steps from the
preset's start each time. Patches of 22 pixels replace the last two convolutions by pointwise ones, patches of 118
pixels dilate them twice; the patches that count are chosen as for 70 pixels. Writes discriminator.json and
discriminator.md below --results; goes on with missing cells when run again.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from harness import (
    SCORES,
    Results,
    Stopwatch,
    common_arguments,
    configuration,
    load_truth,
    markdown_table,
    mean_of,
    needed_lpips,
    parsed_size,
    prepare,
    score_texture,
    started,
    write_report,
)
from torch import Tensor, nn

from advtex_engine.adversarial.discriminator import STRIDES, PatchDiscriminator
from advtex_engine.adversarial.optimizer import AdversarialOptimizer
from advtex_engine.methods import MethodInput
from advtex_engine.methods.mean import dense_texture
from advtex_engine.metrics.lpips import Lpips
from advtex_engine.pipeline import choose_device
from advtex_engine.render.pairs import own_pairs, related_pairs
from advtex_engine.synthetic.scan import synthesize

PATCHES = {22: (1, 1), 70: (4, 1), 118: (4, 2)}
"""Receptive field in pixels: kernel and dilation of the two convolutions that have stride 1."""
OPTIONS: dict[str, dict[str, Any]] = {
    "as in the paper": {},
    "no condition": {"condition": False},
    "no auxiliary views": {"auxiliary": False},
    "patches of 22 pixels": {"patch": 22},
    "patches of 118 pixels": {"patch": 118},
}


class SizedDiscriminator(PatchDiscriminator):
    """The paper's discriminator with another receptive field; its logits lie on the same grid of patch centers."""

    def __init__(self, patch: int, generator: torch.Generator) -> None:
        super().__init__(generator)
        kernel, self.dilation = PATCHES[patch]
        if kernel == 1:
            for index in (3, 4):
                wide = self.convolutions[index]
                assert isinstance(wide, nn.Conv2d)
                narrow = nn.Conv2d(wide.in_channels, wide.out_channels, 1)
                # As many inputs as a 4x4 kernel has would give 16 times the variance.
                nn.init.normal_(narrow.weight, 0.0, 4 * 0.02, generator=generator)
                assert narrow.bias is not None
                nn.init.zeros_(narrow.bias)
                self.convolutions[index] = narrow

    def examine(self, x: Tensor, parameters: Sequence[Tensor] | None = None) -> tuple[Tensor, list[Tensor]]:
        given = list(self.parameters() if parameters is None else parameters)
        # A GPU's examples have two channels of zeros more.
        x, features = x[:, :6].to(given[0].dtype), list[Tensor]()
        for index, (weight, bias, stride) in enumerate(zip(given[::2], given[1::2], STRIDES, strict=True)):
            last = index >= 3
            dilation = self.dilation if last else 1
            padding = dilation * (weight.shape[-1] - 1) // 2 if last else 1
            x = F.conv2d(x, weight, bias, stride, padding, dilation)
            if index < 4:
                x = F.leaky_relu(x, 0.2)
                features.append(x)
        return x[..., 1:-1, 1:-1], features


def discriminator(patch: int, seed: int) -> PatchDiscriminator:
    generator = torch.Generator().manual_seed(seed)
    return PatchDiscriminator(generator) if patch == 70 else SizedDiscriminator(patch, generator)


def arguments_of(line: list[str] | None = None) -> argparse.Namespace:
    parser = common_arguments("discriminator", __doc__)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--options", nargs="+", default=list(OPTIONS), choices=list(OPTIONS))
    parsed: argparse.Namespace = parser.parse_args(line)
    return parsed


def cells(arguments: argparse.Namespace) -> Iterator[dict[str, Any]]:
    for seed in range(arguments.seeds):
        for option in arguments.options:
            shared = ("views", "size", "steps", "preset", "faces", "refine")
            yield {"option": option, "seed": seed, **{name: getattr(arguments, name) for name in shared}}


def optimize(given: MethodInput, seed: int, patch: int = 70, **ablation: bool) -> Tensor:
    """The texture [H,W,3] on the CPU after the preset's steps from its start."""
    given = started(given)
    maps, kind = given.maps[1], given.scene.kind
    preset = dataclasses.replace(given.preset, **ablation)  # type: ignore[arg-type]  # flags of the ablations
    assert given.start is not None
    pairs = own_pairs(maps)
    if preset.auxiliary:
        pairs = related_pairs(maps, kind, preset.max_pair_angle, preset.min_pair_overlap)
    device = maps.color.device
    optimizer = AdversarialOptimizer(
        maps,
        pairs,
        given.start[maps.slot_map >= 0],
        preset,
        kind=kind,
        steps=preset.steps,
        generator=torch.Generator(device).manual_seed(seed),
        discriminator=discriminator(patch, seed).to(device),
    )
    for _ in range(preset.steps):
        optimizer.step()
    return dense_texture(maps, optimizer.values.detach()).clamp(0, 1).cpu()


def fill(arguments: argparse.Namespace, results: Results, lpips: Lpips) -> None:
    """Runs every cell that is not in the results yet."""
    missing = [cell for cell in cells(arguments) if results.find(cell) is None]
    if not missing:
        return
    width, height = parsed_size(arguments.size)
    with tempfile.TemporaryDirectory(prefix="advtex-discriminator-") as folder:
        scan = Path(folder) / "scan"
        synthesize(scan, views=arguments.views, width=width, height=height)
        truth = load_truth(scan)
        config = configuration(arguments, "adversarial")
        given = prepare(scan, config, Path(folder) / "work", choose_device(arguments.device))
        for cell in missing:
            watch = Stopwatch()
            texture = optimize(given, cell["seed"], **OPTIONS[cell["option"]])
            seconds = watch.seconds
            results.add(cell, score_texture(given.atlas, texture, truth, lpips), seconds)


def report(arguments: argparse.Namespace, results: Results) -> None:
    """discriminator.md: means over the seeds."""
    found = [cell for wanted in cells(arguments) if (cell := results.find(wanted)) is not None]
    rows = []
    for option in arguments.options:
        mine = [cell for cell in found if cell["settings"]["option"] == option]
        if mine:
            rows.append([option, *(mean_of(mine, name) for name in SCORES), len(mine)])
    table = markdown_table(["discriminator", *SCORES.values(), "seeds"], rows)
    write_report(arguments.results / "discriminator.md", "Options of the discriminator", found, table)


def main(line: list[str] | None = None) -> None:
    arguments = arguments_of(line)
    results = Results(arguments.results / "discriminator.json")
    fill(arguments, results, needed_lpips(arguments.lpips_weights))
    report(arguments, results)


if __name__ == "__main__":
    main()

"""What helps a discriminator to learn: how many patches it tells apart of a texture that stands still.

    python tests/benchmarks/learning.py SCAN … [--scan-size 192x144] [--steps 2000] [--options NAME …] [--seeds 1]
        [--elsewhere]

The start of the preset `standard` does not move, so that what is told apart grows or stays: half of the patches by
guessing, all by one that knows everything. Each option changes one thing of the discriminator, of how it learns, or of
the examples that it is shown; told apart are the patches since the reading before. With --seeds it begins as often,
each time from other weights, and the least of the seeds says whether one collapsed. With --elsewhere it learns for
--steps on every other scan, by turns, and is then asked about a scan that it has never seen, and learns nothing there.
Projected features are AlexNet's: their weights lie in $ADVTEX_LPIPS_WEIGHTS.

Writes learning.json (a cell per scan, option and seed) and learning.md below --results; goes on with missing cells when
started again.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import statistics
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
import torch.nn.functional as F
from harness import RESULTS, Results, Stopwatch, markdown_table, parsed_size, prepare, started, write_report
from paper import HOLDOUT, SCAN_FACES
from torch import Tensor, nn

from advtex_engine.adversarial.discriminator import PATCH_STRIDE, STRIDES, PatchDiscriminator
from advtex_engine.adversarial.game import knowledge
from advtex_engine.adversarial.optimizer import AdversarialOptimizer, Losses
from advtex_engine.core.config import TextureConfig, resolve_preset
from advtex_engine.methods import MethodInput
from advtex_engine.methods.adversarial import pairs_of
from advtex_engine.metrics.lpips import load_features
from advtex_engine.runtime.devices import choose_device

SHARES = (0.1, 0.25, 0.5, 1.0)
"""Of the steps, at which is read out."""
SLOPE = 0.2
PENALTY = 10.0
"""Of R1 (Mescheder et al. 2018), gamma."""
CROPS = 4
DRAWS = 200
"""Pairs of a scan that nothing is learned of."""
CENTERED = "accuracy, centered"


class He(PatchDiscriminator):
    """Begins with the variance that keeps responses as large from layer to layer (He et al. 2015)."""

    def __init__(self, generator: torch.Generator) -> None:
        super().__init__(generator)
        for layer in self.convolutions:
            assert isinstance(layer, nn.Conv2d)
            nn.init.kaiming_normal_(layer.weight, SLOPE, generator=generator)


class LargeResidual(PatchDiscriminator):
    """The residual has a tenth of the condition's standard deviation: ten times of it have the same."""

    def examine(self, x: Tensor, parameters: Sequence[Tensor] | None = None) -> tuple[Tensor, list[Tensor]]:
        return super().examine(torch.cat((x[:, :3], 10 * x[:, 3:]), 1), parameters)


class Both(LargeResidual, He):
    """He's start, and a large residual."""


class Spectral(Both):
    """Each convolution divided by its largest singular value (Miyato et al. 2018), one step of power iteration each."""

    def __init__(self, generator: torch.Generator) -> None:
        super().__init__(generator)
        sizes = [layer.weight.shape[0] for layer in self.convolutions]  # type: ignore[union-attr,index]
        self.directions = [F.normalize(torch.randn(int(size), generator=generator), dim=0) for size in sizes]

    def examine(self, x: Tensor, parameters: Sequence[Tensor] | None = None) -> tuple[Tensor, list[Tensor]]:
        given = list(self.parameters() if parameters is None else parameters)
        for index in range(len(self.directions)):
            with torch.no_grad():
                matrix = given[2 * index].detach().float().flatten(1)
                other = F.normalize(matrix.T @ self.directions[index].to(matrix), dim=0)
                self.directions[index] = F.normalize(matrix @ other, dim=0)
                largest = self.directions[index] @ matrix @ other
            given[2 * index] = given[2 * index] / largest.to(given[2 * index].dtype)
        return super().examine(x, given)


class Instance(Both):
    """Instance normalization (Ulyanov et al. 2016) of the three inner layers."""

    def examine(self, x: Tensor, parameters: Sequence[Tensor] | None = None) -> tuple[Tensor, list[Tensor]]:
        given = list(self.parameters() if parameters is None else parameters)
        x = torch.cat((x[:, :3], 10 * x[:, 3:6]), 1).to(given[0].dtype)
        features = list[Tensor]()
        for index, stride in enumerate(STRIDES):
            x = F.conv2d(x, given[2 * index], given[2 * index + 1], stride, padding=1)
            if index < len(STRIDES) - 1:
                x = F.leaky_relu(F.instance_norm(x) if index else x, SLOPE)
                features.append(x)
        return x, features


class TwoScales(Both):
    """The mean of two, one of which sees the images at half their size (Wang et al. 2018)."""

    def __init__(self, generator: torch.Generator) -> None:
        super().__init__(generator)
        self.smaller = Both(generator)

    def examine(self, x: Tensor, parameters: Sequence[Tensor] | None = None) -> tuple[Tensor, list[Tensor]]:
        given = list(self.parameters() if parameters is None else parameters)
        count = len(given) // 2
        logits, features = super().examine(x, given[:count])
        coarse, _ = self.smaller.examine(F.avg_pool2d(x, 2), given[count:])
        return (logits + F.interpolate(coarse, logits.shape[-2:], mode="bilinear")) / 2, features


class Augmented(Both):
    """Examples mirrored and with their channels in another order, by chance; patches stay where they are."""

    def examine(self, x: Tensor, parameters: Sequence[Tensor] | None = None) -> tuple[Tensor, list[Tensor]]:
        flipped = [side for side in (2, 3) if torch.rand(()) < 0.5]
        order = torch.randperm(3)
        logits, features = super().examine(x[:, torch.cat((order, 3 + order))].flip(flipped), parameters)
        return logits.flip(flipped), features


class Projected(PatchDiscriminator):
    """Sees both images as the first two layers of AlexNet do, which stand still (Sauer et al. 2021)."""

    def __init__(self, generator: torch.Generator) -> None:
        super().__init__(generator)
        self.seen = [load_features("alexnet")]  # in a list: no part of what learns
        channels = (2 * (64 + 192), 128, 128, 1)
        self.convolutions = nn.ModuleList(nn.Conv2d(a, b, 3, padding=1) for a, b in itertools.pairwise(channels))
        for layer in self.convolutions:
            nn.init.kaiming_normal_(layer.weight, SLOPE, generator=generator)  # type: ignore[arg-type]

    def examine(self, x: Tensor, parameters: Sequence[Tensor] | None = None) -> tuple[Tensor, list[Tensor]]:
        given = list(self.parameters() if parameters is None else parameters)
        condition, residual = x[:, :3].float(), x[:, 3:6].float()
        fine, coarse = self.seen[0](torch.cat((condition, condition + residual)))[:2]
        both = torch.cat((F.avg_pool2d(fine, 2), F.interpolate(coarse, [side // 2 for side in fine.shape[-2:]])), 1)
        y = torch.cat(both.chunk(2), 1).to(given[0].dtype)
        for weight, bias in zip(given[:-2:2], given[1:-2:2], strict=True):
            y = F.leaky_relu(F.conv2d(y, weight, bias, padding=1), SLOPE)
        logits = F.conv2d(y, given[-2], given[-1], padding=1)
        return F.interpolate(logits, [side // PATCH_STRIDE - 2 for side in x.shape[-2:]], mode="bilinear"), []


class Watched(Both):
    """Keeps the last example, which is the real one, and its logits."""

    def examine(self, x: Tensor, parameters: Sequence[Tensor] | None = None) -> tuple[Tensor, list[Tensor]]:
        x = x if x.requires_grad else x.detach().requires_grad_()
        logits, features = super().examine(x, parameters)
        self.last = (x, logits)
        return logits, features


class Penalized(AdversarialOptimizer):
    """R1: the discriminator's slope at real examples costs."""

    def _discriminator_gradients(self, losses: Losses) -> tuple[Tensor, ...]:
        assert isinstance(self.discriminator, Watched)
        real, logits = self.discriminator.last
        (slope,) = torch.autograd.grad(logits.sum(), [real], create_graph=True)
        penalty = PENALTY / 2 * slope.float().square().sum() / logits.numel()
        penalized = dataclasses.replace(losses, discriminator=losses.discriminator + penalty)
        return super()._discriminator_gradients(penalized)


class SeveralCrops(AdversarialOptimizer):
    """The mean gradient of CROPS crops a step."""

    def _discriminator_gradients(self, losses: Losses) -> tuple[Tensor, ...]:
        total = super()._discriminator_gradients(losses)
        for _ in range(CROPS - 1):
            torch._foreach_add_(total, super()._discriminator_gradients(self.play(self.draw())))
        torch._foreach_div_(total, CROPS)
        return total


@dataclasses.dataclass(frozen=True)
class Option:
    """A discriminator, how it learns, and what differs from the preset."""

    discriminator: type[PatchDiscriminator] = Both
    optimizer: type[AdversarialOptimizer] = AdversarialOptimizer
    preset: dict[str, Any] = dataclasses.field(default_factory=lambda: {"lr_discriminator": 2e-4})


SLOW = {"lr_discriminator": 2e-4}
OPTIONS = {
    "as in `standard`": Option(PatchDiscriminator, preset={}),
    "a quarter of its rate": Option(PatchDiscriminator),
    "He": Option(He),
    "ten times the residual": Option(LargeResidual),
    "both": Option(),
    "both, at `standard`'s rate": Option(preset={}),
    "both, half the rate": Option(preset={"lr_discriminator": 1e-4}),
    "both, spectral normalization": Option(Spectral),
    "both, instance normalization": Option(Instance),
    "both, two scales": Option(TwoScales),
    "both, augmented": Option(Augmented),
    "projected features": Option(Projected),
    "both, R1": Option(Watched, Penalized),
    "both, four crops a step": Option(optimizer=SeveralCrops),
    "both, examples not aligned": Option(preset={**SLOW, "alignment": False}),
    "both, examples as photographed": Option(preset={**SLOW, "toned": False}),
    "both, the nearest half of the pairs": Option(preset={**SLOW, "nearest_share": 0.5}),
    "both, the source itself, displaced": Option(preset={**SLOW, "auxiliary": False, "perturbation": 1 / 320}),
}


def arguments_of(line: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scans", nargs="+", type=Path, help="folders or zip files")
    parser.add_argument("--scan-size", default="192x144", help="WIDTHxHEIGHT of the views")
    parser.add_argument("--steps", type=int, default=2_000)
    parser.add_argument("--options", nargs="+", default=list(OPTIONS), choices=OPTIONS, metavar="NAME")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--elsewhere", action="store_true", help="what is learned on all scans but one, of that one")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--results", type=Path, default=RESULTS / "learning", help="folder of the results")
    parsed: argparse.Namespace = parser.parse_args(line)
    return parsed


def settings_of(arguments: argparse.Namespace, scan: Path, option: str, seed: int, elsewhere: bool) -> dict[str, Any]:
    """What a cell is found by."""
    others = sorted(other.stem for other in arguments.scans if other != scan) if elsewhere else []
    shared = {"size": arguments.scan_size, "steps": arguments.steps, "option": option, "seed": seed}
    return {"scan": scan.stem, **shared, "learned_on": " ".join(others) or scan.stem}


def optimizer_of(given: MethodInput, option: Option, steps: int, seed: int) -> AdversarialOptimizer:
    """At the given start, which does not move for as long as the preset's pretraining lasts."""
    maps, start = given.maps[1], given.start
    assert start is not None
    return option.optimizer(
        maps,
        pairs_of(given, maps),
        start[maps.slot_map >= 0],
        given.preset,
        kind=given.scene.kind,
        steps=steps,
        generator=torch.Generator(maps.device).manual_seed(seed),
        discriminator=option.discriminator(torch.Generator().manual_seed(seed)).to(maps.device),
    )


def learn(given: MethodInput, option: Option, steps: int, seed: int) -> dict[str, float]:
    """Shares told apart, and margins, before each of SHARES of the steps."""
    torch.manual_seed(seed)
    optimizer = optimizer_of(given, option, steps, seed)
    found = dict[str, float]()
    for share in SHARES:
        while optimizer.index < round(share * steps):
            optimizer.step()
        read = optimizer.drain_losses()
        found |= {f"{name} {share:g}": read[name] for name in ("accuracy", "margin")}
    return found


def learned_on(givens: Sequence[MethodInput], option: Option, steps: int, seed: int) -> AdversarialOptimizer:
    """After so many steps on each of the scans, by turns: the optimizer of the first, with the one discriminator."""
    torch.manual_seed(seed)
    players = [optimizer_of(given, option, steps, seed) for given in givens]
    first = players[0]
    for parameter, gradient in zip(first.parameters, first._gradients, strict=True):
        parameter.grad = gradient
    for player in players:  # one discriminator, one state of its Adam
        _share(first, player)
        player._gradients, player.adam_discriminator = first._gradients, first.adam_discriminator
    for _ in range(steps):
        for player in players:
            player.step()
    return first


def _share(first: AdversarialOptimizer, other: AdversarialOptimizer) -> None:
    """The other plays with the discriminator of the first."""
    other.discriminator, other.parameters = first.discriminator, first.parameters
    other.bfloat16 = other.bfloat16


def learn_elsewhere(
    unseen: MethodInput, others: Sequence[MethodInput], option: Option, steps: int, seed: int
) -> dict[str, float]:
    """What is told apart of a scan after so many steps on each of the others, by turns; nothing is learned of it.

    Logits of another scan lie higher or lower as a whole. Centered: less their mean over this scan's examples, real and
    fake, which takes no knowledge of which is which; over other draws than those that are told apart then.
    """
    first = learned_on(others, option, steps, seed)
    last = optimizer_of(unseen, option, steps, seed)
    _share(first, last)
    last.schedule.read()

    def told() -> list[float]:
        return torch.stack([last.play(last.draw()).told for _ in range(DRAWS)]).sum(0).tolist()

    asked = told()
    patches, real_sum, fake_sum = asked[0], asked[3], asked[4]
    middle = (real_sum + fake_sum) / (2 * patches)
    examine = first.discriminator.examine

    def centered(x: Tensor, parameters: Sequence[Tensor] | None = None) -> tuple[Tensor, list[Tensor]]:
        logits, features = examine(x, parameters)
        return logits - middle, features

    with patch.object(first.discriminator, "examine", centered):
        again = told()
    read = knowledge(asked)
    found = {f"{name} {SHARES[-1]:g}": read[name] for name in ("accuracy", "margin", "spread")}
    return found | {CENTERED: knowledge(again)["accuracy"]}


def fill(arguments: argparse.Namespace, results: Results) -> None:
    """Runs every cell that is not in the results yet."""
    device = choose_device(arguments.device)
    cells = [(option, seed) for option in arguments.options for seed in range(arguments.seeds)]

    def lacks(scan: Path, option: str, seed: int) -> bool:
        return results.find(settings_of(arguments, scan, option, seed, arguments.elsewhere)) is None

    config = TextureConfig(
        preset="standard",
        size=parsed_size(arguments.scan_size),
        holdout=HOLDOUT,
        face_budget=SCAN_FACES,
        device=arguments.device,
    )
    preset = dataclasses.replace(
        resolve_preset(config), pretraining=arguments.steps, feature_weight=0.0, gabor_weight=0.0
    )
    starts = dict[tuple[Path, bool], MethodInput]()

    def given(scan: Path, option: Option) -> MethodInput:
        changed = dataclasses.replace(preset, **option.preset)
        key = (scan, changed.toned)
        if key not in starts:
            with tempfile.TemporaryDirectory(prefix="advtex-learning-") as folder:
                prepared = prepare(scan, config, Path(folder), device)
            starts[key] = started(dataclasses.replace(prepared, preset=changed))
        return dataclasses.replace(starts[key], preset=changed)

    for scan in arguments.scans:
        for name, seed in cells:
            if not lacks(scan, name, seed):
                continue
            option = OPTIONS[name]
            this = given(scan, option)
            others = [given(other, option) for other in arguments.scans if other != scan and arguments.elsewhere]
            watch = Stopwatch()
            if arguments.elsewhere:
                scores = learn_elsewhere(this, others, option, arguments.steps, seed)
            else:
                scores = learn(this, option, arguments.steps, seed)
            results.add(settings_of(arguments, scan, name, seed, arguments.elsewhere), scores, watch.seconds)
        if not arguments.elsewhere:
            starts.clear()


def report(arguments: argparse.Namespace, results: Results) -> None:
    """learning.md: a line per option; per scan its mean share at the end, and over all scans and seeds the least."""
    body, found = "", list[dict[str, Any]]()
    for elsewhere, title in ((False, "Learned on the scan"), (True, "Learned on all other scans")):
        if elsewhere and len(arguments.scans) == 1:
            continue
        lines = list[list[Any]]()
        for name in OPTIONS:
            of_scans = [_cells(arguments, results, scan, name, elsewhere) for scan in arguments.scans]
            if every := [cell for cells in of_scans for cell in cells]:
                found += every
                last, *before = (f"accuracy {share:g}" for share in reversed(SHARES))
                early = [] if elsewhere else [_mean(every, share) for share in reversed(before)]
                for label, score in ((name, last), (f"{name}, centered", CENTERED))[: 2 if elsewhere else 1]:
                    least = min(cell["scores"][score] for cell in every)
                    lines.append([label, *(_mean(cells, score) for cells in of_scans), *early, least, len(every)])
        if lines:
            head = ["option", *(scan.stem for scan in arguments.scans)]
            if not elsewhere:
                head += [f"all, until step {round(share * arguments.steps)}" for share in SHARES[:-1]]
            body += f"\n## {title}\n\n{markdown_table([*head, 'least', 'runs'], lines)}"
    told = (
        f"\nShare of patches told apart, {arguments.scan_size}, {arguments.steps} steps; in the second half of them,"
        " but for the columns that say otherwise, and for scans that nothing is learned of.\n"
    )
    write_report(arguments.results / "learning.md", "What helps a discriminator to learn", found, told + body)


def _cells(
    arguments: argparse.Namespace, results: Results, scan: Path, option: str, elsewhere: bool
) -> list[dict[str, Any]]:
    """Those of all seeds that were run."""
    rows = [result["settings"]["seed"] for result in results.cells]
    found = (
        results.find(settings_of(arguments, scan, option, seed, elsewhere)) for seed in range(max(rows, default=0) + 1)
    )
    return [cell for cell in found if cell is not None]


def _mean(cells: Sequence[dict[str, Any]], name: str) -> float | str:
    return statistics.mean(cell["scores"][name] for cell in cells) if cells else "-"


def main(line: list[str] | None = None) -> None:
    arguments = arguments_of(line)
    results = Results(arguments.results / "learning.json")
    fill(arguments, results)
    report(arguments, results)


if __name__ == "__main__":
    main()

"""The game's recipes, each played to its end: what a choice does to what the discriminator knows, and to the texture.

    python tests/benchmarks/recipes.py SCAN … [--size 320x240] [--preset standard] [--recipes NAME …]
        [--elsewhere SCAN …]

On scans of one's own, against every 8th frame, held out. Each recipe is the preset with some of its choices made
otherwise, from the same selection; "awake" is a discriminator that has learned before the texture moves: He's
start, a residual ten times as large, a quarter of the rate, and a third of the steps by itself (`learning.py` has why).
"Learned elsewhere" is one that has learned on the scans of --elsewhere, but never on the one that it plays for then.
Told apart are shares of patches after the pretraining, in the middle and at the end.

Writes recipes.json (a cell per scan and recipe) and recipes.md below --results, and per scan and recipe the model and a
contact sheet; goes on with missing cells when started again.
"""

from __future__ import annotations

import argparse
import copy
import dataclasses
import tempfile
from pathlib import Path
from typing import Any

import torch
from harness import (
    RESULTS,
    SCAN_SCORES,
    Results,
    Stopwatch,
    completed,
    geometric_means,
    markdown_table,
    needed_lpips,
    parsed_size,
    prepare,
    score_model,
    started,
    write_report,
)
from learning import OPTIONS, SLOW, Both, SeveralCrops, TwoScales, learned_on
from paper import HOLDOUT, SCAN_FACES
from parts import patched
from torch import Tensor

from advtex_engine.adversarial.backend import choose_operations
from advtex_engine.adversarial.discriminator import PatchDiscriminator
from advtex_engine.core.config import PRESETS, TextureConfig, resolve_preset
from advtex_engine.methods import MethodInput, texture_function
from advtex_engine.methods.adversarial import pairs_of
from advtex_engine.methods.gabor import wide_loss
from advtex_engine.render.pairs import Pairs
from advtex_engine.render.view_maps import ViewMaps
from advtex_engine.runtime.devices import choose_device
from advtex_engine.selection.candidates import frame_blur


@dataclasses.dataclass(frozen=True)
class Recipe:
    """A method, and what differs from the preset and from the engine's code.

    alone: share of the steps pretrained. elsewhere: the discriminator has learned on other scans before.
    """

    method: str = "adversarial"
    alone: float | None = None
    elsewhere: bool = False
    preset: dict[str, Any] = dataclasses.field(default_factory=dict)
    code: dict[str, Any] = dataclasses.field(default_factory=dict)


def sharper_pairs(given: MethodInput, maps: ViewMaps) -> Pairs:
    """The sharper half of the auxiliary views of each source, and the source itself."""
    pairs, blur = pairs_of(given, maps), frame_blur(maps)
    auxiliary, count = pairs.auxiliary.clone(), pairs.count.clone()
    relative = pairs.relative.clone()
    for source in pairs.sources.tolist():
        others = torch.arange(1, int(count[source]), device=auxiliary.device)
        kept = others[blur[auxiliary[source, others]].argsort()[: (len(others) + 1) // 2]]
        row = torch.cat((kept.new_zeros(1), kept))
        auxiliary[source, : len(row)] = pairs.auxiliary[source, row]
        relative[source, : len(row)] = pairs.relative[source, row]
        count[source] = len(row)
    return Pairs(auxiliary, count, pairs.sources, relative)


def widely_compared(device: torch.device) -> Any:
    """The device's operations, with means over blocks compared beside Gabor energies, as `methods/gabor.py` does."""
    operations = choose_operations(device)

    def both(render: Tensor, photograph: Tensor, foreground: Tensor, filters: Tensor) -> Tensor:
        wide = wide_loss(render.float(), photograph.float(), foreground)
        return operations.gabor_loss(render, photograph, foreground, filters) + wide

    return dataclasses.replace(operations, gabor_loss=both)


GAME = "advtex_engine.methods.adversarial"
BOTH = {f"{GAME}.PatchDiscriminator": Both}
ELSEWHERE = "learned elsewhere"
ELSEWHERE_SIZE, ELSEWHERE_STEPS = "192x144", 2_000  # on each of the scans


def awake(code: dict[str, Any] | None = None, **preset: Any) -> Recipe:
    """The preset with a discriminator that has learned, and some of its choices made otherwise."""
    return Recipe(alone=1 / 3, preset={"lr_discriminator": 2e-4, **preset}, code={**BOTH, **(code or {})})


RECIPES = {
    "no descent": Recipe("view_selection_no_descent"),
    "view selection": Recipe("view_selection"),
    "as it is": Recipe(),
    "without Gabor energies": Recipe(preset={"gabor_weight": 0.0}),
    "without features": Recipe(preset={"feature_weight": 0.0}),
    "one that never learns": Recipe(preset={"lr_discriminator": 0.0}),
    "one that never learns, features alone": Recipe(preset={"lr_discriminator": 0.0, "gabor_weight": 0.0}),
    "wide means compared": Recipe(code={"advtex_engine.adversarial.optimizer.choose_operations": widely_compared}),
    "without averaging": Recipe(preset={"averaging": 0}),
    "lambda 10": Recipe(preset={"l1_weight": 10.0}),
    "awake": awake(),
    "awake, without features": awake(feature_weight=0.0),
    "awake, without Gabor energies": awake(gabor_weight=0.0),
    "awake, by itself": awake(gabor_weight=0.0, feature_weight=0.0),
    "awake, lambda 10": awake(l1_weight=10.0),
    "awake, two scales": awake({f"{GAME}.PatchDiscriminator": TwoScales}),
    "awake, four crops a step": awake({f"{GAME}.AdversarialOptimizer": SeveralCrops}),
    "awake, examples not aligned": awake(alignment=False),
    "awake, the nearest half of the pairs": awake(nearest_share=0.5),
    "awake, the sharper half of the pairs": awake({f"{GAME}.pairs_of": sharper_pairs}),
    "awake, the source itself, displaced": awake(auxiliary=False, perturbation=1 / 320),
    ELSEWHERE: Recipe(elsewhere=True, preset={"lr_discriminator": 2e-4}),
}


def arguments_of(line: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scans", nargs="+", type=Path, help="folders or zip files")
    parser.add_argument("--size", default="320x240", help="WIDTHxHEIGHT of the views")
    parser.add_argument("--preset", default="standard", choices=PRESETS)
    parser.add_argument("--steps", type=int, help="the preset's if not given")
    parser.add_argument("--recipes", nargs="+", choices=RECIPES, metavar="NAME", help="default: all that can be played")
    parser.add_argument("--elsewhere", nargs="+", default=[], type=Path, help=f'scans that "{ELSEWHERE}" learns on')
    parser.add_argument("--elsewhere-steps", type=int, default=ELSEWHERE_STEPS, help="on each of them")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--lpips-weights", type=Path, help="folder; default: $ADVTEX_LPIPS_WEIGHTS, else the cache")
    parser.add_argument("--results", type=Path, default=RESULTS / "recipes", help="folder of the results")
    parsed: argparse.Namespace = parser.parse_args(line)
    if parsed.recipes is None:
        parsed.recipes = [name for name, recipe in RECIPES.items() if parsed.elsewhere or not recipe.elsewhere]
    elif not parsed.elsewhere and any(RECIPES[name].elsewhere for name in parsed.recipes):
        parser.error(f'"{ELSEWHERE}" needs --elsewhere')
    return parsed


def settings_of(arguments: argparse.Namespace, scan: Path, recipe: str) -> dict[str, Any]:
    """What a cell is found by."""
    shared = {name: getattr(arguments, name) for name in ("size", "preset", "steps")}
    return {"scan": scan.stem, "recipe": recipe, **shared}


def play(given: MethodInput, recipe: Recipe) -> tuple[Tensor, dict[str, float]]:
    """The texture [H,W,3], and the shares of patches told apart at three points of a game."""
    given.work.clear()
    preset = dataclasses.replace(given.preset, **recipe.preset)
    if recipe.alone is not None:
        preset = dataclasses.replace(preset, pretraining=round(recipe.alone * preset.steps))
    config = dataclasses.replace(given.config, method=recipe.method)
    given = dataclasses.replace(given, preset=preset, config=config, facts={})
    with patched(recipe.code):
        texture, _ = texture_function(recipe.method)(given)
    points = given.facts.get("game", {}).get("points", [])
    told = {f"told apart, {point['at']}": point["accuracy"] for point in points}
    return completed(given, texture), told


def configured(arguments: argparse.Namespace, size: str) -> TextureConfig:
    return TextureConfig(
        preset=arguments.preset,
        size=parsed_size(size),
        holdout=HOLDOUT,
        steps=arguments.steps,
        face_budget=SCAN_FACES,
        device=arguments.device,
    )


def begun(scan: Path, config: TextureConfig, device: torch.device) -> MethodInput:
    """The scan before its optimization; its work folder is gone."""
    with tempfile.TemporaryDirectory(prefix="advtex-recipes-") as folder:
        given = prepare(scan, config, Path(folder), device)
        return started(dataclasses.replace(given, preset=resolve_preset(config)))


def learned_elsewhere(arguments: argparse.Namespace, scan: Path, device: torch.device) -> PatchDiscriminator:
    """That of `learning.py`'s option "both", after its steps on each of the other scans."""
    others, config = list[MethodInput](), configured(arguments, ELSEWHERE_SIZE)
    alone = {"pretraining": arguments.elsewhere_steps, "feature_weight": 0.0, "gabor_weight": 0.0}
    for other in arguments.elsewhere:
        if other.stem != scan.stem:
            given = begun(other, config, device)
            others.append(dataclasses.replace(given, preset=dataclasses.replace(given.preset, **SLOW, **alone)))
    return learned_on(others, OPTIONS["both"], arguments.elsewhere_steps, 0).discriminator


def fill(arguments: argparse.Namespace, results: Results) -> None:
    """Runs every cell that is not in the results yet; all recipes of a scan begin with the same selection."""
    device = choose_device(arguments.device)
    for scan in arguments.scans:
        missing = [name for name in arguments.recipes if results.find(settings_of(arguments, scan, name)) is None]
        if not missing:
            continue
        config = configured(arguments, arguments.size)
        with tempfile.TemporaryDirectory(prefix="advtex-recipes-") as folder:
            given = prepare(scan, config, Path(folder), device)
            given = started(dataclasses.replace(given, preset=resolve_preset(config)))
            for name in missing:
                recipe = RECIPES[name]
                if recipe.elsewhere:
                    learned = learned_elsewhere(arguments, scan, device)
                    knowing = {f"{GAME}.PatchDiscriminator": lambda _, learned=learned: copy.deepcopy(learned)}
                    recipe = dataclasses.replace(recipe, code=knowing)
                watch = Stopwatch()
                texture, told = play(given, recipe)
                seconds = watch.seconds
                kept = arguments.results / scan.stem / name.replace(" ", "_").replace(",", "")
                scores = score_model(given, texture, scan, kept, None, arguments.lpips_weights)
                results.add(settings_of(arguments, scan, name), {**scores, **told}, seconds)


def report(arguments: argparse.Namespace, results: Results) -> None:
    """recipes.md: a table per scan, and the geometric means over all scans."""
    told = {f"told apart, {at}": f"told apart, {at}" for at in ("end of pretraining", "middle", "end")}
    shown = {**told, **SCAN_SCORES}
    body, found = "", list[dict[str, Any]]()
    for scan in arguments.scans:
        cells = {name: results.find(settings_of(arguments, scan, name)) for name in RECIPES}
        rows = [
            [name, *(cell["scores"].get(score, "-") for score in shown), cell["seconds"]]
            for name, cell in cells.items()
            if cell is not None
        ]
        found += [cell for cell in cells.values() if cell is not None]
        table = markdown_table(["recipe", *shown.values(), "seconds"], rows)
        body += f"\n## {scan.stem}, {arguments.size}, {arguments.preset}\n\n{table}"
    over_scans = {
        name: [results.find(settings_of(arguments, scan, name)) for scan in arguments.scans] for name in RECIPES
    }
    body += geometric_means("recipe", over_scans)
    write_report(arguments.results / "recipes.md", "The game's recipes", found, body)


def main(line: list[str] | None = None) -> None:
    arguments = arguments_of(line)
    needed_lpips(arguments.lpips_weights)
    results = Results(arguments.results / "recipes.json")
    fill(arguments, results)
    report(arguments, results)


if __name__ == "__main__":
    main()

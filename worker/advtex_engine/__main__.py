"""`advtex-engine texture|check|evaluate|synthesize|compare|bench`: the engine alone, without a service."""

from __future__ import annotations

import argparse
import dataclasses
import json
import signal
import sys
import time
from collections.abc import Mapping
from pathlib import Path

from advtex_engine.bench.options import add_bench_options
from advtex_engine.core.config import METHODS, PRESETS, TextureConfig
from advtex_engine.core.errors import EngineError, OptionError, Problem, Stopped
from advtex_engine.core.monitor import Monitor
from advtex_scan.layouts import LAYOUT_NAMES
from advtex_scan.version import product_version


class _Printer(Monitor):
    """Prints warnings to stderr, each line with the seconds since the start."""

    def __init__(self) -> None:
        self.started = time.monotonic()

    def warning(self, problem: Problem) -> None:
        self._say(f"warning: {problem.where}: {problem.message} ({problem.remedy})")

    def note(self, message: str) -> None:
        self._say(message)

    def _say(self, words: str) -> None:
        print(f"[{time.monotonic() - self.started:7.1f} s] {words}", file=sys.stderr, flush=True)


class _Terminal(_Printer):
    """Prints stages and progress too; the first SIGINT or SIGTERM asks for a stop with a checkpoint."""

    def __init__(self) -> None:
        super().__init__()
        self.stop = False
        self.first: tuple[int, float] | None = None
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._ask)

    def _ask(self, number: int, _frame: object) -> None:
        self.stop = True
        signal.signal(number, signal.SIG_DFL)

    def stage_started(self, stage: str) -> None:
        self._say(f"{stage} ...")

    def stage_finished(
        self, stage: str, seconds: float, peak_memory_bytes: int, _peak_device_memory_bytes: int | None
    ) -> None:
        self._say(f"{stage}: {seconds:.1f} s, peak memory {peak_memory_bytes / 2**20:.0f} MiB")

    def progress(self, step: int, steps: int, losses: Mapping[str, float]) -> None:
        now = time.monotonic()
        first, since = self.first = self.first or (step, now)
        rate = (step - first) / (now - since) if step > first else 0.0
        left = f", {(steps - step) / rate:.0f} s left" if rate else ""
        named = ", ".join(f"{name} {value:.3f}" for name, value in losses.items())
        self._say(f"step {step}/{steps}: {named}{left}")

    def stop_requested(self) -> bool:
        return self.stop


def parse_size(text: str) -> tuple[int, int]:
    """ "320x240" -> (320, 240)."""
    width, _, height = text.lower().partition("x")
    if not (width.isdigit() and height.isdigit()):
        raise argparse.ArgumentTypeError(f"{text!r} is not a size; write WIDTHxHEIGHT, for example 320x240")
    return int(width), int(height)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="advtex-engine", description=__doc__)
    parser.add_argument("--version", action="version", version=f"advtex-engine {product_version()}")
    commands = parser.add_subparsers(dest="command", required=True)
    texture = commands.add_parser("texture", help="texture a scan (folder or zip)")
    texture.add_argument("scan", type=Path)
    texture.add_argument("-o", "--out", type=Path, required=True, help="folder for the result")
    texture.add_argument("--preset", default="auto", choices=("auto", *PRESETS))
    texture.add_argument("--method", default="adversarial", choices=METHODS)
    texture.add_argument("--size", type=parse_size, help="working size of the views, WIDTHxHEIGHT")
    texture.add_argument("--holdout", type=int, help="leave out the sorted frames whose position %% N == N // 2")
    texture.add_argument("--steps", type=int, help="override the preset's step count")
    texture.add_argument(
        "--refine",
        action=argparse.BooleanOptionalAction,
        default=TextureConfig.refine,
        help="refine cameras and exposures first; the preset paper never does, the method colormap always",
    )
    texture.add_argument("--face-budget", type=int, default=TextureConfig.face_budget)
    texture.add_argument("--max-views", type=int, default=TextureConfig.max_views, help="chosen from a longer scan")
    texture.add_argument("--max-texture-size", type=int, default=TextureConfig.max_texture_size)
    texture.add_argument("--layout", choices=LAYOUT_NAMES, help="how the files are laid out; else found out")
    texture.add_argument("--device", default="auto")
    texture.add_argument("--seed", type=int, default=0)
    texture.add_argument("--checkpoint-seconds", type=float, default=TextureConfig.checkpoint_seconds)
    texture.add_argument("--resume", action="store_true", help="go on from the checkpoint in OUT/work")
    check = commands.add_parser("check", help="measure whether a scan means what its layout says")
    check.add_argument("scan", type=Path, help="folder or zip")
    check.add_argument("--layout", choices=LAYOUT_NAMES, help="how the files are laid out; else found out")
    check.add_argument("--json", action="store_true", help="one line of JSON")
    evaluate = commands.add_parser("evaluate", help="score a textured model against a scan's photographs")
    evaluate.add_argument("model", type=Path, help="OBJ or GLB with one texture")
    evaluate.add_argument("scan", type=Path, help="folder or zip")
    evaluate.add_argument("--holdout", type=int, help="only the sorted frames whose position %% N == N // 2")
    evaluate.add_argument("--size", type=parse_size, help="size of renders and photographs, WIDTHxHEIGHT")
    evaluate.add_argument("--layout", choices=LAYOUT_NAMES, help="how the scan's files are laid out; else found out")
    evaluate.add_argument("--reference", type=Path, help="mesh that decides which pixels count; default: the scan's")
    evaluate.add_argument("--lpips-weights", type=Path, help="folder; default: $ADVTEX_LPIPS_WEIGHTS, else the cache")
    evaluate.add_argument("--download-weights", action="store_true", help="fetch the weights of LPIPS if they lack")
    evaluate.add_argument(
        "--refine-heldout", action="store_true", help="refine the frames' poses against the model first, and say so"
    )
    evaluate.add_argument("--json", type=Path, help="write the scores per view and their means")
    evaluate.add_argument("--contact-sheet", type=Path, help="write a PNG: photograph, render, difference")
    synthesize = commands.add_parser("synthesize", help="make a scan with known truth")
    synthesize.add_argument("out", type=Path, help="folder, or file.zip")
    synthesize.add_argument("--views", type=int, default=60)
    synthesize.add_argument("--size", type=parse_size, default=(320, 240))
    synthesize.add_argument("--seed", type=int, default=0)
    compare = commands.add_parser("compare", help="score a result against the truth of a synthesized scan")
    compare.add_argument("model", type=Path, help="model.obj")
    compare.add_argument("scan", type=Path, help="the synthesized scan")
    bench = commands.add_parser("bench", help="time a step of the optimization, its parts and the stages around it")
    add_bench_options(bench)
    return parser


def main(argv: list[str] | None = None) -> int:
    """Runs a command; exit codes: 0 done, 1 the input cannot be used, 2 usage, 130 stopped with a checkpoint."""
    arguments = _parser().parse_args(argv)
    try:
        return _COMMANDS[arguments.command](arguments)
    except Stopped as stopped:
        print(f"advtex-engine: {stopped}", file=sys.stderr)
        return 130
    except OptionError as error:
        print(f"advtex-engine: {error}", file=sys.stderr)
        return 2
    except EngineError as error:
        print(f"advtex-engine: {error}", file=sys.stderr)
        return 1


def _texture(arguments: argparse.Namespace) -> int:
    from advtex_engine.pipeline import texture_scan

    names = {option.name for option in dataclasses.fields(TextureConfig)} & vars(arguments).keys()
    config = TextureConfig(**{name: getattr(arguments, name) for name in names})
    out: Path = arguments.out
    result = texture_scan(arguments.scan, out, config, work=out / "work", resume=arguments.resume, monitor=_Terminal())
    for path in result.files:
        print(path)
    return 0


def _check(arguments: argparse.Namespace) -> int:
    from advtex_engine.conventions.check import deep_check

    check = deep_check(arguments.scan, arguments.layout)
    if arguments.json:
        print(json.dumps(None if check is None else check.to_dict()))
    else:
        print("nothing can be measured: there is neither depth nor a mesh" if check is None else check.format_text())
    return 1 if check is not None and check.hopeless else 0


def _evaluate(arguments: argparse.Namespace) -> int:
    from advtex_engine.metrics.evaluate import evaluate, write_json
    from advtex_engine.metrics.lpips import LPIPS_SOURCES, download, weights_folder

    if arguments.download_weights:
        download(LPIPS_SOURCES, weights_folder(arguments.lpips_weights))
    given = {name: getattr(arguments, name) for name in ("model", "scan", "size", "holdout", "layout", "reference")}
    evaluation = evaluate(
        **given,
        weights=arguments.lpips_weights,
        sheet=arguments.contact_sheet,
        refine_poses=arguments.refine_heldout,
        monitor=_Printer(),
    )
    if arguments.json is not None:
        write_json(arguments.json, evaluation, given)
    for name, value in evaluation.mean.items():
        print(f"{name:24}{'-' if value is None else format(value, '.4g')}")
    if evaluation.refined is not None:
        print("poses were refined against the model before scoring:")
        for row in evaluation.refined:
            words = "kept its pose" if row["kept_pose"] else f"moved by {row['moved_pixels']:.2f} pixels"
            print(f"  {row['name']} {words}")
    for name, reason in evaluation.missing.items():
        print(f"{name} is missing: {reason}", file=sys.stderr)
    return 0


def _synthesize(arguments: argparse.Namespace) -> int:
    from advtex_engine.synthetic.scan import synthesize

    width, height = arguments.size
    synthesize(arguments.out, views=arguments.views, width=width, height=height, seed=arguments.seed)
    print(arguments.out)
    return 0


def _compare(arguments: argparse.Namespace) -> int:
    from advtex_engine.synthetic.scan import compare_to_truth

    print(json.dumps(compare_to_truth(arguments.model, arguments.scan)))
    return 0


def _bench(arguments: argparse.Namespace) -> int:
    from advtex_engine.bench.run import run

    return run(arguments)


_COMMANDS = {
    "texture": _texture,
    "check": _check,
    "evaluate": _evaluate,
    "synthesize": _synthesize,
    "compare": _compare,
    "bench": _bench,
}


if __name__ == "__main__":
    sys.exit(main())

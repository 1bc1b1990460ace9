"""`advtex-engine texture|check|evaluate|synthesize|compare|bench`: the engine alone, without a service."""

from __future__ import annotations

import json
import signal
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from advtex_engine.bench.options import DEVICE, FACES, HEIGHT, PRESET, VIEWS, WIDTH
from advtex_engine.core.config import PRESETS, TextureConfig
from advtex_engine.core.errors import EngineError, OptionError, Problem, Stopped
from advtex_engine.core.monitor import Monitor
from advtex_options import parse_size
from advtex_options.flags import LayoutFlag, option_flags, version_flag


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


app = typer.Typer(
    help="The engine alone, without a service.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

ScanPath = Annotated[Path, typer.Argument(help="folder or zip")]
HOLDOUT = "only the sorted frames whose position % N == N // 2"
SIZE = "size of renders and photographs"


@app.callback()
def advtex_engine(
    _version: Annotated[bool, version_flag("advtex-engine")] = False,
) -> None:
    """The engine alone, without a service."""


def main(argv: list[str] | None = None) -> int:
    """Runs a command; exit codes: 0 done, 1 the input cannot be used, 2 usage, 130 stopped with a checkpoint."""
    try:
        app(argv, prog_name="advtex-engine")
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else 1
    except Stopped as stopped:
        print(f"advtex-engine: {stopped}", file=sys.stderr)
        return 130
    except OptionError as error:
        print(f"advtex-engine: {error}", file=sys.stderr)
        return 2
    except EngineError as error:
        print(f"advtex-engine: {error}", file=sys.stderr)
        return 1
    return 0


@app.command()
@option_flags
def texture(
    scan: ScanPath,
    out: Annotated[Path, typer.Option("-o", "--out", help="folder for the result")],
    given: dict[str, Any],
    refine: Annotated[
        bool, typer.Option(help="refine cameras and exposures first; the preset paper never does, some methods always")
    ] = TextureConfig.refine,
    device: Annotated[str, typer.Option(help="cpu, cuda, cuda:N, or auto")] = TextureConfig.device,
    checkpoint_seconds: Annotated[
        float, typer.Option(help="time between checkpoints")
    ] = TextureConfig.checkpoint_seconds,
    resume: Annotated[bool, typer.Option("--resume", help="go on from the checkpoint in OUT/work")] = False,
) -> None:
    """Texture a scan (folder or zip)."""
    from advtex_engine.pipeline import texture_scan

    given["size"] = _pair(given.get("size"))
    config = TextureConfig(**given, refine=refine, device=device, checkpoint_seconds=checkpoint_seconds)
    result = texture_scan(scan, out, config, work=out / "work", resume=resume, monitor=_Terminal())
    for path in result.files:
        print(path)


@app.command()
def check(
    scan: ScanPath,
    layout: LayoutFlag = None,
    as_json: Annotated[bool, typer.Option("--json", help="one line of JSON")] = False,
) -> None:
    """Measure whether a scan means what its layout says."""
    from advtex_engine.conventions.check import deep_check

    found = deep_check(scan, layout)
    if as_json:
        print(json.dumps(None if found is None else found.to_dict()))
    else:
        print("nothing can be measured: there is neither depth nor a mesh" if found is None else found.format_text())
    if found is not None and found.hopeless:
        raise typer.Exit(1)


@app.command()
def evaluate(
    model: Annotated[Path, typer.Argument(help="OBJ or GLB with one texture")],
    scan: ScanPath,
    holdout: Annotated[int | None, typer.Option(help=HOLDOUT)] = None,
    size: Annotated[str | None, typer.Option(metavar="WxH", help=SIZE)] = None,
    layout: LayoutFlag = None,
    reference: Annotated[
        Path | None, typer.Option(help="mesh that decides which pixels count", show_default="the scan's")
    ] = None,
    lpips_weights: Annotated[
        Path | None, typer.Option(help="folder", show_default="$ADVTEX_LPIPS_WEIGHTS, else the cache")
    ] = None,
    download_weights: Annotated[
        bool, typer.Option("--download-weights", help="fetch the weights of LPIPS if they lack")
    ] = False,
    refine_heldout: Annotated[
        bool, typer.Option("--refine-heldout", help="refine the frames' poses against the model first, and say so")
    ] = False,
    budget: Annotated[
        bool, typer.Option("--budget", help="split LPIPS into what pose, tone, displacement, motion and content cost")
    ] = False,
    json_: Annotated[Path | None, typer.Option("--json", help="write the scores per view and their means")] = None,
    contact_sheet: Annotated[Path | None, typer.Option(help="write a PNG: photograph, render, difference")] = None,
) -> None:
    """Score a textured model against a scan's photographs."""
    from advtex_engine.metrics.budget import TABLE, format_budget
    from advtex_engine.metrics.evaluate import evaluate, write_json
    from advtex_engine.metrics.lpips import LPIPS_SOURCES, download, weights_folder

    given: dict[str, Any] = {
        "model": model,
        "scan": scan,
        "size": _pair(size),
        "holdout": holdout,
        "layout": layout,
        "reference": reference,
    }
    if download_weights:
        download(LPIPS_SOURCES, weights_folder(lpips_weights))
    evaluation = evaluate(
        **given,
        weights=lpips_weights,
        sheet=contact_sheet,
        refine_poses=refine_heldout,
        budget=budget,
        monitor=_Printer(),
    )
    if json_ is not None:
        write_json(json_, evaluation, given)
    for name, value in evaluation.mean.items():
        if not budget or name not in TABLE:
            print(f"{name:24}{'-' if value is None else format(value, '.4g')}")
    if budget:
        print(format_budget(evaluation.per_view, evaluation.mean))
    if evaluation.refined is not None:
        print("poses were refined against the model before scoring:")
        for row in evaluation.refined:
            words = "kept its pose" if row["kept_pose"] else f"moved by {row['moved_pixels']:.2f} pixels"
            print(f"  {row['name']} {words}")
    for name, reason in evaluation.missing.items():
        print(f"{name} is missing: {reason}", file=sys.stderr)


@app.command()
def synthesize(
    out: Annotated[Path, typer.Argument(help="folder, or file.zip")],
    views: int = 60,
    size: Annotated[
        str | None, typer.Option(metavar="WxH", help="of the views, pixels", show_default="320x240; real: 640x480")
    ] = None,
    seed: int = 0,
    real: Annotated[bool, typer.Option("--real", help="with all that real cameras, sensors and trackers do")] = False,
    scene: Annotated[
        Literal["room", "object"] | None, typer.Option(help="with --real: what is scanned", show_default="room")
    ] = None,
    sensor: Annotated[
        Literal["structured", "lidar"] | None, typer.Option(help="with --real: of depth", show_default="structured")
    ] = None,
) -> None:
    """Make a scan with known truth."""
    if real:
        from advtex_engine.synthetic.real import synthesize_real

        width, height = _pair(size) or (640, 480)
        scene, sensor = scene or "room", sensor or "structured"
        synthesize_real(out, scene=scene, sensor=sensor, views=views, width=width, height=height, seed=seed)
    elif scene is not None or sensor is not None:
        raise typer.BadParameter("--scene and --sensor are of scans with the errors of real ones; give --real too")
    else:
        from advtex_engine.synthetic.scan import synthesize

        width, height = _pair(size) or (320, 240)
        synthesize(out, views=views, width=width, height=height, seed=seed)
    print(out)


@app.command()
def compare(
    model: Annotated[Path, typer.Argument(help="model.obj")],
    scan: Annotated[Path, typer.Argument(help="the synthesized scan")],
) -> None:
    """Score a result against the truth of a synthesized scan."""
    from advtex_engine.synthetic.scan import compare_to_truth

    print(json.dumps(compare_to_truth(model, scan)))


@app.command()
def bench(
    device: str = DEVICE,
    width: Annotated[int, typer.Option(help="of the full frame in pixels; a step sees a crop of it")] = WIDTH,
    height: Annotated[int, typer.Option(help="of the full frame in pixels")] = HEIGHT,
    preset: Annotated[
        str, typer.Option(metavar="|".join(PRESETS), help="decides the crop's size and the losses")
    ] = PRESET,
    views: Annotated[int, typer.Option(help="of the scene that is made")] = VIEWS,
    faces: Annotated[int, typer.Option(help="of the scene that is made, about")] = FACES,
    as_json: Annotated[bool, typer.Option("--json", help="one line of JSON")] = False,
) -> None:
    """Time a step of the optimization, its parts and the stages around it."""
    if preset not in PRESETS:
        raise OptionError(f"preset {preset!r} is unknown; choose one of {', '.join(PRESETS)}")
    from advtex_engine.bench.run import bench, print_table

    result = bench(device, width, height, preset, views=views, faces=faces)
    if as_json:
        print(json.dumps(result))
    else:
        print_table(result)


def _pair(size: str | None) -> tuple[int, int] | None:
    """Width and height of a flag; OptionError."""
    try:
        return None if size is None else parse_size(size)
    except ValueError as error:
        raise OptionError(str(error)) from error


if __name__ == "__main__":
    sys.exit(main())

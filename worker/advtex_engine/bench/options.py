"""The options of `advtex-engine bench`; nothing here imports torch."""

from __future__ import annotations

import argparse

from advtex_engine.core.config import PRESETS

VIEWS, FACES = 16, 80_000


def add_bench_options(parser: argparse.ArgumentParser) -> None:
    """The options of the command, in whichever parser it is."""
    parser.add_argument("--device", default="auto")
    parser.add_argument("--width", type=int, default=640, help="of the full frame in pixels; a step sees a crop of it")
    parser.add_argument("--height", type=int, default=480, help="of the full frame in pixels")
    parser.add_argument("--preset", default="paper", choices=PRESETS, help="decides the crop's size and the losses")
    parser.add_argument("--views", type=int, default=VIEWS, help="of the scene that is made")
    parser.add_argument("--faces", type=int, default=FACES, help="of the scene that is made, about")
    parser.add_argument("--json", action="store_true", help="one line of JSON")

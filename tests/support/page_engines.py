"""An engine for tests of the page: a seed says what happens, and the result is one that the real engine made before."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path

import fake_engines

from advtex_engine.core.config import TextureConfig
from advtex_engine.core.monitor import Glimpse, Monitor

FAILS = 1  # the seed
CURVES = {"steps": [1, 2, 3], "series": {"l1": [0.3, 0.2, 0.1]}, "quality": {"steps": [], "series": {}}}


def engine(scan: Path, out: Path, config: TextureConfig, *, work: Path, resume: bool, monitor: Monitor) -> None:
    """A glimpse, `config.steps` steps of 10 ms, then the files of $ADVTEX_ENGINE_PAGE_RESULT; an error with FAILS."""
    result = Path(os.environ["ADVTEX_ENGINE_PAGE_RESULT"])
    if config.seed == FAILS:
        print("looking for the widget", file=sys.stderr, flush=True)
        raise ValueError("the widget is not a gadget")
    monitor.glimpsed(
        Glimpse(1, {"0.jpg": (result / "previews" / "thumbnail.jpg").read_bytes()}, {"0.jpg": "color/4"}, CURVES)
    )
    fake_engines.stepping(scan, out, config, work=work, resume=resume, monitor=monitor)
    shutil.copytree(result, out, dirs_exist_ok=True)

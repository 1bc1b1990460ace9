"""Losses, what the discriminator knows, and quality over the steps, as files and pages show them.

`previews/curves.json`:

    {"steps": [...], "series": {"l1": [...], ...}, "quality": {"steps": [...], "series": {"psnr": [...], ...}}}

Every series has a value per step, null where there is none. Losses are means since the step before, and so are the
numbers of `adversarial/game.py`, but for the gradients' norms. Quality is measured now and then on a few fixed views
(`live.py`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

MAX_POINTS = 500

Point = Mapping[str, Any]
"""{"step": int, name: value, ...}"""


def curves(losses: Sequence[Point], quality: Sequence[Point], game: Sequence[Point] = ()) -> dict[str, Any]:
    """All histories as JSON values; of more than MAX_POINTS each, points from all over it, the last one included.

    game: what is told of the losses' steps beside them, if not among them.
    """
    beside = {point["step"]: point for point in game}
    told = [{**point, **beside.get(point["step"], {})} for point in losses]
    return {**_series(told), "quality": _series(quality)}


def _series(points: Sequence[Point]) -> dict[str, Any]:
    stride = max(1, -(-len(points) // MAX_POINTS))
    kept = points[(len(points) - 1) % stride :: stride] if points else []
    names = sorted({name for point in kept for name in point} - {"step"})
    return {
        "steps": [point["step"] for point in kept],
        "series": {name: [_number(point.get(name)) for point in kept] for name in names},
    }


def _number(value: float | None) -> float | None:
    """Six digits are more than a picture shows. JSON has no NaN."""
    return float(f"{value:.6g}") if value is not None and math.isfinite(value) else None

"""A box in the scan's world, as an option has it."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

FORM = "X,Y,Z,SIZE_X,SIZE_Y,SIZE_Z[,YAW]"


@dataclass(frozen=True)
class Box:
    """center, size: metres, in the world that the scan's cameras are given in. yaw: degrees about the up axis.

    size: along the world's three axes, before the box is turned about its center, counter-clockwise seen from above.
    """

    center: tuple[float, float, float]
    size: tuple[float, float, float]
    yaw: float = 0.0


def parse_box(text: object) -> Box:
    """ "0,0,1,2,2,2,30" -> a box of 2 m a side about (0, 0, 1), turned by 30 degrees; ValueError for what is none."""
    words = f"box {str(text)[:60]!r} is no box; give it as {FORM}, in metres and degrees, with sizes above 0"
    if not isinstance(text, str):
        raise ValueError(words)
    try:
        numbers = [float(part) for part in re.split(r"\s*,\s*", text.strip())]
    except ValueError as error:
        raise ValueError(words) from error
    if len(numbers) not in (6, 7) or not all(map(math.isfinite, numbers)) or min(numbers[3:6]) <= 0:
        raise ValueError(words)
    x, y, z, along_x, along_y, along_z, *yaw = numbers
    return Box((x, y, z), (along_x, along_y, along_z), *yaw)

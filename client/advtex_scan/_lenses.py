"""Whether a lens's distortion is one that can be undone: within the image, it must not fold."""

from __future__ import annotations

import math
from functools import lru_cache

from advtex_scan.manifest import Intrinsics

STEPS = 200  # from the middle of the image outwards
FARTHEST = 4.0  # of the corner's distance, that a straight ray may have come from
MOST_TANGENTIAL = 0.1  # of p1 and p2; those of real lenses are below 0.02


@lru_cache(maxsize=1024)
def distortion_problem(camera: Intrinsics) -> str | None:
    """Return why a camera's distortion cannot be undone, None if it can or if there is none.

    Rays at growing angles must come to lie at growing distances from the principal point, until the farthest corner
    is reached.
    """
    bent = camera.distortion
    if bent is None:
        return None
    values = (bent.k1, bent.k2, bent.p1, bent.p2, bent.k3)
    shown = ", ".join(f"{value:g}" for value in values)
    if not all(map(math.isfinite, values)) or max(abs(bent.p1), abs(bent.p2)) > MOST_TANGENTIAL:
        return f"its distortion k1, k2, p1, p2, k3 = {shown} is that of no lens"
    corner = math.hypot(
        max(camera.cx, camera.width - camera.cx) / camera.fx, max(camera.cy, camera.height - camera.cy) / camera.fy
    )
    reached = 0.0
    for step in range(1, STEPS + 1):
        radius = FARTHEST * corner * step / STEPS
        square = radius * radius
        place = radius * (1 + square * (bent.k1 + square * (bent.k2 + square * bent.k3)))
        if not place > reached:
            break
        reached = place
        if reached >= corner:
            return None
    share = reached / corner if math.isfinite(corner) else 0.0
    return f"its distortion k1, k2, p1, p2, k3 = {shown} folds the image at {share:.0%} of the way to its corner"

"""Quadric edge collapse (Garland & Heckbert 1997). Arrays only, without torch.

The library holds the interpreter until it is done, a second for 300,000 faces, so that nothing else of the process
would go on: large meshes are collapsed in a child process (`runtime/children.py`).
"""

from __future__ import annotations

import threading
from collections.abc import Sequence

import fast_simplification
import numpy as np
import numpy.typing as npt

from advtex_engine.core.monitor import Monitor
from advtex_engine.runtime.children import Arrays, run_in_children

# From this many faces on, collapsing takes longer than a child's start (.2 s).
CHILD_FACES = 100_000
TOO_LARGE = "simplify the mesh before upload, or free memory on the machine"

# The library keeps the mesh it works on in variables of the process: two threads would mix up their meshes.
_LOCK = threading.Lock()


def collapse(
    position: npt.NDArray[np.float32],
    faces: npt.NDArray[np.int32],
    target: int,
    rounds: Sequence[tuple[float, bool]],
    monitor: Monitor,
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int64]]:
    """Positions [V,3] and faces [T,3] of the mesh with about `target` faces; deterministic.

    rounds: aggression, and whether borders stay, one after the other until the target is reached. May leave degenerate
    faces. Raises Stopped when the monitor asks for it, and EngineError when a child process died twice.
    """
    request: Arrays = {
        "position": position,
        "faces": faces,
        "target": np.array(target),
        "rounds": np.array(rounds, dtype=np.float64),
    }
    if len(faces) < CHILD_FACES:
        collapsed = collapse_rounds(**request)
    else:
        (collapsed,) = run_in_children("advtex_engine.mesh.quadric:collapse_rounds", [request], 1, monitor, TOO_LARGE)
    return collapsed["position"], collapsed["faces"]


def collapse_rounds(
    position: npt.NDArray[np.float32],
    faces: npt.NDArray[np.int32],
    target: npt.NDArray[np.int64],
    rounds: npt.NDArray[np.float64],
) -> Arrays:
    """What a child does for `collapse`."""
    for aggression, preserved in rounds.tolist():
        with _LOCK:
            position, faces = fast_simplification.simplify(
                np.ascontiguousarray(position, np.float32),
                np.ascontiguousarray(faces, np.int32),
                target_count=int(target),
                agg=aggression,
                preserve_border=bool(preserved),
            )
        if len(faces) <= int(target):
            break
    return {"position": position.astype(np.float32), "faces": faces.astype(np.int64)}

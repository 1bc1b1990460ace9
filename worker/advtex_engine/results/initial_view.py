"""Where a viewer of the model file begins: there, where the turntable does."""

from __future__ import annotations

import math
from typing import Any

import torch

from advtex_engine.core.cameras import camera_center
from advtex_engine.core.scene import TO_Y_UP
from advtex_engine.previews.turntable import FIELD_OF_VIEW, SIZE, Circle, circle_cameras
from advtex_scan.matrices import from_quaternion


def orbit(circle: Circle, up_axis: str) -> dict[str, Any]:
    """The turntable's first camera, as viewers of glTF want it.

    orientation: roll, pitch and yaw in radians that stand the GLB's model upright (first roll around +z, then pitch
    around +x, then yaw around +y); all else is after it. target: [x, y, z] and radius in metres. theta: around +y from
    +z; phi: from +y; radians. field_of_view: degrees, of the image's height. aspect: the width over the height of an
    image that holds the whole model all the way around.
    """
    as_glb = torch.tensor(from_quaternion(*TO_Y_UP[up_axis], (0.0, 0.0, 0.0)), dtype=torch.float64)[:3, :3]
    stand = _to_y(as_glb @ circle.up)
    world = stand @ as_glb
    away = (world @ (camera_center(circle_cameras(circle)[0]) - circle.center)).tolist()
    radius = math.hypot(*away)
    return {
        "orientation": [
            math.atan2(stand[1, 0], stand[1, 1]),
            math.asin(-float(stand[1, 2].clamp(-1, 1))),
            math.atan2(stand[0, 2], stand[2, 2]),
        ],
        "target": (world @ circle.center).tolist(),
        "radius": radius,
        "theta": math.atan2(away[0], away[2]),
        "phi": math.acos(away[1] / radius),
        "field_of_view": FIELD_OF_VIEW,
        "aspect": SIZE[0] / SIZE[1],
    }


def _to_y(up: torch.Tensor) -> torch.Tensor:
    """The rotation [3,3] by which a unit vector [3] becomes +y on the shortest way."""
    x, y, z = up.tolist()
    if y < -1 + 1e-9:
        return torch.diag(up.new_tensor([1.0, -1.0, -1.0]))
    # Rodrigues' formula with the axis up x y, whose length is the angle's sine
    cross = up.new_tensor([[0, -x, 0], [x, 0, z], [0, -z, 0]])
    turn: torch.Tensor = torch.eye(3, dtype=up.dtype) + cross + cross @ cross / (1 + y)
    return turn

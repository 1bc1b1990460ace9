"""4x4 rigid transforms as nested tuples, and the test that a pose is one. Rows first; points are columns."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import cast

from advtex_scan.manifest import IDENTITY, Matrix4, UpAxis

ROTATION_TOLERANCE = 0.01  # largest entry of |R Rᵀ - I|; six printed digits (ScanNet) give about 1e-6


def matrix4(values: Sequence[float]) -> Matrix4:
    """Return a matrix from 16 numbers, row by row, or from the 12 of its upper three rows."""
    full = [*values, 0.0, 0.0, 0.0, 1.0] if len(values) == 12 else list(values)
    assert len(full) == 16
    return cast(Matrix4, tuple(tuple(float(value) for value in full[row : row + 4]) for row in range(0, 16, 4)))


def says_nothing(values: Sequence[float]) -> bool:
    """Tell whether 16 numbers are the identity, or all 0, as some writers leave a matrix that they do not know."""
    unit = [value for row in IDENTITY for value in row]
    return not any(values) or all(abs(a - b) <= 1e-6 for a, b in zip(values, unit, strict=True))


def compose(a: Matrix4, b: Matrix4) -> Matrix4:
    """Return a @ b: first b, then a."""
    columns = list(zip(*b, strict=True))
    rows = [[sum(x * y for x, y in zip(row, column, strict=True)) for column in columns] for row in a]
    return matrix4([value for row in rows for value in row])


def invert_rigid(transform: Matrix4) -> Matrix4:
    """Return the inverse of a rotation and translation: Rᵀ, -Rᵀ t."""
    rotation = [row[:3] for row in transform[:3]]
    shift = [row[3] for row in transform[:3]]
    values: list[float] = []
    for column in zip(*rotation, strict=True):
        values += [*column, -sum(x * y for x, y in zip(column, shift, strict=True))]
    return matrix4(values)


def opencv_axes(pose: Matrix4) -> Matrix4:
    """Turn a camera_to_world from OpenGL's and ARKit's camera axes (y up, z backward) to OpenCV's; same world."""
    return matrix4([sign * value for row in pose for sign, value in zip((1, -1, -1, 1), row, strict=True)])


def from_quaternion(x: float, y: float, z: float, w: float, shift: Sequence[float]) -> Matrix4:
    """Return the rotation of a unit quaternion, then `shift`; a quaternion of another length gives no rotation."""
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w), shift[0]),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w), shift[1]),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y), shift[2]),
    )
    return matrix4([value for row in rows for value in row])


def from_rotation_vector(vector: Sequence[float], shift: Sequence[float]) -> Matrix4:
    """Return the rotation by |vector| radians about `vector`, then `shift`; NaN for a vector without a length."""
    angle = math.hypot(*vector)
    if not math.isfinite(angle):
        return matrix4([math.nan] * 12)
    scale = math.sin(angle / 2) / angle if angle else 0.5
    x, y, z = (scale * value for value in vector)
    return from_quaternion(x, y, z, math.cos(angle / 2), shift)


def pose_problem(transform: Matrix4) -> str | None:
    """Return why a matrix is no rigid transform, None if it is one within ROTATION_TOLERANCE."""
    if not all(math.isfinite(value) for row in transform for value in row):
        return "the pose holds NaN or infinite numbers"
    if any(abs(x - y) > 1e-3 for x, y in zip(transform[3], (0, 0, 0, 1), strict=True)):
        return f"the last row of the pose is {list(transform[3])}, not 0 0 0 1"
    r0, r1, r2 = (row[:3] for row in transform[:3])
    off = max(abs(_dot(a, b) - (a is b)) for a in (r0, r1, r2) for b in (r0, r1, r2))
    if not off <= ROTATION_TOLERANCE:
        return f"the pose is not a rotation: R Rᵀ is off the identity by {off:.3g} (at most {ROTATION_TOLERANCE})"
    cross = (r0[1] * r1[2] - r0[2] * r1[1], r0[2] * r1[0] - r0[0] * r1[2], r0[0] * r1[1] - r0[1] * r1[0])
    if _dot(cross, r2) < 0:
        return "the pose mirrors: its determinant is -1, not 1"
    return None


def is_lost(transform: Matrix4) -> bool:
    """Tell whether this is the mark of lost tracking (ScanNet, BundleFusion): nothing in the upper rows is finite."""
    return not any(math.isfinite(value) for row in transform[:3] for value in row)


def up_axis_of(poses: Iterable[Matrix4]) -> UpAxis:
    """Return the world axis nearest to where camera_to_world poses (OpenCV axes) have their upper side on average.

    For layouts whose world has no stated up direction: people hold a camera upright more often than not. "+z" without a
    finite pose.
    """
    ups = [[-row[1] for row in pose[:3]] for pose in poses if not pose_problem(pose)]
    mean = [sum(axis) for axis in zip(*ups, strict=True)] if ups else [0.0, 0.0, 1.0]
    index = max(range(3), key=lambda axis: abs(mean[axis]))
    return cast(UpAxis, ("+" if mean[index] > 0 else "-") + "xyz"[index])


def _dot(a: Sequence[float], b: Sequence[float]) -> float:
    return sum(x * y for x, y in zip(a, b, strict=True))

"""What is done with a whole mesh's numbers at once; whoever has numpy brings arithmetic of their own."""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence
from typing import Any, Protocol

from advtex_scan.manifest import IDENTITY, Matrix4
from advtex_scan.matrices import compose
from advtex_scan.mesh._part import MeshPart

Vector = tuple[float, float, float]


class Arithmetic(Protocol):
    """The steps of reading a mesh whose time grows with it. Nothing in a part is changed."""

    def compose(self, parent: Any, local: Matrix4) -> Any:
        """The transform that is first `local`, then `parent`, 4x4; `parent` is a Matrix4 or came from here."""
        ...

    def placed(self, parts: Sequence[MeshPart]) -> memoryview:
        """All parts' vertices in world coordinates, format "f": transformed in double precision, then rounded."""
        ...

    def joined(self, parts: Sequence[MeshPart]) -> memoryview:
        """All parts' triangles, format "q", as indices into what `placed` gives."""
        ...

    def extremes(self, indices: array[int]) -> tuple[int, int]:
        """The lowest and the highest of some indices."""
        ...

    def count_not_finite(self, positions: memoryview) -> int:
        """How many coordinates are NaN or infinite."""
        ...

    def bounds(self, positions: memoryview) -> tuple[Vector, Vector]:
        """The lowest and the highest x, y and z."""
        ...


class PlainArithmetic:
    """`Arithmetic` by the standard library."""

    def compose(self, parent: Any, local: Matrix4) -> Matrix4:
        return compose(parent, local)

    def placed(self, parts: Sequence[MeshPart]) -> memoryview:
        if len(parts) == 1 and parts[0].positions.typecode == "f" and parts[0].transform in (None, IDENTITY):
            return memoryview(parts[0].positions)
        positions = array("f")
        for part in parts:
            if part.transform in (None, IDENTITY):
                positions.extend(array("f", part.positions))
            else:
                positions.extend(_moved(part.positions, part.transform))
        return memoryview(positions)

    def joined(self, parts: Sequence[MeshPart]) -> memoryview:
        if len(parts) == 1:
            return memoryview(parts[0].triangles)
        triangles, base = array("q"), 0
        for part in parts:
            triangles.extend(map(base.__add__, part.triangles) if base else part.triangles)
            base += len(part.positions) // 3
        return memoryview(triangles)

    def extremes(self, indices: array[int]) -> tuple[int, int]:
        return min(indices), max(indices)

    def count_not_finite(self, positions: memoryview) -> int:
        if all(map(math.isfinite, positions)):
            return 0
        return sum(not math.isfinite(value) for value in positions)

    def bounds(self, positions: memoryview) -> tuple[Vector, Vector]:
        x, y, z = (positions[axis::3] for axis in range(3))
        return (min(x), min(y), min(z)), (max(x), max(y), max(z))


def _moved(positions: array[float], transform: Matrix4) -> array[float]:
    (a, b, c, d), (e, f, g, h), (i, j, k, m) = transform[:3]
    moved = array("f")
    for x, y, z in zip(positions[0::3], positions[1::3], positions[2::3], strict=True):
        moved.extend((a * x + b * y + c * z + d, e * x + f * y + g * z + h, i * x + j * y + k * z + m))
    return moved

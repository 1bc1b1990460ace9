"""Wavefront OBJ: `v`, `vt`, `f` and `usemtl` lines; its groups and objects are joined.

Polygons are split into fans, negative indices count from the newest vertex, and a line that ends with a backslash goes
on in the next one. Colors and weights of vertices are passed over.
"""

from __future__ import annotations

from array import array
from collections import defaultdict
from dataclasses import dataclass
from itertools import repeat
from operator import sub
from typing import Literal

from advtex_scan.errors import MeshError
from advtex_scan.mesh._part import MeshPart, MeshSource, add_fans, broken, check_counts
from advtex_scan.mesh._text import INTEGERS, TextReader, common_form, numbers, table, tidy

USEMTL = b"\nusemtl "


def read_obj(source: MeshSource) -> MeshPart:
    """Vertices, fan-split faces, and uv if all corners have them. Raises MeshError."""
    contents = _Contents(source.path)
    reader = TextReader(source.stream)
    while True:
        try:
            text = reader.block()
        except ValueError as error:
            raise MeshError(broken(source.path, f"behind line {contents.lines}, {error}")) from error
        if not text:
            return contents.part()
        contents.add(text)


@dataclass(frozen=True, slots=True)
class _Faces:
    """sides: how many corners each has, or one number for all; corners, uv: their indices as the file counts them."""

    sides: int | list[int]
    corners: list[int]
    uv: list[int] | None


class _Contents:
    """The mesh as far as it is read. lines: of the file, so far."""

    def __init__(self, path: str) -> None:
        self.lines = 0
        self._path = path
        self._mesh = MeshPart(materials=[(0, "")])
        self._uv = array("d")
        self._uv_triangles: array[int] | None = array("q")  # None once a corner has none

    def part(self) -> MeshPart:
        if self._uv_triangles:
            self._mesh.uv, self._mesh.uv_triangles = self._uv, self._uv_triangles
        return self._mesh

    def add(self, text: bytes) -> None:
        """Whole lines."""
        if b"\\" in text:
            return self._add_lines(text)
        first, *others = (b"\n" + text).split(USEMTL)
        self._add_lines(first[1:] + b"\n" if others else first[1:])
        for place, lines in enumerate(others, 1):
            name, _, rest = lines.partition(b"\n")
            self._use_material(name.split())
            self.lines += 1
            self._add_lines(rest + b"\n" if place < len(others) else rest)
        return None

    def _add_lines(self, text: bytes) -> None:
        if text.strip() and not self._add_alike(tidy(text.replace(b"\\\n", b" "))):
            self._add_by_words(text)
        self.lines += text.count(b"\n")
        check_counts(self._path, len(self._mesh.positions) // 3, len(self._mesh.triangles) // 3)

    def _use_material(self, words: list[bytes]) -> None:
        self._mesh.materials.append((len(self._mesh.triangles) // 3, b" ".join(words).decode("latin-1")))

    # Lines that differ in their numbers alone -------------------------------------------------------------------------

    def _add_alike(self, text: bytes) -> bool:
        """Lines of which all of a kind are alike; False, and nothing is added, if they are to be read word by word."""
        kinds = _by_kind(text)
        if kinds is None:
            return False
        positions = _vectors(kinds[b"v "], b"v ", "f", 3) if b"v " in kinds else array("f")
        uv = _vectors(kinds[b"vt"], b"vt ", "d", 2) if b"vt" in kinds else array("d")
        faces = _faces(kinds[b"f "]) if b"f " in kinds else _Faces(3, [], None)
        if positions is None or uv is None or faces is None:
            return False
        relative = b"-" in kinds.get(b"f ", b"") and len(kinds) > 1
        try:
            above = _counts_above(text, b"v ", faces) if relative else None
            corners = _from_zero(faces.corners, len(self._mesh.positions) // 3, above)
            above = _counts_above(text, b"vt", faces) if relative else None
            uv_corners = _from_zero(faces.uv or [], len(self._uv) // 2, above if faces.uv else None)
        except OverflowError:
            return False
        self._mesh.positions.extend(positions)
        self._uv.extend(uv)
        add_fans(self._mesh.triangles, corners, faces.sides)
        if len(uv_corners) < len(corners):
            self._uv_triangles = None
        elif self._uv_triangles is not None:
            add_fans(self._uv_triangles, uv_corners, faces.sides)
        return True

    # Word by word -----------------------------------------------------------------------------------------------------

    def _add_by_words(self, text: bytes) -> None:
        number = self.lines
        # A vertical tab is as good as a space, and tells how many lines of the file are one.
        for line in text.replace(b"\\\n", b"\v").splitlines():
            number += 1 + line.count(b"\v")
            words = line.split()
            kind = words[0] if words else b""
            try:
                if kind == b"v":
                    self._mesh.positions.extend((float(words[1]), float(words[2]), float(words[3])))
                elif kind == b"vt":
                    self._uv.extend((float(words[1]), float(words[2]) if len(words) > 2 else 0.0))
                elif kind == b"f":
                    self._add_face(words[1:])
                elif kind == b"usemtl":
                    self._use_material(words[1:])
            except (ValueError, IndexError, OverflowError) as error:
                shown = line[:60].decode("ascii", "replace").strip()
                raise MeshError(broken(self._path, f"line {number} is not understood: {shown!r}")) from error

    def _add_face(self, words: list[bytes]) -> None:
        parts = [word.split(b"/") for word in words]
        uv = [int(part[1]) for part in parts if len(part) > 1 and part[1]]
        if len(uv) < len(parts):
            self._uv_triangles = None
        elif self._uv_triangles is not None:
            add_fans(self._uv_triangles, _from_zero(uv, len(self._uv) // 2), [len(parts)])
        corners = _from_zero([int(part[0]) for part in parts], len(self._mesh.positions) // 3)
        add_fans(self._mesh.triangles, corners, [len(parts)])


def _by_kind(text: bytes) -> dict[bytes, bytes] | None:
    """The lines by their first two bytes; None if some of them must be read word by word."""
    kind = text[:2]
    if kind in (b"v ", b"f ") and text.count(b"\n" + kind) == text.count(b"\n") - 1:
        return {kind: text}
    if b"\v" in text or b"\f" in text:
        return None
    lines = defaultdict[bytes, list[bytes]](list)
    for line in text.split(b"\n"):
        lines[line[:2]].append(line)
    if not lines.keys().isdisjoint((b"v", b"f", b"us")):
        return None
    return {kind: b"\n".join([*lines[kind], b""]) for kind in (b"v ", b"vt", b"f ") if kind in lines}


def _without(text: bytes, keyword: bytes) -> bytes | None:
    """Lines without the keyword that they all begin with; None if not all of them do."""
    if not text.startswith(keyword) or text.count(b"\n" + keyword) < text.count(b"\n") - 1:
        return None
    return text[len(keyword) :].replace(b"\n" + keyword, b"\n")


def _vectors(text: bytes, keyword: bytes, kind: Literal["f", "d"], width: int) -> array[float] | None:
    """The first `width` numbers of each line."""
    body = _without(text, keyword)
    found = None if body is None else table(body, float)
    if found is None or found[1] < width:
        return None
    values, columns = found
    if columns == width:
        return array(kind, values)
    flat = array(kind, bytes(array(kind).itemsize * width * (len(values) // columns)))
    for place in range(width):
        flat[place::width] = array(kind, values[place::columns])
    return flat


def _faces(text: bytes) -> _Faces | None:
    """Faces whose corners are all written alike: v, v/vt, v//vn or v/vt/vn."""
    body = _without(text, b"f ")
    if body is None:
        return None
    slashes = body.translate(None, INTEGERS).replace(b"\n", b" ")
    form = slashes[: slashes.find(b" ")]
    corners = slashes.count(b" ")
    if form not in (b"", b"/", b"//") or slashes != (form + b" ") * corners:
        return None
    doubled = body.count(b"//")
    if doubled not in (0, corners):
        return None
    found = numbers(body.replace(b"//", b"/") if doubled else body)
    if found is None:
        return None
    step = 1 + len(form) - bool(doubled)
    common = common_form(body, INTEGERS)
    sides = [line.count(b" ") + 1 for line in body.splitlines()] if common is None else common.count(b" ") + 1
    return _Faces(sides, found[::step], found[1::step] if form and not doubled else None)


def _counts_above(text: bytes, kind: bytes, faces: _Faces) -> list[int]:
    """How many lines of a kind stand above the line of each corner."""
    count, above = 0, list[int]()
    for line in text.splitlines():
        if line.startswith(kind):
            count += 1
        elif line.startswith(b"f "):
            above.append(count)
    sides = repeat(faces.sides) if isinstance(faces.sides, int) else faces.sides
    return [each for each, corners in zip(above, sides, strict=False) for _ in range(corners)]


def _from_zero(indices: list[int], count: int, above: list[int] | None = None) -> array[int]:
    """Indices that count from 0.

    The file's count from 1; those with a sign, back from the newest of what was there before, which are `count` and as
    many as `above` says of each. 0 becomes -1.
    """
    if min(indices, default=0) >= 0:
        return array("q", map(sub, indices, repeat(1)))
    newest = repeat(count, len(indices)) if above is None else map(count.__add__, above)
    pairs = zip(indices, newest, strict=True)
    return array("q", [index - 1 if index >= 0 else max(index + end, -1) for index, end in pairs])

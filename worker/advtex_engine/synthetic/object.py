"""The synthetic object: a still life on a turntable, made by code alone, with its true texture.

A tea tin with a lid and a carrying arch, a mug in front of it, a book and a toy block: parts hide each other from
most directions, and their print is as fine as a scanner's camera resolves. World: metres, +z up, the turntable's
axis is the z axis and its foot lies at z = 0.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial

import numpy as np
import torch

from advtex_engine.core.scene import Atlas
from advtex_engine.synthetic import print as prints
from advtex_engine.synthetic.patches import Array, Patch, Sky, Surface, join, light, pack, paint, shaded, square_grid

TEXTURE_SIZE = 2048
DENSITY = 3.1
"""Texels per millimetre: the drawings fill the atlas."""
SPACING = 4.5
"""Millimetres between vertices: fine enough for the paper's per-vertex offsets to bend every surface."""


@cache
def build(seed: int = 0) -> tuple[Atlas, torch.Tensor]:
    """The object with its atlas, and its texture [TEXTURE_SIZE,TEXTURE_SIZE,3] uint8 sRGB; light is baked in.

    Made once for all scans of a process, and shared: not to be written to.
    """
    parts = patches(seed)
    corners = pack([patch.drawing.shape[:2] for patch in parts], TEXTURE_SIZE)
    mesh = join(parts, corners, TEXTURE_SIZE)
    lit = [shaded(patch.drawing, shade) for patch, shade in zip(parts, light(mesh, parts, Sky()), strict=True)]
    texture = torch.from_numpy(paint(lit, corners, TEXTURE_SIZE))
    return Atlas(mesh, TEXTURE_SIZE, TEXTURE_SIZE, "scan", len(parts)), texture


def patches(seed: int = 0) -> list[Patch]:
    """All surfaces of the object; the seed decides what is printed on them."""
    return list(_patches(np.random.default_rng(seed)))


# The parts, in millimetres.


def _patches(rng: np.random.Generator) -> Iterator[Patch]:
    yield from _turntable(rng)
    yield from _tin(rng)
    yield from _mug(rng)
    yield from _book(rng)
    block = _rounded_rectangle(32, 32, 2.5)
    place = _placed(-9, -84, 49, 28)
    yield _swept(block, [(0, 32), (0, 0), (0, -1)], place, partial(prints.letter_block, rng=rng))
    yield _cap(block, 32, place, partial(prints.block_top, rng=rng))


def _turntable(rng: np.random.Generator) -> Iterator[Patch]:
    place = _placed(0, 0, 0, 0)
    half = np.linspace(0, 1, 721)[:361]
    for turn in (0.0, 180.0):
        rim = 150 * np.stack([np.cos(2 * np.pi * half), np.sin(2 * np.pi * half)], -1)
        profile = [(-2.0, 28.0), (0.0, 26.0), (0.0, 0.0)]
        yield _swept(rim, profile, _placed(0, 0, 0, turn), partial(prints.turntable_side, rng=rng))
    yield _cap(_ellipse(148, 148), 28, place, partial(prints.turntable_top, rng=rng))


def _tin(rng: np.random.Generator) -> Iterator[Patch]:
    place = _placed(-24, 44, 28, 14)
    wall = _rounded_rectangle(112, 78, 14)
    yield _swept(wall, [(0, 124), (0, 0), (0, -1)], place, partial(prints.tin_side, rng=rng))
    rim = [(-4, 146), (-1, 145), (1.5, 142), (2, 139), (2, 122), (0, 121)]
    yield _swept(wall, rim, place, partial(prints.lid_side, rng=rng))
    yield _cap(_rounded_rectangle(104, 70, 10), 146, place, partial(prints.lid_top, rng=rng))
    angle = np.linspace(np.pi, 0, 121)
    arch = np.stack([61 * np.cos(angle), 0 * angle, 112 + 78 * np.sin(angle)], -1)
    yield _tube(arch, 3.6, place, partial(prints.metal, rng=rng))
    for turn in (0.0, 180.0):
        boss = _ellipse(7, 7)
        side = _compose(place, _turned(90 + turn))
        yield _cap(boss, 65.0, _compose(side, _tipped(0, 0, 112)), partial(prints.brass, rng=rng))
        rod = [(0, 65), (0, 54)]
        stand = _compose(side, _tipped(0, 0, 112))
        yield _swept(boss, rod, stand, partial(prints.brass, rng=rng))


def _mug(rng: np.random.Generator) -> Iterator[Patch]:
    place = _placed(80, -44, 28, -8)
    wall = _ellipse(37, 37)
    outside = [(-1.6, 88), (0, 86.5), (0, 6), (-2.5, 0), (-2.5, -1)]
    yield _swept(wall, outside, place, partial(prints.mug_side, rng=rng))
    yield _swept(wall[::-1], [(1.6, 88), (3.6, 86.5), (4, 60)], place, partial(prints.glaze, rng=rng))
    yield _cap(_ellipse(33.2, 33.2), 66, place, partial(prints.tea, rng=rng))
    angle = np.linspace(1.5, -1.5, 91)
    handle = np.stack([33 + 30 * np.cos(angle), 0 * angle, 46 + 27 * np.sin(angle)], -1)
    yield _tube(handle, 5.2, _compose(place, _turned(-48)), partial(prints.glaze, rng=rng, color=prints.BLUE))


def _book(rng: np.random.Generator) -> Iterator[Patch]:
    place = _placed(-42, -58, 28, -12)
    board = _rounded_rectangle(128, 92, 2.5)
    for bottom, art in ((0.0, prints.book_board), (17.5, prints.book_cover)):
        yield _swept(
            board, [(0, bottom + 3.5), (0, bottom - 0.5)], place, partial(prints.book_board, rng=rng), columns=150
        )
        yield _cap(board, bottom + 3.5, place, partial(art, rng=rng), columns=150)
    # The block of pages is flush with the boards at the spine, which lies along y at the left.
    pages = _rounded_rectangle(122, 85, 2.0) + np.array([-2.6, 0])
    start = int(np.argmin(np.linalg.norm(pages - np.array([-63.6, 42.5]), axis=1)))
    pages = np.concatenate([pages[start:-1], pages[: start + 1]])
    block = partial(prints.book_block, rng=rng, spine=85.0)
    yield _swept(pages, [(0, 17.6), (0, 3.4)], place, block, columns=140)


# Surfaces over the unit square.


def _along(line: Array) -> Callable[[Array], Array]:
    """The polyline [N,D] as a function of its arc length, 0 to 1."""
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    return lambda at: np.stack([np.interp(at, length / length[-1], axis) for axis in line.T], -1)


def _length(line: Array) -> float:
    return float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())


def _ellipse(a: float, b: float) -> Array:
    """Closed counter-clockwise outline [N,2] that starts at -y, so that the chart's seam lies there."""
    angle = np.linspace(-np.pi, np.pi, 721)
    return np.stack([a * np.cos(angle), b * np.sin(angle)], -1)


def _rounded_rectangle(width: float, height: float, radius: float) -> Array:
    """Closed counter-clockwise outline [N,2] from the corner at -x, -y: the wall at -y comes first."""
    turns = [(-1, -1, np.pi), (1, -1, 1.5 * np.pi), (1, 1, 0.0), (-1, 1, 0.5 * np.pi)]
    points = []
    for x, y, start in turns:
        angle = start + np.linspace(0, np.pi / 2, 19)
        center = np.array([x * (width / 2 - radius), y * (height / 2 - radius)])
        points.append(center + radius * np.stack([np.cos(angle), np.sin(angle)], -1))
    ring = np.concatenate(points)
    return np.concatenate([ring[9:], ring[:10]])


def _outward(outline: Array) -> Array:
    """Unit normals [N,2] of an outline, to the right of its direction; the ends of a closed one agree."""
    closed = np.allclose(outline[0], outline[-1])
    padded = np.concatenate(
        [outline[-2:-1] if closed else outline[:1], outline, outline[1:2] if closed else outline[-1:]]
    )
    tangent = padded[2:] - padded[:-2]
    normal = np.stack([tangent[:, 1], -tangent[:, 0]], -1)
    return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True), np.float64)


def _steps(length: float) -> int:
    return max(2, round(length / SPACING))


def _swept(
    outline: Array,
    profile: Sequence[tuple[float, float]],
    place: Surface,
    draw: Callable[[float, float, float], prints.Image],
    columns: int | None = None,
) -> Patch:
    """A wall: `profile` (outward offset, height) from top to bottom, swept along `outline`."""
    edge, normal, side = _along(outline), _along_with(outline, _outward(outline)), np.array(profile, np.float64)
    rise = _along(side)

    def surface(st: Array) -> Array:
        at = rise(st[..., 1])
        plan = edge(st[..., 0]) + normal(st[..., 0]) * at[..., :1]
        return place(np.concatenate([plan, at[..., 1:]], -1))

    wide, high = _length(outline), _length(side)
    grid = square_grid(columns or _steps(wide), _steps(high))
    return Patch(surface, grid, draw(wide, high, DENSITY))


def _along_with(line: Array, values: Array) -> Callable[[Array], Array]:
    """`values` [N,D] of the polyline's points as a function of its arc length, 0 to 1."""
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    return lambda at: np.stack([np.interp(at, length / length[-1], axis) for axis in values.T], -1)


def _cap(
    outline: Array,
    height: float,
    place: Surface,
    draw: Callable[[float, float, float], prints.Image],
    columns: int | None = None,
) -> Patch:
    """The flat top inside a closed outline; its chart is the bounding rectangle."""
    low, high = outline.min(0), outline.max(0)
    size = high - low

    def surface(st: Array) -> Array:
        plan = np.stack([low[0] + st[..., 0] * size[0], high[1] - st[..., 1] * size[1]], -1)
        return place(np.concatenate([plan, np.full((*plan.shape[:-1], 1), height)], -1))

    around = _along(outline)(np.linspace(0, 1, (columns or _steps(_length(outline))) + 1))
    shares = np.linspace(0, 1, _steps(float(size.min()) / 2) + 1)[:, None, None]
    plan = (low + high) / 2 * (1 - shares) + around * shares
    grid = np.stack([(plan[..., 0] - low[0]) / size[0], (high[1] - plan[..., 1]) / size[1]], -1)
    return Patch(surface, grid, draw(float(size[0]), float(size[1]), DENSITY))


def _tube(path: Array, radius: float, place: Surface, draw: Callable[[float, float, float], prints.Image]) -> Patch:
    """A rod along a path [N,3] that lies in the plane y = 0."""
    center = _along(path)
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    binormal = np.array([0.0, 1.0, 0.0])
    normal = _along_with(path, np.cross(tangent, binormal))

    def surface(st: Array) -> Array:
        angle = 2 * np.pi * st[..., 1:]
        return place(center(st[..., 0]) + radius * (np.cos(angle) * normal(st[..., 0]) - np.sin(angle) * binormal))

    length = _length(path)
    grid = square_grid(_steps(length), 10)
    return Patch(surface, grid, draw(length, 2 * np.pi * radius, DENSITY))


def _turned(degrees: float) -> Surface:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return lambda p: p @ turn.T


def _placed(x: float, y: float, z: float, degrees: float) -> Surface:
    turn = _turned(degrees)
    return lambda p: turn(p) + np.array([x, y, z])


def _tipped(x: float, y: float, z: float) -> Surface:
    """The part's +z becomes -y: a rod that stands becomes one that points to the viewer."""
    return lambda p: np.stack([p[..., 0], -p[..., 2], p[..., 1]], -1) + np.array([x, y, z])


def _compose(outer: Surface, inner: Surface) -> Surface:
    return lambda p: outer(inner(p))

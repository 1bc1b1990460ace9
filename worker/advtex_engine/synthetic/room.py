"""The synthetic room: the corner of a kitchen, made by code alone, with its true texture.

Three walls, a floor, a counter below tiles, a fridge whose door carries small print, shelves with books, a window that
is brighter than any exposure for the room can hold, a table, and chairs on thin legs. World: metres, +z up, the floor
at z = 0, the back wall at y = 3; patches are in millimetres.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import Protocol

import numpy as np

from advtex_engine.synthetic import room_print as prints
from advtex_engine.synthetic.patches import Array, Patch, Sky, square_grid
from advtex_engine.synthetic.print import CREAM, Image

WIDTH, DEPTH, HEIGHT = 3600.0, 3000.0, 2500.0
SPACING = 70.0
"""Millimetres between vertices: rolling shutter and lenses bend straight lines, and do it at vertices."""
TEXTURE_SIZE = 4096
SKY = Sky(center=(1.8, 1.5, 1.0), reach=2.6, distance=30.0, size=900, slack=0.012)
WINDOW_LIGHT = 7.0
"""The window's light over that of white paper in the room."""
FRIDGE = (620.0, 2350.0, 660.0, 640.0, 1750.0)
"""x, y, width, depth, height; its door faces -y."""


class Drawing(Protocol):
    """Draws a rectangle of width x height millimetres."""

    def __call__(self, width: float, height: float, density: float, *, rng: np.random.Generator) -> Image:
        """[H,W,3] uint8 sRGB."""


def patches(seed: int = 0) -> list[Patch]:
    """All surfaces of the room; the seed decides what is printed on them."""
    rng = np.random.default_rng([seed, 1])
    return [
        *_shell(rng),
        *_window(rng),
        *_counter(rng),
        *_fridge(rng),
        *_shelf(rng),
        *_table(rng),
        *_chair(900.0, 1250.0, rng),
        *_chair(2150.0, 1750.0, rng),
    ]


def _panel(
    origin: tuple[float, float, float],
    right: tuple[float, float, float],
    down: tuple[float, float, float],
    draw: Drawing,
    rng: np.random.Generator,
    density: float,
) -> Patch:
    """A flat rectangle, seen from where `right` points right and `down` down."""
    corner, across, along = np.array(origin), np.array(right), np.array(down)

    def surface(st: Array) -> Array:
        place: Array = corner + st[..., :1] * across + st[..., 1:] * along
        return place

    wide, high = float(np.linalg.norm(across)), float(np.linalg.norm(along))
    grid = square_grid(max(1, round(wide / SPACING)), max(1, round(high / SPACING)))
    return Patch(surface, grid, draw(wide, high, density, rng=rng))


def _box(
    x: float,
    y: float,
    z: float,
    size: tuple[float, float, float],
    draw: Drawing,
    rng: np.random.Generator,
    density: float,
    sides: Mapping[str, tuple[Drawing, float]] | None = None,
) -> Iterator[Patch]:
    """A box with its corner at (x, y, z); `sides` by their names have drawings and densities of their own."""
    w, d, h = size
    up = z + h
    places = {
        "front": ((x, y, up), (w, 0.0, 0.0), (0.0, 0.0, -h)),
        "back": ((x + w, y + d, up), (-w, 0.0, 0.0), (0.0, 0.0, -h)),
        "right": ((x + w, y, up), (0.0, d, 0.0), (0.0, 0.0, -h)),
        "left": ((x, y + d, up), (0.0, -d, 0.0), (0.0, 0.0, -h)),
        "top": ((x, y + d, up), (w, 0.0, 0.0), (0.0, -d, 0.0)),
        "bottom": ((x, y, z), (w, 0.0, 0.0), (0.0, d, 0.0)),
    }
    for name, place in places.items():
        drawing, fine = (sides or {}).get(name, (draw, density))
        yield _panel(*place, drawing, rng, fine)


def _shell(rng: np.random.Generator) -> Iterator[Patch]:
    yield _panel((0, DEPTH, 0), (WIDTH, 0, 0), (0, -DEPTH, 0), prints.floor, rng, 0.4)
    yield _panel((0, DEPTH, HEIGHT), (WIDTH, 0, 0), (0, 0, -HEIGHT), prints.wall, rng, 0.2)
    yield _panel((0, 0, HEIGHT), (0, DEPTH, 0), (0, 0, -HEIGHT), prints.wall, rng, 0.2)
    yield _panel((WIDTH, DEPTH, HEIGHT), (0, -DEPTH, 0), (0, 0, -HEIGHT), prints.wall, rng, 0.2)
    for y, high in ((2500.0, 840.0), (1600.0, 700.0)):
        wide = high / 1.4
        yield _panel((WIDTH - 8, y, 1900), (0, -wide, 0), (0, 0, -high), prints.poster, rng, 0.95)
    yield _panel((8, 250, 1900), (0, 500, 0), (0, 0, -700), prints.poster, rng, 0.95)
    yield _panel((8, 2000, 2200), (0, 430, 0), (0, 0, -600), prints.poster, rng, 0.95)


def _window(rng: np.random.Generator) -> Iterator[Patch]:
    left, top, wide, high = 2350.0, 2150.0, 1000.0, 1150.0
    pane = _panel((left, DEPTH - 10, top), (wide, 0, 0), (0, 0, -high), prints.window, rng, 0.4)
    yield replace(pane, glow=WINDOW_LIGHT, clear=1.0)
    white = partial(prints.plain, color=prints.WHITE, grain=0.01)
    bars = [(left - 50, wide + 100, top, 50.0), (left - 50, wide + 100, top - high - 50, 50.0)]
    for x, length, z, thick in bars:
        yield from _box(x, DEPTH - 50, z, (length, 50.0, thick), white, rng, 0.3)
    for x in (left - 50, left + wide / 2 - 20, left + wide):
        yield from _box(x, DEPTH - 50, top - high, (50.0, 50.0, high), white, rng, 0.3)


def _counter(rng: np.random.Generator) -> Iterator[Patch]:
    stone = partial(prints.plain, color=(74, 72, 74), grain=0.12)
    sides: dict[str, tuple[Drawing, float]] = {"right": (prints.cupboards, 0.7), "top": (stone, 0.5)}
    yield from _box(0, 500, 0, (560.0, 2500.0, 860.0), prints.timber, rng, 0.3, sides)
    tiled = _panel((7, 500, 1400), (0, 2500, 0), (0, 0, -540), prints.tiles, rng, 0.75)
    yield replace(tiled, gloss=0.6)
    for y, wide, high in ((800.0, 120.0, 190.0), (1050.0, 90.0, 240.0), (1500.0, 160.0, 150.0), (1900.0, 110.0, 260.0)):
        sides = {"right": (prints.cover, 1.4), "front": (prints.cover, 1.4)}
        yield from _box(170, y, 860, (80.0, wide, high), prints.plain, rng, 0.5, sides)


def _fridge(rng: np.random.Generator) -> Iterator[Patch]:
    x, y, wide, deep, high = FRIDGE
    enamel = partial(prints.plain, color=prints.WHITE, grain=0.008)
    yield from _box(x, y, 0, (wide, deep, high), enamel, rng, 0.3, {"front": (prints.fridge_door, 1.4)})


def _shelf(rng: np.random.Generator) -> Iterator[Patch]:
    left, wide, deep = 1400.0, 800.0, 270.0
    back = DEPTH - deep
    for z in (150.0, 530.0, 910.0, 1290.0, 1670.0):
        yield from _box(left, back, z, (wide, deep, 22.0), prints.timber, rng, 0.5)
    for x in (left - 22, left + wide):
        yield from _box(x, back, 0, (22.0, deep, 1900.0), prints.timber, rng, 0.5)
    for z in (172.0, 552.0, 932.0, 1312.0):
        x = left + 12
        while x < left + wide - 70:
            thick, high = float(rng.uniform(24, 58)), float(rng.uniform(190, 320))
            deep_in = float(rng.uniform(12, 45))
            plain = partial(prints.plain, color=CREAM)
            yield from _box(
                x, back + deep_in, z, (thick, 190.0, high), plain, rng, 0.25, {"front": (prints.spine, 1.3)}
            )
            x += thick + (float(rng.uniform(40, 140)) if rng.random() < 0.15 else 1.5)


def _table(rng: np.random.Generator) -> Iterator[Patch]:
    x, y, wide, deep, high = 1350.0, 900.0, 1200.0, 720.0, 720.0
    yield from _box(x, y, high, (wide, deep, 32.0), prints.timber, rng, 0.5, {"top": (prints.timber, 0.8)})
    for dx in (20.0, wide - 70):
        for dy in (20.0, deep - 70):
            yield from _box(x + dx, y + dy, 0, (50.0, 50.0, high), prints.timber, rng, 0.4)
    top = high + 32
    for dx, dy, side in ((120.0, 120.0, 210.0), (400.0, 330.0, 190.0), (820.0, 160.0, 220.0)):
        yield from _box(
            x + dx, y + dy, top, (side, side * 1.35, 9.0), prints.plain, rng, 0.4, {"top": (prints.cover, 1.4)}
        )
    sides: dict[str, tuple[Drawing, float]] = dict.fromkeys(("front", "back", "left", "right"), (prints.cover, 1.4))
    yield from _box(x + 650, y + 420, top, (140.0, 100.0, 200.0), prints.plain, rng, 0.5, sides)


def _chair(x: float, y: float, rng: np.random.Generator) -> Iterator[Patch]:
    """Its legs are 22 mm thin and its back is of slats."""
    side, seat, back, leg = 400.0, 450.0, 900.0, 22.0
    dark = partial(prints.timber, tones=prints.WALNUT)
    yield from _box(x, y, seat, (side, side, 25.0), dark, rng, 0.5)
    black = partial(prints.plain, color=(34, 32, 32))
    for dx in (0.0, side - leg):
        yield from _box(x + dx, y, 0, (leg, leg, seat), black, rng, 0.3)
        yield from _box(x + dx, y + side - leg, 0, (leg, leg, back), black, rng, 0.3)
    for z in (560.0, 680.0, 800.0):
        yield from _box(x + leg, y + side - 20, z, (side - 2 * leg, 16.0, 60.0), dark, rng, 0.5)

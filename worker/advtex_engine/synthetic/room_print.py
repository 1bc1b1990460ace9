"""The printed surfaces of the synthetic room: walls, tiles, wood, posters, notes, covers of books.

As in `print.py`, a drawing covers a rectangle given in millimetres and comes back as [H,W,3] uint8 sRGB.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from advtex_engine.synthetic.print import (
    BLUE,
    CREAM,
    GOLD,
    GREEN,
    INK,
    RED,
    SKY,
    Image,
    Rgb,
    Sheet,
    hatching,
    rosette,
    wood,
)

WHITE: Rgb = (236, 235, 230)
OAK: tuple[Rgb, Rgb] = ((206, 160, 104), (142, 96, 56))
WALNUT: tuple[Rgb, Rgb] = ((112, 76, 50), (62, 40, 28))
CLOTHS: Sequence[Rgb] = (RED, GREEN, BLUE, INK, SKY, CREAM, (96, 56, 104), (206, 120, 40), (70, 110, 60))
WORDS = """harbor lantern meadow copper winter signal orchard granite velvet compass ember thistle marble canyon
saffron pepper anchor willow cinder juniper"""


def wall(width: float, height: float, density: float, rng: np.random.Generator) -> Image:
    """Painted plaster: almost nothing to hold on to."""
    sheet = Sheet(width, height, density, (214, 210, 200))
    sheet.grain(rng, 0.012, (14, 14))
    sheet.grain(rng, 0.02, (420, 420))
    return sheet.done()


def floor(width: float, height: float, density: float, rng: np.random.Generator) -> Image:
    """Stone tiles of 300 mm, each of its own tone."""
    sheet = Sheet(width, height, density, (120, 112, 104))
    for y in np.arange(0.0, height, 300.0):
        for x in np.arange(0.0, width, 300.0):
            tone = int(rng.integers(-16, 17))
            sheet.box(float(x) + 3, float(y) + 3, 294, 294, (168 + tone, 158 + tone, 142 + tone))
    sheet.grain(rng, 0.05, (9, 9))
    return sheet.done()


def tiles(width: float, height: float, density: float, rng: np.random.Generator) -> Image:
    """Glazed tiles of 100 mm; one in five has an ornament."""
    sheet = Sheet(width, height, density, (140, 136, 130))
    for y in np.arange(0.0, height, 100.0):
        for x in np.arange(0.0, width, 100.0):
            tone = int(rng.integers(-6, 7))
            sheet.box(float(x) + 2, float(y) + 2, 96, 96, (226 + tone, 228 + tone, 226 + tone))
            if rng.random() < 0.2:
                rosette(sheet, float(x) + 50, float(y) + 50, 34, BLUE, 8, 2.0)
    return sheet.done()


def plain(
    width: float, height: float, density: float, rng: np.random.Generator, color: Rgb = INK, grain: float = 0.03
) -> Image:
    """Paint of one color."""
    sheet = Sheet(width, height, density, color)
    sheet.grain(rng, grain, (6, 6))
    return sheet.done()


def timber(
    width: float, height: float, density: float, rng: np.random.Generator, tones: tuple[Rgb, Rgb] = OAK
) -> Image:
    """Wood with its grain along x."""
    sheet = Sheet(width, height, density, tones[0])
    wood(sheet, rng, *tones, 26.0)
    return sheet.done()


def cupboards(width: float, height: float, density: float, rng: np.random.Generator) -> Image:
    """The counter's front: doors of dark wood with knobs, and a black oven with a scale."""
    sheet = Sheet(width, height, density, WALNUT[0])
    wood(sheet, rng, *WALNUT, 34.0)
    doors = max(2, round(width / 480))
    for door in range(doors):
        left, side = width * door / doors, width / doors
        sheet.box(left + 6, 20, side - 12, height - 90, INK, 5)
        if door == 1:
            oven(sheet, left + 12, 26, side - 24, height - 102)
        else:
            sheet.disc(left + side * 0.85, height * 0.25, 17, (226, 222, 210))
    sheet.box(0, height - 60, width, 60, (30, 28, 28))
    return sheet.done()


def oven(sheet: Sheet, x: float, y: float, width: float, height: float) -> None:
    """Black glass below a panel with knobs."""
    sheet.box(x, y, width, height, (26, 26, 28))
    sheet.box(x, y, width, 90, (206, 206, 204))
    for knob in range(4):
        at = x + width * (knob + 0.5) / 4
        sheet.disc(at, y + 45, 22, INK)
        sheet.text(str(knob + 1), at, y + 80, 11, RED)
    sheet.text("FORNAX 600", x + width / 2, y + height - 40, 18, (190, 190, 190))


def window(width: float, height: float, density: float, rng: np.random.Generator) -> Image:
    """A sky over roofs; what makes it a window is its light."""
    sheet = Sheet(width, height, density, (224, 236, 246))
    sheet.grain(rng, 0.05, (160, 90))
    for x in np.arange(0.0, width, 210.0):
        top = height * (0.72 + 0.1 * rng.random())
        sheet.box(float(x), top, 190, height - top, (150, 118, 104))
    return sheet.done()


def poster(width: float, height: float, density: float, rng: np.random.Generator) -> Image:
    """A picture above a title and lines of text, in a frame."""
    paper = CLOTHS[int(rng.integers(len(CLOTHS)))]
    sheet = Sheet(width, height, density, CREAM)
    sheet.box(0, 0, width, height, INK, width * 0.03)
    sheet.box(width * 0.08, height * 0.06, width * 0.84, height * 0.55, paper)
    for _ in range(5):
        x, y = rng.uniform(0.25, 0.75) * width, rng.uniform(0.18, 0.48) * height
        color = CLOTHS[int(rng.integers(len(CLOTHS)))]
        rosette(sheet, x, y, width * 0.14, color, int(rng.integers(5, 13)), width * 0.004)
    sheet.text(_words(rng, 1).upper(), width / 2, height * 0.69, width * 0.1, INK, bold=True)
    hatching(sheet, width * 0.15, height * 0.75, width * 0.7, height * 0.02, INK)
    for line in range(4):
        sheet.text(_words(rng, 3), width / 2, height * (0.81 + 0.045 * line), width * 0.036, INK)
    return sheet.done()


def fridge_door(width: float, height: float, density: float, rng: np.random.Generator) -> Image:
    """White enamel with a handle, notes, a calendar and magnets: print of 5 to 14 mm."""
    sheet = Sheet(width, height, density, WHITE)
    sheet.grain(rng, 0.006, (5, 5))
    sheet.box(0, height * 0.3 - 4, width, 8, (96, 96, 96))
    sheet.box(width * 0.06, height * 0.34, 18, 300, (150, 152, 156))
    for x, y, title in ((0.34, 0.1, "SHOPPING"), (0.72, 0.12, "PHONE"), (0.36, 0.46, "RECIPE")):
        _note(sheet, x * width, y * height, title, rng)
    _calendar(sheet, width * 0.55, height * 0.36)
    for _ in range(9):
        x, y = rng.uniform(0.2, 0.92) * width, rng.uniform(0.03, 0.75) * height
        color = CLOTHS[int(rng.integers(4))]
        sheet.disc(x, y, 19, color)
        sheet.text(chr(int(rng.integers(65, 91))), x, y, 20, WHITE, bold=True)
    return sheet.done()


def _note(sheet: Sheet, x: float, y: float, title: str, rng: np.random.Generator) -> None:
    """A sheet of paper 170 x 210 mm, centre (x, y)."""
    left, top = x - 85, y - 105
    sheet.box(left, top, 170, 210, (250, 244, 206))
    sheet.box(left, top, 170, 210, (150, 140, 110), 1.5)
    sheet.text(title, x, top + 22, 14, RED, bold=True)
    for line in range(9):
        sheet.text(_words(rng, 2), x, top + 50 + 17 * line, 8.5, INK)


def _calendar(sheet: Sheet, x: float, y: float) -> None:
    """Days in a grid 230 x 250 mm, top left (x, y)."""
    sheet.box(x, y, 230, 250, (252, 252, 250))
    sheet.box(x, y, 230, 44, BLUE)
    sheet.text("OCTOBER", x + 115, y + 22, 17, WHITE, bold=True)
    for day in range(31):
        row, column = divmod(day + 2, 7)
        sheet.text(str(day + 1), x + 20 + 32 * column, y + 68 + 38 * row, 9.5, RED if column == 6 else INK)
    for row in range(6):
        at = y + 49 + 38 * row
        sheet.lines([np.array([[x + 4, at], [x + 226, at]])], (170, 170, 176), 1.2)


def spine(width: float, height: float, density: float, rng: np.random.Generator) -> Image:
    """A book's back with its title along it."""
    cloth = CLOTHS[int(rng.integers(len(CLOTHS)))]
    ink = INK if sum(cloth) > 380 else GOLD
    sheet = Sheet(height, width, density, cloth)
    sheet.grain(rng, 0.03, (2, 2))
    for share in (0.06, 0.09, 0.91, 0.94):
        sheet.box(height * share, 0, 2.2, width, ink)
    sheet.text(_words(rng, 2).upper(), height * 0.5, width / 2, min(11.0, width * 0.38), ink, bold=True)
    return np.ascontiguousarray(np.rot90(sheet.done(), -1))


def cover(width: float, height: float, density: float, rng: np.random.Generator) -> Image:
    """A magazine that lies on the table."""
    paper = CLOTHS[int(rng.integers(len(CLOTHS)))]
    ink = INK if sum(paper) > 380 else CREAM
    sheet = Sheet(width, height, density, paper)
    sheet.text(_words(rng, 1).upper(), width / 2, height * 0.12, width * 0.11, ink, bold=True)
    rosette(sheet, width / 2, height * 0.5, width * 0.32, GOLD, 9, 1.6)
    for line in range(3):
        sheet.text(_words(rng, 2), width / 2, height * (0.83 + 0.05 * line), width * 0.042, ink)
    return sheet.done()


def _words(rng: np.random.Generator, count: int) -> str:
    return " ".join(str(word) for word in rng.choice(WORDS.split(), count, replace=False))

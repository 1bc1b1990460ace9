"""The printed surfaces of the synthetic object: labels, ornament, hatching, wood, drawn by code.

Every drawing covers one rectangle given in millimetres, origin at its top left, x right, y down, and comes back as
[H,W,3] uint8 sRGB (RGB order) at the density asked for. Lines and letters are drawn at twice that density and
averaged down, so that they are anti-aliased as ink on paper is.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Rgb = tuple[int, int, int]

CREAM: Rgb = (242, 232, 208)
INK: Rgb = (38, 34, 40)
GREEN: Rgb = (22, 84, 72)
GOLD: Rgb = (206, 164, 84)
RED: Rgb = (158, 38, 36)
BLUE: Rgb = (34, 66, 138)
SKY: Rgb = (128, 172, 206)
OVERSAMPLE = 2
SUBPIXEL_BITS = 4

SMALL_PRINT = ("Second flush, picked in May", "above 1,900 m. 3 g to a cup,", "water at 90 C, 3 minutes.")


class Sheet:
    """A rectangle of width x height millimetres to draw on, `density` texels per millimetre."""

    def __init__(self, width: float, height: float, density: float, paper: Rgb) -> None:
        self.width, self.height = width, height
        self.shape = (max(2, round(height * density)), max(2, round(width * density)))
        self.scale = density * OVERSAMPLE
        self.pixels: Image = np.full((self.shape[0] * OVERSAMPLE, self.shape[1] * OVERSAMPLE, 3), paper, np.uint8)

    def _points(self, points: NDArray[np.float64]) -> NDArray[np.int32]:
        return np.rint(points * self.scale * (1 << SUBPIXEL_BITS)).astype(np.int32)

    def lines(self, curves: Sequence[NDArray[np.float64]], color: Rgb, width: float, *, closed: bool = False) -> None:
        """Draw each curve [N,2] with a pen `width` mm wide."""
        pen = max(1, round(width * self.scale))
        fixed = [self._points(curve) for curve in curves]
        cv2.polylines(self.pixels, fixed, closed, color, pen, cv2.LINE_AA, SUBPIXEL_BITS)

    def fill(self, outline: NDArray[np.float64], color: Rgb) -> None:
        """Fill the polygon [N,2]."""
        cv2.fillPoly(self.pixels, [self._points(outline)], color, cv2.LINE_AA, SUBPIXEL_BITS)

    def box(self, x: float, y: float, width: float, height: float, color: Rgb, pen: float | None = None) -> None:
        """A rectangle, filled or, with a pen of so many mm, outlined."""
        corners = np.array([[x, y], [x + width, y], [x + width, y + height], [x, y + height]], np.float64)
        if pen is None:
            self.fill(corners, color)
        else:
            self.lines([corners], color, pen, closed=True)

    def disc(self, x: float, y: float, radius: float, color: Rgb, pen: float | None = None) -> None:
        """A circle, filled or outlined."""
        ring = circle(x, y, radius)
        if pen is None:
            self.fill(ring, color)
        else:
            self.lines([ring], color, pen, closed=True)

    def text(self, words: str, x: float, y: float, height: float, color: Rgb, *, bold: bool = False) -> None:
        """Write `words` centred on (x, y) with capitals `height` mm high."""
        face = cv2.FONT_HERSHEY_DUPLEX if bold else cv2.FONT_HERSHEY_SIMPLEX
        pen = max(1, round(height * self.scale / 12))
        unit = cv2.getTextSize("H", face, 4.0, pen)[0][1] / 4.0
        size = height * self.scale / unit
        (wide, high), _ = cv2.getTextSize(words, face, size, pen)
        at = (round(x * self.scale - wide / 2), round(y * self.scale + high / 2))
        cv2.putText(self.pixels, words, at, face, size, color, pen, cv2.LINE_AA)

    def paste(self, image: Image, x: float, y: float) -> None:
        """Put a drawing made at the pen's density with its top left corner at (x, y)."""
        row, column = round(y * self.scale), round(x * self.scale)
        self.pixels[row : row + image.shape[0], column : column + image.shape[1]] = image

    def grain(self, rng: np.random.Generator, amount: float, stretch: tuple[float, float] = (0.6, 0.6)) -> None:
        """Multiply by smooth noise of `amount` (standard deviation) with features of `stretch` mm in x and y."""
        noise = smooth_noise(self.pixels.shape[:2], rng, (stretch[0] * self.scale, stretch[1] * self.scale))
        self.pixels = np.clip(self.pixels * (1.0 + amount * noise[..., None]), 0, 255).astype(np.uint8)

    def done(self) -> Image:
        """The drawing at its density."""
        size = (self.shape[1], self.shape[0])
        return np.asarray(cv2.resize(self.pixels, size, interpolation=cv2.INTER_AREA), np.uint8)


def smooth_noise(shape: tuple[int, int], rng: np.random.Generator, feature: tuple[float, float]) -> NDArray[np.float32]:
    """Noise [H,W] of zero mean and unit deviation whose features are `feature` pixels long in x and y."""
    coarse = (max(2, round(shape[0] / feature[1])) + 1, max(2, round(shape[1] / feature[0])) + 1)
    noise = cv2.resize(rng.standard_normal(coarse).astype(np.float32), shape[::-1], interpolation=cv2.INTER_CUBIC)
    return np.asarray((noise - noise.mean()) / max(float(noise.std()), 1e-6), np.float32)


def circle(x: float, y: float, radius: float, count: int = 180) -> NDArray[np.float64]:
    """A ring of points [count,2]."""
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return np.stack([x + radius * np.cos(angle), y + radius * np.sin(angle)], -1)


def rosette(sheet: Sheet, x: float, y: float, radius: float, color: Rgb, petals: int, pen: float) -> None:
    """Engine-turned ornament: three families of interlaced waves around a circle, as on banknotes."""
    angle = np.linspace(0, 2 * np.pi, 720)
    strands = int(np.clip(radius / 5, 2, 5))
    curves = []
    for inner, outer in ((0.18, 0.52), (0.48, 0.8), (0.76, 1.0)):
        for phase in np.linspace(0, 2 * np.pi, strands, endpoint=False):
            wave = 0.5 + 0.5 * np.sin(petals * angle + phase)
            r = radius * (inner + (outer - inner) * wave)
            curves.append(np.stack([x + r * np.cos(angle), y + r * np.sin(angle)], -1))
    sheet.lines(curves, color, pen)
    sheet.disc(x, y, radius * 1.04, color, pen * 2)
    sheet.disc(x, y, radius * 0.14, color)


def braid(sheet: Sheet, y: float, height: float, period: float, color: Rgb, pen: float) -> None:
    """A border of interlaced sine waves across the whole sheet, closing where the sheet wraps around."""
    waves = max(1, round(sheet.width / period))
    x = np.linspace(0, sheet.width, waves * 24)
    curves = [
        np.stack([x, y + height / 2 * np.sin(2 * np.pi * waves * x / sheet.width + phase)], -1)
        for phase in np.linspace(0, 2 * np.pi, 4, endpoint=False)
    ]
    sheet.lines(curves, color, pen)
    for edge in (y - height * 0.7, y + height * 0.7):
        sheet.lines([np.array([[0, edge], [sheet.width, edge]], np.float64)], color, pen * 1.6)


def checker(sheet: Sheet, y: float, cell: float, rows: int, color: Rgb) -> None:
    """A band of squares across the whole sheet from y down, closing where the sheet wraps around."""
    columns = 2 * max(1, round(sheet.width / cell / 2))
    width = sheet.width / columns
    for row in range(rows):
        for column in range(row % 2, columns, 2):
            sheet.box(column * width, y + row * cell, width, cell, color)


def hatching(sheet: Sheet, x: float, y: float, width: float, height: float, color: Rgb) -> None:
    """A ruled rectangle: lines that draw closer from left to right, as an engraver shades."""
    steps = np.cumsum(np.geomspace(2.2, 0.7, 80))
    marks = x + steps[steps < width]
    sheet.lines([np.array([[at, y], [at, y + height]], np.float64) for at in marks], color, 0.3)


def label(sheet: Sheet, x: float, y: float, title: str, number: str) -> None:
    """A paper label 76 x 108 mm, centre (x, y): frame, ornament, title and small print."""
    left, top = x - 38, y - 54
    sheet.box(left, top, 76, 108, CREAM)
    sheet.box(left + 2, top + 2, 72, 104, INK, 0.9)
    sheet.box(left + 3.8, top + 3.8, 68.4, 100.4, RED, 0.4)
    for dx in (9, 67):
        for dy in (9, 99):
            rosette(sheet, left + dx, top + dy, 4.2, RED, 5, 0.2)
    sheet.text("ALDER & SONS", x, top + 9, 5.2, INK)
    rosette(sheet, x, top + 31, 14.5, BLUE, 9, 0.25)
    sheet.disc(x, top + 31, 7.2, CREAM)
    sheet.text(number, x, top + 31, 6.6, RED, bold=True)
    sheet.text(title, x, top + 54, 8.2, INK, bold=True)
    sheet.text("FINE LEAF TEA", x, top + 64.5, 5.8, RED)
    hatching(sheet, left + 8, top + 70.5, 60, 3.6, INK)
    for line, words in enumerate(SMALL_PRINT):
        sheet.text(words, x, top + 79 + 5.2 * line, 3.1, INK)
    sheet.text("NET 250 g", x, top + 98, 4.6, INK, bold=True)


def tin_side(width: float, height: float, density: float, rng: np.random.Generator) -> Image:
    """The tin's wall, wrapped once around: two labels, two ornamented narrow sides, gold borders."""
    sheet = Sheet(width, height, density, GREEN)
    sheet.grain(rng, 0.05, (1.5, 1.5))
    braid(sheet, 5.5, 5.0, 7.5, GOLD, 0.45)
    braid(sheet, height - 5.5, 5.0, 7.5, GOLD, 0.45)
    quarters = [width * share for share in (0.145, 0.395, 0.645, 0.895)]
    for x, title, number in ((quarters[0], "DARJEELING", "12"), (quarters[2], "EARL GREY", "27")):
        label(sheet, x, height / 2, title, number)
    for x in (quarters[1], quarters[3]):
        for y in np.linspace(0.27, 0.73, 2) * height:
            rosette(sheet, x, float(y), 23, GOLD, 12, 0.3)
            sheet.disc(x, float(y), 4.6, GREEN)
            sheet.text("A", x, float(y), 5.2, GOLD, bold=True)
        sheet.text("FINE TEAS", x, height / 2, 5.0, CREAM, bold=True)
    return sheet.done()


def lid_side(width: float, height: float, density: float, rng: np.random.Generator) -> Image:
    """The lid's rim, wrapped once around."""
    sheet = Sheet(width, height, density, GOLD)
    sheet.grain(rng, 0.04, (8, 0.5))
    for x in np.linspace(0, width, 7)[:-1]:
        sheet.text("* FINE LEAF TEA * SINCE 1862 *", float(x) + width / 12, height * 0.62, 3.2, INK)
    for y in (height * 0.42, height * 0.86):
        sheet.lines([np.array([[0, y], [width, y]])], GREEN, 0.8)
    return sheet.done()


def lid_top(width: float, height: float, density: float, rng: np.random.Generator) -> Image:
    """The lid from above: an engine-turned field with a title."""
    sheet = Sheet(width, height, density, GREEN)
    sheet.grain(rng, 0.05, (1.5, 1.5))
    rosette(sheet, width / 2, height / 2, height * 0.42, GOLD, 16, 0.35)
    for x in (width * 0.14, width * 0.86):
        rosette(sheet, x, height / 2, height * 0.13, GOLD, 8, 0.3)
    sheet.disc(width / 2, height / 2, height * 0.2, GREEN)
    sheet.text("ALDER", width / 2, height / 2 - 3, 6.0, CREAM, bold=True)
    sheet.text("& SONS", width / 2, height / 2 + 6, 4.0, CREAM)
    return sheet.done()


def mug_side(width: float, height: float, density: float, rng: np.random.Generator) -> Image:
    """The mug's outside: checker, waves and a motto."""
    sheet = Sheet(width, height, density, CREAM)
    sheet.grain(rng, 0.012, (3, 3))
    sheet.box(0, 0, width, height * 0.1, BLUE)
    checker(sheet, height * 0.13, 4.6, 2, BLUE)
    braid(sheet, height * 0.86, 7, 11, BLUE, 0.5)
    for x, (first, second) in zip(
        np.array([1, 3, 5]) * width / 6, (("GOOD", "MORNING"), ("ONE MORE", "CUP"), ("TAKE", "YOUR TIME")), strict=True
    ):
        sheet.text(first, float(x), height * 0.42, 8.0, BLUE, bold=True)
        sheet.text(second, float(x), height * 0.56, 8.0, RED, bold=True)
        sheet.text("stoneware, glazed and fired twice", float(x), height * 0.67, 2.9, INK)
    for x in np.array([0, 2, 4]) * width / 6:
        for side in (float(x), float(x) + width if x == 0 else float(x)):
            rosette(sheet, side, height * 0.49, 8.0, SKY, 7, 0.35)
    return sheet.done()


def glaze(width: float, height: float, density: float, rng: np.random.Generator, color: Rgb = CREAM) -> Image:
    """Plain glazed ware with faint streaks and a rim line at the top."""
    sheet = Sheet(width, height, density, color)
    sheet.grain(rng, 0.012, (8, 20))
    sheet.box(0, 0, width, 2.5, BLUE)
    return sheet.done()


def brass(width: float, height: float, density: float, rng: np.random.Generator) -> Image:
    """A plain fitting."""
    sheet = Sheet(width, height, density, GOLD)
    sheet.grain(rng, 0.04, (1, 4))
    return sheet.done()


def tea(width: float, height: float, density: float, rng: np.random.Generator) -> Image:
    """Tea in the mug, with a light ring where it meets the wall."""
    sheet = Sheet(width, height, density, (122, 62, 22))
    for share, color in ((0.99, (176, 104, 44)), (0.9, (142, 76, 28)), (0.8, (122, 62, 22)), (0.5, (112, 54, 20))):
        sheet.disc(width / 2, height / 2, width / 2 * share, color)
    sheet.grain(rng, 0.015, (6, 6))
    return sheet.done()


def metal(width: float, height: float, density: float, rng: np.random.Generator) -> Image:
    """A brass rod with rings turned into it."""
    sheet = Sheet(width, height, density, (188, 150, 84))
    sheet.grain(rng, 0.1, (0.8, 6))
    for x in np.arange(4.0, width, 6.0):
        sheet.box(float(x), 0, 0.9, height, (112, 80, 36))
    return sheet.done()


def wood(sheet: Sheet, rng: np.random.Generator, light: Rgb, dark: Rgb, ring: float) -> None:
    """Grain along x: growth rings `ring` mm apart, bent by slow noise, and fine pores."""
    shape = sheet.pixels.shape[:2]
    bend = smooth_noise(shape, rng, (90 * sheet.scale, 22 * sheet.scale))
    rows = np.arange(shape[0], dtype=np.float32)[:, None] / sheet.scale
    rings = 0.5 + 0.5 * np.sin(2 * np.pi * (rows + 4.5 * bend) / ring)
    pores = smooth_noise(shape, rng, (9 * sheet.scale, 0.45 * sheet.scale))
    share = np.clip(0.65 * rings**2 + 0.13 * pores + 0.12, 0, 1)[..., None]
    mixed = np.asarray(light) * (1 - share) + np.asarray(dark) * share
    sheet.pixels = np.clip(mixed, 0, 255).astype(np.uint8)


def turntable_top(width: float, height: float, density: float, rng: np.random.Generator) -> Image:
    """The plinth from above: wood with an inlaid dial of degrees."""
    sheet = Sheet(width, height, density, CREAM)
    wood(sheet, rng, (214, 172, 118), (150, 100, 58), 7.5)
    radius = width / 2
    x = y = radius
    ring = np.concatenate([circle(x, y, radius * 0.965, 720), circle(x, y, radius * 0.845, 720)[::-1]])
    sheet.fill(ring, CREAM)
    for share in (0.965, 0.845):
        sheet.disc(x, y, radius * share, INK, 0.7)
    for degree in range(0, 360, 2):
        angle = np.radians(degree)
        inner = 0.92 if degree % 10 else 0.9
        ends = np.array([[np.cos(angle), -np.sin(angle)]]) * radius * np.array([[inner], [0.955]]) + [x, y]
        sheet.lines([ends], INK, 0.4 if degree % 10 else 0.8)
    for degree in range(0, 360, 15):
        _radial_text(sheet, str(degree), radius, radius * 0.873, degree)
    for share in (0.82, 0.8):
        sheet.disc(x, y, radius * share, RED, 0.5)
    return sheet.done()


def _radial_text(sheet: Sheet, words: str, center: float, radius: float, degree: float) -> None:
    """Write `words` on a dial so that they read upright from outside at `degree` (counter-clockwise from +x)."""
    tile = Sheet(16, 7, sheet.scale / OVERSAMPLE, CREAM)
    tile.text(words, 8, 3.5, 4.6, INK, bold=True)
    size = (tile.pixels.shape[1], tile.pixels.shape[0])
    angle = np.radians(degree)
    x = (center + radius * np.cos(angle)) * sheet.scale
    y = (center - radius * np.sin(angle)) * sheet.scale
    turn = cv2.getRotationMatrix2D((size[0] / 2, size[1] / 2), degree + 90, 1.0)
    turn[:, 2] += np.array([x - size[0] / 2, y - size[1] / 2])
    whole = sheet.pixels.shape[1::-1]
    ink = cv2.warpAffine(tile.pixels, turn, whole, flags=cv2.INTER_LINEAR, borderValue=(255, 255, 255))
    sheet.pixels = np.minimum(sheet.pixels, np.asarray(ink, np.uint8))


def turntable_side(width: float, height: float, density: float, rng: np.random.Generator) -> Image:
    """Half of the plinth's rim: wood with an inlaid checker band."""
    sheet = Sheet(width, height, density, CREAM)
    wood(sheet, rng, (176, 128, 80), (112, 70, 40), 5.0)
    sheet.box(0, height * 0.34, width, height * 0.36, CREAM)
    checker(sheet, height * 0.34, height * 0.18, 2, INK)
    return sheet.done()


def book_board(width: float, height: float, density: float, rng: np.random.Generator) -> Image:
    """Cloth of a book's board."""
    sheet = Sheet(width, height, density, RED)
    sheet.grain(rng, 0.07, (0.5, 0.5))
    return sheet.done()


def book_cover(width: float, height: float, density: float, rng: np.random.Generator) -> Image:
    """The front cover: cloth stamped in gold."""
    sheet = Sheet(width, height, density, RED)
    sheet.grain(rng, 0.07, (0.5, 0.5))
    sheet.box(4, 4, width - 8, height - 8, GOLD, 1.2)
    sheet.box(6.5, 6.5, width - 13, height - 13, GOLD, 0.5)
    sheet.text("THE LITTLE BOOK", width / 2, 17, 6.8, GOLD, bold=True)
    sheet.text("OF SURFACES", width / 2, 28, 6.8, GOLD, bold=True)
    for x in (18, width - 18):
        rosette(sheet, x, height * 0.62, 11, GOLD, 8, 0.3)
    sheet.text("with 48 engravings", width / 2, height - 11, 3.4, GOLD)
    return sheet.done()


def book_block(width: float, height: float, density: float, rng: np.random.Generator, spine: float) -> Image:
    """The pages' edges, wrapped once around; the first `spine` mm are the spine."""
    sheet = Sheet(width, height, density, CREAM)
    for y in np.arange(0.4, height, 0.9):
        shade = int(rng.integers(150, 205))
        sheet.lines(
            [np.array([[spine, y], [width, y + rng.uniform(-0.15, 0.15)]])], (shade, shade - 14, shade - 44), 0.3
        )
    sheet.box(0, 0, spine, height, RED)
    for x in (6.0, 9.0, spine - 9.0, spine - 6.0):
        sheet.box(x, 0, 1.2, height, GOLD)
    sheet.text("SURFACES", spine / 2, height / 2, 6.0, GOLD, bold=True)
    return sheet.done()


def letter_block(width: float, height: float, density: float, rng: np.random.Generator) -> Image:
    """Four faces of a toy block, wrapped once around."""
    sheet = Sheet(width, height, density, CREAM)
    wood(sheet, rng, (232, 200, 150), (206, 164, 108), 5.0)
    for side, (letter, color) in enumerate(zip("RGBD", (RED, GREEN, BLUE, INK), strict=True)):
        _block_face(sheet, width / 4 * (side + 0.5), height / 2, width / 4, letter, color)
    return sheet.done()


def block_top(width: float, height: float, density: float, rng: np.random.Generator) -> Image:
    """The toy block from above."""
    sheet = Sheet(width, height, density, CREAM)
    wood(sheet, rng, (232, 200, 150), (206, 164, 108), 5.0)
    _block_face(sheet, width / 2, height / 2, width, "T", (196, 120, 30))
    return sheet.done()


def _block_face(sheet: Sheet, x: float, y: float, side: float, letter: str, color: Rgb) -> None:
    half = side / 2 - 3.2
    sheet.box(x - half, y - half, 2 * half, 2 * half, color, 1.4)
    sheet.text(letter, x, y, side * 0.46, color, bold=True)

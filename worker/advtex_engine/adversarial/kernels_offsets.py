"""Triton kernels of the examples' alignment; `triton_offsets.py` launches them.

One program does BLOCK values, or one block of SIDE x SIDE pixels; such blocks lie SIDE / 2 apart. Tensors are
contiguous, and a shape in brackets is followed by the stored type. Rows are the pixels of a crop, row by row.
"""

from __future__ import annotations

import triton
import triton.language as tl


@triton.jit
def luminance(condition, real, fake, visible, planes, PIXELS: tl.constexpr, BLOCK: tl.constexpr):
    """Luminance of three images, 0 where nothing is visible.

    condition, real, fake: [PIXELS,3] float32 in [-1,1]. visible: [PIXELS] float32, 0 or 1.
    planes: [3,PIXELS] float32, in this order, written.
    """
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = pixel < PIXELS
    seen = tl.load(visible + pixel, mask=live, other=0.0)
    for number in tl.static_range(3):
        rows = condition if number == 0 else (real if number == 1 else fake)
        red = tl.load(rows + pixel * 3, mask=live, other=0.0)
        green = tl.load(rows + pixel * 3 + 1, mask=live, other=0.0)
        blue = tl.load(rows + pixel * 3 + 2, mask=live, other=0.0)
        value = (red * 0.299 + green * 0.587 + blue * 0.114) * seen
        tl.store(planes + number * PIXELS + pixel, value, mask=live)


@triton.jit
def cut_blocks(
    planes,
    smooth,
    visible,
    window,
    blocks,
    WIDTH: tl.constexpr,
    HEIGHT: tl.constexpr,
    COLUMNS: tl.constexpr,
    ROWS: tl.constexpr,
    SIDE: tl.constexpr,
):
    """A program's block of one plane, without what is smooth, where visible, fading out to the border.

    planes: [3,HEIGHT,WIDTH] float32, of `luminance`. smooth: the same shape, its means over boxes.
    visible: [HEIGHT,WIDTH] float32, 0 or 1. window: [SIDE,SIDE] float32, 1 amid a block and 0 at its border.
    blocks: [3,ROWS,COLUMNS,SIDE,SIDE] float32, written.
    """
    number = tl.program_id(0)
    image, block = number // (ROWS * COLUMNS), number % (ROWS * COLUMNS)
    place = tl.arange(0, SIDE * SIDE)
    x = block % COLUMNS * (SIDE // 2) + place % SIDE
    y = block // COLUMNS * (SIDE // 2) + place // SIDE
    at = y * WIDTH + x
    there = image * (WIDTH * HEIGHT) + at
    detail = (tl.load(planes + there) - tl.load(smooth + there)) * tl.load(visible + at)
    tl.store(blocks + number * (SIDE * SIDE) + place, detail * tl.load(window + place))


@triton.jit
def whiten(spectrum, cross, strength, COUNT: tl.constexpr, VALUES: tl.constexpr, BLOCK: tl.constexpr):
    """The cross spectrum e r* of each example e and the reference r, over the root of its strength.

    spectrum: [3,COUNT,2] float32, real and imaginary part, of reference, real and fake example.
    Written: cross [2,COUNT,2] float32; strength [2,COUNT] float32, |e r*|. VALUES: 2 COUNT.
    """
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = at < VALUES
    reference, example = spectrum + (at % COUNT) * 2, spectrum + (COUNT + at) * 2
    a, b = tl.load(reference, mask=live, other=0.0), tl.load(reference + 1, mask=live, other=0.0)
    c, d = tl.load(example, mask=live, other=0.0), tl.load(example + 1, mask=live, other=0.0)
    real, imaginary = c * a + d * b, d * a - c * b
    size = tl.sqrt(real * real + imaginary * imaginary)
    scale = 1.0 / (tl.sqrt(size) + 1e-6)
    tl.store(strength + at, size, mask=live)
    tl.store(cross + at * 2, real * scale, mask=live)
    tl.store(cross + at * 2 + 1, imaginary * scale, mask=live)


@triton.jit
def find_peaks(
    correlation,
    strength,
    visible,
    offsets,
    BOUND: tl.constexpr,
    MIN_SEEN: tl.constexpr,
    MIN_CORRELATION: tl.constexpr,
    MIN_GAIN: tl.constexpr,
    WIDTH: tl.constexpr,
    COLUMNS: tl.constexpr,
    ROWS: tl.constexpr,
    SIDE: tl.constexpr,
):
    """Where a program's block has its highest correlation, if that is to be believed, else 0.

    correlation: [2,ROWS,COLUMNS,SIDE,SIDE] float32, of real and fake example, at offset (0, 0) first.
    strength: [2,ROWS,COLUMNS,SIDE,SIDE/2+1] float32, of `whiten`. visible: [HEIGHT,WIDTH] float32, 0 or 1.
    offsets: [2,ROWS,COLUMNS,2] float32, x then y in pixels, written.
    BOUND: the largest offset that is believed, pixels. MIN_SEEN: share of the block that is visible. MIN_CORRELATION:
    of what equal spectra give. MIN_GAIN: over the correlation at no offset.
    """
    number = tl.program_id(0)
    block = number % (ROWS * COLUMNS)
    place = tl.arange(0, SIDE * SIDE)
    values = correlation + number * (SIDE * SIDE)
    best, highest = tl.max(tl.load(values + place), 0, return_indices=True)
    x, y = highest % SIDE, highest // SIDE
    x, y = tl.where(x >= SIDE // 2, x - SIDE, x), tl.where(y >= SIDE // 2, y - SIDE, y)
    # Of a real signal half of the spectrum is stored; all columns but the first and the last stand for two.
    HALF: tl.constexpr = SIDE // 2 + 1
    stored = place < SIDE * HALF
    twice = tl.where((place % HALF > 0) & (place % HALF < HALF - 1), 2.0, 1.0)
    root = tl.sqrt(tl.load(strength + number * (SIDE * HALF) + place, mask=stored, other=0.0))
    most = tl.sum(root * twice, 0) / (SIDE * SIDE)
    at_x, at_y = block % COLUMNS * (SIDE // 2) + place % SIDE, block // COLUMNS * (SIDE // 2) + place // SIDE
    seen = tl.sum(tl.load(visible + at_y * WIDTH + at_x), 0) / (SIDE * SIDE)
    near = (tl.abs(x) <= BOUND) & (tl.abs(y) <= BOUND)
    clear = (best > most * MIN_CORRELATION) & (best > tl.load(values) * MIN_GAIN)
    believed = near & clear & (seen > MIN_SEEN)
    tl.store(offsets + number * 2, tl.where(believed, x, 0).to(tl.float32))
    tl.store(offsets + number * 2 + 1, tl.where(believed, y, 0).to(tl.float32))

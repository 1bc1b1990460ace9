"""Triton kernels of the Gabor term; `triton_gabor.py` launches them.

The pixels of an image's OCTAVES octaves are one list, PIXELS in all: octave by octave, row by row. An octave has half
the sides, rounded down, of the one before it; the first has HEIGHT x WIDTH pixels. Their windows are a list too, of
WINDOWS. A filter lies right of and below the pixel that it is said to be at, as in a correlation without a border; so
does a window. Of two images the render comes first. One program does BLOCK pixels or windows, all orientations of each.
Tensors are contiguous, and a shape in brackets is followed by the stored type.
"""

from __future__ import annotations

import triton
import triton.language as tl

from advtex_engine.adversarial import gabor

ORIENTATIONS = tl.constexpr(gabor.ORIENTATIONS)
PADDED = tl.constexpr(triton.next_power_of_2(gabor.ORIENTATIONS))
SIZE = tl.constexpr(gabor.SIZE)
TAPS = tl.constexpr(gabor.SIZE**2)
WINDOW = tl.constexpr(gabor.WINDOW)
SPACING = tl.constexpr(gabor.SPACING)
LEAST = tl.constexpr(gabor.window_reach())  # pixels a side that the filters of a window lie in
REACH = tl.constexpr((gabor.window_reach() - 1) // gabor.WINDOW + 1)  # windows, across, that see a pixel
FAINT = tl.constexpr(gabor.FAINT)
TINY = tl.constexpr(gabor.TINY)
RED, GREEN, BLUE = (tl.constexpr(part / 2) for part in gabor.LUMA)


@triton.jit
def windows_along(pixels):
    """Windows along a side of so many pixels, which one fits into."""
    return (pixels - LEAST) // WINDOW + 1


@triton.jit
def pixels_before(octave, HEIGHT: tl.constexpr, WIDTH: tl.constexpr, OCTAVES: tl.constexpr):
    """Pixels in the list before those of an octave."""
    before = octave * 0
    for number in tl.static_range(OCTAVES - 1):
        before += tl.where(octave > number, (HEIGHT >> number) * (WIDTH >> number), 0)
    return before


@triton.jit
def windows_before(octave, HEIGHT: tl.constexpr, WIDTH: tl.constexpr, OCTAVES: tl.constexpr):
    """Windows in the list before those of an octave."""
    before = octave * 0
    for number in tl.static_range(OCTAVES - 1):
        windows = windows_along(HEIGHT >> number) * windows_along(WIDTH >> number)
        before += tl.where(octave > number, windows, 0)
    return before


@triton.jit
def place_of_pixel(pixel, HEIGHT: tl.constexpr, WIDTH: tl.constexpr, OCTAVES: tl.constexpr):
    """Octave, x and y of pixels of the list."""
    octave = pixel * 0
    for number in tl.static_range(1, OCTAVES):
        octave += (pixel >= pixels_before(number, HEIGHT, WIDTH, OCTAVES)).to(tl.int32)
    number = pixel - pixels_before(octave, HEIGHT, WIDTH, OCTAVES)
    width = WIDTH >> octave
    return octave, number % width, number // width


@triton.jit
def place_of_window(window, HEIGHT: tl.constexpr, WIDTH: tl.constexpr, OCTAVES: tl.constexpr):
    """Octave, column and row of windows of the list."""
    octave = window * 0
    for number in tl.static_range(1, OCTAVES):
        octave += (window >= windows_before(number, HEIGHT, WIDTH, OCTAVES)).to(tl.int32)
    number = window - windows_before(octave, HEIGHT, WIDTH, OCTAVES)
    columns = windows_along(WIDTH >> octave)
    return octave, number % columns, number // columns


@triton.jit
def gray(rows, pixel, mask):
    """Gray levels [BLOCK] of pixels of rows [P,3] in [-1,1], with differences as of colors in [0,1]."""
    red = tl.load(rows + pixel * 3, mask=mask, other=0.0)
    green = tl.load(rows + pixel * 3 + 1, mask=mask, other=0.0)
    blue = tl.load(rows + pixel * 3 + 2, mask=mask, other=0.0)
    return red * RED + green * GREEN + blue * BLUE


@triton.jit
def octaves(
    render,
    photograph,
    foreground,
    grays,
    HEIGHT: tl.constexpr,
    WIDTH: tl.constexpr,
    OCTAVES: tl.constexpr,
    PIXELS: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Gray levels of both images in all octaves, the photograph's in place of the render's where that does not count.

    render, photograph: [HEIGHT*WIDTH,3] float32 in [-1,1]. foreground: [HEIGHT*WIDTH,1] float32, where not 0 the render
    counts. grays: [2,PIXELS] float32, written.
    """
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = pixel < PIXELS
    octave, x, y = place_of_pixel(pixel, HEIGHT, WIDTH, OCTAVES)
    side = 1 << octave
    ours, theirs = tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32)
    for down in range(1 << (OCTAVES - 1)):
        for right in range(1 << (OCTAVES - 1)):
            inside = live & (down < side) & (right < side)
            at = (y * side + down) * WIDTH + x * side + right
            named = gray(photograph, at, inside)
            shown = tl.load(foreground + at, mask=inside, other=0.0) > 0
            ours += tl.where(shown, gray(render, at, inside & shown), named)
            theirs += named
    share = 1.0 / (side * side).to(tl.float32)
    tl.store(grays + pixel, ours * share, mask=live)
    tl.store(grays + PIXELS + pixel, theirs * share, mask=live)


@triton.jit
def energies(
    grays,
    filters,
    squares,
    HEIGHT: tl.constexpr,
    WIDTH: tl.constexpr,
    OCTAVES: tl.constexpr,
    PIXELS: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Squared energies of an image, which is the second axis of programs, at its pixels.

    grays: [2,PIXELS] float32, of `octaves`. filters: [2,ORIENTATIONS,SIZE,SIZE] float32, even and odd ones.
    squares: [2,ORIENTATIONS,PIXELS] float32, written at the places of filters, SPACING apart, inside of the octave.
    """
    image = tl.program_id(1)
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    octave, x, y = place_of_pixel(pixel, HEIGHT, WIDTH, OCTAVES)
    width = WIDTH >> octave
    live = (pixel < PIXELS) & (x <= width - SIZE) & (y <= (HEIGHT >> octave) - SIZE)
    live = live & (x % SPACING == 0) & (y % SPACING == 0)
    orientation = tl.arange(0, PADDED)[:, None]
    there = orientation < ORIENTATIONS
    even, odd = tl.zeros((PADDED, BLOCK), tl.float32), tl.zeros((PADDED, BLOCK), tl.float32)
    for down in range(SIZE):
        for right in tl.static_range(SIZE):
            value = tl.load(grays + image * PIXELS + pixel + down * width + right, mask=live, other=0.0)[None, :]
            tap = filters + orientation * TAPS + down * SIZE + right
            even += tl.load(tap, mask=there, other=0.0) * value
            odd += tl.load(tap + ORIENTATIONS * TAPS, mask=there, other=0.0) * value
    at = (image * ORIENTATIONS + orientation) * PIXELS + pixel[None, :]
    tl.store(squares + at, even * even + odd * odd, mask=there & live[None, :])


@triton.jit
def distances(
    grays,
    filters,
    squares,
    sums,
    pulls,
    places,
    HEIGHT: tl.constexpr,
    WIDTH: tl.constexpr,
    OCTAVES: tl.constexpr,
    PIXELS: tl.constexpr,
    WINDOWS: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """What each block of windows adds to the loss, and how the loss depends on the render's greatest energies.

    grays: [2,PIXELS] float32. filters: [2,ORIENTATIONS,SIZE,SIZE] float32. squares: [2,ORIENTATIONS,PIXELS] float32, of
    `energies`. Written: sums [number of programs] float32, whose total is the loss; places [ORIENTATIONS,WINDOWS]
    int32, where in the window, counted row by row, the render's energy is greatest, of such places the first; pulls
    [2,ORIENTATIONS,WINDOWS] float32, the loss's gradient of the responses there to the even and the odd filter.
    """
    window = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    octave, column, row = place_of_window(window, HEIGHT, WIDTH, OCTAVES)
    width = WIDTH >> octave
    corner = pixels_before(octave, HEIGHT, WIDTH, OCTAVES) + (row * width + column) * WINDOW
    orientation = tl.arange(0, PADDED)[:, None]
    there = orientation < ORIENTATIONS
    live = there & (window < WINDOWS)[None, :]
    best, theirs = tl.zeros((PADDED, BLOCK), tl.float32) - 1.0, tl.zeros((PADDED, BLOCK), tl.float32)
    place = tl.zeros((PADDED, BLOCK), tl.int32)
    for down in range(0, WINDOW, SPACING):
        for right in tl.static_range(0, WINDOW, SPACING):
            at = squares + orientation * PIXELS + (corner + down * width + right)[None, :]
            value = tl.load(at, mask=live, other=0.0)
            place = tl.where(value > best, down * WINDOW + right, place)
            best = tl.maximum(best, value)
            theirs = tl.maximum(theirs, tl.load(at + ORIENTATIONS * PIXELS, mask=live, other=0.0))
    even, odd = tl.zeros((PADDED, BLOCK), tl.float32), tl.zeros((PADDED, BLOCK), tl.float32)
    at = grays + corner[None, :] + place // WINDOW * width[None, :] + place % WINDOW
    for down in range(SIZE):
        for right in tl.static_range(SIZE):
            value = tl.load(at + down * width[None, :] + right, mask=live, other=0.0)
            tap = filters + orientation * TAPS + down * SIZE + right
            even += tl.load(tap, mask=there, other=0.0) * value
            odd += tl.load(tap + ORIENTATIONS * TAPS, mask=there, other=0.0) * value
    counts = live.to(tl.float32)
    ours, theirs = tl.sqrt(best + TINY), tl.sqrt(theirs + TINY)
    norm = tl.sqrt(tl.sum(ours * ours * counts, 0) + FAINT * FAINT)[None, :]
    their_norm = tl.sqrt(tl.sum(theirs * theirs * counts, 0) + FAINT * FAINT)[None, :]
    apart = (ours / norm - theirs / their_norm) * counts
    share = 1.0 / (windows_along(WIDTH >> octave) * windows_along(HEIGHT >> octave)).to(tl.float32)
    tl.store(sums + tl.program_id(0), tl.sum(tl.sum(apart * apart, 0) * share, 0))
    along = tl.sum(apart * ours, 0)[None, :]
    slope = 2.0 * share[None, :] * (apart / ours - along / (norm * norm)) / norm
    at = orientation * WINDOWS + window[None, :]
    tl.store(places + at, place, mask=live)
    tl.store(pulls + at, slope * even, mask=live)
    tl.store(pulls + ORIENTATIONS * WINDOWS + at, slope * odd, mask=live)


@triton.jit
def energies_backward(
    filters,
    pulls,
    places,
    slopes,
    HEIGHT: tl.constexpr,
    WIDTH: tl.constexpr,
    OCTAVES: tl.constexpr,
    PIXELS: tl.constexpr,
    WINDOWS: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """The loss's gradient of the render's gray levels, which each pixel gathers from the windows that see it.

    filters: [2,ORIENTATIONS,SIZE,SIZE] float32. pulls: [2,ORIENTATIONS,WINDOWS] float32 and places:
    [ORIENTATIONS,WINDOWS] int32, of `distances`. slopes: [PIXELS] float32, written.
    """
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = pixel < PIXELS
    octave, x, y = place_of_pixel(pixel, HEIGHT, WIDTH, OCTAVES)
    first = windows_before(octave, HEIGHT, WIDTH, OCTAVES)
    rows, columns = windows_along(HEIGHT >> octave), windows_along(WIDTH >> octave)
    orientation = tl.arange(0, PADDED)[:, None]
    there = orientation < ORIENTATIONS
    total = tl.zeros((PADDED, BLOCK), tl.float32)
    for above in range(REACH):
        for left in range(REACH):
            row, column = y // WINDOW - above, x // WINDOW - left
            inside = live & (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
            seen = there & inside[None, :]
            at = orientation * WINDOWS + (first + row * columns + column)[None, :]
            place = tl.load(places + at, mask=seen, other=0)
            down = (y - row * WINDOW)[None, :] - place // WINDOW
            right = (x - column * WINDOW)[None, :] - place % WINDOW
            seen = seen & (down >= 0) & (down < SIZE) & (right >= 0) & (right < SIZE)
            tap = filters + orientation * TAPS + down * SIZE + right
            even = tl.load(tap, mask=seen, other=0.0)
            odd = tl.load(tap + ORIENTATIONS * TAPS, mask=seen, other=0.0)
            total += tl.load(pulls + at, mask=seen, other=0.0) * even
            total += tl.load(pulls + ORIENTATIONS * WINDOWS + at, mask=seen, other=0.0) * odd
    tl.store(slopes + pixel, tl.sum(total, 0), mask=live)


@triton.jit
def octaves_backward(
    slopes,
    foreground,
    gradient,
    into,
    HEIGHT: tl.constexpr,
    WIDTH: tl.constexpr,
    OCTAVES: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """The gradient of the render's colors, from that of its gray levels in all octaves, where the render counts.

    slopes: [PIXELS] float32, of `energies_backward`. foreground: [HEIGHT*WIDTH,1] float32. gradient: 0-dim float32, the
    loss's. into: [HEIGHT*WIDTH,3] float32, written.
    """
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = pixel < HEIGHT * WIDTH
    x, y = pixel % WIDTH, pixel // WIDTH
    total = tl.zeros((BLOCK,), tl.float32)
    for number in tl.static_range(OCTAVES):
        column, row = x >> number, y >> number
        # Of an odd side the last pixel is in no mean.
        inside = live & (column < (WIDTH >> number)) & (row < (HEIGHT >> number))
        at = pixels_before(number, HEIGHT, WIDTH, OCTAVES) + row * (WIDTH >> number) + column
        total += tl.load(slopes + at, mask=inside, other=0.0) / (1 << 2 * number)
    shown = tl.load(foreground + pixel, mask=live, other=0.0) > 0
    total = tl.where(shown, total * tl.load(gradient), 0.0)
    tl.store(into + pixel * 3, total * RED, mask=live)
    tl.store(into + pixel * 3 + 1, total * GREEN, mask=live)
    tl.store(into + pixel * 3 + 2, total * BLUE, mask=live)

"""Triton kernels of a step's images; `triton_operations.py` launches them and names each one's plain twin in torch.

One program does BLOCK pixels (or values). Rows [P,C] are the P pixels of a crop, row by row, with C channels each; maps
are those of `ViewMaps`, V views of H x W pixels. Tensors are contiguous, and a shape in brackets is followed by the
stored type. Sizes are constants of a compiled kernel: a run has one of each. All images and textures have at least
2 x 2 pixels.
"""

from __future__ import annotations

import triton
import triton.language as tl

UV_LEVELS = tl.constexpr(65535.0)
MIN_DEPTH = tl.constexpr(1e-6)
MIN_FOREGROUND_WEIGHT = tl.constexpr(0.99)
WHOLLY_VISIBLE = tl.constexpr(0.99)
FAR_APART = tl.constexpr(4.0)
LEAST_WEIGHT = tl.constexpr(1e-6)
GRID = tl.constexpr(32)  # pixels between the centers of two blocks of offsets


@triton.jit
def pick(random, count):
    """Uniform integer in [0, count) from a uniform number in [0, 1)."""
    return tl.minimum((random * count).to(tl.int64), count - 1)


@triton.jit
def clamp(value, highest):
    return tl.minimum(tl.maximum(value, 0.0), highest)


@triton.jit
def corner(x, y, WIDTH: tl.constexpr, HEIGHT: tl.constexpr):
    """Upper left of the four cells around (x, y), in units of cells from the first center, and the place among them."""
    x = clamp(x, WIDTH - 1.0)
    y = clamp(y, HEIGHT - 1.0)
    x0 = tl.minimum(tl.floor(x), WIDTH - 2.0)
    y0 = tl.minimum(tl.floor(y), HEIGHT - 2.0)
    return y0.to(tl.int32) * WIDTH + x0.to(tl.int32), x - x0, y - y0


@triton.jit
def cubic(t, TAP: tl.constexpr):
    """Weight of pixel TAP (0 to 3) of a row of four, at t in [0, 1] between the middle two (Keys 1981, a = -0.75)."""
    apart = tl.abs(t + 1 - TAP)
    if TAP % 3 == 0:
        return ((-0.75 * apart + 3.75) * apart - 6.0) * apart + 3.0
    else:
        return (1.25 * apart - 2.25) * apart * apart + 1.0


@triton.jit
def choose(
    random,
    source_count,
    sources,
    count,
    auxiliary,
    chosen,
    COLUMNS: tl.constexpr,
    FREE_X: tl.constexpr,
    FREE_Y: tl.constexpr,
):
    """One program draws a pair and a crop's corner, `PairSampler.choose`.

    random: [4] float32, uniform in [0, 1). source_count: [1] int64, S. sources: [S] int64, views that can be drawn.
    count: [V] int64, candidates of each. auxiliary: [V,COLUMNS] int64, these candidates.
    chosen: [5] int64, written: source, auxiliary view, row of the pair, left and top of the crop.
    FREE_X, FREE_Y: how many places the crop has in a view.
    """
    source = tl.load(sources + pick(tl.load(random), tl.load(source_count)))
    pair = source * COLUMNS + pick(tl.load(random + 1), tl.load(count + source))
    tl.store(chosen, source)
    tl.store(chosen + 1, tl.load(auxiliary + pair))
    tl.store(chosen + 2, pair)
    tl.store(chosen + 3, pick(tl.load(random + 2), FREE_X))
    tl.store(chosen + 4, pick(tl.load(random + 3), FREE_Y))


@triton.jit
def warped(color, depth, around, first, right, down, live, WIDTH: tl.constexpr, HEIGHT: tl.constexpr):
    """Bicubic color of a view at `corner`'s result, bilinear where one of the 16 pixels is background or missing.

    color: [V,H*W,3] uint8. depth: [V,H*W] float16, 0 = background. around: `first` among the pixels of all views.
    Returns red, green and blue [BLOCK] float32 in [0,255].
    """
    column, row = first % WIDTH, first // WIDTH
    whole = live & (column > 0) & (column < WIDTH - 2) & (row > 0) & (row < HEIGHT - 2)
    for tap in tl.static_range(16):
        found = tl.load(depth + around + (tap // 4 - 1) * WIDTH + tap % 4 - 1, mask=whole, other=0.0).to(tl.float32)
        whole = whole & (found > 0)
    red = tl.zeros_like(right)
    green, blue = red, red
    for tap in tl.static_range(16):
        there = around + (tap // 4 - 1) * WIDTH + tap % 4 - 1
        weight = tl.where(whole, cubic(right, tap % 4) * cubic(down, tap // 4), 0.0)
        wanted = whole
        if tap % 4 % 3 != 0 and tap // 4 % 3 != 0:  # the four of the bilinear footprint
            beside = (right if tap % 4 == 2 else 1 - right) * (down if tap // 4 == 2 else 1 - down)
            weight = tl.where(whole, weight, beside)
            wanted = live
        red += weight * tl.load(color + there * 3, mask=wanted, other=0).to(tl.float32)
        green += weight * tl.load(color + there * 3 + 1, mask=wanted, other=0).to(tl.float32)
        blue += weight * tl.load(color + there * 3 + 2, mask=wanted, other=0).to(tl.float32)
    return clamp(red, 255.0), clamp(green, 255.0), clamp(blue, 255.0)


@triton.jit
def texel_of(uv, flat, live, TEXTURE_WIDTH: tl.constexpr, TEXTURE_HEIGHT: tl.constexpr):
    """Where pixels sample the texture, in texels; uv: rows [P,2] int16, `texture.encode_uv`."""
    u = (tl.load(uv + flat * 2, mask=live, other=0).to(tl.float32) + 32768.0) / UV_LEVELS * TEXTURE_WIDTH
    v = (tl.load(uv + flat * 2 + 1, mask=live, other=0).to(tl.float32) + 32768.0) / UV_LEVELS * TEXTURE_HEIGHT
    return u, v


@triton.jit
def step_to_next(
    uv,
    depth,
    flat,
    distance,
    u,
    v,
    inside_before,
    inside_after,
    NEXT: tl.constexpr,
    TEXTURE_WIDTH: tl.constexpr,
    TEXTURE_HEIGHT: tl.constexpr,
):
    """How far apart is what a pixel and the next along an axis show, u and v in texels; `texture._steps`.

    NEXT: pixels from one to the next. inside_before, inside_after: [BLOCK] bool, whether the crop has it.
    """
    before = inside_before & (tl.load(depth + flat - NEXT, mask=inside_before, other=0.0) > 0) & (distance > 0)
    after = inside_after & (tl.load(depth + flat + NEXT, mask=inside_after, other=0.0) > 0) & (distance > 0)
    u_before, v_before = texel_of(uv, flat - NEXT, before, TEXTURE_WIDTH, TEXTURE_HEIGHT)
    u_after, v_after = texel_of(uv, flat + NEXT, after, TEXTURE_WIDTH, TEXTURE_HEIGHT)
    u_before, v_before, u_after, v_after = u - u_before, v - v_before, u_after - u, v_after - v
    far = float("inf")
    length_before = tl.maximum(tl.abs(u_before), tl.abs(v_before))
    length_before = tl.where(before & (length_before <= FAR_APART), length_before, far)
    length_after = tl.maximum(tl.abs(u_after), tl.abs(v_after))
    length_after = tl.where(after & (length_after <= FAR_APART), length_after, far)
    nearer = length_before < length_after
    same = tl.minimum(length_before, length_after) < far
    step_u = tl.where(same, tl.where(nearer, u_before, u_after), 0.0)
    step_v = tl.where(same, tl.where(nearer, v_before, v_after), 0.0)
    return step_u, step_v


@triton.jit
def inner(right, down):
    """Quarters of both steps, [BLOCK] texels, so that the samples lie within two texels."""
    right, down = right / 4, down / 4
    share = 0.5 / tl.maximum(tl.abs(right) + tl.abs(down), 0.5)
    return right * share, down * share


@triton.jit
def share_of(middle, first, right, down, highest, SAMPLE: tl.constexpr, CELL: tl.constexpr):
    """What cell CELL (0 to 2) after the first has of sample SAMPLE (0 to 3) around the middle, along one axis."""
    place = clamp(middle + (right if SAMPLE % 2 else -right) + (down if SAMPLE // 2 else -down), highest) - first
    before, after = tl.maximum(1 - place, 0.0), tl.maximum(place - 1, 0.0)
    if CELL == 0:
        return before
    elif CELL == 2:
        return after
    else:
        return 1 - before - after


@triton.jit
def draw(
    chosen,
    relative,
    color,
    uv,
    depth,
    intrinsics,
    slot_map,
    condition,
    real,
    foreground,
    visible,
    slots,
    weights,
    tolerance,
    AREAS: tl.constexpr,
    WIDTH: tl.constexpr,
    HEIGHT: tl.constexpr,
    CROP: tl.constexpr,
    PIXELS: tl.constexpr,
    TEXTURE_WIDTH: tl.constexpr,
    TEXTURE_HEIGHT: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Unprojects the source's depth, projects into the auxiliary view, tests visibility, and samples both.

    chosen: [5] int64, of `choose`. relative: [3,4] float32, source camera to auxiliary camera.
    color: [V,H*W,3] uint8. uv: [V,H*W,2] int16, `texture.encode_uv`. depth: [V,H*W] float16, metres along z,
    0 = background. intrinsics: [V,4] float32, fx, fy, cx, cy in pixels.
    slot_map: [TEXTURE_HEIGHT,TEXTURE_WIDTH] int32, rows of the compact texture, -1 = none.
    Written, of the crop's PIXELS: condition and real [P,3] float32 in [-1,1], the source and the auxiliary view warped
    into it; foreground and visible [P,1] float32, 0 or 1; slots [P,4] int32 and weights [P,4] float32, where the source
    samples the texture, weight 0 for background; [P,9] with AREAS.
    tolerance: theta_z, metres. WIDTH, HEIGHT: of the views. CROP: the crop's width.
    """
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = pixel < PIXELS
    source, auxiliary = tl.load(chosen), tl.load(chosen + 1)
    x = pixel % CROP + tl.load(chosen + 3).to(tl.int32)
    y = pixel // CROP + tl.load(chosen + 4).to(tl.int32)
    flat = source * (WIDTH * HEIGHT) + y * WIDTH + x
    distance = tl.load(depth + flat, mask=live, other=0.0).to(tl.float32)

    lens = intrinsics + source * 4
    on_x = (x + 0.5 - tl.load(lens + 2)) / tl.load(lens) * distance
    on_y = (y + 0.5 - tl.load(lens + 3)) / tl.load(lens + 1) * distance
    x_b = on_x * tl.load(relative) + on_y * tl.load(relative + 1) + distance * tl.load(relative + 2)
    y_b = on_x * tl.load(relative + 4) + on_y * tl.load(relative + 5) + distance * tl.load(relative + 6)
    z_b = on_x * tl.load(relative + 8) + on_y * tl.load(relative + 9) + distance * tl.load(relative + 10)
    x_b += tl.load(relative + 3)
    y_b += tl.load(relative + 7)
    z_b += tl.load(relative + 11)
    before = z_b > MIN_DEPTH
    divisor = tl.where(before, z_b, 1.0)
    lens = intrinsics + auxiliary * 4
    x_b = x_b / divisor * tl.load(lens) + tl.load(lens + 2)
    y_b = y_b / divisor * tl.load(lens + 1) + tl.load(lens + 3)

    inside = (x_b >= 0.5) & (x_b <= WIDTH - 0.5) & (y_b >= 0.5) & (y_b <= HEIGHT - 0.5)
    seen = live & before & inside & (distance > 0)
    first, right, down = corner(x_b - 0.5, y_b - 0.5, WIDTH, HEIGHT)
    around = auxiliary * (WIDTH * HEIGHT) + first
    nearest = tl.full((BLOCK,), float("inf"), tl.float32)
    covered = tl.zeros((BLOCK,), tl.float32)
    for tap in tl.static_range(4):
        weight = (right if tap % 2 else 1 - right) * (down if tap // 2 else 1 - down)
        found = tl.load(depth + around + (tap // 2) * WIDTH + tap % 2, mask=live, other=0.0).to(tl.float32)
        nearest = tl.where(found > 0, tl.minimum(nearest, tl.abs(found - z_b)), nearest)
        covered += tl.where(found > 0, weight, 0.0)
    red, green, blue = warped(color, depth, around, first, right, down, live, WIDTH, HEIGHT)
    seen = (seen & (covered > MIN_FOREGROUND_WEIGHT) & (nearest < tolerance)).to(tl.float32)
    tl.store(foreground + pixel, (distance > 0).to(tl.float32), mask=live)
    tl.store(visible + pixel, seen, mask=live)
    tl.store(real + pixel * 3, red / 127.5 - 1, mask=live)
    tl.store(real + pixel * 3 + 1, green / 127.5 - 1, mask=live)
    tl.store(real + pixel * 3 + 2, blue / 127.5 - 1, mask=live)
    for channel in tl.static_range(3):
        value = tl.load(color + flat * 3 + channel, mask=live, other=0).to(tl.float32)
        tl.store(condition + pixel * 3 + channel, value / 127.5 - 1, mask=live)

    u, v = texel_of(uv, flat, live, TEXTURE_WIDTH, TEXTURE_HEIGHT)
    if AREAS:
        left, last = pixel % CROP > 0, pixel % CROP == CROP - 1
        right_u, right_v = step_to_next(
            uv, depth, flat, distance, u, v, live & left, live & ~last, 1, TEXTURE_WIDTH, TEXTURE_HEIGHT
        )
        above, below = live & (pixel >= CROP), pixel < PIXELS - CROP
        down_u, down_v = step_to_next(
            uv, depth, flat, distance, u, v, above, below, WIDTH, TEXTURE_WIDTH, TEXTURE_HEIGHT
        )
        right_u, down_u = inner(right_u, down_u)
        right_v, down_v = inner(right_v, down_v)
        u, v = u - 0.5, v - 0.5
        most_u, most_v = TEXTURE_WIDTH - 1.0, TEXTURE_HEIGHT - 1.0
        first_u = clamp(tl.floor(u - tl.abs(right_u) - tl.abs(down_u)), most_u - 2)
        first_v = clamp(tl.floor(v - tl.abs(right_v) - tl.abs(down_v)), most_v - 2)
        corner_of = slot_map + first_v.to(tl.int32) * TEXTURE_WIDTH + first_u.to(tl.int32)
        total = tl.zeros_like(u)
        for cell in tl.static_range(9):
            slot = tl.load(corner_of + (cell // 3) * TEXTURE_WIDTH + cell % 3, mask=live, other=0)
            weight = tl.zeros_like(u)
            for one in tl.static_range(4):
                across = share_of(u, first_u, right_u, down_u, most_u, one, cell % 3)
                weight += across * share_of(v, first_v, right_v, down_v, most_v, one, cell // 3) / 4
            weight = tl.where((distance > 0) & (slot >= 0), weight, 0.0)
            total += weight
            tl.store(slots + pixel * 9 + cell, tl.maximum(slot, 0), mask=live)
            tl.store(weights + pixel * 9 + cell, weight, mask=live)
        for cell in tl.static_range(9):
            weight = tl.load(weights + pixel * 9 + cell, mask=live, other=0.0)
            tl.store(weights + pixel * 9 + cell, weight / tl.maximum(total, LEAST_WEIGHT), mask=live)
    else:
        first, right, down = corner(u - 0.5, v - 0.5, TEXTURE_WIDTH, TEXTURE_HEIGHT)
        for tap in tl.static_range(4):
            slot = tl.load(slot_map + first + (tap // 2) * TEXTURE_WIDTH + tap % 2, mask=live, other=0)
            weight = (right if tap % 2 else 1 - right) * (down if tap // 2 else 1 - down)
            tl.store(slots + pixel * 4 + tap, tl.maximum(slot, 0), mask=live)
            tl.store(weights + pixel * 4 + tap, tl.where(distance > 0, weight, 0.0), mask=live)


@triton.jit
def sample(values, slots, weights, rows, PIXELS: tl.constexpr, TAPS: tl.constexpr, BLOCK: tl.constexpr):
    """Some weighted texels for each pixel, `texture.sample_texels`.

    values: [N,3] float32, the compact texture. slots: [P,TAPS] int32 or int64, its rows. weights: [P,TAPS] float32.
    rows: [P,3] float32, written.
    """
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = pixel < PIXELS
    red = tl.zeros((BLOCK,), tl.float32)
    green, blue = red, red
    for tap in tl.static_range(TAPS):
        weight = tl.load(weights + pixel * TAPS + tap, mask=live, other=0.0)
        texel = values + tl.load(slots + pixel * TAPS + tap, mask=live, other=0).to(tl.int64) * 3
        red += weight * tl.load(texel, mask=live, other=0.0)
        green += weight * tl.load(texel + 1, mask=live, other=0.0)
        blue += weight * tl.load(texel + 2, mask=live, other=0.0)
    tl.store(rows + pixel * 3, red, mask=live)
    tl.store(rows + pixel * 3 + 1, green, mask=live)
    tl.store(rows + pixel * 3 + 2, blue, mask=live)


@triton.jit
def sample_backward(gradient, slots, weights, into, PIXELS: tl.constexpr, TAPS: tl.constexpr, BLOCK: tl.constexpr):
    """Adds the gradient of `sample`'s rows to that of its values; no weight, no cost.

    gradient: [P,3] float32. slots: [P,TAPS] int32 or int64. weights: [P,TAPS] float32. into: [N,3] float32, added to.
    """
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = pixel < PIXELS
    for tap in tl.static_range(TAPS):
        weight = tl.load(weights + pixel * TAPS + tap, mask=live, other=0.0)
        texel = into + tl.load(slots + pixel * TAPS + tap, mask=live, other=0).to(tl.int64) * 3
        for channel in tl.static_range(3):
            value = tl.load(gradient + pixel * 3 + channel, mask=live, other=0.0)
            tl.atomic_add(texel + channel, weight * value, mask=live & (weight != 0), sem="relaxed")


@triton.jit
def moved_corner(offsets, x, y, WIDTH: tl.constexpr, HEIGHT: tl.constexpr, COLUMNS: tl.constexpr, ROWS: tl.constexpr):
    """`corner` of the place that pixel (x, y) is moved to.

    offsets: [ROWS,COLUMNS,2] float32, x then y in pixels, interpolated between the blocks' centers.
    """
    at_x = clamp((x + 0.5) / GRID - 1, COLUMNS - 1.0)
    at_y = clamp((y + 0.5) / GRID - 1, ROWS - 1.0)
    x0, y0 = tl.floor(at_x).to(tl.int32), tl.floor(at_y).to(tl.int32)
    right, down = at_x - x0, at_y - y0
    x1, y1 = tl.minimum(x0 + 1, COLUMNS - 1), tl.minimum(y0 + 1, ROWS - 1)
    nw, ne = offsets + (y0 * COLUMNS + x0) * 2, offsets + (y0 * COLUMNS + x1) * 2
    sw, se = offsets + (y1 * COLUMNS + x0) * 2, offsets + (y1 * COLUMNS + x1) * 2
    upper_x = tl.load(nw) * (1 - right) + tl.load(ne) * right
    upper_y = tl.load(nw + 1) * (1 - right) + tl.load(ne + 1) * right
    lower_x = tl.load(sw) * (1 - right) + tl.load(se) * right
    lower_y = tl.load(sw + 1) * (1 - right) + tl.load(se + 1) * right
    x_moved = x + upper_x * (1 - down) + lower_x * down
    y_moved = y + upper_y * (1 - down) + lower_y * down
    return corner(x_moved, y_moved, WIDTH, HEIGHT)


@triton.jit
def bilinear(image, first, right, down, live, channel, CHANNELS: tl.constexpr, WIDTH: tl.constexpr):
    """One channel [BLOCK] around `corner`'s result; image: rows [P,CHANNELS] float32."""
    nw = tl.load(image + first * CHANNELS + channel, mask=live, other=0.0)
    ne = tl.load(image + (first + 1) * CHANNELS + channel, mask=live, other=0.0)
    sw = tl.load(image + (first + WIDTH) * CHANNELS + channel, mask=live, other=0.0)
    se = tl.load(image + (first + WIDTH + 1) * CHANNELS + channel, mask=live, other=0.0)
    return (nw * (1 - right) + ne * right) * (1 - down) + (sw * (1 - right) + se * right) * down


@triton.jit
def assemble(
    condition,
    real,
    fake,
    visible,
    offsets,
    fake_input,
    real_input,
    moved_fake,
    moved_real,
    moved_visible,
    CONDITIONED: tl.constexpr,
    MOVED: tl.constexpr,
    CHANNELS: tl.constexpr,
    WIDTH: tl.constexpr,
    HEIGHT: tl.constexpr,
    COLUMNS: tl.constexpr,
    ROWS: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Both inputs of the discriminator: condition, residual of the moved example, zeros; `examples.assemble`.

    condition, real, fake: [P,3] float32 in [-1,1]. visible: [P,1] float32, 0 or 1.
    offsets: [2,ROWS,COLUMNS,2] float32, the real example's first, in pixels; not read unless MOVED.
    fake_input, real_input: [P,CHANNELS] float32 or bfloat16, written.
    moved_fake, moved_real: [P,3] float32, and moved_visible: [P,1] float32, written if MOVED.
    WIDTH, HEIGHT: of the crop.
    """
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = pixel < WIDTH * HEIGHT
    seen = tl.load(visible + pixel, mask=live, other=0.0)
    # Defined on both ways, which the compiler asks for.
    first_real, right_real, down_real = pixel, seen, seen
    first_fake, right_fake, down_fake = pixel, seen, seen
    if MOVED:
        x, y = pixel % WIDTH, tl.minimum(pixel // WIDTH, HEIGHT - 1)
        first_real, right_real, down_real = moved_corner(offsets, x, y, WIDTH, HEIGHT, COLUMNS, ROWS)
        of_fake = offsets + ROWS * COLUMNS * 2
        first_fake, right_fake, down_fake = moved_corner(of_fake, x, y, WIDTH, HEIGHT, COLUMNS, ROWS)
        least = tl.minimum(
            bilinear(visible, first_real, right_real, down_real, live, 0, 1, WIDTH),
            bilinear(visible, first_fake, right_fake, down_fake, live, 0, 1, WIDTH),
        )
        seen = tl.where(least > WHOLLY_VISIBLE, seen, 0.0)
        tl.store(moved_visible + pixel, seen, mask=live)
    for channel in tl.static_range(3):
        if MOVED:
            of_real = bilinear(real, first_real, right_real, down_real, live, channel, 3, WIDTH)
            of_fake = bilinear(fake, first_fake, right_fake, down_fake, live, channel, 3, WIDTH)
            tl.store(moved_real + pixel * 3 + channel, of_real, mask=live)
            tl.store(moved_fake + pixel * 3 + channel, of_fake, mask=live)
        else:
            of_real = tl.load(real + pixel * 3 + channel, mask=live, other=0.0)
            of_fake = tl.load(fake + pixel * 3 + channel, mask=live, other=0.0)
        shown = tl.zeros((BLOCK,), tl.float32)
        if CONDITIONED:
            shown = tl.load(condition + pixel * 3 + channel, mask=live, other=0.0)
        at = pixel * CHANNELS + channel
        tl.store(real_input + at, shown, mask=live)
        tl.store(fake_input + at, shown, mask=live)
        tl.store(real_input + at + 3, (of_real - shown) * seen, mask=live)
        tl.store(fake_input + at + 3, (of_fake - shown) * seen, mask=live)
    for channel in tl.static_range(6, CHANNELS):
        tl.store(real_input + pixel * CHANNELS + channel, tl.zeros((BLOCK,), tl.float32), mask=live)
        tl.store(fake_input + pixel * CHANNELS + channel, tl.zeros((BLOCK,), tl.float32), mask=live)


@triton.jit
def assemble_backward(
    of_input,
    of_moved,
    visible,
    offsets,
    into,
    MOVED: tl.constexpr,
    WITH_MOVED: tl.constexpr,
    CHANNELS: tl.constexpr,
    WIDTH: tl.constexpr,
    HEIGHT: tl.constexpr,
    COLUMNS: tl.constexpr,
    ROWS: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Gradient of the fake example from those of its input and of it as moved.

    of_input: [P,CHANNELS] float32 or bfloat16. of_moved: [P,3] float32; not read unless WITH_MOVED.
    visible: [P,1] float32, as moved if MOVED. offsets: [ROWS,COLUMNS,2] float32, the fake example's; not read unless
    MOVED. into: [P,3] float32, written, or added to if MOVED: then it holds zeros before.
    """
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = pixel < WIDTH * HEIGHT
    seen = tl.load(visible + pixel, mask=live, other=0.0)
    first, right, down = pixel, seen, seen
    if MOVED:
        x, y = pixel % WIDTH, tl.minimum(pixel // WIDTH, HEIGHT - 1)
        first, right, down = moved_corner(offsets, x, y, WIDTH, HEIGHT, COLUMNS, ROWS)
    for channel in tl.static_range(3):
        gradient = tl.load(of_input + pixel * CHANNELS + 3 + channel, mask=live, other=0.0).to(tl.float32) * seen
        if WITH_MOVED:
            gradient += tl.load(of_moved + pixel * 3 + channel, mask=live, other=0.0)
        if MOVED:
            for tap in tl.static_range(4):
                weight = (right if tap % 2 else 1 - right) * (down if tap // 2 else 1 - down)
                there = into + (first + (tap // 2) * WIDTH + tap % 2) * 3 + channel
                tl.atomic_add(there, weight * gradient, mask=live & (weight * gradient != 0), sem="relaxed")
        else:
            tl.store(into + pixel * 3 + channel, gradient, mask=live)


@triton.jit
def average(mean, state, weight, COUNT: tl.constexpr, BLOCK: tl.constexpr):
    """mean += weight * (state - mean); nine steps of ten have weight 0, and read nothing.

    mean: [COUNT] float32, read and written. state: [COUNT] float32. weight: 0-dim float32.
    """
    share = tl.load(weight)
    if share != 0:
        at = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
        live = at < COUNT
        before = tl.load(mean + at, mask=live, other=0.0)
        tl.store(mean + at, before + share * (tl.load(state + at, mask=live, other=0.0) - before), mask=live)

"""Triton kernels of the losses; `triton_losses.py` launches them and names each one's plain twin in torch.

Tensors are contiguous, and a shape in brackets is followed by the stored type; "any float" is float32 or bfloat16. Rows
[P,C] are the P pixels of a crop, row by row. Logits are those of a crop's patches, COUNT in all.
"""

from __future__ import annotations

import triton
import triton.language as tl

MIN_FOREGROUND = tl.constexpr(0.1)
MIN_UNOCCLUDED = tl.constexpr(0.5)


@triton.jit
def softplus(x):
    return tl.maximum(x, 0.0) + tl.log(1.0 + tl.exp(-tl.abs(x)))


@triton.jit
def sigmoid(x):
    return 1.0 / (1.0 + tl.exp(-x))


@triton.jit
def patches(shares, at, live, COUNT: tl.constexpr):
    """1 or 0 float32 [BLOCK]: which patches count for the texture, and which for the discriminator.

    shares: [2,COUNT] float32, of each patch how much is foreground, and how much is visible; `losses.example_shares`.
    """
    inside = tl.load(shares + at, mask=live, other=0.0)
    seen = tl.load(shares + COUNT + at, mask=live, other=0.0)
    of_texture = live & (inside >= MIN_FOREGROUND)
    of_discriminator = of_texture & (seen > inside * MIN_UNOCCLUDED)
    return of_texture.to(tl.float32), of_discriminator.to(tl.float32)


@triton.jit
def judge(
    real,
    fake,
    shares,
    pretraining,
    of_discriminator,
    of_texture,
    ahead,
    counts,
    told,
    COUNT: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Both players' losses over all logits, and what they tell apart, in one program; `losses.judge`.

    real, fake: [COUNT] any float, logits. shares: [2,COUNT] float32. pretraining: 0-dim float32, 1 or 0.
    Written: of_discriminator, of_texture, 0-dim float32, the losses; ahead, 0-dim float32, 1 where the discriminator is
    ahead; counts [2] float32, how many logits count for discriminator and texture, at least 1; told [7] float32, the
    sums of `losses.told_apart`.
    """
    lost, fooled, judged, drawn = (
        tl.zeros((BLOCK,), tl.float32),
        tl.zeros((BLOCK,), tl.float32),
        tl.zeros((BLOCK,), tl.float32),
        tl.zeros((BLOCK,), tl.float32),
    )
    real_right, real_sum, real_squares = (
        tl.zeros((BLOCK,), tl.float32),
        tl.zeros((BLOCK,), tl.float32),
        tl.zeros((BLOCK,), tl.float32),
    )
    fake_right, fake_sum, fake_squares = (
        tl.zeros((BLOCK,), tl.float32),
        tl.zeros((BLOCK,), tl.float32),
        tl.zeros((BLOCK,), tl.float32),
    )
    for first in range(0, COUNT, BLOCK):
        at = first + tl.arange(0, BLOCK)
        live = at < COUNT
        texture, discriminator = patches(shares, at, live, COUNT)
        of_real = tl.load(real + at, mask=live, other=0.0).to(tl.float32)
        of_fake = tl.load(fake + at, mask=live, other=0.0).to(tl.float32)
        lost += (softplus(-of_real) + softplus(of_fake)) * discriminator
        fooled += softplus(-of_fake) * texture
        judged += discriminator
        drawn += texture
        real_right += tl.where(of_real > 0, 1.0, tl.where(of_real < 0, 0.0, 0.5)) * discriminator
        fake_right += tl.where(of_fake < 0, 1.0, tl.where(of_fake > 0, 0.0, 0.5)) * discriminator
        real_sum += of_real * discriminator
        fake_sum += of_fake * discriminator
        real_squares += of_real * of_real * discriminator
        fake_squares += of_fake * of_fake * discriminator
    first_count, second_count = tl.maximum(tl.sum(judged, 0), 1.0), tl.maximum(tl.sum(drawn, 0), 1.0)
    first_loss, second_loss = tl.sum(lost, 0) / first_count, tl.sum(fooled, 0) / second_count
    tl.store(of_discriminator, first_loss)
    tl.store(of_texture, second_loss)
    tl.store(ahead, tl.where(first_loss <= second_loss, 1.0 - tl.load(pretraining), 0.0))
    tl.store(counts, first_count)
    tl.store(counts + 1, second_count)
    tl.store(told, tl.sum(judged, 0))
    tl.store(told + 1, tl.sum(real_right, 0))
    tl.store(told + 2, tl.sum(fake_right, 0))
    tl.store(told + 3, tl.sum(real_sum, 0))
    tl.store(told + 4, tl.sum(fake_sum, 0))
    tl.store(told + 5, tl.sum(real_squares, 0))
    tl.store(told + 6, tl.sum(fake_squares, 0))


@triton.jit
def judge_backward(
    real,
    fake,
    shares,
    counts,
    of_discriminator,
    of_texture,
    into_real,
    into_fake,
    COUNT: tl.constexpr,
    JUDGED: tl.constexpr,
    DRAWN: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Gradients of the logits. JUDGED, DRAWN: whether there is one of the discriminator's loss, of the texture's.

    real, fake: [COUNT] any float. shares: [2,COUNT] float32. counts: [2] float32, of `judge`.
    of_discriminator, of_texture: 0-dim float32, the losses' gradients; not read unless JUDGED, or DRAWN.
    into_real, into_fake: [COUNT] of the logits' type, written; into_real only if JUDGED.
    """
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = at < COUNT
    texture, discriminator = patches(shares, at, live, COUNT)
    of_fake = tl.load(fake + at, mask=live, other=0.0).to(tl.float32)
    gradient = tl.zeros((BLOCK,), tl.float32)
    if JUDGED:
        scale = tl.load(of_discriminator) / tl.load(counts) * discriminator
        of_real = tl.load(real + at, mask=live, other=0.0).to(tl.float32)
        tl.store(into_real + at, -sigmoid(-of_real) * scale, mask=live)
        gradient += sigmoid(of_fake) * scale
    if DRAWN:
        gradient -= sigmoid(-of_fake) * texture * (tl.load(of_texture) / tl.load(counts + 1))
    tl.store(into_fake + at, gradient, mask=live)


@triton.jit
def l1(a, b, visible, sums, PARTS: tl.constexpr, PIXELS: tl.constexpr, BLOCK: tl.constexpr):
    """Sums of |a - b| over each block's visible pixels, and of these pixels; `losses.l1_loss`.

    a, b: [PIXELS,3] float32. visible: [PIXELS,1] float32, 0 or 1. sums: [2,PARTS] float32, a column for each program,
    written.
    """
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = pixel < PIXELS
    seen = tl.load(visible + pixel, mask=live, other=0.0)
    apart = tl.zeros((BLOCK,), tl.float32)
    for channel in tl.static_range(3):
        at = pixel * 3 + channel
        apart += tl.abs(tl.load(a + at, mask=live, other=0.0) - tl.load(b + at, mask=live, other=0.0))
    tl.store(sums + tl.program_id(0), tl.sum(apart * seen, 0))
    tl.store(sums + PARTS + tl.program_id(0), tl.sum(seen, 0))


@triton.jit
def l1_mean(sums, mean, count, PARTS: tl.constexpr, BLOCK: tl.constexpr):
    """The quotient of the sums' totals, in one program.

    sums: [2,PARTS] float32, of `l1`. Written: mean, 0-dim float32; count, 0-dim float32, how many numbers it is the
    mean of, at least 1.
    """
    apart, seen = tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32)
    for first in range(0, PARTS, BLOCK):
        part = first + tl.arange(0, BLOCK)
        apart += tl.load(sums + part, mask=part < PARTS, other=0.0)
        seen += tl.load(sums + PARTS + part, mask=part < PARTS, other=0.0)
    numbers = tl.maximum(3.0 * tl.sum(seen, 0), 1.0)
    tl.store(mean, tl.sum(apart, 0) / numbers)
    tl.store(count, numbers)


@triton.jit
def l1_backward(a, b, visible, gradient, count, into, PIXELS: tl.constexpr, BLOCK: tl.constexpr):
    """The mean's gradient times the sign of a - b where it is visible.

    a, b: [PIXELS,3] float32. visible: [PIXELS,1] float32. gradient, count: 0-dim float32, the mean's gradient and
    `l1_mean`'s count. into: [PIXELS,3] float32, the gradient of a, written.
    """
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = pixel < PIXELS
    scale = tl.load(gradient) / tl.load(count) * tl.load(visible + pixel, mask=live, other=0.0)
    for channel in tl.static_range(3):
        at = pixel * 3 + channel
        apart = tl.load(a + at, mask=live, other=0.0) - tl.load(b + at, mask=live, other=0.0)
        tl.store(into + at, tl.where(apart > 0, scale, tl.where(apart < 0, -scale, 0.0)), mask=live)


@triton.jit
def difference(a, b, sums, COUNT: tl.constexpr, BLOCK: tl.constexpr):
    """Sum of |a - b| over each block; `losses.mean_difference`.

    a, b: [COUNT] any float. sums: [number of programs] float32, written.
    """
    at = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = at < COUNT
    value = tl.load(a + at, mask=live, other=0.0).to(tl.float32) - tl.load(b + at, mask=live, other=0.0).to(tl.float32)
    tl.store(sums + tl.program_id(0), tl.sum(tl.abs(value), 0))


@triton.jit
def difference_mean(sums, mean, COUNT: tl.constexpr, PARTS: tl.constexpr, BLOCK: tl.constexpr):
    """The sums' total over COUNT, in one program.

    sums: [PARTS] float32, of `difference`. mean: 0-dim float32, written.
    """
    total = tl.zeros((BLOCK,), tl.float32)
    for first in range(0, PARTS, BLOCK):
        part = first + tl.arange(0, BLOCK)
        total += tl.load(sums + part, mask=part < PARTS, other=0.0)
    tl.store(mean, tl.sum(total, 0) / COUNT)


@triton.jit
def difference_backward(a, b, gradient, into, COUNT: tl.constexpr, BLOCK: tl.constexpr):
    """The mean's gradient times the sign of a - b.

    a, b: [COUNT] any float. gradient: 0-dim float32, the mean's. into: [COUNT] of a's type, the gradient of a, written.
    """
    at = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = at < COUNT
    value = tl.load(a + at, mask=live, other=0.0).to(tl.float32) - tl.load(b + at, mask=live, other=0.0).to(tl.float32)
    scale = tl.load(gradient) / COUNT
    tl.store(into + at, tl.where(value > 0, scale, tl.where(value < 0, -scale, 0.0)), mask=live)

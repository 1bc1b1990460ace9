"""What a worker must have for a job. Estimated without the engine, from runs of it that were measured.

Peak memory of 18 runs on CPUs (44 to 62 views at 320x240 and 640x480, all methods) against this estimate: never above
it, and at least a third of it. On GPUs the base covers CUDA's own context.
"""

from __future__ import annotations

from advtex_contract.options import JobOptions, Preset

GIB = 1 << 30
BASE = GIB  # libraries, mesh, discriminator
PER_VIEW_PIXEL = 9  # color, uv and depth of every view stay on the device
TEXELS_PER_VIEW_PIXEL = 0.5  # views overlap: 0.13 to 0.38 were measured
PER_TEXEL = 48  # value, gradient, two moments, in float32
PER_STEP_PIXEL = 2048  # activations of the discriminator and what is rendered
PER_SCORED_PIXEL = 4096  # LPIPS of held-out views
STANDARD_STEP_PIXELS = 384 * 288  # that preset sees larger views in parts


def needed_memory(options: JobOptions, views: int, width: int, height: int) -> int:
    """Bytes, for `views` images of width x height pixels (the options' working size comes first)."""
    pixels = (options.width or width) * (options.height or height)
    texels = min(options.max_texture_size**2, int(views * pixels * TEXELS_PER_VIEW_PIXEL))
    step_pixels = min(pixels, STANDARD_STEP_PIXELS) if options.preset is Preset.standard else pixels
    scored = pixels * PER_SCORED_PIXEL if options.holdout else 0
    return BASE + views * pixels * PER_VIEW_PIXEL + texels * PER_TEXEL + step_pixels * PER_STEP_PIXEL + scored

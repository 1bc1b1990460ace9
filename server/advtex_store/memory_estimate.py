"""What a worker must have for a job. Estimated without the engine, from runs of it that were measured.

Peak memory of 18 runs on CPUs (44 to 62 views at 320x240 and 640x480, all methods) was never above this estimate. The
engine counts its own need by part (`advtex_engine/budget/workload.py`) once it knows the scene; what is asked for here
is never less. On GPUs the base covers CUDA's own context.
"""

from __future__ import annotations

from advtex_contract.options import JobOptions, Preset
from advtex_options.options import MAX_VIEWS

GIB = 1 << 30
BASE = GIB  # libraries, mesh, discriminator
PER_VIEW_PIXEL = 9  # color, uv and depth of every view stay on the device
COARSE_TOO = 1.25  # the preset preview keeps views of half the size beside them
TEXELS_PER_VIEW_PIXEL = 0.5  # views overlap: 0.13 to 0.38 were measured
# Value, gradient, two moments, average and start, in float32; and the whole image with its holes being filled.
PER_TEXEL = 200
PER_STEP_PIXEL = 2048  # activations of the discriminator and what is rendered
PER_SCORED_PIXEL = 4096  # LPIPS of held-out views
STANDARD_STEP_PIXELS = 640 * 480  # that preset sees larger views in parts
MAX_VIEW_BYTES = 8 * GIB  # the engine chooses fewer views where theirs would be more
MAX_SCORED_VIEWS = 50  # kept beside them
# Of a mesh that is fused from depth, before it is decimated: 62 frames of a kitchen took 0.95 GiB. The engine caps its
# voxels, and with them its faces.
PER_FUSED_FRAME = 16 << 20
MAX_FUSED = 6 * GIB


def needed_memory(options: JobOptions, views: int, width: int, height: int, *, fuses: bool = False) -> int:
    """Bytes, for `views` images of width x height pixels (the options' working size comes first).

    fuses: whether the mesh is made from their depth, which is done with when the texture is begun.
    """
    pixels = (options.width or width) * (options.height or height)
    scored_views = MAX_SCORED_VIEWS if options.holdout else 0
    kept = min(views, (options.max_views or MAX_VIEWS) + scored_views)
    view_pixels = min(kept * pixels, MAX_VIEW_BYTES // PER_VIEW_PIXEL + scored_views * pixels)
    texels = min(options.max_texture_size**2, int(view_pixels * TEXELS_PER_VIEW_PIXEL))
    step_pixels = min(pixels, STANDARD_STEP_PIXELS) if options.preset is Preset.standard else pixels
    scored = pixels * PER_SCORED_PIXEL if options.holdout else 0
    view_bytes = int(view_pixels * PER_VIEW_PIXEL * (COARSE_TOO if options.preset is Preset.preview else 1))
    textured = view_bytes + texels * PER_TEXEL + step_pixels * PER_STEP_PIXEL + scored
    fused = min(views * PER_FUSED_FRAME, MAX_FUSED) if fuses else 0
    return BASE + max(textured, fused)

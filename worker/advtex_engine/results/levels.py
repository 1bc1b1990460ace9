"""Smaller models: one for phones, and levels of detail."""

from __future__ import annotations

from collections.abc import Set
from dataclasses import replace
from pathlib import Path

from torch import Tensor

from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import Atlas
from advtex_engine.results.baking import TexturedModel, smaller
from advtex_engine.results.export import write_glb

MOBILE_FACES, MOBILE_SIDE, MOBILE_BYTES = 50_000, 4096, 5_000_000
SMALL_SIDE, SHRINKING = 2048, 1.3
"""The image has SMALL_SIDE texels a side where the texture is at most SHRINKING times as large: a kitchen's renders of
1.22 times are .003 LPIPS farther from the full model's by it, and 1.5 times would cost over .01."""
LEVELS, QUARTER = 2, 4
LEAST_FACES = 200  # no level has fewer: they cost nothing, and a coarse mesh would collapse to nothing
QUALITIES = (95, 90, 85, 80, 70, 60, 50)
"""Of JPEGs, tried until a file is small enough."""


def write_smaller(
    out: Path,
    atlas: Atlas,
    texture: Tensor,
    outputs: Set[str],
    *,
    up_axis: str,
    normal_map: Tensor | None = None,
    name: str = "model",
) -> tuple[Path, ...]:
    """Write those of `name`_mobile.glb and `name`_lod1.glb, `name`_lod2.glb that `outputs` asks for; -> their paths.

    outputs: words of `advtex_options.outputs`. texture: as `export_model` takes it. Images are JPEGs. normal_map: the
    model's for phones has one as well; levels of detail are seen from far away.
    """
    files = list[Path]()
    if outputs.isdisjoint({"mobile", "lod"}):
        return ()
    full = TexturedModel.of(atlas, texture, normal_map)
    if "mobile" in outputs:
        files.append(out / f"{name}_mobile.glb")
        write_within(files[-1], mobile(full), MOBILE_BYTES, up_axis)
    if "lod" in outputs:
        level = replace(full, normal_map=None)
        for number in range(1, LEVELS + 1):
            level = smaller(level, max(level.faces // QUARTER, LEAST_FACES), 1 / QUARTER, MOBILE_SIDE, Monitor()).model
            files.append(out / f"{name}_lod{number}.glb")
            write_glb(files[-1], level.atlas, level.texture, up_axis=up_axis)
    return tuple(files)


def mobile(full: TexturedModel) -> TexturedModel:
    """The model with one image and faces that phones draw; the same one where it is as small already."""
    side = SMALL_SIDE if full.atlas.width <= SMALL_SIDE * SHRINKING else MOBILE_SIDE
    if full.faces <= MOBILE_FACES and full.atlas.pages == 1 and full.atlas.width <= side:
        return full
    return smaller(full, MOBILE_FACES, 1.0, side, Monitor()).model


def write_within(path: Path, model: TexturedModel, most: int, up_axis: str) -> None:
    """Write the GLB with the best JPEG by which it has at most that many bytes, or else the last of QUALITIES."""
    for quality in QUALITIES:
        write_glb(path, model.atlas, model.texture, up_axis=up_axis, quality=quality, normal_map=model.normal_map)
        if path.stat().st_size <= most:
            break

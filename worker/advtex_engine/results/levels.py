"""Smaller models: one for phones, and levels of detail."""

from __future__ import annotations

from collections.abc import Set
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from torch import Tensor

from advtex_engine.core.errors import OptionError, Problem
from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import Atlas, face_areas
from advtex_engine.results.baking import TexturedModel, smaller
from advtex_engine.results.export import write_glb

MOBILE_FACES, MOBILE_SIDE, MOBILE_BYTES = 50_000, 4096, 5_000_000
SMALL_SIDE, SHRINKING = 2048, 1.3
"""The image has SMALL_SIDE texels a side where the texture is at most SHRINKING times as large: a kitchen's renders of
1.22 times are .003 LPIPS farther from the full model's by it, and 1.5 times would cost over .01."""
LEVELS, QUARTER = 2, 4
LEAST_FACES = 200  # no level has fewer: they cost nothing, and a coarse mesh would collapse to nothing
LEAST_SURFACE = 0.8  # of the full model's; a kitchen keeps 102 %, for borders grow
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
    monitor: Monitor | None = None,
) -> tuple[Path, ...]:
    """Write those of `name`_mobile.glb and `name`_lod1.glb, `name`_lod2.glb that `outputs` asks for; -> their paths.

    outputs: words of `advtex_options.outputs`. texture: as `export_model` takes it. Images are JPEGs. normal_map: the
    model's for phones has one as well; levels of detail are seen from far away. A model for phones that misses its
    limits is written all the same, and a level whose charts do not fit in its image is left out: the monitor is told
    why.
    """
    monitor = monitor or Monitor()
    files = list[Path]()
    if outputs.isdisjoint({"mobile", "lod"}):
        return ()
    full = TexturedModel.of(atlas, texture, normal_map)
    if "mobile" in outputs:
        files.append(out / f"{name}_mobile.glb")
        model = mobile(full)
        write_within(files[-1], model, MOBILE_BYTES, up_axis)
        if missed := missed_limits(full, model, files[-1].stat().st_size):
            remedy = "remove small loose pieces from the mesh, or lower the face budget or the largest texture"
            monitor.warning(Problem("mobile_limits_missed", files[-1].name, "; ".join(missed), remedy))
    if "lod" in outputs:
        level = full if full.normal_map is None else replace(full, normal_map=None)
        for number in range(1, LEVELS + 1):
            path = out / f"{name}_lod{number}.glb"
            faces = max(level.faces // QUARTER, LEAST_FACES)
            try:
                level = smaller(level, faces, 1 / QUARTER, MOBILE_SIDE, Monitor()).model
            except OptionError as error:
                monitor.warning(
                    Problem("level_left_out", path.name, str(error), "remove small loose pieces from the mesh")
                )
                break
            files.append(path)
            write_glb(path, level.atlas, level.texture, up_axis=up_axis)
    return tuple(files)


def mobile(full: TexturedModel) -> TexturedModel:
    """The model with one image and faces that phones draw; the same one where it is as small already.

    It is the same one also where it consists of so many pieces that their charts fit in no image for phones.
    """
    side = SMALL_SIDE if full.atlas.width <= SMALL_SIDE * SHRINKING else MOBILE_SIDE
    if full.faces <= MOBILE_FACES and full.atlas.pages == 1 and full.atlas.width <= side:
        return full
    for longest in sorted({side, MOBILE_SIDE}):
        with suppress(OptionError):
            return smaller(full, MOBILE_FACES, 1.0, longest, Monitor()).model
    return full


def missed_limits(full: TexturedModel, model: TexturedModel, size: int) -> list[str]:
    """What a model for phones made of `full` has too much or too little of, and why. size: bytes of its file."""
    charts = f"its surface is in {model.atlas.charts:,} pieces of the texture"
    missed = []
    if model.faces > MOBILE_FACES:
        missed.append(f"it has {model.faces:,} faces, more than {MOBILE_FACES:,}: {charts}, which do not decimate")
    if model.atlas.pages > 1 or model.atlas.width > MOBILE_SIDE:
        missed.append(f"it has {model.atlas.width} texels a side, more than {MOBILE_SIDE}: {charts}, which do not fit")
    if size > MOBILE_BYTES:
        quality = f"with its image as a JPEG of quality {QUALITIES[-1]}"
        missed.append(f"it has {size / 1e6:.1f} MB, more than {MOBILE_BYTES / 1e6:.0f}, {quality}: {charts}")
    kept = float(face_areas(model.atlas.mesh).sum() / face_areas(full.atlas.mesh).sum())
    if kept < LEAST_SURFACE:
        missed.append(
            f"it lacks {1 - kept:.0%} of the surface: loose pieces do not decimate, and the least are left out"
        )
    return missed


def write_within(path: Path, model: TexturedModel, most: int, up_axis: str) -> None:
    """Write the GLB with the best JPEG by which it has at most that many bytes, or else the last of QUALITIES."""
    for quality in QUALITIES:
        write_glb(path, model.atlas, model.texture, up_axis=up_axis, quality=quality, normal_map=model.normal_map)
        if path.stat().st_size <= most:
            break

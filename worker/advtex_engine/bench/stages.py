"""Times the stages before and after the optimization on a scene that the bench made.

Those that other libraries do (image decoding, atlas, export) are timed where these are installed, and else reported as
left out with the reason.
"""

from __future__ import annotations

import importlib
import math
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from advtex_engine.bench.counts import Work, stage_works
from advtex_engine.core.config import PRESETS, TextureConfig
from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import Atlas, Mesh, Scene
from advtex_engine.methods.inputs import MethodInput
from advtex_engine.methods.mean import mean_texture
from advtex_engine.methods.view_selection import view_selection_no_descent
from advtex_engine.previews.live import Live
from advtex_engine.previews.turntable import FRAMES, SIZE, circle_cameras, facing, find_circle
from advtex_engine.render.pairs import Pairs, related_pairs
from advtex_engine.render.render_view import gbuffer, shade
from advtex_engine.render.texture import fill_holes
from advtex_engine.render.view_maps import ViewMaps, build_view_maps
from advtex_engine.runtime.checkpoint import WorkFolder
from advtex_engine.runtime.devices import wait_for
from advtex_engine.runtime.threads import in_threads

PICTURES, SUPERSAMPLE = FRAMES, 2  # those of a result's turntable
JPEG_QUALITY = 95


@dataclass(frozen=True)
class Stage:
    """seconds: None where it was left out, for this reason. work: None where nothing can be counted."""

    seconds: float | None = None
    work: Work | None = None
    left_out: str | None = None


def time_stages(scene: Scene, atlas: Atlas, device: torch.device) -> tuple[dict[str, Stage], ViewMaps, Pairs]:
    """All stages in the order of a run, and the maps and pairs that the step is timed on. Pairs: of the preset full."""
    preset = PRESETS["full"]
    seconds: dict[str, float] = {}
    timed = _Timed(seconds, device)
    if device.type == "cuda":  # libraries load and kernels are compiled at their first use
        _run(replace(scene, views=scene.views[:2]), atlas, _Timed({}, device), device)
    maps, pairs = _run(scene, atlas, timed, device)
    axes = maps.world_to_camera[:, 2, :3]
    near = int((axes @ axes.T >= math.cos(math.radians(preset.max_pair_angle))).sum())
    camera = scene.views[0].camera
    works = stage_works(
        views=maps.count,
        pixels=camera.width * camera.height,
        faces=len(atlas.mesh.t_pos_idx),
        vertices=len(atlas.mesh.v_pos),
        texels=atlas.width * atlas.height,
        slots=maps.slots,
        near=near,
        pictures=PICTURES,
        shown=SIZE[0] * SIZE[1] * SUPERSAMPLE**2,
    )
    stages = {"decode": _library("decoding images", ("cv2", "imagecodecs"), lambda: _decode(scene))}
    stages["atlas"] = _library("making charts", ("xatlas",), lambda: _atlas(scene))
    stages |= {name: Stage(seconds[name], works[name]) for name in works}
    stages["export"] = _library("writing PNG", ("cv2",), lambda: _export(scene, atlas))
    return stages, maps, pairs


class _Timed:
    """Seconds of what is done within `part`, until the device has done it."""

    def __init__(self, seconds: dict[str, float], device: torch.device) -> None:
        self.seconds, self.device = seconds, device

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        wait_for(self.device)
        started = time.perf_counter()
        yield
        wait_for(self.device)
        self.seconds[name] = time.perf_counter() - started


def _run(scene: Scene, atlas: Atlas, timed: _Timed, device: torch.device) -> tuple[ViewMaps, Pairs]:
    preset = PRESETS["full"]
    atlas = replace(atlas, mesh=_moved(atlas.mesh, device))
    with timed.part("upload"):
        views = tuple(
            replace(view, color=view.color.to(device), depth=None if view.depth is None else view.depth.to(device))
            for view in scene.views
        )
    with timed.part("view maps"):
        maps = build_view_maps(atlas, views, scene.kind)
    with timed.part("overlaps and pairs"):
        pairs = related_pairs(maps, scene.kind, preset.max_pair_angle, preset.min_pair_overlap)
    with timed.part("mean texture"):
        mean = mean_texture(maps)
    monitor = Monitor()
    with tempfile.TemporaryDirectory() as folder:
        work = WorkFolder(Path(folder), "", monitor)
        given = MethodInput(
            scene, atlas, {1: maps}, {1: mean}, preset, TextureConfig(), monitor, work, Live(scene, atlas, monitor)
        )
        with timed.part("view selection"):
            texture, _ = view_selection_no_descent(given)
    with timed.part("dilation"):
        fill_holes(texture, maps.slot_map >= 0)
    with timed.part("pictures"):
        _paint_all(scene, atlas, texture)
    return maps, pairs


def _paint_all(scene: Scene, atlas: Atlas, texture: Tensor) -> None:
    circle = find_circle(atlas.mesh, scene.views, scene.up_axis)
    for camera in circle_cameras(circle, frames=PICTURES):
        shade(gbuffer(facing(atlas, camera, circle.outer), camera, SUPERSAMPLE), texture)


def _library(what: str, modules: tuple[str, ...], work: Callable[[], float]) -> Stage:
    for module in modules:
        try:
            importlib.import_module(module)
        except ImportError as error:
            return Stage(left_out=f"{what} needs {module}, which cannot be imported here ({error})")
    return Stage(work())


def _decode(scene: Scene) -> float:
    """Seconds for the scene's photographs as JPEG files in memory, in as many threads as ingest has."""
    import cv2

    from advtex_engine.ingest.decode import decode_color
    from advtex_scan.manifest import Intrinsics

    camera = scene.views[0].camera
    size = (camera.width, camera.height)
    intrinsics = Intrinsics(float(camera.K[0, 0]), float(camera.K[1, 1]), size[0] / 2, size[1] / 2, *size)
    files = []
    for view in scene.views:
        done, data = cv2.imencode(".jpg", view.color.numpy()[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        assert done
        files.append(data.tobytes())
    started = time.perf_counter()
    for image in in_threads(lambda data: decode_color(data, "image.jpg", intrinsics, size), files):
        assert image.dtype == np.uint8
    return time.perf_counter() - started


def _atlas(scene: Scene) -> float:
    """Seconds for new charts of the mesh, one process's worth or several as the engine decides."""
    from advtex_engine.atlas.build import build_atlas

    bare = Mesh(scene.mesh.v_pos, scene.mesh.t_pos_idx)
    started = time.perf_counter()
    build_atlas(bare, [view.camera for view in scene.views], TextureConfig(), Monitor())
    return time.perf_counter() - started


def _export(scene: Scene, atlas: Atlas) -> float:
    from advtex_engine.results.export import export_model

    photograph = torch.nn.functional.interpolate(
        scene.views[0].color.permute(2, 0, 1)[None].float() / 255, (atlas.height, atlas.width), mode="bilinear"
    )
    texture = photograph[0].permute(1, 2, 0).contiguous()
    with tempfile.TemporaryDirectory() as folder:
        started = time.perf_counter()
        export_model(Path(folder), atlas, texture, up_axis=scene.up_axis)
        return time.perf_counter() - started


def _moved(mesh: Mesh, device: torch.device) -> Mesh:
    assert mesh.v_uv is not None and mesh.t_uv_idx is not None
    return Mesh(*(part.to(device) for part in (mesh.v_pos, mesh.t_pos_idx, mesh.v_uv, mesh.t_uv_idx)))

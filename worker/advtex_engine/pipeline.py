"""The stages, in reading order: from a scan's files to a textured model.

ingest -> geometry -> refinement -> atlas -> view maps -> initial texture -> optimization -> dilation -> export
-> previews
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.atlas import build_atlas
from advtex_engine.cameras import scaled_camera
from advtex_engine.checkpoint import WorkFolder
from advtex_engine.config import PRESETS, Preset, PyramidLevel, TextureConfig
from advtex_engine.errors import OptionError
from advtex_engine.export import export_model
from advtex_engine.geometry import clean, decimate
from advtex_engine.ingest import ingest, opened
from advtex_engine.methods import METHODS, MethodInput, require
from advtex_engine.methods.mean import mean_texture
from advtex_engine.methods.view_selection import select_views
from advtex_engine.monitor import Monitor
from advtex_engine.refine import apply_refinement, refine_cameras, refinement_from_dict, refinement_to_dict
from advtex_engine.report import (
    Stages,
    WarningKeeper,
    describe_scene,
    heldout_scores,
    scene_from_dict,
    scene_to_dict,
    versions,
    write_previews,
    write_report,
)
from advtex_engine.scene import Atlas, Mesh, Scene, View
from advtex_engine.texture import fill_holes
from advtex_engine.views import ViewMaps, build_view_maps


@dataclass(frozen=True)
class RunResult:
    """What a run leaves: the files below its output folder and the report that is also in report.json."""

    files: tuple[Path, ...]
    report: dict[str, Any]


def texture_scan(
    scan: Path, out: Path, config: TextureConfig, *, work: Path, resume: bool = False, monitor: Monitor | None = None
) -> RunResult:
    """Textures a scan: model.obj, model.mtl, model.png, model.glb, report.json and previews/ below `out`.

    work: folder for stage caches and checkpoints. With `resume`, what it holds of the same scan and options is used;
    without, it is cleared. Raises ScanError, OptionError, WeightsError for a method without its weights, and Stopped
    once the monitor asks for a stop.
    """
    device = choose_device(config.device)
    preset = resolve_preset(config, device)
    require(config.method)
    monitor = WarningKeeper(monitor or Monitor())
    folder = WorkFolder(work, fingerprint(scan, config), monitor)
    if not resume:
        folder.clear()
    out.mkdir(parents=True, exist_ok=True)
    stages = Stages(monitor, folder, device)

    scene = _load_scene(scan, config, folder, stages, monitor)
    scene, refinement = _refine(scene, config, folder, stages, device)
    atlas = _load_atlas(scene, config, folder, stages, monitor)
    atlas = replace(atlas, mesh=_mesh_to(atlas.mesh, device))
    maps = _view_maps(scene, atlas, preset, folder, stages, device)
    with stages.run("initial_texture"):
        means = {scale: mean_texture(level) for scale, level in maps.items()}
        given = MethodInput(scene, atlas, maps, means, preset, config, monitor, folder)
        if preset.start == "selection" and config.method.startswith("adversarial"):
            given = replace(given, start=_selected_start(given))
    stages.save()
    with stages.run("optimization"):
        texture, losses = METHODS[config.method](given)
    with stages.run("dilation"):
        texture = fill_holes(texture, maps[1].slot_map >= 0).cpu()
        mean = means[1].cpu()
    atlas = replace(atlas, mesh=_mesh_to(atlas.mesh, torch.device("cpu")))
    with stages.run("export"):
        files = export_model(out, atlas, texture, up_axis=scene.up_axis)
    with stages.run("previews"):
        files += write_previews(out, scene, atlas, texture, mean)
        scores = heldout_scores(scene, atlas, texture, mean)
    parts = {
        "scan": describe_scene(scene),
        "refinement": refinement,
        "atlas": {key: getattr(atlas, key) for key in ("width", "height", "source", "charts")},
        "touched_texels": maps[1].slots,
        "stages": stages.records,
        "saving_seconds": round(folder.seconds, 3),
        "losses": losses,
        "heldout": scores,
    }
    report = _report(monitor, config, preset, device, parts)
    return RunResult((*files, write_report(out, report)), report)


def choose_device(name: str) -> torch.device:
    """ "auto" is the GPU when there is one. Raises OptionError for a device that is not there."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        raise OptionError(f"device {name!r} is not available here ({error}); use auto, cpu or cuda") from error
    return device


def resolve_preset(config: TextureConfig, device: torch.device) -> Preset:
    """The preset's numbers, "auto" decided by the device and the steps overridden where asked."""
    name = config.preset
    if name == "auto":
        name = "full" if device.type == "cuda" else "standard"
    preset = PRESETS[name]
    if config.steps is None:
        return preset
    share = config.steps / preset.steps
    levels = [PyramidLevel(round(level.steps * share), level.scale) for level in preset.levels]
    levels[-1] = PyramidLevel(config.steps - sum(level.steps for level in levels[:-1]), levels[-1].scale)
    return replace(preset, levels=tuple(levels), pretraining=int(preset.pretraining * share))


def fingerprint(scan: Path, config: TextureConfig) -> str:
    """Identifies a run: the state of the scan's files, and every option that changes the result.

    A zip keeps its fingerprint wherever it is copied; a folder keeps it where copies keep the files' times.
    Raises ScanError for what cannot be opened.
    """
    with opened(scan) as archive:
        files = archive.stamps()
    options = {key: value for key, value in asdict(config).items() if key not in ("device", "checkpoint_seconds")}
    content = {"files": files, "options": options}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _load_scene(scan: Path, config: TextureConfig, folder: WorkFolder, stages: Stages, monitor: Monitor) -> Scene:
    saved = folder.load("scene")
    if saved is not None:
        stages.restore("ingest", "geometry")
        return scene_from_dict(saved)
    with stages.run("ingest"):
        scene = ingest(scan, config, monitor)
    with stages.run("geometry"):
        scene = replace(scene, mesh=decimate(clean(scene.mesh), config.face_budget, monitor))
    folder.save("scene", scene_to_dict(scene))
    stages.save()
    return scene


def _refine(
    scene: Scene, config: TextureConfig, folder: WorkFolder, stages: Stages, device: torch.device
) -> tuple[Scene, dict[str, Any] | None]:
    """The scene with refined cameras and exposures, and the report's part about them; None when it was not asked for.

    What was found is small and cached by itself: the scene as it came stays in its own cache.
    """
    if not config.refines:
        return scene, None
    saved = folder.load("refinement")
    if saved is not None:
        stages.restore("refinement")
        refinement = refinement_from_dict(saved)
        return apply_refinement(scene, refinement), refinement.report
    with stages.run("refinement"):
        refinement = refine_cameras(scene, device, config.seed)
        refined = apply_refinement(scene, refinement)
    folder.save("refinement", refinement_to_dict(refinement))
    stages.save()
    return refined, refinement.report


def _load_atlas(scene: Scene, config: TextureConfig, folder: WorkFolder, stages: Stages, monitor: Monitor) -> Atlas:
    saved = folder.load("atlas")
    if saved is not None:
        stages.restore("atlas")
        mesh = Mesh(scene.mesh.v_pos, saved["t_pos_idx"], saved["v_uv"], saved["t_uv_idx"])
        return Atlas(mesh, saved["width"], saved["height"], saved["source"], saved["charts"])
    with stages.run("atlas"):
        atlas = build_atlas(scene.mesh, [view.camera for view in scene.views], config, monitor)
    folder.save(
        "atlas",
        {
            "t_pos_idx": atlas.mesh.t_pos_idx,
            "v_uv": atlas.mesh.v_uv,
            "t_uv_idx": atlas.mesh.t_uv_idx,
            "width": atlas.width,
            "height": atlas.height,
            "source": atlas.source,
            "charts": atlas.charts,
        },
    )
    stages.save()
    return atlas


def _view_maps(
    scene: Scene, atlas: Atlas, preset: Preset, folder: WorkFolder, stages: Stages, device: torch.device
) -> dict[int, ViewMaps]:
    """View maps for every scale of the preset, and for the full size, which mean textures and export need."""
    maps: dict[int, ViewMaps] = {}
    with stages.run("view_maps"):
        for scale in sorted({1, *(level.scale for level in preset.levels)}):
            saved = folder.load(f"view_maps_{scale}")
            if saved is not None:
                maps[scale] = ViewMaps(**{key: saved[key] for key in ViewMaps.__dataclass_fields__}).to(device)
                continue
            small = replace(atlas, width=atlas.width // scale, height=atlas.height // scale)
            maps[scale] = build_view_maps(small, tuple(shrink(view, scale) for view in scene.views), scene.kind)
            folder.save(f"view_maps_{scale}", vars(maps[scale]))
    stages.save()
    return maps


def _selected_start(given: MethodInput) -> Tensor:
    """The texture by view selection; from the work folder when it is there."""
    saved = given.work.load("initial_texture")
    if saved is not None:
        texture: Tensor = saved["texture"].to(given.means[1])
        return texture
    texture = select_views(given).texture
    given.work.save("initial_texture", {"texture": texture})
    return texture


def shrink(view: View, scale: int) -> View:
    """The view at 1/scale of its size: color averaged over blocks, depth taken from one pixel of each block."""
    if scale == 1:
        return view
    width, height = view.camera.width // scale, view.camera.height // scale
    color = view.color[: height * scale, : width * scale].permute(2, 0, 1)[None].to(torch.float32)
    color = F.avg_pool2d(color, scale)[0].permute(1, 2, 0).round().to(torch.uint8)
    depth = None
    if view.depth is not None:
        depth = view.depth[scale // 2 : height * scale : scale, scale // 2 : width * scale : scale].contiguous()
    camera = scaled_camera(view.camera, width, height)
    return View(view.name, camera, color, depth)


def _mesh_to(mesh: Mesh, device: torch.device) -> Mesh:
    uv = None if mesh.v_uv is None or mesh.t_uv_idx is None else (mesh.v_uv.to(device), mesh.t_uv_idx.to(device))
    return Mesh(mesh.v_pos.to(device), mesh.t_pos_idx.to(device), *(uv or ()))


def _report(
    run: WarningKeeper, config: TextureConfig, preset: Preset, device: torch.device, parts: Mapping[str, Any]
) -> dict[str, Any]:
    """report.json: what went in, what was done with it, what it cost."""
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"
    return {
        "versions": versions(),
        "device": f"{device.type} ({name}, {torch.get_num_threads()} threads)",
        "options": asdict(config),
        "preset": asdict(preset),
        "warnings": run.warnings,
        **parts,
    }

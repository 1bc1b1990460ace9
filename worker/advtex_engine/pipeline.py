"""The stages, in reading order: from a scan's files to a textured model.

ingest -> conventions -> fusion (of scans without a mesh) -> geometry -> refinement -> atlas -> view maps
-> initial texture -> optimization -> dilation -> export -> previews
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

from advtex_engine.atlas import begin_charts, build_atlas
from advtex_engine.cameras import scaled_camera
from advtex_engine.capture import FrameStore
from advtex_engine.chart_cache import ChartMaker, charts_folder
from advtex_engine.checkpoint import FORMAT, WorkFolder
from advtex_engine.config import PRESETS, Preset, PyramidLevel, TextureConfig
from advtex_engine.curves import curves
from advtex_engine.deep_check import judge
from advtex_engine.devices import choose_device as choose_device
from advtex_engine.errors import Diverged, MemoryShortage, OptionError, Problem, ScanError, few_of
from advtex_engine.export import export_model
from advtex_engine.fusion import fuse
from advtex_engine.gallery import write_gallery
from advtex_engine.ingest import opened, read_capture
from advtex_engine.limits import Budget
from advtex_engine.live import Live
from advtex_engine.memory import Workload, held_bytes
from advtex_engine.methods import METHODS, MethodInput, require
from advtex_engine.methods.adversarial import starting_texture
from advtex_engine.methods.mean import mean_texture
from advtex_engine.methods.view_selection import select_views
from advtex_engine.monitor import Monitor
from advtex_engine.optimize import native_bfloat16
from advtex_engine.preparation import MeshPreparation
from advtex_engine.refine import Refinement, apply_refinement, refine_cameras, refinement_from_dict, refinement_to_dict
from advtex_engine.registration import MAX_FRAMES, register_mesh
from advtex_engine.report import (
    Stages,
    WarningKeeper,
    describe_scene,
    heldout_scores,
    scene_from_dict,
    scene_to_dict,
    versions,
    write_report,
)
from advtex_engine.result_page import write_page
from advtex_engine.scene import Atlas, Mesh, Scene, View
from advtex_engine.shortage import memory_problem
from advtex_engine.speckle import speckle_share
from advtex_engine.streaming import host_allocator, keep_off
from advtex_engine.texture import fill_holes
from advtex_engine.toning import tone_views
from advtex_engine.views import ViewMaps, build_view_maps, foregrounds

BORDERS = 1.25  # texels that views touch, of those that the charts cover
OF_MESH, OF_ATLAS = ("t_pos_idx", "v_uv", "t_uv_idx"), ("width", "height", "source", "charts", "pages")
"""What the cache of an atlas holds: the mesh's positions are the scene's."""
NO_RESULT = ("device", "checkpoint_seconds", "memory_bytes")  # options that the result does not depend on


@dataclass(frozen=True)
class RunResult:
    """What a run leaves: the files below its output folder and the report that is also in report.json."""

    files: tuple[Path, ...]
    report: dict[str, Any]


def texture_scan(
    scan: Path, out: Path, config: TextureConfig, *, work: Path, resume: bool = False, monitor: Monitor | None = None
) -> RunResult:
    """Textures a scan: model.obj, model.mtl, model.png, model.glb, report.json, previews/ and index.html below `out`.

    work: folder for stage caches and checkpoints. With `resume`, what it holds of the same scan and options is used;
    without, it is cleared. Where memory runs out, the run begins again from its caches with less to hold
    (`limits.py`). Raises ScanError, OptionError, WeightsError for a method without its weights, MemoryShortage once
    nothing is left to be made smaller, and Stopped once the monitor asks for a stop.
    """
    device = choose_device(config.device)
    require(config.method)
    keeper = WarningKeeper(monitor or Monitor())
    folder = WorkFolder(work, fingerprint(scan, config), keeper)
    if not resume:
        folder.clear()
    out.mkdir(parents=True, exist_ok=True)
    budget = Budget(device, config, folder, keeper)
    while True:
        try:
            return _run(scan, out, budget)
        except Exception as error:
            problem = memory_problem(error)
            if problem is None:
                raise
        # Not in the handler: the error's traceback holds what the run had in memory.
        budget.shrink(keeper.stage, problem)


def _run(scan: Path, out: Path, budget: Budget) -> RunResult:
    """The stages within the limits that the budget has now."""
    config, device, folder, monitor = budget.config, budget.device, budget.folder, budget.monitor
    stages = Stages(monitor, folder, device)
    with ChartMaker(charts_folder()) as charts:
        scene, made = _load_scene(scan, config, folder, stages, budget.early_device, charts)
        scene, refinement = _refine(scene, config, folder, stages, budget.early_device)
        atlas, work = _fitting_atlas(scene, budget, stages, charts)
    folder = budget.texture_folder()
    atlas = replace(atlas, mesh=_mesh_to(atlas.mesh, device))
    on_host = budget.limits.on_device is not None
    maps = _view_maps(scene, atlas, work.preset, folder, stages, device, on_host=on_host)
    work = replace(work, slots=maps[1].slots)
    budget.fit(work, "view_maps", held_bytes(maps.values(), device), known=True)
    if budget.limits.on_device is not None and not on_host:
        maps = {scale: keep_off(level, device, folder.path) for scale, level in maps.items()}
    preset = budget.preset(work.preset)
    with stages.run("initial_texture"):
        means = {scale: mean_texture(level) for scale, level in maps.items()}
        live = Live(scene, atlas, monitor)
        given = MethodInput(scene, atlas, maps, means, preset, config, monitor, folder, live)
        given = replace(given, on_device=budget.limits.on_device)
        if config.method.startswith("adversarial"):
            if preset.start == "selection":
                given = replace(given, start=_selected_start(given))
            if preset.toned:
                for level in maps.values():
                    tone_views(level, starting_texture(given))
    stages.save()
    held = held_bytes(maps.values(), device) + sum(mean.nbytes for mean in means.values())
    held += 0 if given.start is None else given.start.nbytes
    budget.begin()
    with stages.run("optimization"):
        texture, losses = METHODS[config.method](given)
        budget.folder.earlier_seconds = folder.earlier_seconds
    if not bool(texture.isfinite().all()):
        raise Diverged(f"the texture of the method {config.method} is not finite everywhere; choose another method")
    memory = budget.report(work, stages.records[-1], held)
    with stages.run("dilation"):
        texture = fill_holes(texture, maps[1].slot_map >= 0)
    with stages.run("export"):
        files = export_model(out, atlas, texture, up_axis=scene.up_axis)
    with stages.run("previews"):
        files += write_gallery(out, scene, atlas, texture, means[1], curves(losses, live.quality))
        atlas = replace(atlas, mesh=_mesh_to(atlas.mesh, torch.device("cpu")))
        scores = heldout_scores(scene, atlas, texture.cpu(), means[1].cpu())
    parts = {
        "scan": describe_scene(scene),
        **made,
        "refinement": refinement and refinement | given.facts.get("refinement", {}),
        "atlas": {key: getattr(atlas, key) for key in ("width", "height", "source", "charts", "pages")},
        "touched_texels": maps[1].slots,
        "speckled_texels": speckle_share(texture, maps[1].slot_map >= 0),
        "stages": stages.records,
        "saving_seconds": round(folder.seconds + (0 if folder is budget.folder else budget.folder.seconds), 3),
        "step": given.facts.get("step"),
        "memory": memory,
        "losses": losses,
        "heldout": scores,
    }
    report = _report(monitor, config, preset, device, parts)
    files += (write_report(out, report),)
    return RunResult((*files, write_page(out, report, files)), report)


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
    pretraining, averaging = int(preset.pretraining * share), int(preset.averaging * share)
    return replace(preset, levels=tuple(levels), pretraining=pretraining, averaging=averaging)


def fingerprint(scan: Path, config: TextureConfig) -> str:
    """Identifies a run: the state of the scan's files, and every option and number that changes the result.

    A zip keeps its fingerprint wherever it is copied; a folder keeps it where copies keep the files' times.
    Raises ScanError for what cannot be opened.
    """
    with opened(scan) as archive:
        files = archive.stamps()
    options = {key: value for key, value in asdict(config).items() if key not in NO_RESULT}
    presets = {name: asdict(preset) for name, preset in PRESETS.items()}
    content = {"format": FORMAT, "files": files, "options": options, "presets": presets}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _load_scene(
    scan: Path, config: TextureConfig, folder: WorkFolder, stages: Stages, device: torch.device, charts: ChartMaker
) -> tuple[Scene, dict[str, Any]]:
    """The scene, mesh and views within their budgets, and the report's parts about how it was made."""
    saved = folder.load("scene", (*Scene.__dataclass_fields__, "made"))
    if saved is not None:
        stages.restore("ingest", "conventions", "fusion", "geometry")
        return scene_from_dict(saved), saved["made"]
    with FrameStore(folder.path) as store:
        scene, made = _make_scene(scan, config, store, stages, device, charts)
    folder.save("scene", {**scene_to_dict(scene), "made": made})
    stages.save()
    return scene, made


def _make_scene(
    scan: Path, config: TextureConfig, store: FrameStore, stages: Stages, device: torch.device, charts: ChartMaker
) -> tuple[Scene, dict[str, Any]]:
    monitor = stages.monitor
    made: dict[str, Any] = {"conventions": None, "fusion": None, "registration": None}
    with MeshPreparation(config.face_budget, charts) as preparation:
        with stages.run("ingest"):
            capture = read_capture(
                scan, config, store, monitor, lambda mesh, moves: preparation.begin(mesh, moves=moves != "none")
            )
        with stages.run("conventions"):
            made["conventions"] = judge(scan, capture.manifest, capture.mesh, monitor)
        if capture.mesh is None:
            with stages.run("fusion"):
                fused, made["fusion"] = fuse(capture.measured(), device, monitor)
            preparation.begin(fused)
        with stages.run("geometry"):
            mesh = preparation.result(monitor)
            capture, made["view_choice"] = capture.choose(mesh, config.max_views, monitor)
            scene = capture.scene(mesh, monitor)
            if capture.mesh_refinement != "none" and (frames := capture.measured(MAX_FRAMES)):
                with_scale = capture.mesh_refinement == "scaled"
                mesh, made["registration"] = register_mesh(scene.mesh, frames, with_scale=with_scale)
                scene = replace(scene, mesh=mesh)
            begin_charts(scene.mesh, charts)
    return scene, made


def _refine(
    scene: Scene, config: TextureConfig, folder: WorkFolder, stages: Stages, device: torch.device
) -> tuple[Scene, dict[str, Any] | None]:
    """The scene with refined cameras and exposures, and the report's part about them; None when it was not asked for.

    What was found is small and cached by itself: the scene as it came stays in its own cache.
    """
    if not config.refines:
        return scene, None
    saved = folder.load("refinement", Refinement.__dataclass_fields__)
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


def _fitting_atlas(scene: Scene, budget: Budget, stages: Stages, charts: ChartMaker) -> tuple[Atlas, Workload]:
    """The atlas of the largest texture that fits into memory, and what is to be done with it.

    How many texels the views will touch is guessed: what the charts cover, and a margin for their borders.
    """
    monitor, device = budget.monitor, budget.device
    preset = resolve_preset(budget.config, device)
    while True:
        try:
            atlas = _load_atlas(scene, budget.texture_config(), budget.texture_folder(), stages, monitor, charts)
        except OptionError as error:
            if budget.limits.texture is None:
                raise
            raise MemoryShortage(f"a texture that fits into memory does not hold the charts: {error}") from error
        camera, size = scene.views[0].camera, (atlas.width, atlas.height)
        slots = min(1.0, BORDERS * uv_area(atlas.mesh)) * atlas.width * atlas.height
        work = Workload(
            len(scene.views),
            camera.width,
            camera.height,
            size,
            int(slots),
            budget.config.method,
            preset,
            device.type,
            native_bfloat16(device),
        )
        if not budget.fit(work, "atlas"):
            return atlas, work


def _load_atlas(
    scene: Scene, config: TextureConfig, folder: WorkFolder, stages: Stages, monitor: Monitor, charts: ChartMaker
) -> Atlas:
    saved = folder.load("atlas", (*OF_MESH, *OF_ATLAS))
    if saved is not None:
        stages.restore("atlas")
        mesh = Mesh(scene.mesh.v_pos, *(saved[name] for name in OF_MESH))
        return Atlas(mesh, **{name: saved[name] for name in OF_ATLAS})
    with stages.run("atlas"):
        atlas = build_atlas(scene.mesh, [view.camera for view in scene.views], config, monitor, charts)
    saved = {name: getattr(atlas.mesh, name) for name in OF_MESH}
    folder.save("atlas", saved | {name: getattr(atlas, name) for name in OF_ATLAS})
    stages.save()
    return atlas


def _view_maps(
    scene: Scene,
    atlas: Atlas,
    preset: Preset,
    folder: WorkFolder,
    stages: Stages,
    device: torch.device,
    *,
    on_host: bool,
) -> dict[int, ViewMaps]:
    """View maps for every scale of the preset, and for the full size, which mean textures and export need.

    on_host: their pixels are kept off the device.
    """
    maps: dict[int, ViewMaps] = {}
    allocate = host_allocator(device, folder.path) if on_host else None
    with stages.run("view_maps"):
        for scale in sorted({1, *(level.scale for level in preset.levels)}):
            saved = folder.load(f"view_maps_{scale}", ViewMaps.__dataclass_fields__, mapped=on_host)
            if saved is not None:
                level = ViewMaps(**{key: saved[key] for key in ViewMaps.__dataclass_fields__})
                # A copy on the host as well: what is written into a mapped cache would stay in memory.
                maps[scale] = keep_off(level, device, folder.path) if on_host else level.to(device)
                continue
            small = replace(atlas, width=atlas.width // scale, height=atlas.height // scale)
            maps[scale] = build_view_maps(
                small, tuple(shrink(view, scale) for view in scene.views), scene.kind, allocate
            )
            folder.save(f"view_maps_{scale}", vars(maps[scale]))
        _check_foregrounds(scene, maps[1], stages.monitor)
    stages.save()
    return maps


def _check_foregrounds(scene: Scene, maps: ViewMaps, monitor: Monitor) -> None:
    """Tells the monitor of views that show nothing, which no method draws from; ScanError where all are like that."""
    shows = foregrounds(maps).tolist()
    blind = [view.name for view, seen in zip(scene.views, shows, strict=True) if not seen]
    if not blind:
        return
    share = "all" if len(blind) == len(shows) else f"{len(blind)} of {len(shows)}"
    told = f"{share} frames show nothing of the mesh where they may be used"
    problem = Problem("no_foreground", few_of(blind), told, "check the masks, the poses and the mesh")
    if share == "all":
        raise ScanError(problem)
    monitor.warning(problem)


def _selected_start(given: MethodInput) -> Tensor:
    """The texture by view selection; from the work folder when it is there."""
    saved = given.work.load("initial_texture", ("texture",))
    if saved is not None:
        texture: Tensor = saved["texture"].to(given.means[1])
        return texture
    texture = select_views(given).texture
    given.work.save("initial_texture", {"texture": texture})
    return texture


def shrink(view: View, scale: int) -> View:
    """The view at 1/scale of its size: color averaged over blocks, depth taken from one pixel of each block.

    A mask lets a block be used if it does all of its pixels.
    """
    if scale == 1:
        return view
    width, height = view.camera.width // scale, view.camera.height // scale
    color = view.color[: height * scale, : width * scale].permute(2, 0, 1)[None].to(torch.float32)
    color = F.avg_pool2d(color, scale)[0].permute(1, 2, 0).round().to(torch.uint8)
    depth = None
    if view.depth is not None:
        depth = view.depth[scale // 2 : height * scale : scale, scale // 2 : width * scale : scale].contiguous()
    mask = None
    if view.mask is not None:
        mask = view.mask[: height * scale, : width * scale].reshape(height, scale, width, scale).all(3).all(1)
    return View(view.name, scaled_camera(view.camera, width, height), color, depth, mask)


def uv_area(mesh: Mesh) -> float:
    """Share of the texture that the faces cover, each counted for itself."""
    assert mesh.v_uv is not None and mesh.t_uv_idx is not None
    corners = mesh.v_uv[mesh.t_uv_idx].double()
    one, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return float((one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]).abs().sum() / 2)


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

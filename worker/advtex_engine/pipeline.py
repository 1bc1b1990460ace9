"""The stages, in reading order: from a scan's files to a textured model.

ingest -> conventions -> fusion (of scans without a mesh) -> geometry -> refinement -> atlas -> view maps
-> initial texture -> optimization -> dilation -> export -> previews
"""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from advtex_engine.atlas import ChartMaker, MeshPreparation, begin_charts, charts_folder
from advtex_engine.budget import Budget
from advtex_engine.conventions import checked_conventions, coarse_mesh
from advtex_engine.core import Diverged, Monitor, TextureConfig, WarningKeeper
from advtex_engine.core.scene import DepthFrame, Mesh
from advtex_engine.ingest import Capture, FrameStore, read_capture
from advtex_engine.mesh import LOOKS, MAX_FRAMES, fuse, register_mesh
from advtex_engine.methods import require, texture_function
from advtex_engine.metrics.speckle import speckle_share
from advtex_engine.previews.curves import curves
from advtex_engine.results import (
    assembled,
    describe_scene,
    export_model,
    heldout_scores,
    require_draco,
    write_compressed,
    write_gallery,
    write_page,
    write_report,
    write_seen,
    write_smaller,
    write_tiles,
)
from advtex_engine.runtime import Stages, WorkFolder, choose_device, threads_fitted
from advtex_engine.stages import (
    MadeScene,
    baked_normals,
    cached_scene,
    completed_model,
    fingerprint,
    fitting_atlas,
    fitting_view_maps,
    keep_detail,
    method_input,
    refined_scene,
)
from advtex_options.box import parse_box
from advtex_options.outputs import wanted
from advtex_scan.manifest import MeshRefinement, UpAxis


@dataclass(frozen=True)
class RunResult:
    """What a run leaves: the files below its output folder and the report that is also in report.json."""

    files: tuple[Path, ...]
    report: dict[str, Any]


def texture_scan(
    scan: Path, out: Path, config: TextureConfig, *, work: Path, resume: bool = False, monitor: Monitor | None = None
) -> RunResult:
    """Textures a scan: the model (`export_model`), report.json, previews/ and index.html below `out`.

    work: folder for stage caches and checkpoints. With `resume`, what it holds of the same scan and options is used;
    without, it is cleared. Where memory runs out, the run begins again from its caches with less to hold
    (`budget/limits.py`). Raises ScanError, OptionError, WeightsError for a method without its weights, MemoryShortage
    once nothing is left to be made smaller, and Stopped once the monitor asks for a stop.
    """
    device = choose_device(config.device)
    require(config.method)
    if "draco" in wanted(config.outputs):
        require_draco()
    keeper = WarningKeeper(monitor or Monitor())
    folder = WorkFolder(work, fingerprint(scan, config), keeper)
    if not resume:
        folder.clear()
    out.mkdir(parents=True, exist_ok=True)
    budget = Budget(device, config, folder, keeper)
    with threads_fitted():
        return budget.run(lambda: _run(scan, out, budget))


def _run(scan: Path, out: Path, budget: Budget) -> RunResult:
    """All stages, within what memory the budget has."""
    config, early_device = budget.config, budget.early_device
    stages = Stages(budget.monitor, budget.folder, budget.device)
    refinement: dict[str, Any] | None = None
    with ChartMaker(charts_folder()) as charts:
        scene, made = cached_scene(stages, lambda store: _scene(scan, config, store, stages, early_device, charts))
        if config.refines:
            scene, refinement = refined_scene(scene, stages, early_device, config.seed)
        atlas, work = fitting_atlas(scene, budget, stages, charts)
    maps, work = fitting_view_maps(scene, atlas, work, budget, stages)
    given = method_input(scene, atlas, maps, work, budget, stages)
    with stages.run("optimization"):
        texture, losses = texture_function(config.method)(given)
        budget.folder.earlier_seconds = given.work.earlier_seconds
    if not bool(texture.isfinite().all()):
        raise Diverged(f"the texture of the method {config.method} is not finite everywhere; choose another method")
    memory, game = budget.report(work, stages.records[-1]), given.facts.get("game")
    touched, mean = maps[1].slot_map >= 0, given.means[1]
    with stages.run("dilation"):
        seen = touched & given.facts.get("known", touched)
        whole = atlas
        atlas, completed = completed_model(atlas, texture, seen, made["mesh"]["made_up_faces"], config)
    texture = completed.texture
    # Export is of one thread for the most part, as is scoring of one view.
    on_cpu = replace(atlas, mesh=atlas.mesh.to(torch.device("cpu")))
    with ThreadPoolExecutor(1, thread_name_prefix="advtex-scores") as beside:
        scored = beside.submit(heldout_scores, scene, on_cpu, texture.cpu(), mean.cpu())
        with stages.run("export"):
            outputs = wanted(config.outputs, large=atlas.pages > 1)
            normals = baked_normals(whole, made["normal_map"], budget.folder)
            files = export_model(
                out,
                atlas,
                texture,
                up_axis=scene.up_axis,
                lossless=config.lossless,
                usdz="usdz" in outputs,
                normal_map=normals,
            )
            files += write_seen(out, atlas, completed.state)
            files += write_smaller(
                out, atlas, texture, outputs, up_axis=scene.up_axis, normal_map=normals, monitor=stages.monitor
            )
            files += write_compressed(out, atlas, texture, outputs, lossless=bool(config.lossless))
            if "tiles" in outputs:
                files += (write_tiles(out, atlas, texture, up_axis=scene.up_axis, monitor=stages.monitor),)
        with stages.run("previews"):
            told = curves(losses, given.live.quality, game["curve"] if game else ())
            files += write_gallery(out, scene, atlas, texture, mean, told, completed.state)
            scores = scored.result()
    parts = {
        "scan": describe_scene(scene),
        **made,
        "refinement": refinement and refinement | given.facts.get("refinement", {}),
        "atlas": {key: getattr(atlas, key) for key in ("width", "height", "source", "charts", "pages")},
        "touched_texels": maps[1].slots,
        "surface": completed.shares,
        "speckled_texels": speckle_share(texture, touched),
        "stages": stages.records,
        "saving_seconds": round(sum(folder.seconds for folder in {budget.folder, given.work}), 3),
        "step": given.facts.get("step"),
        "memory": memory,
        "losses": losses,
        "game": game,
        "heldout": scores,
    }
    report = assembled(config, given.preset, budget.device, budget.monitor.warnings, parts)
    files += (write_report(out, report),)
    return RunResult((*files, *write_page(out, report, files)), report)


def _scene(
    scan: Path, config: TextureConfig, store: FrameStore, stages: Stages, device: torch.device, charts: ChartMaker
) -> MadeScene:
    """The scene, mesh and views within their budgets, and the report's parts about how it was made."""
    monitor = stages.monitor
    made: dict[str, Any] = {"conventions": None, "fusion": None, "registration": None}
    box = None if config.box is None else parse_box(config.box)
    with (
        MeshPreparation(config.face_budget, charts, box=box, holes=config.close_holes) as preparation,
        ThreadPoolExecutor(1, thread_name_prefix="advtex-coarse") as beside,
    ):
        coarse: Future[Mesh] | None = None

        def begin(mesh: Mesh, moves: MeshRefinement, up_axis: UpAxis) -> None:
            nonlocal coarse
            preparation.begin(mesh, up_axis=up_axis, moves=moves != "none")
            if moves == "none":
                coarse = beside.submit(coarse_mesh, mesh)

        with stages.run("ingest"):
            capture = read_capture(scan, config, store, monitor, begin)
            if capture.mesh is not None:
                preparation.look(_looks(capture, capture.mesh, config))
        with stages.run("conventions"):
            looked_at = capture.mesh if coarse is None else coarse.result()
            made["conventions"] = checked_conventions(scan, capture.manifest, looked_at, monitor)
        if capture.mesh is None:
            with stages.run("fusion"):
                fused, made["fusion"] = fuse(capture.measured(), device, monitor)
            preparation.begin(fused, up_axis=capture.up_axis)
            preparation.look(_looks(capture, fused, config))
        with stages.run("geometry"):
            frames = [] if capture.mesh_refinement == "none" else capture.measured(MAX_FRAMES)

            def onto_depth(mesh: Mesh) -> Mesh:
                with_scale = capture.mesh_refinement == "scaled"
                mesh, made["registration"] = register_mesh(mesh, frames, with_scale=with_scale)
                return mesh

            mesh, made["mesh"] = preparation.result(monitor, onto_depth if frames else None)
            capture, made["view_choice"] = capture.choose(mesh, config.max_views, monitor)
            scene = capture.scene(mesh, monitor)
            begin_charts(scene.mesh, charts)
            made["normal_map"] = keep_detail(preparation, stages.folder)
    return scene, made


def _looks(capture: Capture, mesh: Mesh, config: TextureConfig) -> list[DepthFrame]:
    """Depth for what decimation does to the borders of the mesh; none where it is within the budget."""
    return capture.measured(LOOKS) if len(mesh.t_pos_idx) > config.face_budget else []

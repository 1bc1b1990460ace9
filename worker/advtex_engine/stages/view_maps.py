"""Where every view sees the texture, at each size that the preset works at, from the work folder or rasterized."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from advtex_engine.budget.limits import Budget
from advtex_engine.budget.workload import Workload
from advtex_engine.core.errors import Problem, ScanError, few_of
from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import Atlas, Scene
from advtex_engine.ingest.shrink import shrink
from advtex_engine.render.streaming import host_allocator, keep_off
from advtex_engine.render.view_maps import ViewMaps, build_view_maps, foregrounds, held_bytes
from advtex_engine.runtime.stage_records import Stages


def fitting_view_maps(
    scene: Scene, atlas: Atlas, work: Workload, budget: Budget, stages: Stages
) -> tuple[Mapping[int, ViewMaps], Workload]:
    """View maps per scale of the preset, the full size (1) always among them, and the work with its texels counted.

    They are on the run's device as far as memory allows, else on the host.
    """
    on_host = budget.limits.on_device is not None
    maps = _cached_view_maps(scene, atlas, work, budget, stages, on_host=on_host)
    work = replace(work, slots=maps[1].slots)
    budget.fit(work, "view_maps", held_bytes(maps.values(), budget.device), known=True)
    if budget.limits.on_device is not None and not on_host:
        folder = budget.texture_folder()
        maps = {scale: keep_off(level, budget.device, folder.path) for scale, level in maps.items()}
    return maps, work


def _cached_view_maps(
    scene: Scene, atlas: Atlas, work: Workload, budget: Budget, stages: Stages, *, on_host: bool
) -> dict[int, ViewMaps]:
    """`on_host`: their pixels are kept off the device."""
    device, folder = budget.device, budget.texture_folder()
    maps: dict[int, ViewMaps] = {}
    allocate = host_allocator(device, folder.path) if on_host else None
    with stages.run("view_maps"):
        for scale in work.scales:
            saved = folder.load(f"view_maps_{scale}", ViewMaps.__dataclass_fields__, mapped=on_host)
            if saved is not None:
                level = ViewMaps(**{key: saved[key] for key in ViewMaps.__dataclass_fields__})
                # A copy on the host as well: what is written into a mapped cache would stay in memory.
                maps[scale] = keep_off(level, device, folder.path) if on_host else level.to(device)
                continue
            small = replace(atlas, width=atlas.width // scale, height=atlas.height // scale)
            views = tuple(shrink(view, scale) for view in scene.views)
            maps[scale] = build_view_maps(small, views, scene.kind, allocate)
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

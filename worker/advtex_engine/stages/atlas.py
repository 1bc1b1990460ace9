"""The atlas of the largest texture that fits into memory, from the work folder or made of the mesh."""

from __future__ import annotations

from dataclasses import replace

from advtex_engine.adversarial.optimizer import native_bfloat16
from advtex_engine.atlas.build import build_atlas, covered_share, for_photographs
from advtex_engine.atlas.chart_cache import ChartMaker
from advtex_engine.budget.limits import Budget
from advtex_engine.budget.workload import Workload
from advtex_engine.core.config import TextureConfig, resolve_preset
from advtex_engine.core.errors import MemoryShortage, OptionError
from advtex_engine.core.scene import Atlas, Mesh, Scene
from advtex_engine.runtime.checkpoint import WorkFolder
from advtex_engine.runtime.stage_records import Stages

BORDERS = 1.25  # texels that views touch, of those that the charts cover
OF_MESH, OF_ATLAS = ("t_pos_idx", "v_uv", "t_uv_idx"), ("width", "height", "source", "charts", "pages")
"""What the cache of an atlas holds: the mesh's positions are the scene's."""


def fitting_atlas(scene: Scene, budget: Budget, stages: Stages, charts: ChartMaker) -> tuple[Atlas, Workload]:
    """The atlas, its mesh on the run's device, and what is to be done with it.

    How many texels the views will touch is guessed: what the charts cover, and a margin for their borders. Raises
    MemoryShortage when no texture fits that holds the charts.
    """
    device = budget.device
    preset = resolve_preset(budget.config)
    while True:
        try:
            atlas = _cached_atlas(scene, budget.texture_config(), budget.texture_folder(), stages, charts)
        except OptionError as error:
            if budget.limits.texture is None:
                raise
            raise MemoryShortage(f"a texture that fits into memory does not hold the charts: {error}") from error
        camera, size = scene.views[0].camera, (atlas.width, atlas.height)
        slots = min(1.0, BORDERS * covered_share(atlas.mesh)) * atlas.width * atlas.height
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
            return replace(atlas, mesh=atlas.mesh.to(device)), work


def _cached_atlas(scene: Scene, config: TextureConfig, folder: WorkFolder, stages: Stages, charts: ChartMaker) -> Atlas:
    saved = folder.load("atlas", (*OF_MESH, *OF_ATLAS))
    if saved is not None:
        stages.restore("atlas")
        mesh = Mesh(scene.mesh.v_pos, *(saved[name] for name in OF_MESH))
        return Atlas(mesh, **{name: saved[name] for name in OF_ATLAS})
    with stages.run("atlas"):
        config = for_photographs(config, scene.views)
        atlas = build_atlas(scene.mesh, [view.camera for view in scene.views], config, stages.monitor, charts)
    saved = {name: getattr(atlas.mesh, name) for name in OF_MESH}
    folder.save("atlas", saved | {name: getattr(atlas, name) for name in OF_ATLAS})
    stages.save()
    return atlas

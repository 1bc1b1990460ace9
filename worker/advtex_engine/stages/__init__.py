"""The stages around the method, each from the work folder where an earlier attempt has done it."""

from advtex_engine.stages.atlas import fitting_atlas
from advtex_engine.stages.completion import completed_model
from advtex_engine.stages.identity import fingerprint
from advtex_engine.stages.initial_texture import method_input
from advtex_engine.stages.normal_map import baked_normals, keep_detail
from advtex_engine.stages.refinement import refined_scene
from advtex_engine.stages.scene import MadeScene, cached_scene
from advtex_engine.stages.view_maps import fitting_view_maps

__all__ = [
    "MadeScene",
    "baked_normals",
    "cached_scene",
    "completed_model",
    "fingerprint",
    "fitting_atlas",
    "fitting_view_maps",
    "keep_detail",
    "method_input",
    "refined_scene",
]

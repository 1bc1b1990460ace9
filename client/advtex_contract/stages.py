"""The stages of a run, as people read them. Their names are the engine's (`advtex_engine`'s `STAGES`), in its order."""

from __future__ import annotations

from collections.abc import Mapping

STAGE_LABELS: Mapping[str, str] = {
    "ingest": "Reading the scan",
    "conventions": "Measuring conventions",
    "fusion": "Fusing depth into a mesh",
    "geometry": "Cleaning the mesh",
    "refinement": "Refining cameras and geometry",
    "atlas": "Laying out the texture",
    "view_maps": "Mapping views to texels",
    "initial_texture": "First texture",
    "optimization": "Optimizing the texture",
    "dilation": "Filling borders",
    "export": "Writing the model",
    "previews": "Drawing previews",
}

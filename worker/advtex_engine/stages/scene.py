"""The scene, mesh and views within their budgets, from the work folder or made of the scan."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any

from advtex_engine.core.scene import Camera, Mesh, Scene, View
from advtex_engine.ingest.frames import FrameStore
from advtex_engine.runtime.stage_records import Stages
from advtex_engine.stages.normal_map import has_detail

MadeScene = tuple[Scene, dict[str, Any]]
"""A scene, and the report's parts about how it was made."""


def cached_scene(stages: Stages, make: Callable[[FrameStore], MadeScene]) -> MadeScene:
    """What `make` gives, which runs the stages up to the geometry; or what it gave an earlier attempt."""
    folder = stages.folder
    saved = folder.load("scene", (*Scene.__dataclass_fields__, "made"))
    if saved is not None and has_detail(saved["made"]["normal_map"], folder):
        stages.restore("ingest", "conventions", "fusion", "geometry")
        return scene_from_dict(saved), saved["made"]
    with FrameStore(folder.path) as store:
        scene, made = make(store)
    folder.save("scene", {**scene_to_dict(scene), "made": made})
    stages.save()
    return scene, made


def scene_to_dict(scene: Scene) -> dict[str, Any]:
    """The scene as tensors and plain values; `scene_from_dict` is its inverse."""
    return {
        "mesh": {key: value for key, value in vars(scene.mesh).items() if value is not None},
        "views": [_view_to_dict(view) for view in scene.views],
        "heldout": [_view_to_dict(view) for view in scene.heldout],
        "kind": scene.kind,
        "up_axis": scene.up_axis,
        "notes": list(scene.notes),
    }


def scene_from_dict(saved: Mapping[str, Any]) -> Scene:
    """Inverse of `scene_to_dict`."""
    return Scene(
        Mesh(**saved["mesh"]),
        tuple(_view_from_dict(view) for view in saved["views"]),
        tuple(_view_from_dict(view) for view in saved["heldout"]),
        saved["kind"],
        saved["up_axis"],
        tuple(saved["notes"]),
    )


def _view_to_dict(view: View) -> dict[str, Any]:
    camera = asdict(view.camera)
    return {"name": view.name, "camera": camera, "color": view.color, "depth": view.depth, "mask": view.mask}


def _view_from_dict(saved: Mapping[str, Any]) -> View:
    return View(saved["name"], Camera(**saved["camera"]), saved["color"], saved["depth"], saved["mask"])

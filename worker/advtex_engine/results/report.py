"""What a run says about itself: what was used, scores of held-out views, report.json."""

from __future__ import annotations

import importlib.metadata
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from advtex_engine.core.config import Preset, TextureConfig
from advtex_engine.core.scene import Atlas, Scene
from advtex_engine.metrics.evaluate import configured_lpips, score_views
from advtex_engine.runtime.files import json_text, write_atomically
from advtex_engine.runtime.threads import thread_limit


def versions() -> dict[str, str]:
    """Versions of what decides the result."""
    names = ("advtex", "torch", "numpy", "opencv-python-headless", "xatlas", "fast-simplification")
    found = {"python": platform.python_version()}
    for name in names:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


def describe_scene(scene: Scene) -> dict[str, Any]:
    """Counts and names of what was used."""
    camera = scene.views[0].camera
    return {
        "views": len(scene.views),
        "heldout": [view.name for view in scene.heldout],
        "width": camera.width,
        "height": camera.height,
        "depth": scene.views[0].depth is not None,
        "faces": scene.mesh.t_pos_idx.shape[0],
        "vertices": scene.mesh.v_pos.shape[0],
        "kind": scene.kind,
        "up_axis": scene.up_axis,
        "notes": list(scene.notes),
    }


def heldout_scores(scene: Scene, atlas: Atlas, texture: Tensor, mean: Tensor) -> dict[str, Any] | None:
    """Scores of the held-out views for the texture and for the projected mean; None when no view was held out.

    Those of `evaluate.score_views`; `missing` says why a metric has none.
    """
    if not scene.heldout:
        return None
    lpips, missing = configured_lpips()
    scores = score_views(atlas, {"texture": texture, "mean": mean}, scene.heldout, lpips)
    return {name: found | {"missing": missing} for name, found in scores.items()}


def write_report(out: Path, report: Mapping[str, Any]) -> Path:
    path = out / "report.json"
    write_atomically(path, json_text(report, indent=1).encode() + b"\n")
    return path


def assembled(
    config: TextureConfig,
    preset: Preset,
    device: torch.device,
    warnings: Sequence[Mapping[str, str]],
    parts: Mapping[str, Any],
) -> dict[str, Any]:
    """The whole report: what went in, and `parts`: what was done with it and what it cost."""
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"
    return {
        "versions": versions(),
        "device": f"{device.type} ({name}, {thread_limit()} threads)",
        "options": asdict(config),
        "preset": asdict(preset),
        "warnings": warnings,
        **parts,
    }

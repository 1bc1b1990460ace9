"""What every texturing method is given."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

from advtex_engine.checkpoint import WorkFolder
from advtex_engine.config import Preset, TextureConfig
from advtex_engine.live import Live
from advtex_engine.monitor import Monitor
from advtex_engine.scene import Atlas, Scene
from advtex_engine.views import ViewMaps

LossPoint = dict[str, Any]


@dataclass(frozen=True)
class MethodInput:
    """The scene, its atlas, view maps and mean textures per pyramid scale (1 = full working size), and how to run.

    atlas.mesh is on the device that the run uses; scene's views stay on the CPU.
    means: dense textures [H,W,3] float32 in [0,1], defined on every texel.
    live: shows the texture while it is optimized.
    start: dense texture [H,W,3] that the adversarial methods start from; None: preset.start needs no more than `means`.
    on_device: views of full size that may be on the device at a time, while pairs are drawn; None: all are.
    facts: what the method says for the report about how it ran, by name: "step"; "refinement" adds to that part.
    """

    scene: Scene
    atlas: Atlas
    maps: Mapping[int, ViewMaps]
    means: Mapping[int, Tensor]
    preset: Preset
    config: TextureConfig
    monitor: Monitor
    work: WorkFolder
    live: Live
    start: Tensor | None = None
    on_device: int | None = None
    facts: dict[str, Any] = field(default_factory=dict)

"""What every texturing method is given."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

from advtex_engine.core.config import Preset, TextureConfig
from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import Atlas, Scene
from advtex_engine.previews.live import Live
from advtex_engine.render.view_maps import ViewMaps, held_bytes
from advtex_engine.runtime.checkpoint import WorkFolder

LossPoint = dict[str, Any]


@dataclass(frozen=True)
class MethodInput:
    """The scene, its atlas, view maps and mean textures per pyramid scale (1 = full working size), and how to run.

    atlas.mesh is on the device that the run uses; scene's views stay on the CPU.
    means: dense textures [H,W,3] float32 in [0,1], defined on every texel.
    live: shows the texture while it is optimized.
    start: dense texture [H,W,3] that the method starts from, whose tones the views may have; None: `means`, or black.
    painted: [H,W] int16, the view that each texel of `start` shows, -1 = none; None: not known.
    on_device: views of full size that may be on the device at a time, while pairs are drawn; None: all are.
    facts: what the method says about how it ran, by name: "step" and "game" for the report, whose "refinement" takes
    what is under that name; "known" is [H,W] bool, where the texture shows a photograph; all that views touch, if it
    does not say.
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
    painted: Tensor | None = None
    on_device: int | None = None
    facts: dict[str, Any] = field(default_factory=dict)

    @property
    def held_bytes(self) -> int:
        """Bytes of the tensors that the device holds for the method before it begins."""
        held = held_bytes(self.maps.values(), self.maps[1].device) + sum(mean.nbytes for mean in self.means.values())
        return held + sum(part.nbytes for part in (self.start, self.painted) if part is not None)

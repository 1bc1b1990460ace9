"""What an optimization needs of its device's memory.

Every part is counted from sizes and types: view maps, slot maps and dense textures as they are stored; per texel of the
compact texture its value, gradient, Adam's moments and what the preset keeps beside them; the discriminator; the
activations of the crop by layer; and what else a step holds per pixel of the crop. The last was read off torch's
allocator, as the bytes alive at the fullest moment of a step.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from advtex_engine.adversarial.optimizer import crop_size
from advtex_engine.adversarial.probes import CELL, CELLS
from advtex_engine.core.config import Preset
from advtex_engine.render.view_maps import BYTES_PER_PIXEL
from advtex_engine.runtime.available_memory import CONTEXT
from advtex_options.methods import known_methods

FLOAT = 4
TEXEL = 3 * FLOAT  # of a texture, three channels
SLOT = 4  # of a slot map
LABEL = 2  # of a texel's view
LAYERS = ((64, 2), (128, 2), (128, 2), (128, 1), (1, 1))  # channels and strides of the discriminator
PARAMETERS = 664_001
PROBES = CELLS * CELL**2 * 45  # photographs, footprints and masks of the views that are left out
PROBES_LPIPS = 10 << 20  # AlexNet's convolutions
SCHEDULED = 5 * FLOAT  # per step of the run, its row of the schedule
# On a GPU, from torch's allocator: cuBLAS keeps 32 MiB on Hopper and 8 on others (torch's defaults); what cuDNN and
# cuFFT ask for comes and goes. Not measured yet.
WORKSPACES = 64 << 20
# Per pixel of the crop. With features the fullest moment is at the beginning of the texture's gradient, while examples
# and footprints are still needed, without them in the discriminator's gradient.
HELD_WITH_FEATURES, HELD = 78, 5
SPREAD, SPREAD_PIXEL = 16, 6  # or it is where the texture's gradient is made: per texel, per pixel of the crop
CONVOLUTIONS = 360  # per pixel of the crop: what oneDNN keeps by itself, on a CPU
LIBRARIES = 192 << 20  # on a CPU: code, tables and threads of what steps and glimpses are the first to use
FILLING = 79  # per texel of a dense texture that is made from a compact one
SPLATTING = 240  # per pixel of a view that is averaged into the mean texture


@dataclass(frozen=True)
class Workload:
    """What decides the memory of an optimization.

    views: of width x height pixels, all of them. texture: width and height. slots: texels that views sample.
    device: "cpu" or "cuda". bfloat16: whether the networks' activations are.
    """

    views: int
    width: int
    height: int
    texture: tuple[int, int]
    slots: int
    method: str
    preset: Preset
    device: str = "cpu"
    bfloat16: bool = False

    @property
    def draws_pairs(self) -> bool:
        """Whether the method has a step that draws a pair of views, and can do with a part of them at a time."""
        return known_methods()[self.method].draws_pairs

    @property
    def plays(self) -> bool:
        """Whether there is a discriminator."""
        return known_methods()[self.method].plays_game

    @property
    def starts_selected(self) -> bool:
        """Whether the texture begins as that of view selection."""
        method = known_methods()[self.method]
        return self.preset.start == "selection" if method.plays_game else method.starts_selected

    @property
    def descends(self) -> bool:
        """Whether that texture is brought nearer to the photographs before the method begins."""
        return self.plays and self.starts_selected and self.preset.passes > 0

    @property
    def makes_detail(self) -> bool:
        """Whether the steps of such a descent follow upon view selection."""
        return self.descends or known_methods()[self.method].makes_detail

    @property
    def toned(self) -> bool:
        """Whether the views are given the tones of the texture that the method begins with."""
        method = known_methods()[self.method]
        return self.preset.toned if method.plays_game else method.starts_selected

    @property
    def crop(self) -> tuple[int, int]:
        """The crop (width, height) of a step at full size, in pixels."""
        return crop_size(self.width, self.height, self.preset.max_crop)

    @property
    def scales(self) -> tuple[int, ...]:
        """Those of which maps are kept."""
        return tuple(sorted({1, *(level.scale for level in self.preset.levels)}))


def estimate(work: Workload, on_device: int | None = None) -> dict[str, int]:
    """Bytes by part; their sum is the peak. on_device: views of full size that are there at a time, None for all."""
    texels = work.texture[0] * work.texture[1]
    shares = sum(1 / scale**2 for scale in work.scales)
    views = work.views * shares if on_device is None else on_device
    step = _step(work)
    filling = max(FILLING * texels, SPLATTING * work.width * work.height)
    parts = {
        "view_maps": int(views * work.width * work.height * BYTES_PER_PIXEL),
        "slot_maps": int(texels * SLOT * shares),
        "dense_textures": int(texels * TEXEL * (shares + work.starts_selected)),
        **step,
        "probes": _probes(work),
        # Before and after the steps: what a step needs is not there then, apart from the texture's own state.
        "filling": max(0, filling - step["activations"] - step["step"]),
    }
    if work.device == "cuda":
        parts["context"] = CONTEXT
        if work.plays:
            parts["workspaces"] = WORKSPACES
    elif work.plays:
        parts["convolutions"] = CONVOLUTIONS * work.crop[0] * work.crop[1]
        parts["libraries"] = LIBRARIES
    return parts


def fullest(work: Workload, on_device: int | None = None) -> dict[str, int]:
    """The estimate of the optimization, or of the passes before it where these need more."""
    estimates = [estimate(work, on_device)]
    if work.descends:
        pixels = math.prod(crop_size(work.width, work.height, work.preset.descent_crop))
        passes = estimate(replace(work, method="view_selection"), on_device)
        estimates.append(passes | {"step": known_methods()["view_selection"].memory.rest * pixels})
    return max(estimates, key=lambda parts: sum(parts.values()))


def tensor_bytes(parts: dict[str, int]) -> int:
    """The bytes of an estimate that torch's allocator counts."""
    return sum(size for name, size in parts.items() if name not in ("context", "convolutions", "libraries"))


def activations(width: int, height: int, size: int) -> list[int]:
    """Bytes that are kept of each of the discriminator's layers for its gradient, for one example, `size` per value.

    A convolution's output is kept, and what the leaky ReLU makes of it, apart from the last one's, which has none.
    """
    kept = []
    for number, (channels, stride) in enumerate(LAYERS):
        width, height = (width - 2) // stride + 1, (height - 2) // stride + 1
        kept.append(channels * width * height * size * (2 if number < len(LAYERS) - 1 else 1))
    return kept


def _probes(work: Workload) -> int:
    """What is kept between two looks: the best state, which view painted each texel, and what the next look needs."""
    if not (work.plays and work.preset.turn):
        return 0
    return TEXEL * work.slots + LABEL * math.prod(work.texture) + PROBES + PROBES_LPIPS


def _step(work: Workload) -> dict[str, int]:
    if not work.plays:
        memory = known_methods()[work.method].memory
        seen = (side if memory.crop is None else min(side, memory.crop) for side in (work.width, work.height))
        pixels = math.prod(seen)
        return {
            "compact_texture": memory.textures * TEXEL * work.slots,
            "activations": memory.network * pixels,
            "step": memory.rest * pixels,
        }
    preset, (width, height) = work.preset, work.crop
    # Value, gradient and two moments.
    beside = (preset.l1_target == "start") + bool(preset.averaging)
    size = 2 if work.bfloat16 else FLOAT
    pixels = width * height
    on_gpu = work.device == "cuda"
    # On a CPU both examples are float32, and are copied where the activations are not.
    shown = 2 * 8 * size * pixels if on_gpu else 2 * 6 * (FLOAT + size % FLOAT) * pixels
    features = bool(preset.feature_weight)
    differences = sum(activations(width, height, FLOAT)[:-1]) // 2 if features else 0
    held = (HELD_WITH_FEATURES if features else HELD) * pixels
    fullest = max(shown + held, SPREAD * work.slots + SPREAD_PIXEL * pixels)
    return {
        "compact_texture": (4 + beside) * TEXEL * work.slots,
        # Values, gradients, two moments; the gradients of either example, and what they are gradients of.
        "discriminator": (4 * FLOAT + (3 if work.bfloat16 else 2) * size) * PARAMETERS + SCHEDULED * preset.steps,
        "activations": 2 * sum(activations(width, height, size)),
        "step": differences + fullest,
    }

"""Times the optimization's step and its parts on a device, beside the operations that they need.

The scene is made here, so that only torch is needed: a textured square seen by views whose images are shifted.
"""

from __future__ import annotations

import json
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from advtex_engine.batches import Batch
from advtex_engine.config import PRESETS, Preset
from advtex_engine.discriminator import PatchDiscriminator
from advtex_engine.optimize import AdversarialOptimizer, Losses
from advtex_engine.planar import planar_views
from advtex_engine.views import Pairs, ViewMaps

VIEWS = 8
TEXELS_PER_PIXEL = 1.2
WARMUP, STEPS = 5, 30
LAYERS = ((6, 64, 2), (64, 128, 2), (128, 128, 2), (128, 128, 1), (128, 1, 1))


def discriminator_flops(width: int, height: int) -> list[int]:
    """Floating-point operations (2 per multiply-add) of each layer's forward pass on one image of width x height."""
    counts = []
    for inputs, outputs, stride in LAYERS:
        width, height = (width - 2) // stride + 1, (height - 2) // stride + 1
        counts.append(2 * 16 * inputs * outputs * width * height)
    return counts


def step_flops(width: int, height: int) -> int:
    """Of one step's convolutions.

    Two forward passes; for each a weight gradient, and an input gradient except in the first layer; and one input
    gradient through all layers for the texture.
    """
    layers = discriminator_flops(width, height)
    return 2 * sum(layers) + 2 * sum(layers) + 2 * sum(layers[1:]) + sum(layers)


class _Full(AdversarialOptimizer):
    """Never skips the discriminator's update: the whole cost of a step."""

    def play(self, batch: Batch) -> Losses:
        losses = super().play(batch)
        return replace(losses, ahead=torch.zeros_like(losses.ahead))


class _Timed(_Full):
    """Waits for the device after each part and adds up its seconds."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.seconds: dict[str, float] = defaultdict(float)

    def _time(self, name: str, part: Callable[..., Any], *args: Any) -> Any:
        started = time.perf_counter()
        result = part(*args)
        _wait(self.device)
        self.seconds[name] += time.perf_counter() - started
        return result

    def draw(self) -> Batch:
        return self._time("draw and reproject", super().draw)  # type: ignore[no-any-return]

    def play(self, batch: Batch) -> Losses:
        return self._time("render and forward", super().play, batch)  # type: ignore[no-any-return]

    def texture_gradient(self, losses: Losses) -> Tensor:
        return self._time("texture backward", super().texture_gradient, losses)  # type: ignore[no-any-return]

    def update_discriminator(self, losses: Losses) -> None:
        self._time("discriminator backward and update", super().update_discriminator, losses)

    def update_texture(self, gradient: Tensor) -> None:
        self._time("texture update", super().update_texture, gradient)


def bench(device_name: str, width: int, height: int, preset_name: str) -> dict[str, Any]:
    """Median milliseconds of a step over STEPS steps, then the share of each part in as many more.

    width, height: of the views, in pixels; a step, and so the FLOP count, is of the crop that the preset takes of
    them. Every step updates both players, so a real run, which skips some of the discriminator's updates, is faster.
    """
    from advtex_engine.pipeline import choose_device

    device = choose_device(device_name)
    maps, pairs = planar_views(VIEWS, width, height, TEXELS_PER_PIXEL, device)
    plain, timed = (_optimizer(kind, maps, pairs, PRESETS[preset_name], device) for kind in (_Full, _Timed))
    times = []
    for index in range(WARMUP + STEPS):
        started = time.perf_counter()
        plain.step()
        _wait(device)
        if index >= WARMUP:
            times.append(time.perf_counter() - started)
    assert isinstance(timed, _Timed)
    for index in range(WARMUP + STEPS):
        if index == WARMUP:
            timed.seconds.clear()
        timed.step()
    step_ms = sorted(times)[len(times) // 2] * 1e3
    flops = step_flops(*plain.crop)
    whole = sum(timed.seconds.values())
    return {
        "device": device.type if device.type == "cpu" else torch.cuda.get_device_name(device),
        "threads": torch.get_num_threads(),
        "precision": "bf16" if plain.bfloat16 else "fp32",
        "preset": preset_name,
        "width": width,
        "height": height,
        "crop": list(plain.crop),
        "texels": maps.slots,
        "step_ms": round(step_ms, 3),
        "step_ms_least": round(min(times) * 1e3, 3),
        "flops": flops,
        "gflops_per_second": round(flops / step_ms / 1e6, 1),
        "share": {name: round(seconds / whole, 3) for name, seconds in timed.seconds.items()},
    }


def print_table(result: dict[str, Any]) -> None:
    """The same for people; sizes are in pixels."""
    whole, crop = ("x".join(map(str, size)) for size in ((result["width"], result["height"]), result["crop"]))
    print(f"preset {result['preset']}, crops of {crop} from full frames of {whole}")
    for key, value in result.items():
        if key not in ("preset", "width", "height", "crop"):
            print(f"{key:32} {json.dumps(value)}")


def _optimizer(
    kind: type[AdversarialOptimizer], maps: ViewMaps, pairs: Pairs, preset: Preset, device: torch.device
) -> AdversarialOptimizer:
    """At the first step after the pretraining, in which the texture waits."""
    discriminator = PatchDiscriminator(torch.Generator().manual_seed(0)).to(device)
    generator = torch.Generator(device).manual_seed(0)
    start = torch.zeros((maps.slots, 3), device=device)
    optimizer = kind(
        maps, pairs, start, preset, kind="scene", steps=preset.steps, generator=generator, discriminator=discriminator
    )
    optimizer.index = preset.pretraining
    return optimizer


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)

"""Times a step of the optimization with its parts, and the stages around it, beside what the device could do at best.

    advtex-engine bench --json

The scene is made here (`bench_scene`), so that only torch and numpy are needed: on a bare GPU machine, the folders
`worker` and `client` on the PYTHONPATH are enough to call `bench`. The floor of a part is the time of its bytes at the
speed of a large copy and of its operations at that of a large matrix product, both measured on the device in the same
run. On a CPU, what fits into a core's cache may be faster than its floor.
"""

from __future__ import annotations

import os
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from advtex_engine.adversarial.cuda_graph import Stepper
from advtex_engine.adversarial.discriminator import PatchDiscriminator
from advtex_engine.adversarial.optimizer import AdversarialOptimizer, Losses
from advtex_engine.adversarial.pair_sampler import DrawnPair
from advtex_engine.bench.counts import Work, step_flops, step_parts
from advtex_engine.bench.limits import Limits, measure_limits
from advtex_engine.bench.options import FACES, VIEWS
from advtex_engine.bench.profile import profile_steps
from advtex_engine.bench.scene import made_scene
from advtex_engine.bench.stages import Stage, time_stages
from advtex_engine.core.config import PRESETS, Preset
from advtex_engine.render.pairs import Pairs
from advtex_engine.render.view_maps import ViewMaps
from advtex_engine.runtime.devices import choose_device, wait_for

WARMUP, STEPS = 5, 30
WARM_LAUNCHES, LAUNCHES = 2, 3  # of many steps each, where there are such; the fewest that are timed
PROFILED = 5  # at least so many steps
MANY = 1_000_000
SLEEP_CYCLES = 50_000_000  # 25 ms and more, in which the host queues all kernels of a step


class _Full(AdversarialOptimizer):
    """Never skips the discriminator's update: the whole cost of a step."""

    def play(self, pair: DrawnPair) -> Losses:
        losses = super().play(pair)
        return replace(losses, ahead=torch.zeros_like(losses.ahead))


class _Timed(_Full):
    """Adds up the seconds of each part.

    On a GPU a whole step is queued while the device sleeps, so that a part's seconds are those of its kernels, one
    after the other as in a graph, and not of their launches.
    """

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.seconds: dict[str, float] = defaultdict(float)
        self._events = list[tuple[str, torch.cuda.Event, torch.cuda.Event]]()

    def step(self) -> None:
        if self.device.type == "cuda":
            torch.cuda._sleep(SLEEP_CYCLES)  # type: ignore[no-untyped-call]
        super().step()
        wait_for(self.device)
        for name, began, ended in self._events:
            self.seconds[name] += began.elapsed_time(ended) / 1e3
        self._events.clear()

    def _time(self, name: str, part: Callable[..., Any], *args: Any) -> Any:
        if self.device.type == "cuda":
            began, ended = (torch.cuda.Event(enable_timing=True) for _ in range(2))  # type: ignore[no-untyped-call]
            began.record()
            result = part(*args)
            ended.record()
            self._events.append((name, began, ended))
            return result
        started = time.perf_counter()
        result = part(*args)
        self.seconds[name] += time.perf_counter() - started
        return result

    def draw(self) -> DrawnPair:
        return self._time("draw and reproject", super().draw)  # type: ignore[no-any-return]

    def play(self, pair: DrawnPair) -> Losses:
        return self._time("render and forward", super().play, pair)  # type: ignore[no-any-return]

    def texture_gradient(self, losses: Losses) -> Tensor:
        return self._time("texture backward", super().texture_gradient, losses)  # type: ignore[no-any-return]

    def update_discriminator(self, losses: Losses) -> None:
        self._time("discriminator backward and update", super().update_discriminator, losses)

    def update_texture(self, gradient: Tensor) -> None:
        self._time("texture update", super().update_texture, gradient)


def bench(
    device_name: str, width: int, height: int, preset_name: str, *, views: int = VIEWS, faces: int = FACES
) -> dict[str, Any]:
    """Times of a step (median and least over STEPS), of its parts in as many more, and of the stages, with floors.

    width, height: of the views, in pixels; a step is of the crop that the preset takes of them. views, faces: of the
    scene. Every step updates both players, so a real run, which skips some of the discriminator's updates, is faster.
    """
    device = choose_device(device_name)
    load = os.getloadavg()[0]
    scene, atlas = made_scene(faces, views, width, height)
    stages, maps, pairs = time_stages(scene, atlas, device)
    preset = PRESETS[preset_name]
    plain, timed = full_optimizer(maps, pairs, preset), _begun(_Timed, maps, pairs, preset)
    assert isinstance(timed, _Timed)
    limits = measure_limits(device, torch.bfloat16 if plain.bfloat16 else torch.float32)
    stepper = Stepper(plain)
    times = step_times(stepper)
    for index in range(WARMUP + STEPS):
        if index == WARMUP:
            timed.seconds.clear()
        timed.step()
    profiled = profile_steps(stepper, PROFILED)
    works = step_parts(*plain.crop, maps.slots, 2 if plain.bfloat16 else 4)
    least, median = min(times), sorted(times)[len(times) // 2]
    flops = step_flops(*plain.crop)
    floor = sum(limits.floor(work.flops, work.bytes) for work in works.values())
    whole = sum(timed.seconds.values())
    return {
        "device": device.type if device.type == "cpu" else torch.cuda.get_device_name(device),
        "threads": torch.get_num_threads(),
        "load": round(load, 2),
        "torch": torch.__version__,
        **stepper.describe(),
        "product_gflops_per_second": round(limits.flops / 1e9, 1),
        "copy_gb_per_second": round(limits.bytes / 1e9, 2),
        "upload_gb_per_second": round(limits.upload / 1e9, 2),
        "preset": preset_name,
        "width": width,
        "height": height,
        "crop": list(plain.crop),
        "views": len(scene.views),
        "faces": len(scene.mesh.t_pos_idx),
        "texture": atlas.width,
        "texels": maps.slots,
        "step_ms": round(median * 1e3, 3),
        "step_ms_least": round(least * 1e3, 3),
        "steps_per_second": round(1 / median, 2),
        "flops": flops,
        "bytes": round(sum(work.bytes for work in works.values())),
        "gflops_per_second": round(flops / median / 1e9, 1),
        "floor_ms": _ms(floor),
        "ratio": round(median / floor, 2),
        "parts": {
            name: {**_row(seconds / STEPS, works[name], limits), "share": round(seconds / whole, 3)}
            for name, seconds in timed.seconds.items()
        },
        "stages": {name: _stage_row(stage, limits) for name, stage in stages.items()},
        "profile": profiled,
    }


def step_times(stepper: Stepper) -> list[float]:
    """Seconds per step of about STEPS steps, taken as a run takes them: many at once where a graph can hold them."""
    device, taken, times = stepper.optimizer.device, 0, list[float]()
    while taken < WARMUP + WARM_LAUNCHES * (stepper.steps_per_launch - 1):
        taken += stepper.take(MANY)
    while len(times) < max(LAUNCHES, STEPS / stepper.steps_per_launch):
        wait_for(device)
        started = time.perf_counter()
        taken = stepper.take(MANY)
        wait_for(device)
        times.append((time.perf_counter() - started) / taken)
    return times


def _row(seconds: float, work: Work, limits: Limits) -> dict[str, Any]:
    floor = limits.floor(work.flops, work.bytes, work.uploaded)
    return {
        "ms": _ms(seconds),
        "gflop": float(f"{work.flops / 1e9:.4g}"),
        "mb": float(f"{(work.bytes + work.uploaded) / 1e6:.4g}"),
        "floor_ms": _ms(floor),
        "ratio": round(seconds / floor, 2),
    }


def _stage_row(stage: Stage, limits: Limits) -> dict[str, Any]:
    if stage.seconds is None:
        return {"skipped": stage.left_out}
    if stage.work is None:
        return {"ms": _ms(stage.seconds)}
    return _row(stage.seconds, stage.work, limits)


def _ms(seconds: float) -> float:
    return float(f"{seconds * 1e3:.4g}")


def print_table(result: dict[str, Any]) -> None:
    """The same for people; sizes are in pixels."""
    whole, crop = ("x".join(map(str, size)) for size in ((result["width"], result["height"]), result["crop"]))
    print(f"preset {result['preset']}, crops of {crop} from full frames of {whole}")
    for key, value in result.items():
        if key not in ("preset", "width", "height", "crop", "parts", "stages", "profile"):
            print(f"{key:36} {value}")
    for table, title in (("parts", "part of a step"), ("stages", "stage")):
        print(f"\n{title:36} {'ms':>10} {'GFLOP':>10} {'MB':>10} {'floor ms':>10} {'ratio':>8}")
        for name, row in result[table].items():
            if "skipped" in row:
                print(f"{name:36} skipped: {row['skipped']}")
                continue
            cells = (row.get(key, "-") for key in ("gflop", "mb", "floor_ms"))
            print(
                f"{name:36} {row['ms']:10} "
                + " ".join(f"{cell:>10}" for cell in cells)
                + f" {row.get('ratio', '-'):>8}"
            )
    print(f"\n{'operation':36} {'ms':>10} {'calls':>10} {'share':>10}   of {result['profile']['busy_ms']} ms per step")
    for row in result["profile"]["operations"]:
        print(f"{row['name']:36} {row['ms']:10} {row['calls']:10} {row['share']:10}")


def full_optimizer(maps: ViewMaps, pairs: Pairs, preset: Preset) -> AdversarialOptimizer:
    """The step of an object's run, without the discriminator's pauses, at the first step after the pretraining."""
    return _begun(_Full, maps, pairs, preset)


def _begun(kind: type[AdversarialOptimizer], maps: ViewMaps, pairs: Pairs, preset: Preset) -> AdversarialOptimizer:
    """At the first step after the pretraining, in which the texture waits."""
    device = maps.device
    discriminator = PatchDiscriminator(torch.Generator().manual_seed(0)).to(device)
    generator = torch.Generator(device).manual_seed(0)
    start = torch.zeros((maps.slots, 3), device=device)
    optimizer = kind(
        maps, pairs, start, preset, kind="object", steps=preset.steps, generator=generator, discriminator=discriminator
    )
    optimizer.index = preset.pretraining
    return optimizer

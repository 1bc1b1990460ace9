"""What a run gives up where memory is short, and in which order.

1. Views: they stay on the host, and only so many at a time are on the device (`render/streaming.py`); halved time and
   again. The result is as good; it takes a little longer.
2. The crop of a step, halved: patches are judged as before, fewer at a time.
3. The texture, halved: the atlas is made anew, and what was optimized is lost.
Before the atlas there is neither view nor texture to make smaller: a GPU's stages are done on the CPU instead.

What was given up is kept in the work folder, so that a resumed run has the same limits and goes on with the same steps.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, TypeVar

import torch

from advtex_engine.budget.workload import Workload, estimate, fullest, tensor_bytes
from advtex_engine.core.config import Preset, TextureConfig
from advtex_engine.core.errors import MemoryShortage, Problem
from advtex_engine.core.monitor import WarningKeeper
from advtex_engine.render.streaming import LEAST_VIEWS
from advtex_engine.runtime.available_memory import available_memory, give_back_unused, limit_process, resident_memory
from advtex_engine.runtime.checkpoint import WorkFolder
from advtex_engine.runtime.shortage import memory_problem

LEAST_CROP = 96  # pixels, of the shorter side
LEAST_TEXTURE = 256
EARLY = ("fusion", "refinement")  # stages before the atlas that compute on the device
BEFORE_VIEWS = ("ingest", "conventions", "geometry", *EARLY)
REMEDY = "choose a smaller size or texture, fewer views, or a device with more memory"
PLANNED_SHARE = 0.9  # of the free memory: allocators leave holes
GIB = 1 << 30

T = TypeVar("T")


@dataclass(frozen=True)
class Limits:
    """None or False: no limit. on_device: views of full size. max_crop: width and height. texture: largest side."""

    on_device: int | None = None
    max_crop: tuple[int, int] | None = None
    texture: int | None = None
    early_on_cpu: bool = False


class Budget:
    """The limits of one run, which get narrower while it goes; the folder keeps them."""

    def __init__(self, device: torch.device, config: TextureConfig, folder: WorkFolder, monitor: WarningKeeper) -> None:
        self.device, self.config, self.folder, self.monitor = device, config, folder, monitor
        self.limits, self.measures = Limits(), list[dict[str, str]]()
        saved = folder.load("limits", ("limits", "measures"))
        if saved is not None:
            crop = saved["limits"]["max_crop"]
            self.limits = Limits(**{**saved["limits"], "max_crop": crop and tuple(crop)})
            self.measures = saved["measures"]
        self._work: Workload | None = None
        self._available = 0
        self._began: int | None = None
        self._held = 0
        self._texture_folder = folder
        limit_process(device, config.memory_bytes)

    def run(self, attempt: Callable[[], T]) -> T:
        """What `attempt` gives, which is called again with narrower limits each time that it runs out of memory.

        Raises MemoryShortage once nothing is left to be made smaller.
        """
        while True:
            try:
                return attempt()
            except Exception as error:
                problem = memory_problem(error)
                if problem is None:
                    raise
            # Not in the handler: the error's traceback holds what the attempt had in memory.
            self.shrink(self.monitor.stage, problem)

    @property
    def early_device(self) -> torch.device:
        """The device of the stages before the atlas."""
        return torch.device("cpu") if self.limits.early_on_cpu else self.device

    def preset(self, preset: Preset) -> Preset:
        """The preset, its crops no larger than what is left."""
        crop = self.limits.max_crop
        if crop is None:
            return preset
        width, height = preset.max_crop or crop
        wide, high = preset.descent_crop
        return replace(
            preset,
            max_crop=(min(crop[0], width), min(crop[1], height)),
            descent_crop=(min(crop[0], wide), min(crop[1], high)),
        )

    def texture_config(self) -> TextureConfig:
        """The options, their texture no larger than what is left."""
        texture = self.limits.texture
        return self.config if texture is None else replace(self.config, max_texture_size=texture)

    def texture_folder(self) -> WorkFolder:
        """The work folder for what depends on the texture's size: caches of a larger one are not taken for it."""
        side = self.limits.texture
        fingerprint = self.folder.fingerprint if side is None else f"{self.folder.fingerprint} {side}"
        if self._texture_folder.fingerprint != fingerprint:
            self._texture_folder = WorkFolder(self.folder.path, fingerprint, self.monitor)
        return self._texture_folder

    def fit(self, work: Workload, stage: str, held: int = 0, *, known: bool = False) -> bool:
        """Narrows the limits until the work fits into what is free; -> whether the texture must be made anew.

        work: with the preset as it is without limits. held: bytes of it that are on the device already. known: the
        texels are counted and no longer guessed: the texture is not given up any more. Raises MemoryShortage when the
        least is too much.
        """
        self._work = work
        self._available = available_memory(self.device, self.config.memory_bytes) + held
        room = int(PLANNED_SHARE * self._available)
        self._keep_off(work, stage, room)
        while self._needed(work) > room:
            narrower = self._narrower(work, ("views", "crop") if known else ("views", "crop", "texture"))
            if narrower is None:
                if self._needed(work) > self._available:
                    raise MemoryShortage(self._sentence(work))
                break
            texture = narrower[0].texture != self.limits.texture
            self._take(stage, self._sentence(work), *narrower)
            if texture:
                return True
        return False

    def shrink(self, stage: str, problem: str) -> None:
        """After `stage` ran out of memory: the next limit, and a warning. Raises MemoryShortage when none is left.

        To be called where no handler holds the error any more, whose traceback holds what the stage had.
        """
        gc.collect()
        if self.device.type == "cuda":
            torch.cuda.empty_cache()
        narrower = self._after(stage)
        if narrower is None:
            needs = REMEDY if self._work is None else self._sentence(self._work)
            raise MemoryShortage(f"{stage} ran out of memory ({problem}); nothing is left to be made smaller; {needs}")
        kept = [warning for warning in self.monitor.warnings if warning["code"] == "memory_short"]
        self.monitor.warnings[:] = kept  # the others come again, with their stages or from the work folder
        self._take(stage, problem, *narrower, warns=True)

    def begin(self, held: int) -> None:
        """The optimization begins: what the process has now is not its, but for its tensors, of `held` bytes."""
        give_back_unused()
        self._held = held
        self._began = resident_memory()

    def report(self, work: Workload, record: Mapping[str, Any]) -> dict[str, Any]:
        """report.json's part. record: of the stage optimization.

        used_bytes: on a GPU the most that tensors took. On a CPU what the process grew by, and what it held; None where
        views lie in files, whose pages count as the process's or not as the system likes.
        """
        parts = estimate(self._limited(work), self.limits.on_device)
        used = record["peak_device_memory_bytes"]
        estimated = tensor_bytes(parts)
        if self.device.type != "cuda":
            estimated = sum(parts.values())
            in_files = self.limits.on_device is not None
            peak = record["peak_memory_bytes"]
            used = None if in_files or self._began is None else max(0, peak - self._began) + self._held
        return {
            "estimated_bytes": estimated,
            "used_bytes": used,
            "available_bytes": self._available,
            "parts": parts,
            "views": work.views,
            "limits": asdict(self.limits),
            "measures": self.measures,
        }

    def _limited(self, work: Workload) -> Workload:
        return replace(work, preset=self.preset(work.preset))

    def _needed(self, work: Workload) -> int:
        return _bytes(fullest(self._limited(work), self.limits.on_device))

    def _keep_off(self, work: Workload, stage: str, room: int) -> None:
        """Leaves as many views on the device as fit there."""
        there = self.limits.on_device or work.views
        if self._needed(work) <= room or there <= LEAST_VIEWS:
            return
        one, none = (_bytes(fullest(self._limited(work), count)) for count in (1, 0))
        fits = min(there - 1, (room - none) // (one - none))
        narrower = replace(self.limits, on_device=max(LEAST_VIEWS, fits))
        self._take(stage, self._sentence(work), narrower, self._of_views(work, narrower))

    def _after(self, stage: str) -> tuple[Limits, str] | None:
        work = self._work
        if stage in BEFORE_VIEWS:
            if stage not in EARLY or self.device.type == "cpu" or self.limits.early_on_cpu:
                return None
            return replace(self.limits, early_on_cpu=True), "it is done on the CPU"
        if stage == "atlas" or work is None:
            return self._smaller_texture(self.config.max_texture_size)
        return self._narrower(work, ("views", "crop", "texture") if stage == "optimization" else ("views", "texture"))

    def _narrower(self, work: Workload, kinds: tuple[str, ...]) -> tuple[Limits, str] | None:
        """The next limit of one of the kinds, in their order, and in words what it means."""
        limits = self.limits
        there = limits.on_device or work.views
        fewer = max(LEAST_VIEWS, there // 2)
        # Without pairs views come one by one: off the device is as small as it gets.
        halves = work.draws_pairs or limits.on_device is None
        if "views" in kinds and halves and fewer < there:
            narrower = replace(limits, on_device=fewer)
            return narrower, self._of_views(work, narrower)
        if "crop" in kinds and work.plays:
            width, height = (side // 2 for side in self._limited(work).crop)
            if min(width, height) >= LEAST_CROP:
                return replace(limits, max_crop=(width, height)), f"a step sees {width}x{height} pixels of its views"
        return self._smaller_texture(max(work.texture)) if "texture" in kinds else None

    def _smaller_texture(self, side: int) -> tuple[Limits, str] | None:
        texture = min(side, self.limits.texture or side) // 2
        if texture < LEAST_TEXTURE:
            return None
        return replace(self.limits, texture=texture), f"the texture has at most {texture} texels a side"

    def _of_views(self, work: Workload, limits: Limits) -> str:
        if not work.draws_pairs:
            return f"the {work.views} views stay on the host, and are on the device one at a time"
        return f"of {work.views} views {limits.on_device} at a time are on the device"

    def _sentence(self, work: Workload) -> str:
        name = "the machine" if self.device.type == "cpu" else f"the device {self.device}"
        needed = self._needed(work) / GIB
        return f"the texture needs {needed:.2f} GiB and {name} has {self._available / GIB:.2f} GiB; {REMEDY}"

    def _take(self, stage: str, problem: str, limits: Limits, measure: str, *, warns: bool = False) -> None:
        """The new limits. What costs nothing of the result is only noted, unless something had failed."""
        only_views = replace(limits, on_device=None) == replace(self.limits, on_device=None)
        self.limits = limits
        self.measures = [*self.measures, {"stage": stage, "problem": problem, "measure": measure}]
        self.folder.save("limits", {"limits": asdict(limits), "measures": self.measures})
        said = problem.removesuffix(f"; {REMEDY}")
        if only_views and not warns:
            self.monitor.note(f"{said}: {measure}")
        else:
            self.monitor.warning(Problem("memory_short", stage, f"{said}: {measure}", REMEDY))


def _bytes(parts: Mapping[str, int]) -> int:
    """The bytes of an estimate that must still be free: a device's context is there already when it is asked."""
    return sum(size for name, size in parts.items() if name != "context")

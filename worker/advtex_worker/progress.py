"""Where a run stands, as the user sees it and as the poison rule counts it."""

from __future__ import annotations

import time
from collections.abc import Callable

from advtex_contract.jobs import Progress
from advtex_engine.core.monitor import STAGES
from advtex_worker.events import NoteEvent, ProgressEvent, StageEvent

NOTES, NOTE_LENGTH = 50, 500
STAGE_WEIGHT = 10_000_000  # more than any step count


class ProgressTracker:
    """Folds stage and progress events into one view. Not thread-safe: views are immutable and handed over whole.

    earlier: how far the attempts before came; of it the seconds that they spent in stages, to which this one's are
    added, their peaks of memory and their notes count on.
    """

    def __init__(self, earlier: Progress, clock: Callable[[], float] = time.monotonic) -> None:
        kept = {"stage_seconds", "stage_peak_bytes", "stage_device_peak_bytes", "notes"}
        self.view = Progress(**earlier.model_dump(include=kept))
        self.reached = 0
        self._clock = clock
        self._first: tuple[int, float] | None = None
        self._before = 0.0  # seconds in the stage until it began this time
        self._began = 0.0

    def stage(self, event: StageEvent) -> None:
        if event.seconds is not None:
            self.view = self.view.model_copy(update=self._ended(event, event.seconds))
            return
        self._before, self._began = self.view.stage_seconds.get(event.stage, 0.0), self._clock()
        self._first = None
        self.view = self.view.model_copy(update={"stage": event.stage, "steps_per_second": None, "eta_seconds": None})
        self._reach(event.stage, 0)

    def progress(self, event: ProgressEvent) -> None:
        """The rate is this attempt's own: steps that an earlier attempt made do not count."""
        now = self._clock()
        if self._first is None:
            self._first = (event.step, now)
        first_step, since = self._first
        done = event.step - first_step
        rate = done / (now - since) if done > 0 and now > since else None
        update = {
            "step": event.step,
            "steps": event.steps,
            "losses": event.losses,
            "stage_seconds": self._spent(self.view.stage, now - self._began),
            "steps_per_second": rate,
            "eta_seconds": (event.steps - event.step) / rate if rate else None,
        }
        self.view = self.view.model_copy(update=update)
        self._reach(self.view.stage, event.step)

    def note(self, event: NoteEvent) -> None:
        """A stage that is done again says the same again."""
        message = event.message[:NOTE_LENGTH]
        if message not in self.view.notes:
            self.view = self.view.model_copy(update={"notes": [*self.view.notes, message][-NOTES:]})

    def _ended(self, event: StageEvent, seconds: float) -> dict[str, object]:
        update: dict[str, object] = {"stage_seconds": self._spent(event.stage, seconds)}
        if event.peak_bytes is not None:
            update["stage_peak_bytes"] = self.view.stage_peak_bytes | {event.stage: event.peak_bytes}
        if event.device_peak_bytes is not None:
            update["stage_device_peak_bytes"] = self.view.stage_device_peak_bytes | {
                event.stage: event.device_peak_bytes
            }
        return update

    def _spent(self, stage: str, seconds: float) -> dict[str, float]:
        return self.view.stage_seconds | {stage: round(self._before + seconds, 3)}

    def _reach(self, stage: str, step: int) -> None:
        index = STAGES.index(stage) if stage in STAGES else 0
        self.reached = max(self.reached, index * STAGE_WEIGHT + step)

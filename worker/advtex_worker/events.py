"""All that the runner and its parent say to each other: one JSON object per line.

The parent writes one `Request` to the runner's stdin and, when it wants it to end, the line `stop` or `cancel`: the
engine then ends at its next step with a checkpoint, after a cancel within `CANCEL_SECONDS` wherever it is. The runner
writes events to its stdout; what libraries print goes to the log instead.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from advtex_contract.errors import ErrorDetail
from advtex_contract.live import LiveRecord
from advtex_contract.options import JobOptions

STOP_LINE = "stop\n"
CANCEL_LINE = "cancel\n"
CANCEL_SECONDS = 0.7


class _Message(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    def line(self) -> str:
        return self.model_dump_json() + "\n"


class Request(_Message):
    """What to run. `engine` is `module:function` with the signature of `advtex_engine.pipeline.texture_scan`.

    snapshots: where reported checkpoint files are kept until the parent has taken them; beside `work`.
    jobs_per_gpu: how many may run on the device at a time. memory_bytes: what this one may take of a GPU.
    """

    engine: str
    scan: Path
    out: Path
    work: Path
    snapshots: Path
    resume: bool
    options: JobOptions
    device: str
    jobs_per_gpu: int = 1
    memory_bytes: int | None = None


class StageEvent(_Message):
    """A stage began, or ended if `seconds` is set; then the peaks of its memory are known too."""

    kind: Literal["stage"] = "stage"
    stage: str
    seconds: float | None = None
    peak_bytes: int | None = None
    device_peak_bytes: int | None = None


class ProgressEvent(_Message):
    kind: Literal["progress"] = "progress"
    step: int
    steps: int
    losses: dict[str, float] = Field(default_factory=dict)


class WarningEvent(_Message):
    kind: Literal["warning"] = "warning"
    problem: ErrorDetail


class NoteEvent(_Message):
    """Something that a user may like to know."""

    kind: Literal["note"] = "note"
    message: str


class LiveEvent(_Message):
    """What the texture looks like now."""

    kind: Literal["live"] = "live"
    record: LiveRecord


class CheckpointEvent(_Message):
    """Durable files: name below the work folder -> a snapshot that nobody changes any more."""

    kind: Literal["checkpoint"] = "checkpoint"
    files: dict[str, Path]


class DiskFullEvent(_Message):
    """The engine waits for room below the work folder, and goes on from its checkpoint."""

    kind: Literal["disk_full"] = "disk_full"


class FinishedEvent(_Message):
    """All results are in the out folder."""

    kind: Literal["finished"] = "finished"


class FailedEvent(_Message):
    """The engine gave up for a reason that it would meet again."""

    kind: Literal["failed"] = "failed"
    code: Literal["invalid_scan", "invalid_options", "out_of_memory", "engine_error"]
    message: str
    details: list[ErrorDetail] = Field(default_factory=list)


class StoppedEvent(_Message):
    """It was asked to stop. Its checkpoint is reported, unless a cancel left no time for one."""

    kind: Literal["stopped"] = "stopped"


Ending = FinishedEvent | FailedEvent | StoppedEvent
Event = StageEvent | ProgressEvent | WarningEvent | NoteEvent | LiveEvent | CheckpointEvent | DiskFullEvent | Ending
_EVENT: TypeAdapter[Event] = TypeAdapter(Annotated[Event, Field(discriminator="kind")])


def parse_event(line: str | bytes) -> Event:
    """The event that a line holds. Raises ValueError for anything else."""
    return _EVENT.validate_json(line)

"""Jobs as client, server and worker speak of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from typing import Annotated, Literal, Self

from pydantic import (
    AwareDatetime,
    BaseModel,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    StringConstraints,
    computed_field,
    model_serializer,
    model_validator,
)

from advtex_contract.errors import JOB_EXPLANATIONS, ErrorDetail
from advtex_contract.options import JobOptions
from advtex_contract.stored_options import AnyOptions

Label = Annotated[str, StringConstraints(max_length=200, pattern=r"^[^\x00-\x1f\x7f]*$")]


ID_PATTERN = r"^[0-9A-Za-z_-]{1,64}$"
BatchId = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$")]


class JobState(StrEnum):
    checking = "checking"
    queued = "queued"
    running = "running"
    preempted = "preempted"
    succeeded = "succeeded"
    failed = "failed"
    canceled = "canceled"
    rejected = "rejected"


@dataclass(frozen=True, slots=True)
class StateFacts:
    """What is true of every job in one state.

    meaning: continues the sentence that begins with the state's name.
    label, tone: what the page shows for it, and in which of its colors.
    becomes: the states that may follow.
    waiting: for a worker; any may take the job. terminal: it has ended; only a retry changes that.
    """

    meaning: str
    label: str
    tone: Literal["plain", "busy", "good", "bad", "warn"] = "plain"
    becomes: frozenset[JobState] = frozenset()
    waiting: bool = False
    terminal: bool = False


S = JobState
STATES: Mapping[JobState, StateFacts] = {
    S.checking: StateFacts(
        "waits until its scan is checked",
        "checking",
        "busy",
        becomes=frozenset({S.queued, S.rejected, S.failed, S.canceled}),
    ),
    S.queued: StateFacts(
        "waits for a worker",
        "queued",
        # A waiting job can succeed: a late attempt's manifest is adopted instead of doing the work again.
        becomes=frozenset({S.running, S.succeeded, S.canceled}),
        waiting=True,
    ),
    S.running: StateFacts(
        "has a worker",
        "running",
        "busy",
        becomes=frozenset({S.queued, S.preempted, S.succeeded, S.failed, S.canceled, S.rejected}),
    ),
    S.preempted: StateFacts(
        "had to give its worker back and waits to go on",
        "preempted",
        "warn",
        becomes=frozenset({S.running, S.succeeded, S.canceled}),
        waiting=True,
    ),
    S.succeeded: StateFacts("has its results", "succeeded", "good", terminal=True),
    S.failed: StateFacts(
        "has ended with an error, and can be retried",
        "failed",
        "bad",
        becomes=frozenset({S.checking, S.queued}),
        terminal=True,
    ),
    S.canceled: StateFacts(
        "was ended by its owner, and can be retried",
        "canceled",
        becomes=frozenset({S.checking, S.queued}),
        terminal=True,
    ),
    S.rejected: StateFacts("has a scan that cannot be textured", "rejected", "bad", terminal=True),
}
TERMINAL = frozenset(state for state in STATES if STATES[state].terminal)
WAITING = frozenset(state for state in STATES if STATES[state].waiting)
PENDING = frozenset(JobState) - TERMINAL - {S.running}
RETRYABLE = frozenset(state for state in TERMINAL if STATES[state].becomes)
ANY_STATE_HEADER = "Advtex-Any-State"  # of clients that read the following; others of ours know no `checking`
AnyState = Annotated[
    JobState | str,
    Field(union_mode="left_to_right", description="a state that is not known here is one in which the job goes on"),
]
JobState.__doc__ = f"A job that is {'; '.join(f'`{state}` {STATES[state].meaning}' for state in STATES)}."


class JobSpec(BaseModel):
    """Body of `POST /v1/jobs`: texture the scan of a finished upload, or one that lies where the server can read it."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    upload_id: str | None = Field(default=None, pattern=r"^[0-9A-Za-z_-]{0,64}$")
    source: str | None = Field(
        default=None, max_length=2000, description="file:// or s3:// URL below a root that the operator allowed"
    )
    options: JobOptions = JobOptions()
    label: Label = ""
    batch: BatchId | None = Field(default=None, description="a name of your own for jobs that belong together")
    priority: int = Field(default=0, ge=-100, le=100, description="larger runs earlier, among your own jobs")
    retention_seconds: int | None = Field(
        default=None, ge=60, description="how long the job is kept after its end; the server's usual time if left out"
    )
    deadline: AwareDatetime | None = Field(
        default=None, description="by when it is to have ended: the sooner, the earlier among your jobs of its priority"
    )

    @model_serializer(mode="wrap")
    def _without_unset_deadline(self, write: SerializerFunctionWrapHandler):  # type: ignore[no-untyped-def]
        # no return annotation, as in `GivenOnly`; a server from before deadlines refuses their name
        return {name: value for name, value in write(self).items() if name != "deadline" or value is not None}

    @model_validator(mode="after")
    def _one_scan(self) -> Self:
        if (self.upload_id is None) == (self.source is None):
            raise ValueError("give either upload_id or source")
        return self


class Progress(BaseModel):
    """Where a running job stands.

    losses: the newest values by name; `accuracy` is the share of patches that the discriminator told apart over the
    last twentieth of the steps: one half is guessing. stage_seconds: of all attempts. stage_peak_bytes,
    stage_device_peak_bytes: the most memory that the engine's process, and its tensors on a GPU, took in a stage that
    has ended, in the last attempt that ran it. steps_per_second: this attempt's rate in this stage. notes: what the
    engine has to say that is no warning, in words.
    """

    stage: str = ""
    step: int = 0
    steps: int = 0
    losses: dict[str, float] = Field(default_factory=dict)
    stage_seconds: dict[str, float] = Field(default_factory=dict)
    stage_peak_bytes: dict[str, int] = Field(default_factory=dict)
    stage_device_peak_bytes: dict[str, int] = Field(default_factory=dict)
    steps_per_second: float | None = None
    eta_seconds: float | None = None
    notes: list[str] = Field(default_factory=list)


class ResultFile(BaseModel):
    """A file of a finished job, downloadable at `url` (path on the same server) with Range requests.

    kind: the word by which the option `outputs` has it, or "seen", "report", "page" or "previews". purpose: what it is
    for, in a phrase. Both are empty where they are not known.
    """

    name: str
    size: int
    sha256: str
    content_type: str
    url: str
    kind: str = ""
    purpose: str = ""


class JobError(BaseModel):
    """Why a job failed or was rejected, in words, with the remedy and the log's tail.

    help: where the server explains the code, a path on it; empty for a code that is not its own.
    """

    code: str
    message: str
    details: list[ErrorDetail] = Field(default_factory=list)
    log_tail: str = ""

    @computed_field  # type: ignore[prop-decorator]
    @property
    def help(self) -> str:
        return f"/errors#job-{self.code}" if self.code in JOB_EXPLANATIONS else ""


class JobView(BaseModel):
    """A job as the API shows it.

    attempt: counts from 1; it is 0 until a worker first takes the job.
    waiting_reason: why the job still waits, in words; empty when it does not.
    memory_bytes: what a worker must have for it, estimated from its views, texture size and preset once the scan is
    checked.
    retention_seconds: how long it is kept after its end; then `expires_at` is known.
    late: whether it ended after its deadline, or goes on though that has passed.
    """

    id: str
    state: AnyState
    label: str = ""
    upload_id: str
    source: str | None = None
    batch: str | None = None
    options: AnyOptions
    priority: int = 0
    attempt: int = 0
    waiting_reason: str = ""
    memory_bytes: int = 0
    progress: Progress = Progress()
    warnings: list[ErrorDetail] = Field(default_factory=list)
    error: JobError | None = None
    results: list[ResultFile] = Field(default_factory=list)
    created_at: datetime
    updated_at: datetime
    finished_at: datetime | None = None
    retention_seconds: int = 0
    expires_at: datetime | None = None
    deadline: datetime | None = None
    late: bool = False


class JobPage(BaseModel):
    """A page of jobs, newest first; `next_cursor` is null on the last one."""

    jobs: list[JobView]
    next_cursor: str | None = None


class BatchView(BaseModel):
    """Jobs with a common name.

    eta_seconds: until all have ended, at the step rates that were measured; null while nothing was, and in lists.
    paused: whether its jobs that wait stay waiting. max_running: how many of them run at a time; null for any number.
    """

    id: str
    jobs: int
    states: dict[AnyState, int]
    finished: bool
    eta_seconds: float | None = None
    paused: bool = False
    max_running: int | None = None
    created_at: datetime
    updated_at: datetime


class BatchLimits(BaseModel):
    """Body of `PUT /v1/batches/{batch_id}/limits`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    max_running: int | None = Field(
        default=None, ge=1, le=2**31 - 1, description="how many of its jobs run at a time; any number if left out"
    )


class BatchPage(BaseModel):
    """A page of batches, newest first; `next_cursor` is null on the last one."""

    batches: list[BatchView]
    next_cursor: str | None = None


class UploadView(BaseModel):
    """An upload: complete once `offset == size` and its sha256 is known."""

    id: str
    size: int
    offset: int
    complete: bool
    sha256: str | None = None
    filename: str = ""
    created_at: datetime
    expires_at: datetime | None = None


class UploadList(BaseModel):
    """Uploads that have the same bytes, the most useful one first."""

    uploads: list[UploadView]


class StorageInfo(BaseModel):
    """What the server accepts at most, and how long it keeps things (seconds)."""

    max_upload_bytes: int
    retention_seconds: int
    max_retention_seconds: int

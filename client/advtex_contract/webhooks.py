"""Webhooks: where an owner wants to be told of changes, and what is sent there (https://www.standardwebhooks.com)."""

from __future__ import annotations

from datetime import datetime

from pydantic import BaseModel, ConfigDict, Field

from advtex_contract.jobs import TERMINAL, AnyState, JobState


class WebhookSpec(BaseModel):
    """Body of `POST /v1/webhooks`. `events` are the states whose beginning is told; by default the final ones."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    url: str = Field(min_length=1, max_length=2000)
    events: frozenset[JobState] = Field(default=TERMINAL, min_length=1)


class WebhookView(BaseModel):
    """A webhook as the API shows it.

    secret: for checking signatures; shown once, in the answer that creates the webhook.
    failures, last_error: tries in a row that failed, and why the last one did; too many disable the webhook.
    """

    id: str
    url: str
    events: list[AnyState]
    secret: str | None = None
    failures: int = 0
    last_error: str = ""
    created_at: datetime
    disabled_at: datetime | None = None


class WebhookList(BaseModel):
    """All webhooks of an owner, oldest first."""

    webhooks: list[WebhookView]


class JobEventError(BaseModel):
    """Why a job failed or was rejected, without the details that the job itself has."""

    code: str
    message: str


class JobEventData(BaseModel):
    """The job at the time of the event; `GET /v1/jobs/{id}` has all of it."""

    id: str
    state: AnyState
    attempt: int
    label: str
    error: JobEventError | None


class JobEvent(BaseModel):
    """What a receiver gets: `type` is `job.` and the state, `timestamp` is when it began."""

    type: str
    timestamp: datetime
    data: JobEventData

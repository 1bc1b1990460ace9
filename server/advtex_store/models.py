"""The tables. Times are seconds since 1970 on the database's clock (`Database.now`)."""

from __future__ import annotations

from typing import Any

from sqlalchemy import (
    JSON,
    BigInteger,
    ColumnElement,
    Computed,
    Double,
    ForeignKey,
    Index,
    String,
    Text,
    TextClause,
    text,
)
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column, validates

LOG_TAIL = 8000  # characters of a log that its row keeps

# Conditions of partial indexes. A query uses such an index only if it says the same in the same words, and the planners
# know little of how many rows that are: the indexes of waiting rows have words of their own, so that each query has one
# that it can use, and no index on `state` alone serves any. The first is that of the releases before schema 0009.
WAITS_IN_LINE = text("state || '' in ('preempted', 'queued') and deleted_at is null")
WAITS_FOR_ITS_TURN = text("'' || state || '' in ('preempted', 'queued') and deleted_at is null")
WAITS_FOR_A_REASON = text("'' || state in ('preempted', 'queued') and deleted_at is null")
KEPT = text("deleted_at is null")
UNTIDY = text("state = 'succeeded' and tidied_at is null and deleted_at is null")
ENDED = text("finished_at is not null and deleted_at is null")
UNPURGED = text("deleted_at is not null and purged_at is null")


def _partial(name: str, *columns: str | ColumnElement[Any], where: TextClause) -> Index:
    return Index(name, *columns, postgresql_where=where, sqlite_where=where)


class Base(DeclarativeBase):
    type_annotation_map = {str: String(255), float: Double(), dict[str, Any]: JSON(), list[Any]: JSON()}  # noqa: RUF012


class ApiKeyRow(Base):
    """`owner` is what objects belong to, so that a key can be replaced without losing them.

    max_active_jobs, max_bytes: how much its owner may have before this key is refused more; null for no limit.
    max_running_jobs: how many of its owner's jobs run at a time; of several keys the least, null for no limit.
    """

    __tablename__ = "api_keys"

    id: Mapped[str] = mapped_column(primary_key=True)
    owner: Mapped[str] = mapped_column(index=True)
    name: Mapped[str] = mapped_column(default="")
    secret_sha256: Mapped[str]
    scopes: Mapped[list[Any]]
    max_active_jobs: Mapped[int | None]
    max_bytes: Mapped[int | None] = mapped_column(BigInteger)
    max_running_jobs: Mapped[int | None]
    created_at: Mapped[float]
    expires_at: Mapped[float | None]
    revoked_at: Mapped[float | None]


class SessionRow(Base):
    """A browser that signed in with a key, and lasts no longer than it; or a link that signs one browser in, once."""

    __tablename__ = "sessions"

    token_sha256: Mapped[str] = mapped_column(primary_key=True)
    key_id: Mapped[str] = mapped_column(ForeignKey("api_keys.id", ondelete="CASCADE"), index=True)
    link: Mapped[bool] = mapped_column(default=False)
    expires_at: Mapped[float] = mapped_column(index=True)


class UploadRow(Base):
    """A scan: on its way in, complete (`sha256` is set, and only then its blob exists), or one of the operator's that
    stays where it is (`source` is its URL).

    offset: bytes that are durable; all of them from right before the blob gets its name. holder: the newest request for
    the bytes; only that one may move the offset. kept_by: the request that moved it last.
    announced_sha256: what the client says that the bytes will have; the bytes' own once they are complete.
    tus_metadata: as the client gave it. source: as in its job. traceparent: of the span of the whole upload.
    """

    __tablename__ = "uploads"

    id: Mapped[str] = mapped_column(primary_key=True)
    owner: Mapped[str] = mapped_column(index=True)
    filename: Mapped[str] = mapped_column(default="")
    size: Mapped[int] = mapped_column(BigInteger)
    offset: Mapped[int] = mapped_column(BigInteger, default=0)
    sha256: Mapped[str | None]
    announced_sha256: Mapped[str | None] = mapped_column(index=True)
    holder: Mapped[str | None]
    kept_by: Mapped[str | None]
    tus_metadata: Mapped[str] = mapped_column(Text, default="")
    source: Mapped[str | None] = mapped_column(Text)
    traceparent: Mapped[str | None]
    created_at: Mapped[float]
    expires_at: Mapped[float | None]
    deleted_at: Mapped[float | None]
    purged_at: Mapped[float | None]

    __table_args__ = (
        _partial("ix_uploads_expires_at", "expires_at", where=KEPT),
        _partial("ix_uploads_unpurged", "id", where=UNPURGED),
    )


class JobRow(Base):
    """A job. A row in state `queued` or `preempted` is also its own outbox entry: the dispatcher reads it.

    attempt: the number that runs now, or will run next while the job waits, or ran last; the fence of all that a worker
        writes.
    version: grows by one with every change that a user can see; the ids of `EventRow`.
    reached, reached_at_claim, deaths: how far any attempt got, where this one began, and how many attempts in a row
    died without getting farther.
    source: the URL of a scan that stays where it is; its upload row is a mere placeholder.
    memory_bytes: what a worker must have (`memory_estimate.py`). memory_gib: the class of the smallest such worker.
    waiting_reason: for people, the dispatcher's while the job waits and the worker's while it pauses.
    deadline: by when its owner wants it to have ended.
    due: what orders a line (`fair_queue.py`). Without a deadline a job is due a week after it was made, so that others
        do not overtake it for ever.
    line: the jobs of one owner, batch and priority.
    checked_at: when its scan was found good. Until then `worker`, `lease_expires_at` and `deaths` are the checker's
    (`checks.py`); a time without a worker is when the next check may begin.
    tidied_at: when what no result needs was removed.
    traceparent: of the span in which it was made (`tracing.py`).
    """

    __tablename__ = "jobs"

    id: Mapped[str] = mapped_column(primary_key=True)
    owner: Mapped[str]
    upload_id: Mapped[str] = mapped_column(ForeignKey("uploads.id"), index=True)
    source: Mapped[str | None] = mapped_column(Text)
    batch: Mapped[str | None]
    state: Mapped[str] = mapped_column(String(16))
    label: Mapped[str] = mapped_column(default="")
    options: Mapped[dict[str, Any]]
    priority: Mapped[int] = mapped_column(default=0)
    memory_bytes: Mapped[int] = mapped_column(BigInteger, default=0)
    memory_gib: Mapped[int] = mapped_column(BigInteger, Computed("(memory_bytes + 1073741823) / 1073741824"))
    deadline: Mapped[float | None]
    due: Mapped[float] = mapped_column(Computed("coalesce(deadline, created_at + 604800.0)"))
    line: Mapped[str] = mapped_column(
        Text, Computed("cast(priority as text) || '/' || coalesce(batch, '') || '/' || owner")
    )
    checked_at: Mapped[float | None]
    waiting_reason: Mapped[str] = mapped_column(default="")
    attempt: Mapped[int] = mapped_column(default=1)
    worker: Mapped[str | None]
    lease_expires_at: Mapped[float | None]
    cancel_requested: Mapped[bool] = mapped_column(default=False)
    reached: Mapped[int] = mapped_column(BigInteger, default=0)
    reached_at_claim: Mapped[int] = mapped_column(BigInteger, default=0)
    deaths: Mapped[int] = mapped_column(default=0)
    log_tail: Mapped[str] = mapped_column(Text, default="")
    progress: Mapped[dict[str, Any]]
    warnings: Mapped[list[Any]]
    error: Mapped[dict[str, Any] | None]
    results: Mapped[list[Any]]
    version: Mapped[int] = mapped_column(BigInteger, default=1)
    traceparent: Mapped[str | None]
    created_at: Mapped[float]
    updated_at: Mapped[float]
    finished_at: Mapped[float | None]
    retention_seconds: Mapped[int]
    expires_at: Mapped[float | None]
    tidied_at: Mapped[float | None]
    deleted_at: Mapped[float | None]
    purged_at: Mapped[float | None]

    __table_args__ = (
        Index("ix_jobs_owner_id", "owner", "id"),
        Index("ix_jobs_owner_updated_at", "owner", "updated_at"),
        Index("ix_jobs_owner_batch_id", "owner", "batch", "id"),
        _partial("ix_jobs_state_id", "state", "id", where=KEPT),
        _partial("ix_jobs_line", "owner", "memory_gib", "state", priority.desc(), "id", where=WAITS_IN_LINE),
        _partial("ix_jobs_turn", "line", "memory_gib", "state", "due", "id", where=WAITS_FOR_ITS_TURN),
        _partial("ix_jobs_reason", "memory_gib", "waiting_reason", where=WAITS_FOR_A_REASON),
        _partial("ix_jobs_expires_at", "expires_at", where=KEPT),
        _partial("ix_jobs_finished_at", "finished_at", where=ENDED),
        _partial("ix_jobs_untidy", "finished_at", where=UNTIDY),
        _partial("ix_jobs_unpurged", "id", where=UNPURGED),
    )

    @validates("log_tail")
    def _shortened(self, _name: str, text: str) -> str:
        """The newest of it. Libraries print what they like, and PostgreSQL's text has no NUL."""
        return text[-LOG_TAIL:].replace("\0", "\ufffd")


class BatchRow(Base):
    """What its owner has said of a batch as a whole; one of which nothing was said has no row.

    paused_at: since when none of its jobs begins. max_running: how many of them run at a time.
    """

    __tablename__ = "batches"

    owner: Mapped[str] = mapped_column(primary_key=True)
    id: Mapped[str] = mapped_column(primary_key=True)
    paused_at: Mapped[float | None]
    max_running: Mapped[int | None]
    updated_at: Mapped[float]


class EventRow(Base):
    """A change of state or of stage, replayed to listeners that come back."""

    __tablename__ = "events"

    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True)
    version: Mapped[int] = mapped_column(BigInteger, primary_key=True, autoincrement=False)
    data: Mapped[dict[str, Any]]


class IdempotencyRow(Base):
    """A request that is being answered (`job_id` is null until `held_until`) or was answered with a job."""

    __tablename__ = "idempotency"

    owner: Mapped[str] = mapped_column(primary_key=True)
    token: Mapped[str] = mapped_column(primary_key=True)
    body_sha256: Mapped[str]
    holder: Mapped[str]
    held_until: Mapped[float]
    job_id: Mapped[str | None] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"))
    created_at: Mapped[float]


class CounterRow(Base):
    """What has happened so far, counted in the transaction in which it happened: the metrics of the whole fleet."""

    __tablename__ = "tallies"

    name: Mapped[str] = mapped_column(primary_key=True)
    label: Mapped[str] = mapped_column(primary_key=True)
    count: Mapped[int] = mapped_column(BigInteger)
    total: Mapped[float]


class TroubleRow(Base):
    """A job or upload (`item`) that a task of housekeeping fails for, and for how many rounds in a row."""

    __tablename__ = "troubles"

    task: Mapped[str] = mapped_column(primary_key=True)
    item: Mapped[str] = mapped_column(primary_key=True)
    rounds: Mapped[int]
    error: Mapped[str] = mapped_column(Text)
    first_at: Mapped[float]
    last_at: Mapped[float]


class WebhookRow(Base):
    """Where an owner wants to be told. `failures` counts tries in a row that failed; too many disable it."""

    __tablename__ = "webhooks"

    id: Mapped[str] = mapped_column(primary_key=True)
    owner: Mapped[str] = mapped_column(index=True)
    url: Mapped[str] = mapped_column(Text)
    secret: Mapped[str]
    events: Mapped[list[Any]]
    failures: Mapped[int] = mapped_column(default=0)
    last_error: Mapped[str] = mapped_column(Text, default="")
    created_at: Mapped[float]
    disabled_at: Mapped[float | None]


class DeliveryRow(Base):
    """Outbox of the webhooks, written with the change that it tells of; gone once it was delivered or given up.

    next_try_at: also the end of the time that a server has for the try that it has begun.
    """

    __tablename__ = "deliveries"

    id: Mapped[str] = mapped_column(primary_key=True)
    webhook_id: Mapped[str] = mapped_column(ForeignKey("webhooks.id", ondelete="CASCADE"), index=True)
    body: Mapped[str] = mapped_column(Text)
    tries: Mapped[int] = mapped_column(default=0)
    next_try_at: Mapped[float] = mapped_column(index=True)
    created_at: Mapped[float]

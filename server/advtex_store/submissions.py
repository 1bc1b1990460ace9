"""New jobs, lists of them, and idempotency keys.

A request with an idempotency key first reserves it, then looks whether the scan is there, then creates the job and
binds the key to it in one transaction. One whose server died is taken over after `HOLD_SECONDS`, which is as long as a
client that tries again has to wait.
"""

from __future__ import annotations

import hashlib
import secrets
from dataclasses import dataclass
from datetime import datetime

from sqlalchemy import delete, select, update
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session

from advtex_contract.jobs import JobSpec, JobState, Progress
from advtex_contract.stored_options import read_options
from advtex_store.accounts import check_active_jobs
from advtex_store.database import Database
from advtex_store.errors import IdempotencyInFlight, IdempotencyMismatch, RecordNotFound
from advtex_store.ids import new_id
from advtex_store.models import EventRow, IdempotencyRow, JobRow, UploadRow
from advtex_store.webhooks import tell_webhooks

HOLD_SECONDS = 15.0


@dataclass(frozen=True, slots=True)
class Reservation:
    """An idempotency key that this request holds."""

    owner: str
    token: str
    holder: str


@dataclass(frozen=True, slots=True)
class JobFilter:
    """Which jobs a list shows; None for any."""

    state: JobState | None = None
    label: str | None = None
    batch: str | None = None


class Submissions:
    """Jobs as users make and list them."""

    def __init__(self, database: Database, *, retention_seconds: int = 30 * 86400) -> None:
        self.database = database
        self.retention_seconds = retention_seconds

    def reserve(self, owner: str, token: str, spec: JobSpec) -> Reservation | JobRow:
        """Hold the key, or the job that it made before. IdempotencyMismatch, IdempotencyInFlight."""
        holder, body_sha256 = secrets.token_hex(8), hashlib.sha256(spec.model_dump_json().encode()).hexdigest()
        with self.database.write() as session:
            now = self.database.now(session)
            insert = sqlite.insert if session.get_bind().dialect.name == "sqlite" else postgresql.insert
            inserted = insert(IdempotencyRow).values(
                owner=owner,
                token=token,
                body_sha256=body_sha256,
                holder=holder,
                held_until=now + HOLD_SECONDS,
                created_at=now,
            )
            # An update of nothing: it locks the row that is there already, which its request may be about to release.
            session.execute(inserted.on_conflict_do_update(index_elements=["owner", "token"], set_={"token": token}))
            row = session.get_one(IdempotencyRow, (owner, token))
            if row.holder == holder:
                return Reservation(owner, token, holder)
            made = None if row.job_id is None else session.get_one(JobRow, row.job_id)
            # Another release writes the same body in another way: then the job tells whether it is the same.
            if row.body_sha256 != body_sha256 and (made is None or not self._is_made_of(made, spec)):
                raise IdempotencyMismatch(f"the idempotency key {token!r} was used before with another body")
            if made is not None:
                return made
            if row.held_until > now:
                raise IdempotencyInFlight(f"a request with the idempotency key {token!r} is still being answered")
            row.holder, row.held_until = holder, now + HOLD_SECONDS
            return Reservation(owner, token, holder)

    def _is_made_of(self, row: JobRow, spec: JobSpec) -> bool:
        scan = row.source == spec.source and (spec.source is not None or row.upload_id == spec.upload_id)
        kept = spec.retention_seconds or self.retention_seconds
        asked = (spec.options, spec.label, spec.batch, spec.priority, kept, _seconds(spec.deadline))
        told = (read_options(row.options), row.label, row.batch, row.priority, row.retention_seconds, row.deadline)
        return scan and told == asked

    def release(self, reservation: Reservation) -> None:
        """The request made no job: the key is free again."""
        with self.database.write() as session:
            session.execute(
                delete(IdempotencyRow).where(
                    IdempotencyRow.owner == reservation.owner,
                    IdempotencyRow.token == reservation.token,
                    IdempotencyRow.holder == reservation.holder,
                    IdempotencyRow.job_id.is_(None),
                )
            )

    def create_job(
        self,
        owner: str,
        spec: JobSpec,
        *,
        reservation: Reservation | None = None,
        max_active_jobs: int | None = None,
        traceparent: str | None = None,
    ) -> JobRow:
        """A job whose scan is to be checked (`Checks`). RecordNotFound: no such finished upload.

        QuotaExceeded: the owner has `max_active_jobs` jobs already that have not ended.
        """
        retention = spec.retention_seconds or self.retention_seconds
        with self.database.write() as session:
            check_active_jobs(session, owner, max_active_jobs)
            now = self.database.now(session)
            upload = _placeholder(session, owner, spec.source, now) if spec.source else _finished(session, owner, spec)
            # Also keeps a reconciler that is just letting the upload go from doing so: it looks at this time again.
            upload.expires_at = max(upload.expires_at or 0.0, now + retention)
            row = JobRow(
                id=new_id(now),
                owner=owner,
                upload_id=upload.id,
                source=spec.source,
                batch=spec.batch,
                state=JobState.checking.value,
                label=spec.label,
                options=spec.options.model_dump(mode="json"),
                priority=spec.priority,
                deadline=_seconds(spec.deadline),
                attempt=0,
                progress=Progress().model_dump(mode="json"),
                warnings=[],
                results=[],
                version=1,
                created_at=now,
                updated_at=now,
                retention_seconds=retention,
                traceparent=traceparent,
            )
            session.add(row)
            session.flush()
            session.add(
                EventRow(
                    job_id=row.id,
                    version=1,
                    data={"kind": "state", "state": row.state, "attempt": row.attempt, "at": now},
                )
            )
            tell_webhooks(session, row, now)
            if reservation is not None:
                _bind(session, reservation, row.id)
            return row

    def list_jobs(
        self,
        owner: str,
        wanted: JobFilter = JobFilter(),
        *,
        cursor: str | None = None,
        limit: int = 50,
    ) -> tuple[list[JobRow], str | None]:
        """A page of jobs, newest first, and the cursor of the next page."""
        query = select(JobRow).where(JobRow.owner == owner, JobRow.deleted_at.is_(None))
        for column, value in ((JobRow.state, wanted.state), (JobRow.label, wanted.label), (JobRow.batch, wanted.batch)):
            if value is not None:
                query = query.where(column == value)
        if cursor is not None:
            query = query.where(JobRow.id < cursor)
        with self.database.read() as session:
            rows = list(session.scalars(query.order_by(JobRow.id.desc()).limit(limit + 1)))
        return rows[:limit], rows[limit - 1].id if len(rows) > limit else None


def _seconds(time: datetime | None) -> float | None:
    return None if time is None else time.timestamp()


def _finished(session: Session, owner: str, spec: JobSpec) -> UploadRow:
    upload = session.scalar(
        select(UploadRow)
        .where(UploadRow.id == spec.upload_id, UploadRow.owner == owner)
        .where(UploadRow.deleted_at.is_(None), UploadRow.sha256.is_not(None))
        .with_for_update()
    )
    if upload is None:
        raise RecordNotFound(f"there is no finished upload {spec.upload_id}")
    return upload


def _placeholder(session: Session, owner: str, source: str, now: float) -> UploadRow:
    name = source.rstrip("/").rpartition("/")[2]
    upload = UploadRow(id=new_id(now), owner=owner, size=0, filename=name[:255], source=source, created_at=now)
    session.add(upload)
    session.flush()
    return upload


def _bind(session: Session, reservation: Reservation, job_id: str) -> None:
    bound = session.scalar(
        update(IdempotencyRow)
        .where(IdempotencyRow.owner == reservation.owner, IdempotencyRow.token == reservation.token)
        .where(IdempotencyRow.holder == reservation.holder, IdempotencyRow.job_id.is_(None))
        .values(job_id=job_id)
        .returning(IdempotencyRow.token)
    )
    if bound is None:
        raise IdempotencyInFlight(f"another request took over the idempotency key {reservation.token!r}")

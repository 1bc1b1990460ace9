"""Jobs whose scan is being checked.

Any server may take one (`claim`) and says now and then that it still has it (`renew`). Whoever lets go of it, ends with
an outcome, or dies, leaves exactly one outcome behind: each is told together with the claim, and `StaleAttempt` is the
answer once somebody else has the job or its owner canceled it. A claim that nobody renews can be taken by others; three
checks in a row that died with their process end the job.
"""

from __future__ import annotations

import random
import secrets
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import ColumnElement, func, or_, select
from sqlalchemy.orm import Session

from advtex_contract.errors import ErrorDetail
from advtex_contract.jobs import JobError, JobState
from advtex_contract.options import JobOptions, known_options, misunderstood
from advtex_store import keys
from advtex_store.errors import StaleAttempt
from advtex_store.models import JobRow
from advtex_store.records import Records

S = JobState
DEATHS = 3
DECLINED = "a server of another release does not understand its options, upgrade the servers: "
DECLINED_SECONDS = 10.0  # until such a job is looked at again, perhaps by a server that understands it
REMEDY = "make the scan smaller (fewer faces, fewer files), or retry the job on a machine with more memory"


@dataclass(frozen=True, slots=True)
class CheckClaim:
    """A job that this checker now has. `holder` is what proves it."""

    job_id: str
    holder: str
    owner: str
    upload_id: str
    scan_key: str
    source: str | None
    options: JobOptions
    traceparent: str | None = None


class Checks:
    """What a checker does to a job in state `checking`; every change is one compare-and-set."""

    def __init__(self, records: Records) -> None:
        self.records = records
        self.database = records.database
        self.lease_seconds = records.lease_seconds

    def claim(self) -> CheckClaim | None:
        """Take a job that nobody checks, None if there is none. Of all owners that have one, chance chooses: a large
        batch keeps nobody waiting. A job with options that only another release knows is left to that."""
        with self.database.read() as session:
            free = _free(self.database.now(session))
            oldest = list(session.scalars(select(func.min(JobRow.id)).where(*free).group_by(JobRow.owner)))
        random.shuffle(oldest)
        for job_id in oldest:
            with self.database.write() as session:
                now = self.database.now(session)
                query = select(JobRow).where(JobRow.id == job_id, *_free(now)).with_for_update(skip_locked=True)
                row = session.scalar(query)
                if row is not None and (reason := misunderstood(row.options)) is not None:
                    _put_off(row, DECLINED + reason, now, DECLINED_SECONDS)
                elif row is not None and (row.worker is None or self._died(session, row, "its server was killed")):
                    row.worker, row.lease_expires_at = secrets.token_hex(8), now + self.lease_seconds
                    return _claim(row)
        return None

    def renew(self, claim: CheckClaim) -> None:
        """The check still goes on."""
        with self.database.write() as session:
            row = self._held(session, claim)
            row.lease_expires_at = self.database.now(session) + self.lease_seconds

    def passed(self, claim: CheckClaim, warnings: Sequence[ErrorDetail], memory_bytes: int) -> None:
        """The scan can be textured: the job waits for a worker."""
        with self.database.write() as session:
            row = self._held(session, claim)
            self.records.move(
                session,
                claim.job_id,
                S.queued,
                attempt=row.attempt + 1,
                warnings=[warning.model_dump(mode="json") for warning in warnings],
                memory_bytes=memory_bytes,
                checked_at=self.database.now(session),
                **_LET_GO,
            )

    def rejected(self, claim: CheckClaim, error: JobError) -> None:
        """The scan cannot be textured; `error.details` list every problem."""
        self._end(claim, S.rejected, error)

    def failed(self, claim: CheckClaim, error: JobError) -> None:
        """The scan is gone, or cannot be read."""
        self._end(claim, S.failed, error)

    def died(self, claim: CheckClaim, how: str) -> JobState:
        """The process that checked ended without an outcome. -> `checking`, or `failed` after the last try.

        how: continues the sentence "the check of the scan ended without an outcome:".
        """
        with self.database.write() as session:
            row = self._held(session, claim)
            if self._died(session, row, how):
                row.worker = row.lease_expires_at = None
            return JobState(row.state)

    def postpone(self, claim: CheckClaim, reason: str, seconds: float, error: JobError | None = None) -> None:
        """The scan cannot be read now: it is tried again after so many seconds, and `reason` is shown until then.

        error: of trouble that counts as a death, as no try may ever end it: what the last one fails with.
        """
        with self.database.write() as session:
            row = self._held(session, claim)
            if error is None or self._counted(session, row, error):
                _put_off(row, reason, self.database.now(session), seconds)

    def release(self, claim: CheckClaim) -> None:
        """The checker must go; another one begins anew."""
        with self.database.write() as session:
            row = self._held(session, claim)
            row.worker = row.lease_expires_at = None

    def _held(self, session: Session, claim: CheckClaim) -> JobRow:
        held = (JobRow.id == claim.job_id, JobRow.state == S.checking, JobRow.worker == claim.holder)
        row = session.scalar(select(JobRow).where(*held, JobRow.deleted_at.is_(None)).with_for_update())
        if row is None:
            raise StaleAttempt(f"the check of job {claim.job_id} is somebody else's by now, or was canceled")
        return row

    def _died(self, session: Session, row: JobRow, how: str) -> bool:
        message = (
            f"the check of the scan ended without an outcome {DEATHS} times, the last time because {how}; {REMEDY}"
        )
        return self._counted(session, row, JobError(code="check_died", message=message))

    def _counted(self, session: Session, row: JobRow, error: JobError) -> bool:
        """Count one more check in vain. -> whether there is another try; else the job has ended with the error."""
        row.deaths += 1
        if row.deaths < DEATHS:
            return True
        self._finish(session, row.id, S.failed, error)
        return False

    def _end(self, claim: CheckClaim, to: JobState, error: JobError) -> None:
        with self.database.write() as session:
            self._held(session, claim)
            self._finish(session, claim.job_id, to, error)

    def _finish(self, session: Session, job_id: str, to: JobState, error: JobError) -> None:
        data = error.model_dump(mode="json")
        self.records.finish(session, self.records.move(session, job_id, to, error=data, **_LET_GO))


def _free(now: float) -> tuple[ColumnElement[bool], ...]:
    """Of rows that wait for a checker."""
    unheld = or_(JobRow.lease_expires_at.is_(None), JobRow.lease_expires_at < now)
    return JobRow.state == S.checking, JobRow.deleted_at.is_(None), unheld


def _put_off(row: JobRow, reason: str, now: float, seconds: float) -> None:
    row.worker, row.lease_expires_at = None, now + seconds
    if reason[:255] != row.waiting_reason:
        row.waiting_reason, row.updated_at, row.version = reason[:255], now, row.version + 1


_LET_GO: dict[str, Any] = {"worker": None, "lease_expires_at": None, "deaths": 0, "waiting_reason": ""}


def _claim(row: JobRow) -> CheckClaim:
    assert row.worker is not None
    return CheckClaim(
        job_id=row.id,
        holder=row.worker,
        owner=row.owner,
        upload_id=row.upload_id,
        scan_key=keys.scan_key(row.upload_id),
        source=row.source,
        options=JobOptions.model_validate(known_options(row.options)),
        traceparent=row.traceparent,
    )

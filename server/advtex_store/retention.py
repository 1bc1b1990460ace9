"""Letting go of what has expired or was deleted: the row is hidden first, the blobs follow."""

from __future__ import annotations

from sqlalchemy import ColumnElement, and_, exists, select, update

from advtex_contract.jobs import TERMINAL
from advtex_store import keys
from advtex_store.blobs import Blobs
from advtex_store.database import Database
from advtex_store.models import JobRow, UploadRow

BATCH = 100


class Retention:
    """Every step can be repeated, and can be done by several servers at once."""

    def __init__(self, database: Database, blobs: Blobs) -> None:
        self.database = database
        self.blobs = blobs

    def expire(self) -> None:
        """Hide ended jobs, and uploads without a job, that are past the time that was announced for them."""
        in_use = exists().where(JobRow.upload_id == UploadRow.id, JobRow.deleted_at.is_(None))
        with self.database.read() as session:
            now = self.database.now(session)
            due_job = session.scalar(
                select(JobRow.id).where(JobRow.expires_at < now, JobRow.deleted_at.is_(None)).limit(1)
            )
            due_upload = session.scalar(
                select(UploadRow.id).where(UploadRow.expires_at < now, UploadRow.deleted_at.is_(None), ~in_use).limit(1)
            )
        if due_job is None and due_upload is None:
            return
        with self.database.write() as session:
            session.execute(
                update(JobRow)
                .where(JobRow.expires_at < now, JobRow.deleted_at.is_(None), JobRow.state.in_(TERMINAL))
                .values(deleted_at=now)
            )
            session.execute(
                update(UploadRow)
                .where(UploadRow.expires_at < now, UploadRow.deleted_at.is_(None), ~in_use)
                .values(deleted_at=now)
            )

    def purge(self) -> int:
        """Remove the blobs of hidden rows. -> how many rows were done."""
        with self.database.read() as session:
            jobs = session.scalars(select(JobRow.id).where(_hidden(JobRow)).limit(BATCH)).all()
            uploads = session.scalars(select(UploadRow.id).where(_hidden(UploadRow)).limit(BATCH)).all()
        for job_id in jobs:
            self.blobs.delete_prefix(keys.job_prefix(job_id))
            self._done(JobRow, job_id)
        for upload_id in uploads:
            self.blobs.drop_partial(keys.scan_key(upload_id))
            self.blobs.delete_prefix(keys.scan_prefix(upload_id))
            self._done(UploadRow, upload_id)
        return len(jobs) + len(uploads)

    def _done(self, table: type[JobRow] | type[UploadRow], row_id: str) -> None:
        with self.database.write() as session:
            session.execute(update(table).where(table.id == row_id).values(purged_at=self.database.now(session)))


def _hidden(table: type[JobRow] | type[UploadRow]) -> ColumnElement[bool]:
    return and_(table.deleted_at.is_not(None), table.purged_at.is_(None))

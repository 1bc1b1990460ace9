"""Letting go of what has expired or was deleted: the row is hidden first, the blobs follow."""

from __future__ import annotations

from sqlalchemy import ColumnElement, and_, exists, select, update

from advtex_contract.jobs import TERMINAL
from advtex_store import keys
from advtex_store.blobs import Blobs
from advtex_store.database import Database
from advtex_store.ids import ID, created_at
from advtex_store.models import KEPT, UNPURGED, UNTIDY, JobRow, UploadRow
from advtex_store.troubles import PURGE, SWEEP, TIDY, Troubles, not_aside

BATCH = 100
HIDDEN = 1000  # rows at a time
ORPHAN_SECONDS = 7 * 86400.0  # what has no row is kept so long: time to notice that the database is an older one
SETTLED_SECONDS = 600.0  # after a job's end; attempts that lost it have noticed by then


class Retention:
    """Every step can be repeated, and by several servers at once; what fails for one item stops no other."""

    def __init__(self, database: Database, blobs: Blobs) -> None:
        self.database = database
        self.blobs = blobs
        self.troubles = Troubles(database, blobs)

    def expire(self) -> None:
        """Hide ended jobs, and uploads without a job, that are past the time that was announced for them: the first
        few hundred, so that a long night's jobs are not hidden in one transaction."""
        in_use = exists().where(JobRow.upload_id == UploadRow.id, JobRow.deleted_at.is_(None))
        self._hide(JobRow, JobRow.state.in_(TERMINAL))
        self._hide(UploadRow, ~in_use)

    def _hide(self, table: type[JobRow] | type[UploadRow], condition: ColumnElement[bool]) -> None:
        with self.database.read() as session:
            now = self.database.now(session)
            due = and_(table.expires_at < now, KEPT, condition)
            ids = session.scalars(select(table.id).where(due).order_by(table.expires_at).limit(HIDDEN)).all()
        if ids:
            with self.database.write() as session:
                session.execute(update(table).where(table.id.in_(ids), due).values(deleted_at=now))

    def purge(self) -> int:
        """Remove the blobs of hidden rows, as far as they can be removed. -> how many rows were looked at."""
        with self.database.read() as session:
            now = self.database.now(session)
            jobs = session.scalars(select(JobRow.id).where(_hidden(JobRow, now)).limit(BATCH)).all()
            uploads = session.scalars(select(UploadRow.id).where(_hidden(UploadRow, now)).limit(BATCH)).all()
        for job_id in jobs:
            with self.troubles.of(PURGE, job_id):
                self.blobs.delete_prefix(keys.job_prefix(job_id))
                self._done(JobRow, job_id)
        for upload_id in uploads:
            with self.troubles.of(PURGE, upload_id):
                self.blobs.drop_partial(keys.scan_key(upload_id))
                self.blobs.delete_prefix(keys.scan_prefix(upload_id))
                self._done(UploadRow, upload_id)
        return len(jobs) + len(uploads)

    def tidy(self) -> int:
        """Remove what attempts of succeeded jobs left that is no part of the result. -> how many jobs were looked at.

        A result never changes, so nothing that a later attempt may write here is wanted either.
        """
        with self.database.read() as session:
            now = self.database.now(session)
            query = select(JobRow).where(UNTIDY, JobRow.finished_at < now - SETTLED_SECONDS)
            rows = session.scalars(query.where(not_aside(TIDY, JobRow.id, now)).limit(BATCH)).all()
        for row in rows:
            with self.troubles.of(TIDY, row.id):
                self._tidy(row)
        return len(rows)

    def _tidy(self, row: JobRow) -> None:
        kept = {entry["key"] for entry in row.results}
        for prefix in (keys.checkpoints_prefix(row.id), keys.live_prefix(row.id), keys.results_prefix(row.id)):
            for info in list(self.blobs.list(prefix)):
                if info.key not in kept:
                    self.blobs.delete(info.key)
        with self.database.write() as session:
            session.execute(update(JobRow).where(JobRow.id == row.id).values(tidied_at=self.database.now(session)))

    def sweep(self) -> int:
        """Remove the blobs of uploads and jobs that have no row, or one that is purged. -> how many there were.

        Never removes what a row refers to: a row is committed before the first blob below its id is written, and ids do
        not come back. So an id that was seen among the blobs and then, later, has no row has lost it for good, unless
        the database is an older one that was put back: what has no row is kept for ORPHAN_SECONDS. Folders that are
        named otherwise are somebody else's.
        """
        swept = 0
        tables: tuple[tuple[str, type[JobRow] | type[UploadRow]], ...] = ((keys.SCANS, UploadRow), (keys.JOBS, JobRow))
        for prefix, table in tables:
            found = [name for name in self.blobs.folders(prefix) if ID.fullmatch(name)]
            for start in range(0, len(found), BATCH):
                ids = found[start : start + BATCH]
                with self.database.read() as session:
                    now = self.database.now(session)
                    rows = session.execute(select(table.id, table.purged_at).where(table.id.in_(ids)))
                    known = {row_id: purged_at for row_id, purged_at in rows}  # noqa: C416
                old = {found_id for found_id in ids if now - created_at(found_id) >= ORPHAN_SECONDS}
                for orphan in (i for i in ids if (known[i] is not None if i in known else i in old)):
                    with self.troubles.of(SWEEP, orphan):
                        if table is UploadRow:
                            self.blobs.drop_partial(keys.scan_key(orphan))
                        self.blobs.delete_prefix(f"{prefix}{orphan}/")
                        swept += 1
        return swept + self._sweep_multiparts(keys.SCANS, UploadRow) + self._sweep_multiparts(keys.JOBS, JobRow)

    def _sweep_multiparts(self, prefix: str, table: type[JobRow] | type[UploadRow]) -> int:
        """Abort multipart uploads whose writers died: of rows that are gone or need no more bytes, and those that
        another one has taken the place of. -> how many

        A writer that begins one this moment has its row, which is looked at later. All rows end, so in the end nothing
        is left.
        """
        swept = 0
        for found in list(self.blobs.unpublished(prefix)):
            row_id = found.key.removeprefix(prefix).partition("/")[0]
            if ID.fullmatch(row_id) and (found.superseded or not self._needs_bytes(table, row_id)):
                with self.troubles.of(SWEEP, row_id):
                    self.blobs.abort(found)
                    swept += 1
        return swept

    def _needs_bytes(self, table: type[JobRow] | type[UploadRow], row_id: str) -> bool:
        with self.database.read() as session:
            if table is UploadRow:
                upload = session.get(UploadRow, row_id)
                if upload is None:
                    return self.database.now(session) - created_at(row_id) < ORPHAN_SECONDS
                return upload.purged_at is None and upload.sha256 is None
            job = session.get(JobRow, row_id)
            if job is None:
                return self.database.now(session) - created_at(row_id) < ORPHAN_SECONDS
            if job.purged_at is not None:
                return False
            return job.finished_at is None or self.database.now(session) - job.finished_at < SETTLED_SECONDS

    def _done(self, table: type[JobRow] | type[UploadRow], row_id: str) -> None:
        with self.database.write() as session:
            session.execute(update(table).where(table.id == row_id).values(purged_at=self.database.now(session)))


def _hidden(table: type[JobRow] | type[UploadRow], now: float) -> ColumnElement[bool]:
    return and_(UNPURGED, not_aside(PURGE, table.id, now))

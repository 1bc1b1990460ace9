"""Upload rows. The bytes are in the blob storage; a row is complete once its sha256 is set."""

from __future__ import annotations

from sqlalchemy import exists, select, update

from advtex_store.database import Database
from advtex_store.errors import IllegalTransition, RecordNotFound
from advtex_store.ids import new_id
from advtex_store.models import JobRow, UploadRow

INCOMPLETE_SECONDS = 86400.0  # an upload that is not finished by then is forgotten


class Uploads:
    """Scans on their way in."""

    def __init__(self, database: Database, *, retention_seconds: int = 30 * 86400) -> None:
        self.database = database
        self.retention_seconds = retention_seconds

    def create(self, owner: str, size: int, filename: str = "") -> UploadRow:
        """A row for `size` bytes to come."""
        with self.database.write() as session:
            now = self.database.now(session)
            row = UploadRow(
                id=new_id(now),
                owner=owner,
                size=size,
                offset=0,
                filename=filename[:255],
                created_at=now,
                expires_at=now + INCOMPLETE_SECONDS,
            )
            session.add(row)
            return row

    def upload(self, upload_id: str, owner: str | None = None) -> UploadRow:
        """The row, or RecordNotFound."""
        with self.database.read() as session:
            query = select(UploadRow).where(UploadRow.id == upload_id, UploadRow.deleted_at.is_(None))
            if owner is not None:
                query = query.where(UploadRow.owner == owner)
            row = session.scalar(query)
            if row is None:
                raise RecordNotFound(f"there is no upload {upload_id}")
            return row

    def advance(self, upload_id: str, offset: int) -> None:
        """The first `offset` bytes are on disk."""
        with self.database.write() as session:
            session.execute(update(UploadRow).where(UploadRow.id == upload_id).values(offset=offset))

    def finish(self, upload_id: str, sha256: str) -> UploadRow:
        """The blob is durable. Finishing again with the same sha256 changes nothing."""
        with self.database.write() as session:
            row = session.scalar(select(UploadRow).where(UploadRow.id == upload_id).with_for_update())
            if row is None or row.deleted_at is not None:
                raise RecordNotFound(f"there is no upload {upload_id}")
            if row.sha256 not in (None, sha256):
                raise IllegalTransition(f"upload {upload_id} is complete with other bytes")
            row.sha256, row.offset = sha256, row.size
            row.expires_at = self.database.now(session) + self.retention_seconds
            return row

    def discard(self, upload_id: str) -> None:
        """Forget an upload that was cut off; nothing of it is kept."""
        with self.database.write() as session:
            row = session.get(UploadRow, upload_id)
            if row is not None:
                session.delete(row)

    def delete(self, upload_id: str, owner: str | None = None) -> None:
        """Hide an upload that no job needs any more; its blob follows."""
        with self.database.write() as session:
            query = select(UploadRow).where(UploadRow.id == upload_id, UploadRow.deleted_at.is_(None))
            if owner is not None:
                query = query.where(UploadRow.owner == owner)
            row = session.scalar(query.with_for_update())
            if row is None:
                raise RecordNotFound(f"there is no upload {upload_id}")
            if session.scalar(select(exists().where(JobRow.upload_id == upload_id, JobRow.deleted_at.is_(None)))):
                raise IllegalTransition(f"upload {upload_id} belongs to a job: delete the job first")
            row.deleted_at = self.database.now(session)

"""Upload rows. The bytes are in the blob storage; a row is complete once its sha256 is set."""

from __future__ import annotations

import secrets
from collections.abc import Callable

from sqlalchemy import ColumnElement, and_, delete, exists, func, select, update

from advtex_store.accounts import lock_owner
from advtex_store.database import Database
from advtex_store.errors import IllegalTransition, QuotaExceeded, RecordNotFound, Superseded
from advtex_store.ids import new_id
from advtex_store.models import JobRow, UploadRow

INCOMPLETE_SECONDS = 86400.0  # an upload is forgotten this long after its last bytes
FOUND = 20  # of the uploads with the same bytes, the most useful ones


class Uploads:
    """Scans on their way in."""

    def __init__(self, database: Database, *, retention_seconds: int = 30 * 86400) -> None:
        self.database = database
        self.retention_seconds = retention_seconds

    def create(
        self,
        owner: str,
        size: int,
        filename: str = "",
        *,
        announced_sha256: str | None = None,
        tus_metadata: str = "",
        max_bytes: int | None = None,
        admit: Callable[[int], None] = lambda _: None,
    ) -> UploadRow:
        """A row for `size` bytes to come. QuotaExceeded: the owner would then have more than `max_bytes`.

        admit: called with the bytes that unfinished uploads still expect, all owners' together; refuses by raising.
        """
        with self.database.write() as session:
            lock_owner(session, owner)
            held = session.scalar(
                select(func.sum(UploadRow.size)).where(UploadRow.owner == owner, UploadRow.deleted_at.is_(None))
            )
            if max_bytes is not None and int(held or 0) + size > max_bytes:
                raise QuotaExceeded(
                    f"uploads of {int(held or 0)} bytes are kept and this key may have {max_bytes}, "
                    f"so {size} more do not fit: delete jobs and uploads that are no longer needed"
                )
            expected = session.scalar(select(func.sum(UploadRow.size - UploadRow.offset)).where(_unfinished()))
            admit(int(expected or 0))
            now = self.database.now(session)
            row = UploadRow(
                id=new_id(now),
                owner=owner,
                size=size,
                offset=0,
                filename=filename[:255],
                announced_sha256=announced_sha256,
                tus_metadata=tus_metadata,
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

    def digest(self, upload_id: str) -> str | None:
        """The SHA-256 of a complete upload's bytes, in hexadecimal digits; None if it is not complete, or gone."""
        with self.database.read() as session:
            found: str | None = session.scalar(select(UploadRow.sha256).where(UploadRow.id == upload_id))
            return found

    def distrust(self, upload_id: str) -> None:
        """`find` finds it no more: whoever has its bytes sends them anew. They stay, should the storage be mended."""
        with self.database.write() as session:
            session.execute(update(UploadRow).where(UploadRow.id == upload_id).values(announced_sha256=None))

    def find(self, owner: str, sha256: str) -> list[UploadRow]:
        """Uploads that have these bytes, or are to have them: complete ones first, then those that came farthest."""
        with self.database.read() as session:
            query = (
                select(UploadRow)
                .where(UploadRow.owner == owner, UploadRow.announced_sha256 == sha256, UploadRow.deleted_at.is_(None))
                .where(UploadRow.expires_at > self.database.now(session))
                .order_by(UploadRow.sha256.is_(None), UploadRow.offset.desc(), UploadRow.id)
            )
            return list(session.scalars(query.limit(FOUND)))

    def seize(self, upload_id: str, owner: str) -> UploadRow:
        """Take an unfinished upload over from whichever request has it. RecordNotFound; Superseded: it is complete."""
        with self.database.write() as session:
            row: UploadRow | None = session.scalar(
                update(UploadRow)
                .where(UploadRow.id == upload_id, UploadRow.owner == owner, _unfinished())
                .values(holder=secrets.token_hex(8))
                .returning(UploadRow),
                execution_options={"populate_existing": True, "synchronize_session": False},
            )
            if row is None:
                is_whole = (UploadRow.owner == owner, UploadRow.sha256.is_not(None), UploadRow.deleted_at.is_(None))
                if session.scalar(select(UploadRow.id).where(UploadRow.id == upload_id, *is_whole)):
                    raise Superseded(f"upload {upload_id} is complete")
                raise RecordNotFound(f"there is no unfinished upload {upload_id}")
            return row

    def check_held(self, upload_id: str, holder: str) -> None:
        """Superseded: another request has the upload now, or it is complete, or it was deleted."""
        with self.database.read() as session:
            held = (UploadRow.id == upload_id, UploadRow.holder == holder, _unfinished())
            if session.scalar(select(UploadRow.id).where(*held)) is None:
                raise _superseded(upload_id)

    def advance(self, upload_id: str, holder: str, offset: int) -> float:
        """The first `offset` bytes are durable. -> when the upload expires. Superseded: another request has it now."""
        with self.database.write() as session:
            expires_at = self.database.now(session) + INCOMPLETE_SECONDS
            advanced = session.scalar(
                update(UploadRow)
                .where(UploadRow.id == upload_id, UploadRow.holder == holder, _unfinished())
                .values(offset=offset, kept_by=holder, expires_at=expires_at)
                .returning(UploadRow.id)
            )
            if advanced is None:
                raise _superseded(upload_id)
            return expires_at

    def finish(
        self, upload_id: str, sha256: str, kept_by: str | None = None, traceparent: str | None = None
    ) -> UploadRow:
        """The blob is durable. Finishing again with the same sha256 changes nothing.

        kept_by: the request that told of all its bytes, None if they came by none. Whoever then gives the blob its name
        may finish it; Superseded: the row tells of another request's bytes.
        """
        with self.database.write() as session:
            row = session.scalar(select(UploadRow).where(UploadRow.id == upload_id).with_for_update())
            if row is None or row.deleted_at is not None:
                raise RecordNotFound(f"there is no upload {upload_id}")
            if row.sha256 == sha256:
                return row
            if row.sha256 is not None:
                raise IllegalTransition(f"upload {upload_id} is complete with other bytes")
            if row.kept_by != kept_by:
                raise _superseded(upload_id)
            row.sha256, row.announced_sha256, row.offset, row.holder = sha256, sha256, row.size, None
            row.expires_at = self.database.now(session) + self.retention_seconds
            row.traceparent = traceparent
            return row

    def expected_bytes(self) -> int:
        """What unfinished uploads still wait for: room that is promised."""
        with self.database.read() as session:
            query = select(func.sum(UploadRow.size - UploadRow.offset)).where(_unfinished())
            return int(session.scalar(query) or 0)

    def discard(self, upload_id: str, holder: str | None) -> bool:
        """Forget an upload that cannot be completed, None for one that no request has seized yet.

        -> whether that was done: not if another request has it now, or if it is complete
        """
        with self.database.write() as session:
            mine = (UploadRow.id == upload_id, UploadRow.holder == holder, UploadRow.sha256.is_(None))
            return session.scalar(delete(UploadRow).where(*mine).returning(UploadRow.id)) is not None

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


def _superseded(upload_id: str) -> Superseded:
    return Superseded(f"a newer request goes on with upload {upload_id}, or it was deleted")


def _unfinished() -> ColumnElement[bool]:
    return and_(UploadRow.sha256.is_(None), UploadRow.source.is_(None), UploadRow.deleted_at.is_(None))

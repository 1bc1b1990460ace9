"""Jobs as overviews show them: without the parts of a row that can be long."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import Select, select
from sqlalchemy.orm import load_only

from advtex_store.database import Database
from advtex_store.models import JobRow
from advtex_store.submissions import JobFilter

MOST_CHANGED = 1000  # rows; whoever was away longer than that many changes looks at the newest


class Overviews:
    """Rows that have no `results`, `warnings` and `log_tail`: to touch these raises."""

    def __init__(self, database: Database) -> None:
        self.database = database

    def jobs(
        self, owner: str, wanted: JobFilter, cursor: str | None, limit: int
    ) -> tuple[Sequence[JobRow], str | None]:
        """A page of jobs, newest first, and the cursor of the next one. The label need only be contained."""
        query = _short().where(JobRow.owner == owner, JobRow.deleted_at.is_(None))
        if wanted.state is not None:
            query = query.where(JobRow.state == wanted.state)
        if wanted.label is not None:
            query = query.where(JobRow.label.icontains(wanted.label, autoescape=True))
        if wanted.batch is not None:
            query = query.where(JobRow.batch == wanted.batch)
        if cursor is not None:
            query = query.where(JobRow.id < cursor)
        with self.database.read() as session:
            rows = session.scalars(query.order_by(JobRow.id.desc()).limit(limit + 1)).all()
        return rows[:limit], rows[limit - 1].id if len(rows) > limit else None

    def changed(self, owner: str, since: float) -> list[JobRow]:
        """Changed after a time on the database's clock, deleted ones too, in the order of their changes."""
        query = _short().where(JobRow.owner == owner, JobRow.updated_at > since)
        with self.database.read() as session:
            rows = session.scalars(query.order_by(JobRow.updated_at.desc()).limit(MOST_CHANGED)).all()
        return list(reversed(rows))

    def now(self) -> float:
        """The database's clock."""
        with self.database.read() as session:
            return self.database.now(session)


def _short() -> Select[JobRow]:
    columns = (
        JobRow.id,
        JobRow.state,
        JobRow.label,
        JobRow.batch,
        JobRow.options,
        JobRow.progress,
        JobRow.waiting_reason,
        JobRow.error,
        JobRow.created_at,
        JobRow.updated_at,
        JobRow.finished_at,
        JobRow.deleted_at,
    )
    return select(JobRow).options(load_only(*columns, raiseload=True))

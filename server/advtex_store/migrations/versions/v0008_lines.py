"""Indexes with which a look costs what it finds: who is next, what has expired, what is to be removed."""

from __future__ import annotations

from collections.abc import Sequence

import sqlalchemy as sa
from alembic import op

revision = "0008"
down_revision = "0007"
branch_labels = None
depends_on = None

KEPT = "deleted_at is null"
WAITS_IN_LINE = "state || '' in ('preempted', 'queued') and deleted_at is null"
WAITS_FOR_A_REASON = "'' || state in ('preempted', 'queued') and deleted_at is null"
UNTIDY = "state = 'succeeded' and tidied_at is null and deleted_at is null"
UNPURGED = "deleted_at is not null and purged_at is null"

Columns = Sequence[str | sa.TextClause]
NEW: dict[str, tuple[str, Columns, str]] = {
    "ix_jobs_line": ("jobs", ["owner", "memory_gib", "state", sa.text("priority desc"), "id"], WAITS_IN_LINE),
    "ix_jobs_reason": ("jobs", ["memory_gib", "waiting_reason"], WAITS_FOR_A_REASON),
    "ix_jobs_expires_at": ("jobs", ["expires_at"], KEPT),
    "ix_jobs_untidy": ("jobs", ["finished_at"], UNTIDY),
    "ix_jobs_unpurged": ("jobs", ["id"], UNPURGED),
    "ix_uploads_unpurged": ("uploads", ["id"], UNPURGED),
}
NARROWED: dict[str, tuple[str, Columns]] = {
    "ix_jobs_state_id": ("jobs", ["state", "id"]),
    "ix_uploads_expires_at": ("uploads", ["expires_at"]),
}


def upgrade() -> None:
    # Computed, so that it is right in the rows of older servers too. SQLite can only add a column that is not stored.
    stored = op.get_bind().dialect.name == "postgresql"
    gib = sa.Computed("(memory_bytes + 1073741823) / 1073741824", persisted=stored)
    op.add_column("jobs", sa.Column("memory_gib", sa.BigInteger(), gib, nullable=False))
    for name, (table, columns) in NARROWED.items():
        op.drop_index(name, table)
        _create(name, table, columns, KEPT)
    for name, (table, columns, where) in NEW.items():
        _create(name, table, columns, where)


def downgrade() -> None:
    for name, (table, _, _) in NEW.items():
        op.drop_index(name, table)
    for name, (table, columns) in NARROWED.items():
        op.drop_index(name, table)
        op.create_index(name, table, columns)
    op.drop_column("jobs", "memory_gib")


def _create(name: str, table: str, columns: Columns, where: str) -> None:
    op.create_index(name, table, columns, postgresql_where=sa.text(where), sqlite_where=sa.text(where))

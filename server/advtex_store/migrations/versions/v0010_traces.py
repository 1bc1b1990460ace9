"""Traces of uploads and jobs; and an index of what has ended, for looks at the last day."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0010"
down_revision = "0009"
branch_labels = None
depends_on = None

ENDED = "finished_at is not null and deleted_at is null"


def upgrade() -> None:
    for table in ("uploads", "jobs"):
        op.add_column(table, sa.Column("traceparent", sa.String(255), nullable=True))
    where = sa.text(ENDED)
    op.create_index("ix_jobs_finished_at", "jobs", ["finished_at"], postgresql_where=where, sqlite_where=where)


def downgrade() -> None:
    op.drop_index("ix_jobs_finished_at", "jobs")
    for table in ("uploads", "jobs"):
        op.drop_column(table, "traceparent")

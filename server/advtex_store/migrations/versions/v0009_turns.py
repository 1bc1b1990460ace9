"""Deadlines, what is said of a batch as a whole, how many jobs run at a time, and lines of each batch and priority."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0009"
down_revision = "0008"
branch_labels = None
depends_on = None

WAITS_FOR_ITS_TURN = "'' || state || '' in ('preempted', 'queued') and deleted_at is null"
COMPUTED = {
    "due": (sa.Double(), "coalesce(deadline, created_at + 604800.0)"),
    "line": (sa.Text(), "cast(priority as text) || '/' || coalesce(batch, '') || '/' || owner"),
}


def upgrade() -> None:
    op.create_table(
        "batches",
        sa.Column("owner", sa.String(length=255), nullable=False),
        sa.Column("id", sa.String(length=255), nullable=False),
        sa.Column("paused_at", sa.Double(), nullable=True),
        sa.Column("max_running", sa.Integer(), nullable=True),
        sa.Column("updated_at", sa.Double(), nullable=False),
        sa.PrimaryKeyConstraint("owner", "id"),
    )
    op.add_column("api_keys", sa.Column("max_running_jobs", sa.Integer(), nullable=True))
    op.add_column("jobs", sa.Column("deadline", sa.Double(), nullable=True))
    # Computed, so that they are right in older servers' rows too. SQLite can only add columns that are not stored.
    stored = op.get_bind().dialect.name == "postgresql"
    for name, (kind, how) in COMPUTED.items():
        op.add_column("jobs", sa.Column(name, kind, sa.Computed(how, persisted=stored), nullable=False))
    where = sa.text(WAITS_FOR_ITS_TURN)
    columns = ["line", "memory_gib", "state", "due", "id"]
    op.create_index("ix_jobs_turn", "jobs", columns, postgresql_where=where, sqlite_where=where)


def downgrade() -> None:
    op.drop_index("ix_jobs_turn", "jobs")
    for name in (*COMPUTED, "deadline"):
        op.drop_column("jobs", name)
    op.drop_column("api_keys", "max_running_jobs")
    op.drop_table("batches")
